"""An IDCTAB from solutions, with the sigmas and the covariance of all its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration, as_calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.products.formats.common.cards import (
    append_cards,
    convergence_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.formats.common.content import hdus_of
from bayesdist.products.formats.idctab.drift import rates_of
from bayesdist.products.formats.idctab.hdus import (
    Piece,
    closure_cards,
    coefficient_hdu,
    covariance_hdu,
    provenance_cards,
    sigma_hdu,
    tdd_cards,
)
from bayesdist.products.formats.idctab.hst import combination_of, parity_of
from bayesdist.products.formats.idctab.numbers import (
    ChipNumbers,
    check_time,
    chip_inverse,
    chip_numbers,
    joint_covariance,
)
from bayesdist.products.formats.idctab.table import IdcTab

Filter = str | tuple[str, ...]
Source = Solution | Calibration

DESCRIPTION = "Geometric distortion with its uncertainty, by bayesdist"


def idctab_from_solution(
    solution: Source | Mapping[Filter, Source],
    *,
    instrument: str,
    detector: str,
    scale_arcsec: float | None = None,
    v2ref: float = 0.0,
    v3ref: float = 0.0,
    vafactor: float = 1.0,
    filters: Sequence[str] | Sequence[Sequence[str]] | None = None,
    useafter: str | None = None,
    pedigree: str | None = None,
    description: str = DESCRIPTION,
    chips: Sequence[int] | None = None,
    inverse: bool = False,
    history: Sequence[str] = (),
) -> IdcTab:
    """IDCTAB of all chips of a solution, or of several filters with a solution each.

    Frames of exposures are left out: in gauge 'first' the polynomials are the first exposure's.
    Everything is divided by `vafactor`, since stwcs multiplies the sky by that of each exposure.
    The constant of each chip goes to its V2REF and V3REF (and is noted in BDU0_c, BDV0_c), since
    stwcs never uses CX00 and CY00.  A file for ACS/WFC always has TDD_DATE and TDD_CTB1, TDD_CTB2,
    without which stwcs would apply a drift of its own.

    stwcs applies one drift to all rows.  It is that of the first solution; the others must have the
    same reference date and rates, or none: then their constants are those of the reference date.

    Parameters
    ----------
    solution : Solution or Calibration, or mapping of filter to them
        A fit or a posterior, or the calibration of one.  The filter of a mapping is one name
        ("F814W", whose other wheel is clear), or a tuple with those of both wheels; filters with
        the very same solution object share its rows.
    instrument, detector : str
        INSTRUME and DETECTOR, as "ACS" and "WFC".
    scale_arcsec : float, optional
        Arcseconds per pixel: needed for u, v in pixels.  Written as SCALE; without it the mean
        scale of all chips at their reference pixels.
    v2ref, v3ref : float
        V2 and V3 of (u, v) = (0, 0), arcseconds.
    vafactor : float
        Velocity-aberration factor that the positions (u, v) still contain.
    filters : sequence, optional
        Of a single solution: one combination, as ``("F606W", "CLEAR2L")``, or a sequence of such: a
        row for each, all with the same coefficients.  Two names (ACS) make columns FILTER1 and
        FILTER2, one makes FILTER.  Without filters there are no such columns, and the rows serve
        every filter.
    useafter, pedigree : str, optional
        USEAFTER ("Mar 01 2002 00:00:00") and PEDIGREE ("INFLIGHT 01/05/2006"), which only the user
        knows.
    description : str
        DESCRIP.
    chips : sequence of int, optional
        Chip numbers; all by default.
    inverse : bool
        True to add INVERSE rows; their closure is stated as BDCLOS_c.
    history : sequence of str
        Lines for HISTORY.

    Returns
    -------
    IdcTab
        In doubles, with HDUs SIGMA and COVAR (see `bayesdist.products.formats.idctab.table`).
        COVAR names the filters where there are several solutions.  Solutions turned by the same
        orientation (`bayesdist.calibration.orientation`) have its error in common, as covariance
        between their blocks.

    Raises
    ------
    InputError
        For an unknown detector or chip, a missing scale, filters that are none, of different kinds
        or named twice, time-dependent terms that an IDCTAB cannot store (see `check_time`), and
        solutions of different orders or chips, or with a drift other than the first one's.
    DegenerateError
        When the linear part of a chip is singular.

    Notes
    -----
    TDD_DATE is the reference date of the fit.  stwcs dates an exposure by year + day of year /
    365.25, which is within about a day of the decimal year.

    Examples
    --------
    >>> from bayesdist.formats import idctab_from_solution
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> camera = {"instrument": "WFC3", "detector": "IR", "scale_arcsec": 0.13}
    >>> tab = idctab_from_solution(fit, **camera, filters=["F160W"])
    >>> [int(row["DETCHIP"]) for row in tab.rows]
    [1]
    """
    entries = _entries(solution, filters, instrument)
    first = entries[0][0]
    model = first.model
    parity = parity_of(instrument, detector)
    _check_positive(vafactor, "vafactor")
    acs_wfc = (instrument, detector) == ("ACS", "WFC")
    for other, combinations in entries:
        check_time(other.model, acs_wfc=acs_wfc)
        if other is not first:
            _check_alike(other, first, combinations[0])
    numbers = tuple(c.number for c in model.chips) if chips is None else tuple(chips)
    if not numbers:
        raise InputError("no chip is given", where="chips", do="name at least one")
    pieces = []
    for one, combinations in entries:
        factor = _arcsec(one.model.unit, scale_arcsec) / vafactor
        fitted = tuple(
            chip_numbers(one, n, factor=factor, parity=parity, zero=(v2ref, v3ref)) for n in numbers
        )
        if one is not first:  # the file stores the first one's drift
            fitted = tuple(chip.without_rates() for chip in fitted)
        back = tuple(chip_inverse(one, n, factor) for n in numbers) if inverse else ()
        pieces.append(Piece(combinations, fitted, back))
    cov = joint_covariance([one for one, _ in entries], [piece.fitted for piece in pieces])
    scale = _mean_scale(pieces[0].fitted) if scale_arcsec is None else scale_arcsec

    texts = {"DESCRIP": description, "USEAFTER": useafter, "PEDIGREE": pedigree}
    primary = fits.PrimaryHDU()
    cards = [
        text_card("INSTRUME", instrument),
        text_card("DETECTOR", detector),
        number_card("NORDER", model.order, "order of the polynomials"),
        number_card("PARITY", parity[0] * parity[1]),
        text_card("FILETYPE", "DISTORTION COEFFICIENTS"),
        *(text_card(keyword, text) for keyword, text in texts.items() if text),
        *tdd_cards(pieces[0].fitted, model.time.epoch0[0] if model.time else None, acs_wfc),
        *provenance_cards(pieces[0].fitted, vafactor, first),
        *closure_cards(pieces),
        *convergence_cards(first.solution),
        *wrapped_cards("HISTORY", history, 72),
    ]
    append_cards(primary, cards)
    hdus = [
        primary,
        coefficient_hdu(pieces, scale),
        sigma_hdu(pieces, cov),
        covariance_hdu(pieces, cov),
    ]
    return IdcTab(hdus_of(hdus), "new IDCTAB")


def _entries(
    solution: Source | Mapping[Filter, Source],
    filters: Sequence[str] | Sequence[Sequence[str]] | None,
    instrument: str,
) -> list[tuple[Calibration, tuple[tuple[str, ...], ...]]]:
    """Calibrations, each with the filter combinations of its rows; () for rows of all filters."""
    where = "products.idctab.filters"
    named: list[tuple[tuple[str, ...], Source]]
    if isinstance(solution, Mapping):
        if filters:
            raise InputError(
                "the filters are given twice", where=where, do="leave them to the solutions"
            )
        named = [(combination_of(filter, instrument), one) for filter, one in solution.items()]
        if not named:
            raise InputError("no filter is given", where="solutions", do="give at least one")
    elif not filters:
        return [(as_calibration(solution), ((),))]
    elif all(isinstance(f, str) for f in filters):
        named = [(tuple(map(str, filters)), solution)]
    else:
        named = [(tuple(map(str, names)), solution) for names in filters]
    wanted = 2 if instrument == "ACS" else 1
    out: dict[int, tuple[Calibration, list[tuple[str, ...]]]] = {}
    seen: set[tuple[str, ...]] = set()
    for names, one in named:
        if len(names) != wanted:
            raise InputError(
                f"the filter combination {names} has {len(names)} names",
                where=where,
                do=f"give {wanted} for {instrument}, one for each wheel",
            )
        if names in seen:
            raise InputError(
                f"the filter combination {names} stands twice", where=where, do="name each one once"
            )
        seen.add(names)
        if id(one) not in out:  # filters with the very same solution share its rows
            out[id(one)] = as_calibration(one), []
        out[id(one)][1].append(names)
    return [(one, tuple(combinations)) for one, combinations in out.values()]


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
            do="give the pixel scale (scale_mas in Python, --scale of convert)",
        )
    return scale_arcsec


def _mean_scale(fitted: Sequence[ChipNumbers]) -> float:
    """Mean arcseconds per pixel; stwcs keeps 8 decimals."""
    areas = [
        f.column("CX11") * f.column("CY10") - f.column("CX10") * f.column("CY11") for f in fitted
    ]
    return round(float(np.mean(np.sqrt(np.abs(areas)))), 8)


def _check_alike(
    calibration: Calibration, first: Calibration, combination: tuple[str, ...]
) -> None:
    """Refuse calibrations of different orders, chips or drifts: a file has one of each."""
    where = f"filters {' '.join(combination)}"
    a, b = calibration.model, first.model
    if a.order != b.order or a.chips != b.chips:
        raise InputError(
            "the solution has another order or other chips than the first one",
            where=where,
            do="fit all filters with one structure",
        )
    if a.time is None:
        return
    same = b.time is not None and a.time.epoch0 == b.time.epoch0
    if same:
        mine, theirs = (
            {
                (chip.number, term): rate
                for chip in one.model.chips
                for term, rate in rates_of(one.solution, chip.number)[0].items()
            }
            for one in (calibration, first)
        )
        scale = max(map(abs, theirs.values()), default=0.0)
        same = all(
            abs(mine.get(k, 0.0) - theirs.get(k, 0.0)) <= 1e-9 * scale for k in mine | theirs
        )
    if not same:
        raise InputError(
            "the solution drifts otherwise than the first one, and a file stores one drift",
            where=where,
            do="give it the same reference date and rates (`drift.storable`)",
        )
