"""Build an IDCTAB from solutions, with standard deviations and covariance of all its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration, as_calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError
from bayesdist.formats.idctab.drift import rates_of
from bayesdist.formats.idctab.hdus import (
    Piece,
    closure_cards,
    coefficient_hdu,
    covariance_hdu,
    provenance_cards,
    sigma_hdu,
    tdd_cards,
)
from bayesdist.formats.idctab.hst import combination_of, parity_of
from bayesdist.formats.idctab.numbers import (
    ChipNumbers,
    check_time,
    chip_inverse,
    chip_numbers,
    joint_covariance,
)
from bayesdist.formats.idctab.table import IdcTab
from bayesdist.infer.solution.solution import Solution
from bayesdist.products.common.cards import (
    append_cards,
    convergence_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.content import hdus_of

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
                f"the filter combination {names} stands twice",
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
            "u and v are in pixels, and an IDCTAB is in arcseconds",
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
            "the solution has another order or other chips than the first one",
            where=location,
            do="fit all filters with one structure",
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
            "the solution drifts otherwise than the first one, and a file stores one drift",
            where=location,
            do="give it the same reference date and rates (`drift.storable`)",
        )
