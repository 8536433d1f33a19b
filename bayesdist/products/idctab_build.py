"""An IDCTAB from a solution, with the sigmas and the covariance of all it holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution
from bayesdist.errors import InputError
from bayesdist.products.blocks import blocks_of
from bayesdist.products.cards import convergence_cards, number_card, text_card
from bayesdist.products.idctab import IdcTab
from bayesdist.products.idctab_numbers import ChipNumbers, check_time, chip_numbers
from bayesdist.products.parity import parity_of
from bayesdist.products.sip_build import ARCSEC

__all__ = ["idctab_from_solution"]

Float = NDArray[np.float64]
Combinations = list[tuple[str, ...]]


def idctab_from_solution(
    solution: Solution,
    *,
    instrument: str,
    detector: str,
    scale_arcsec: float | None = None,
    v2ref: float = 0.0,
    v3ref: float = 0.0,
    v2v3: str = "aperture",
    vafactor: float = 1.0,
    filters: Sequence[str] | Sequence[Sequence[str]] | None = None,
    useafter: str | None = None,
    pedigree: str | None = None,
    description: str = "Geometric distortion with its uncertainty, by bayesdist",
    chips: Sequence[int] | None = None,
) -> IdcTab:
    """IDCTAB of all chips of a solution, in the frame of its first exposure.

    Everything is divided by `vafactor`, since stwcs multiplies the sky by that of each exposure.
    The constant of each chip goes to its V2REF and V3REF (and is noted in BDU0_c, BDV0_c), since
    stwcs never uses CX00 and CY00.  A file for ACS/WFC always has TDD_DATE and TDD_CTB1, TDD_CTB2,
    without which stwcs would apply a drift of its own.

    Parameters
    ----------
    solution : LinearFit or Posterior
    instrument, detector : str
        INSTRUME and DETECTOR, as "ACS" and "WFC".
    scale_arcsec : float, optional
        Arcseconds per pixel: needed for u, v in pixels.  Written as SCALE; without it the mean
        scale of all chips at their reference pixels.
    v2ref, v3ref : float
        V2 and V3 of (u, v) = (0, 0), arcseconds.
    v2v3 : {'aperture'}
        How (u, v) lie: 'aperture' means along the ideal axes of the aperture, Xc = u and Yc = v.
    vafactor : float
        Velocity-aberration factor that the positions (u, v) still contain.
    filters : sequence, optional
        One combination, as ``("F606W", "CLEAR2L")``, or a sequence of such: a row for each, all
        with the same coefficients.  Two names (ACS) make columns FILTER1 and FILTER2, one makes
        FILTER.  Without filters there are no such columns, and the rows serve every filter.
    useafter, pedigree : str, optional
        USEAFTER ("Mar 01 2002 00:00:00") and PEDIGREE ("INFLIGHT 01/05/2006"), which only the user
        knows.
    description : str
        DESCRIP.
    chips : sequence of int, optional
        Chip numbers; all by default.

    Returns
    -------
    IdcTab
        In doubles, with HDUs SIGMA and COVAR (see `bayesdist.products.idctab`).

    Raises
    ------
    InputError
        For an unknown detector or chip, a missing scale, filters of different kinds, or
        time-dependent terms that an IDCTAB cannot store (see `check_time`).
    DegenerateError
        When the linear part of a chip is singular.

    Notes
    -----
    TDD_DATE is the reference date of the fit.  stwcs dates an exposure by year + day of year /
    365.25, which is within about a day of the decimal year.
    """
    model = solution.model
    parity = parity_of(instrument, detector)
    if v2v3 != "aperture":
        raise InputError(f"v2v3 is {v2v3!r}", where="products.idctab.v2v3", do="choose 'aperture'")
    _check_positive(vafactor, "vafactor")
    acs_wfc = (instrument, detector) == ("ACS", "WFC")
    check_time(model, acs_wfc=acs_wfc)
    combinations = _combinations(filters, instrument)
    factor = _arcsec(model.unit, scale_arcsec) / vafactor
    numbers = tuple(c.number for c in model.chips) if chips is None else tuple(chips)
    if not numbers:
        raise InputError("no chip is given", where="chips", do="name at least one")
    fitted = [
        chip_numbers(solution, n, factor=factor, parity=parity, zero=(v2ref, v3ref))
        for n in numbers
    ]
    jacobian = np.concatenate([f.jacobian for f in fitted])
    cov = jacobian @ np.asarray(solution.cov, float) @ jacobian.T
    scale = _mean_scale(fitted) if scale_arcsec is None else scale_arcsec

    primary = fits.PrimaryHDU()
    for card in [
        text_card("INSTRUME", instrument),
        text_card("DETECTOR", detector),
        number_card("NORDER", model.order, "order of the polynomials"),
        number_card("PARITY", parity[0] * parity[1]),
        text_card("FILETYPE", "DISTORTION COEFFICIENTS"),
        text_card("DESCRIP", description),
        *([text_card("USEAFTER", useafter)] if useafter else []),
        *([text_card("PEDIGREE", pedigree)] if pedigree else []),
        *(_tdd_cards(fitted, model.time.epoch0[0] if model.time else None) if acs_wfc else ()),
        *_provenance_cards(fitted, vafactor, model.unit),
        *convergence_cards(solution),
    ]:
        primary.header.append(fits.Card.fromstring(card), end=True)
    hdus = [
        primary,
        _coefficient_hdu(fitted, combinations, scale),
        _sigma_hdu(fitted, combinations, cov),
        _covariance_hdu(fitted, cov),
    ]
    return IdcTab(blocks_of(hdus), "new IDCTAB")


# -- checks and scales ---------------------------------------------------------------------------


def _check_positive(value: float, name: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(
            f"{name} is {value}", where=f"products.idctab.{name}", do="give a positive number"
        )


def _arcsec(unit: str, scale_arcsec: float | None) -> float:
    """Arcseconds in one unit of u, v."""
    if scale_arcsec is not None:
        _check_positive(scale_arcsec, "scale_arcsec")
    if unit != "pix":
        return ARCSEC[unit]
    if scale_arcsec is None:
        raise InputError(
            "u and v are in pixels, and an IDCTAB is in arcseconds",
            where="detector.scale_mas",
            do="give the pixel scale",
        )
    return scale_arcsec


def _mean_scale(fitted: Sequence[ChipNumbers]) -> float:
    """Mean arcseconds per pixel; stwcs keeps 8 decimals."""
    areas = [
        f.column("CX11") * f.column("CY10") - f.column("CX10") * f.column("CY11") for f in fitted
    ]
    return round(float(np.mean(np.sqrt(np.abs(areas)))), 8)


def _combinations(
    filters: Sequence[str] | Sequence[Sequence[str]] | None, instrument: str
) -> Combinations:
    """Filter names of each row of a chip; one empty combination where rows serve all filters."""
    if not filters:
        return [()]
    flat = all(isinstance(f, str) for f in filters)
    out = [tuple(map(str, filters))] if flat else [tuple(map(str, f)) for f in filters]
    wanted = 2 if instrument == "ACS" else 1
    for names in out:
        if len(names) != wanted:
            raise InputError(
                f"the filter combination {names} has {len(names)} names",
                where="products.idctab.filters",
                do=f"give {wanted} for {instrument}, one for each wheel",
            )
    return out


# -- the HDUs ------------------------------------------------------------------------------------


def _per_row(fitted: Sequence[ChipNumbers], combinations: Combinations) -> list[ChipNumbers]:
    """What stands in each row: the chips in turn, for one filter combination after the other."""
    return [f for _ in combinations for f in fitted]


def _key_columns(fitted: Sequence[ChipNumbers], combinations: Combinations) -> list[fits.Column]:
    rows = _per_row(fitted, combinations)
    names = [combination for combination in combinations for _ in fitted]
    columns = [
        fits.Column("DETCHIP", "1I", unit="chip", array=np.array([f.chip.number for f in rows])),
        fits.Column("DIRECTION", "8A", array=np.array(["FORWARD"] * len(rows))),
    ]
    labels = ("FILTER1", "FILTER2") if len(combinations[0]) == 2 else ("FILTER",)
    for k, label in enumerate(labels[: len(combinations[0])]):
        width = max(8, *(len(n[k]) for n in names))
        columns.append(fits.Column(label, f"{width}A", array=np.array([n[k] for n in names])))
    return columns


def _coefficient_hdu(
    fitted: Sequence[ChipNumbers], combinations: Combinations, scale: float
) -> fits.BinTableHDU:
    rows = _per_row(fitted, combinations)

    def column(name: str, values: list[float], unit: str = "", form: str = "1D") -> fits.Column:
        return fits.Column(name, form, unit=unit or None, array=np.array(values))

    columns = _key_columns(fitted, combinations)
    for k, axis in enumerate("XY"):
        sizes = [int(f.chip.size[k]) for f in rows]
        columns.append(column(f"{axis}SIZE", sizes, "pixel", "1J"))
    for k, axis in enumerate("XY"):
        columns.append(column(f"{axis}REF", [f.chip.reference_pixel[k] for f in rows], "pixel"))
    for name in _column_names(fitted):
        if name == "CX10":
            columns.append(column("SCALE", [scale] * len(rows), "arcsec"))
        values = [f.column(name) for f in rows]
        if name == "CX11" and scale != 1.0:
            # stwcs takes exactly 1 as a sign that coefficients are in units of SCALE
            values = [np.nextafter(1.0, 0.0) if v == 1.0 else v for v in values]
        columns.append(column(name, values, _unit(name)))
    return fits.BinTableHDU.from_columns(columns)


def _sigma_hdu(
    fitted: Sequence[ChipNumbers], combinations: Combinations, cov: Float
) -> fits.BinTableHDU:
    deviations = np.sqrt(np.maximum(np.diag(cov), 0.0))  # -1e-40 is a rounded zero
    ends = np.cumsum([len(f.names) for f in fitted])[:-1]
    by_chip = [
        dict(zip(f.names, s.tolist(), strict=True))
        for f, s in zip(fitted, np.split(deviations, ends), strict=True)
    ]
    rows = [sigma for _ in combinations for sigma in by_chip]
    columns = _key_columns(fitted, combinations) + [
        fits.Column(name, "1D", unit=_unit(name), array=np.array([s[name] for s in rows]))
        for name in _column_names(fitted)
    ]
    hdu = fits.BinTableHDU.from_columns(columns, name="SIGMA")
    for sigma in by_chip:
        for name, value in sigma.items():
            if name.startswith("TDD"):
                card = number_card(name, value, "[arcsec/pix/yr] 1-sigma")
                hdu.header.append(fits.Card.fromstring(card), end=True)
    return hdu


def _covariance_hdu(fitted: Sequence[ChipNumbers], cov: Float) -> fits.BinTableHDU:
    return fits.BinTableHDU.from_columns(
        [
            fits.Column(
                "DETCHIP", "1I", array=np.array([f.chip.number for f in fitted for _ in f.names])
            ),
            fits.Column("PARAM", "8A", array=np.array([name for f in fitted for name in f.names])),
            fits.Column("VALUE", "1D", array=np.concatenate([f.values for f in fitted])),
            fits.Column("COV", f"{len(cov)}D", array=cov),
        ],
        name="COVAR",
    )


def _column_names(fitted: Sequence[ChipNumbers]) -> list[str]:
    return [name for name in fitted[0].names if not name.startswith("TDD")]


def _unit(name: str) -> str:
    if name.startswith("V"):
        return "arcsec"
    order = int(name[2])
    return "arcsec/pixel" if order == 1 else f"arcsec/pixel**{order}"


# -- the primary header --------------------------------------------------------------------------


def _tdd_cards(fitted: Sequence[ChipNumbers], epoch: float | None) -> list[str]:
    """Time-dependent terms of ACS/WFC in the scheme of 2015, zeros where none was fitted."""
    comment = "" if epoch is not None else "no time-dependent terms"
    cards = [number_card("TDD_DATE", 2004.5 if epoch is None else epoch, "[yr] reference date")]
    rates = {name: f.column(name) for f in fitted for name in f.names if name.startswith("TDD")}
    for chip in (1, 2):  # stwcs looks for TDD_CTB1 to know the scheme, whatever the chip
        rates.setdefault(f"TDD_CTB{chip}", 0.0)
    for name in sorted(rates):
        cards.append(number_card(name, rates[name], comment or "[arcsec/pix/yr]"))
    return cards


def _provenance_cards(fitted: Sequence[ChipNumbers], vafactor: float, unit: str) -> list[str]:
    cards = [
        text_card("CREATOR", "bayesdist"),
        number_card("BDVAFAC", float(vafactor), "VAFACTOR that was divided out"),
        text_card("BDUNIT", unit, "unit of u and v in the fit"),
    ]
    for f in fitted:
        for axis, value in zip("UV", f.constant, strict=True):
            keyword = f"BD{axis}0_{f.chip.number}"
            cards.append(number_card(keyword, float(value), "[arcsec] constant, now in V2/V3REF"))
    return cards
