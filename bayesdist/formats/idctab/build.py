"""Build an IDCTAB from solutions, with standard deviations and covariance of all its numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration, as_calibration
from bayesdist.calibration.plane import ARCSEC, Orientation
from bayesdist.errors import InputError
from bayesdist.formats.idctab.drift import rates_of
from bayesdist.formats.idctab.numbers import (
    ChipInverse,
    ChipNumbers,
    check_time,
    chip_inverse,
    chip_numbers,
    joint_covariance,
)
from bayesdist.formats.idctab.table import IdcTab, combination_of, parity_of
from bayesdist.infer.solution.solution import Solution
from bayesdist.products.common.cards import (
    append_cards,
    convergence_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.content import hdus_of
from bayesdist.utils.arrays import Float

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
    """Build an IDCTAB from a solution, or from one solution per filter.

    The frames of exposures are not stored: in the gauge 'first', the polynomials are those of the
    first exposure. All positions are divided by `vafactor`, because stwcs multiplies sky
    coordinates by the factor of each exposure. The constant term of each chip is moved to its V2REF
    and V3REF (and recorded in BDU0_c, BDV0_c), because stwcs ignores CX00 and CY00. A file for
    ACS/WFC always has TDD_DATE, TDD_CTB1 and TDD_CTB2; without them stwcs would apply a built-in
    drift.

    stwcs applies one drift to all rows, which is that of the first solution. The other solutions
    must either have the same reference date and rates, or no drift. In the latter case their
    coefficients are those of the reference date.

    Parameters
    ----------
    solution : Solution or Calibration, or mapping of filter to them
        A fit, a posterior, or the calibration made from one. The filter of a mapping is one name
        ("F814W", with the other wheel clear), or a tuple of the names in both wheels. Filters
        mapped to the same solution object share its rows.
    instrument, detector : str
        INSTRUME and DETECTOR, such as "ACS" and "WFC".
    scale_arcsec : float, optional
        Arcseconds per pixel; required if u and v are in pixels. It is written as SCALE. The default
        SCALE is the mean scale of all chips at their reference pixels.
    v2ref, v3ref : float
        V2 and V3 of (u, v) = (0, 0), arcseconds.
    vafactor : float
        Velocity-aberration factor that the positions (u, v) still contain.
    filters : sequence, optional
        Only for a single solution: one combination, such as ``("F606W", "CLEAR2L")``, or a sequence
        of combinations, which get one row each with the same coefficients. Two names (ACS) are
        written to columns FILTER1 and FILTER2, one name to FILTER. Without filters there are no
        such columns, and the rows are valid for every filter.
    useafter, pedigree : str, optional
        USEAFTER ("Mar 01 2002 00:00:00") and PEDIGREE ("INFLIGHT 01/05/2006"); omitted by default.
    description : str
        DESCRIP.
    chips : sequence of int, optional
        Chip numbers; all by default.
    inverse : bool
        True to add INVERSE rows. Their closure is written as BDCLOS_c.
    history : sequence of str
        Lines of HISTORY.

    Returns
    -------
    IdcTab
        IDCTAB in double precision, with HDUs SIGMA and COVAR (see
        `bayesdist.formats.idctab.table`). With several solutions, COVAR names the filters.
        The error of a common orientation (`bayesdist.calibration.orientation`) appears as
        covariance between the blocks of its solutions.

    Raises
    ------
    InputError
        If the detector or a chip is unknown, if the scale is missing, if filters are invalid, of
        different kinds or repeated, if there are time-dependent terms that an IDCTAB cannot store
        (see `check_time`), or if the solutions differ in order, chips or drift.
    DegenerateError
        If the linear part of a chip is singular.

    Notes
    -----
    TDD_DATE is the reference date of the fit. stwcs dates an exposure by year + day of year /
    365.25, which differs from the decimal year by at most about a day.

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
    for calibration, combinations in entries:
        check_time(calibration.model, acs_wfc=acs_wfc)
        if calibration is not first:
            _check_alike(calibration, first, combinations[0])
    numbers = tuple(c.number for c in model.chips) if chips is None else tuple(chips)
    if not numbers:
        raise InputError("no chip is given", where="chips", do="name at least one")
    pieces = []
    for entry, combinations in entries:
        factor = _arcsec(entry.model.unit, scale_arcsec) / vafactor
        fitted = tuple(
            chip_numbers(entry, n, factor=factor, parity=parity, zero=(v2ref, v3ref))
            for n in numbers
        )
        if entry is not first:  # the file stores the drift of the first solution
            fitted = tuple(chip.without_rates() for chip in fitted)
        back = tuple(chip_inverse(entry, n, factor) for n in numbers) if inverse else ()
        pieces.append(Piece(combinations, fitted, back))
    cov = joint_covariance([entry for entry, _ in entries], [piece.fitted for piece in pieces])
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
    """Calibrations with the filter combinations of their rows; () for rows of all filters."""
    location = "products.idctab.filters"
    named: list[tuple[tuple[str, ...], Source]]
    if isinstance(solution, Mapping):
        if filters:
            raise InputError(
                "the filters are given twice", where=location, do="leave them to the solutions"
            )
        named = [
            (combination_of(filter, instrument), source) for filter, source in solution.items()
        ]
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
    listed: set[tuple[str, ...]] = set()
    for names, source in named:
        if len(names) != wanted:
            raise InputError(
                f"the filter combination {names} has {len(names)} names",
                where=location,
                do=f"give {wanted} for {instrument}, one for each wheel",
            )
        if names in listed:
            raise InputError(
                f"the filter combination {names} occurs twice",
                where=location,
                do="name each one once",
            )
        listed.add(names)
        if id(source) not in out:  # filters with the same solution object share its rows
            out[id(source)] = as_calibration(source), []
        out[id(source)][1].append(names)
    return [(source, tuple(combinations)) for source, combinations in out.values()]


# -- checks and scales ---------------------------------------------------------------------------


def _check_positive(value: float, name: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(
            f"{name} is {value}", where=f"products.idctab.{name}", do="give a positive number"
        )


def _arcsec(unit: str, scale_arcsec: float | None) -> float:
    """Size of one unit of u, v in arcseconds."""
    if scale_arcsec is not None:
        _check_positive(scale_arcsec, "scale_arcsec")
    if unit != "pix":
        return ARCSEC[unit]
    if scale_arcsec is None:
        raise InputError(
            "u and v are in pixels, but an IDCTAB is in arcseconds",
            where="detector.scale_mas",
            do="give the pixel scale (scale_mas in Python, --scale of convert)",
        )
    return scale_arcsec


def _mean_scale(fitted: Sequence[ChipNumbers]) -> float:
    """Mean pixel scale in arcseconds, rounded to the 8 decimals that stwcs keeps."""
    areas = [
        f.column("CX11") * f.column("CY10") - f.column("CX10") * f.column("CY11") for f in fitted
    ]
    return round(float(np.mean(np.sqrt(np.abs(areas)))), 8)


def _check_alike(
    calibration: Calibration, first: Calibration, combination: tuple[str, ...]
) -> None:
    """Raise InputError if order, chips or drift differ from the first calibration."""
    location = f"filters {' '.join(combination)}"
    a, b = calibration.model, first.model
    if a.order != b.order or a.chips != b.chips:
        raise InputError(
            "order or chips differ from those of the first filter",
            where=location,
            do="fit all filters with the same order and chips",
        )
    if a.time is None:
        return
    alike = b.time is not None and a.time.epoch0 == b.time.epoch0
    if alike:
        mine, theirs = (
            {
                (chip.number, term): rate
                for chip in source.model.chips
                for term, rate in rates_of(source.solution, chip.number)[0].items()
            }
            for source in (calibration, first)
        )
        scale = max(map(abs, theirs.values()), default=0.0)
        alike = all(
            abs(mine.get(k, 0.0) - theirs.get(k, 0.0)) <= 1e-9 * scale for k in mine | theirs
        )
    if not alike:
        raise InputError(
            "the drift differs from that of the first filter, but an IDCTAB can store only one",
            where=location,
            do="give it the same reference date and rates (`drift.storable`)",
        )


# -- HDUs and cards -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows that are filled from one solution."""

    combinations: tuple[tuple[str, ...], ...]  # filter names of all wheels; () for all filters
    fitted: tuple[ChipNumbers, ...]  # one per chip
    inverse: tuple[ChipInverse, ...] = ()  # one per chip; empty without INVERSE rows


@dataclass(frozen=True, eq=False)
class _Row:
    filters: tuple[str, ...]
    numbers: ChipNumbers
    inverse: ChipInverse | None
    place: slice  # indices of the chip's numbers in the covariance

    @property
    def key(self) -> dict[str, str | float]:
        """Columns that identify the row."""
        direction = "FORWARD" if self.inverse is None else "INVERSE"
        named: dict[str, str | float] = {
            "DETCHIP": self.numbers.chip.number,
            "DIRECTION": direction,
        }
        return named | _by_wheel(self.filters)

    def value(self, name: str) -> float:
        if self.inverse is None or name not in self.inverse.values:
            return self.numbers.column(name)
        return self.inverse.values[name]

    def sigmas(self, cov: Float) -> dict[str, float]:
        variances = np.diag(cov)[self.place]
        sigmas = np.sqrt(np.maximum(variances, 0.0)).tolist()  # rounding may give -1e-40
        out = dict(zip(self.numbers.names, sigmas, strict=True))
        return out if self.inverse is None else out | self.inverse.sigmas


def _rows(pieces: Sequence[Piece]) -> Iterator[_Row]:
    """Rows ordered by filter, then by chip, with FORWARD before INVERSE."""
    end = 0
    for piece in pieces:
        places = []
        for f in piece.fitted:
            places.append(slice(end, end + len(f.names)))
            end += len(f.names)
        for filters in piece.combinations:
            for f, place in zip(piece.fitted, places, strict=True):
                yield _Row(filters, f, None, place)
            for f, place, inverse in zip(piece.fitted, places, piece.inverse, strict=False):
                yield _Row(filters, f, inverse, place)


def coefficient_hdu(pieces: Sequence[Piece], scale: float) -> fits.BinTableHDU:
    """HDU 1: the coefficient table that pipelines read, in double precision."""
    table = []
    for row in _rows(pieces):
        chip = row.numbers.chip
        out = row.key
        out |= {f"{axis}SIZE": int(n) for axis, n in zip("XY", chip.size, strict=True)}
        out |= {f"{axis}REF": n for axis, n in zip("XY", chip.reference_pixel, strict=True)}
        for name in _column_names(pieces):
            if name == "CX10":
                out["SCALE"] = scale
            out[name] = row.value(name)
        if out.get("CX11") == 1.0 and scale != 1.0:
            # in stwcs, exactly 1 means that the coefficients are in units of SCALE
            out["CX11"] = np.nextafter(1.0, 0.0)
        table.append(out)
    return _table(table)


def sigma_hdu(pieces: Sequence[Piece], cov: Float) -> fits.BinTableHDU:
    """HDU SIGMA: standard deviations of each row; those of the drift are header keywords."""
    table, drift = [], dict[str, float]()
    for row in _rows(pieces):
        sigmas = row.sigmas(cov)
        table.append(row.key | {name: sigmas[name] for name in _column_names(pieces)})
        drift |= {k: v for k, v in sigmas.items() if k.startswith("TDD")}
    hdu = _table(table, "SIGMA")
    append_cards(hdu, (number_card(k, v, "[arcsec/pix/yr] 1-sigma") for k, v in drift.items()))
    return hdu


def covariance_hdu(pieces: Sequence[Piece], cov: Float) -> fits.BinTableHDU:
    """HDU COVAR: every fitted number with its covariances, and its filters if solutions differ."""
    named = [
        {"DETCHIP": f.chip.number}
        | (_by_wheel(p.combinations[0]) if len(pieces) > 1 else {})
        | {"PARAM": name, "VALUE": value}
        for p in pieces
        for f in p.fitted
        for name, value in zip(f.names, f.values, strict=True)
    ]
    return _table([row | {"COV": by} for row, by in zip(named, cov, strict=True)], "COVAR")


def _by_wheel(filters: tuple[str, ...]) -> dict[str, str]:
    """Filter names by the columns that hold them."""
    labels = ("FILTER1", "FILTER2") if len(filters) == 2 else ("FILTER",)
    return dict(zip(labels, filters, strict=False))


def _table(rows: Sequence[Mapping[str, Any]], name: str | None = None) -> fits.BinTableHDU:
    """Table from rows of values by column; in double precision, except for integer columns."""
    columns = []
    for column in rows[0]:
        values = np.array([row[column] for row in rows])
        form = f"{values.shape[1]}D" if values.ndim == 2 else "1D"
        form = {"DETCHIP": "1I", "XSIZE": "1J", "YSIZE": "1J"}.get(column, form)
        if values.dtype.kind == "U":
            form = f"{max(8, values.dtype.itemsize // 4)}A"
        unit = None if name == "COVAR" else _unit(column)
        columns.append(fits.Column(column, form, unit=unit, array=values))
    return fits.BinTableHDU.from_columns(columns, name=name)


def _column_names(pieces: Sequence[Piece]) -> list[str]:
    return [name for name in pieces[0].fitted[0].names if not name.startswith("TDD")]


def _unit(column: str) -> str | None:
    if column[:2] in ("CX", "CY"):
        order = int(column[2])
        return "arcsec/pixel" if order == 1 else f"arcsec/pixel**{order}"
    pixels = dict.fromkeys(("XSIZE", "YSIZE", "XREF", "YREF"), "pixel")
    arcsec = dict.fromkeys(("V2REF", "V3REF", "SCALE"), "arcsec")
    return (pixels | arcsec | {"DETCHIP": "chip"}).get(column)


def tdd_cards(fitted: Sequence[ChipNumbers], epoch: float | None, acs_wfc: bool) -> list[str]:
    """Cards of the ACS/WFC drift in the scheme of 2015; zeros if no drift was fitted."""
    if not acs_wfc:
        return []
    comment = "" if epoch is not None else "no time-dependent terms"
    cards = [number_card("TDD_DATE", 2004.5 if epoch is None else epoch, "[yr] reference date")]
    rates = {name: f.column(name) for f in fitted for name in f.names if name.startswith("TDD")}
    for chip in (1, 2):  # stwcs recognizes the scheme by TDD_CTB1, whatever the chip
        rates.setdefault(f"TDD_CTB{chip}", 0.0)
    comment = comment or "[arcsec/pix/yr]"
    return cards + [number_card(name, rates[name], comment) for name in sorted(rates)]


def provenance_cards(
    fitted: Sequence[ChipNumbers], vafactor: float, calibration: Calibration
) -> list[str]:
    """Cards on the origin of the numbers: unit and constants of the fit, and the orientation."""
    orientation = calibration.plane.orientation
    unit = calibration.unit if orientation is None else orientation.base.model.unit
    cards = [
        text_card("CREATOR", "bayesdist"),
        number_card("BDVAFAC", float(vafactor), "VAFACTOR that was divided out"),
        text_card("BDUNIT", unit, "unit of u and v in the fit"),
    ]
    for f in fitted:
        for axis, value in zip("UV", f.constant, strict=True):
            keyword = f"BD{axis}0_{f.chip.number}"
            cards.append(number_card(keyword, float(value), "[arcsec] constant, now in V2/V3REF"))
    return cards if orientation is None else cards + _orientation_cards(orientation, vafactor)


def _orientation_cards(orientation: Orientation, vafactor: float) -> list[str]:
    """Cards on the orientation, its error and its agreement with the reference."""
    sigma = orientation.sigma
    scale = orientation.scale / vafactor
    degrees = np.rad2deg([orientation.angle, sigma["angle"]]).tolist()
    cards = [
        number_card("BDANGLE", degrees[0], "[deg] from (u, v) to (Xc, Yc)"),
        number_card("BDANGSIG", degrees[1], "[deg] 1-sigma of BDANGLE"),
        number_card("BDSCALE", scale, "[arcsec] one unit of u and v"),
        number_card("BDSCASIG", scale * sigma["log_scale"], "[arcsec] 1-sigma of BDSCALE"),
        number_card("BDV2SIG", sigma["shift_x"], "[arcsec] 1-sigma of V2 of (u, v) = 0"),
        number_card("BDV3SIG", sigma["shift_y"], "[arcsec] 1-sigma of V3 of (u, v) = 0"),
        number_card("BDAGRRMS", orientation.agreement.rms, "[mas] rms distance to reference"),
        number_card("BDAGRMAX", orientation.agreement.worst, "[mas] largest distance"),
    ]
    return cards + wrapped_cards("HISTORY", [f"V2/V3: {orientation.source}"], 72)


def closure_cards(pieces: Sequence[Piece]) -> list[str]:
    """Cards with the worst closure of the INVERSE rows of each chip, over all filters."""
    worst: dict[int, float] = {}
    for piece in pieces:
        for f, back in zip(piece.fitted, piece.inverse, strict=False):
            worst[f.chip.number] = max(worst.get(f.chip.number, 0.0), back.closure)
    return [
        number_card(f"BDCLOS_{chip}", value, "[pix] worst closure of INVERSE at TDD_DATE")
        for chip, value in worst.items()
    ]
