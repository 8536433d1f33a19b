"""Format of IDCTABs: their description as text, and their calibration.

The calibration has all chips in one plane, with drift, covariance and INVERSE rows. Following
stwcs, chips are combined in the plane of Xc and Yc of the reference chip,

    Xc + p0 (V2REF - V2REF_ref),   Yc + p1 (V3REF - V3REF_ref)

in arcseconds from the zero point of the reference chip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveFloat

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import ExplicitInverse
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.drift import RATES
from bayesdist.formats.idctab.lint import LIMITS, lint_idctab, refuse_implausible
from bayesdist.formats.idctab.table import FILTER_COLUMNS, HIGHEST, IdcTab, idctab_column, parity_of
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.products.common.coefficients import largest_magnitude
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Format,
    FormatSettings,
    finding_lines,
    identity_lines,
)
from bayesdist.utils.arrays import Float

_SCHEMES = {
    "2015": "scheme of 2015: CX11 += CXB dt, CY11 += CTB dt, CY10 += CYB dt",
    "2014": "scheme of 2014 (TDD_CXB, TDD_CYB)",
    "order": "skew terms TDD_A, TDD_B",
    "default": "no keywords: stwcs applies its own terms of 2004.5",
    "none": "none",
}


def describe_idctab(tab: IdcTab) -> list[str]:
    """Lines of text on an IDCTAB, with the findings at the end."""
    header = tab.header
    lines = [
        f"{tab.name}: IDCTAB of {tab.instrument}/{tab.detector or '(no DETECTOR)'}, "
        f"order {tab.norder}, {len(tab.rows)} rows",
    ]
    lines += identity_lines(header)
    lines.append(f"  time      {_SCHEMES[tab.tdd_scheme]}")
    lines += [f"            {k} = {v:.10g}" for k, v in tab.tdd.items()]
    filters = sorted({" ".join(f) for f in tab.filters()} - {""})
    if filters:
        shown = ", ".join(filters[:4]) + (" ..." if len(filters) > 4 else "")
        lines.append(f"  filters   {len(filters)} combinations: {shown}")
    else:
        lines.append("  filters   no columns: the rows serve every filter")
    errors = "standard deviations and covariance" if tab.covariance is not None else "none"
    lines.append(f"  errors    {errors}")
    if "BDANGLE" in header:
        lines.append(
            f"  V2/V3     turned by {header['BDANGLE']:.6g} +- {header['BDANGSIG']:.2g} deg, "
            f"scale {header['BDSCALE']:.8g} +- {header['BDSCASIG']:.2g} arcsec"
        )
    for row in _first_rows(tab):
        lines += ["", *_row_text(tab, row)]
    return [*lines, "", *finding_lines(lint_idctab(tab))]


def _first_rows(tab: IdcTab) -> list[int]:
    """Indices of the first row of each chip and direction."""
    names = [c for c in ("DETCHIP", "DIRECTION") if c in tab.columns]
    first_rows: dict[tuple[object, ...], int] = {}
    for k, row in enumerate(tab.rows):
        first_rows.setdefault(tuple(row[c] for c in names), k)
    return list(first_rows.values())


def _row_text(tab: IdcTab, row: int) -> list[str]:
    record = tab.rows[row]
    parts = [f"row {row + 1}"]
    parts += [
        f"{label} {str(record[label]).strip()}"
        for label in ("DETCHIP", "DIRECTION", *FILTER_COLUMNS)
        if label in tab.columns
    ]
    lines = ["  " + ", ".join(parts)]
    geometry = [n for n in ("XSIZE", "YSIZE", "XREF", "YREF", "V2REF", "V3REF", "SCALE", "THETA")
                if n in tab.columns]  # fmt: skip
    lines.append("    " + "  ".join(f"{n} {float(record[n]):.10g}" for n in geometry))
    inverse = tab.directions[row] == "INVERSE"
    if not inverse:
        lines.append(f"    non-linear part: {_non_linear(tab, row)} px at most")
    sigma = tab.sigma
    row_sigma = None if sigma is None or len(sigma) != len(tab.rows) else sigma[row]
    unit = "px/arcsec^n" if inverse else "arcsec/px^n"
    head = f"    column        value [{unit}]" + ("       sigma" if row_sigma is not None else "")
    lines.append(head)
    for prefix in tab.prefixes:
        for i, j in tab.terms:
            if i + j:
                name = idctab_column(prefix, i, j)
                error = f"  {float(row_sigma[name]):10.3e}" if row_sigma is not None else ""
                power = f"X^{i} Y^{j}" if inverse else f"x^{i} y^{j}"
                lines.append(f"    {name:<5} {power:<8} {float(record[name]):21.13e}{error}")
    return lines


def _non_linear(tab: IdcTab, row: int) -> str:
    """Largest value of the terms above order 1 in Xc and Yc, in pixels of SCALE."""
    record = tab.rows[row]
    scale = float(record["SCALE"])
    x_range, y_range = (
        (1 - float(record[f"{a}REF"]), float(record[f"{a}SIZE"]) - float(record[f"{a}REF"]))
        for a in "XY"
    )
    if scale == 0 or not np.isfinite([scale, *x_range, *y_range]).all():
        return "?"
    if not all(1 <= float(record[f"{a}SIZE"]) <= LIMITS[f"{a}SIZE"][1] for a in "XY"):
        return "?"
    out = []
    for values in tab.coefficients_of_row(row):
        terms = {t: c for t, c in zip(tab.terms, values.tolist(), strict=True) if sum(t) > 1}
        out.append(f"{largest_magnitude(terms, x_range, y_range) / abs(scale):.4g}")
    return " and ".join(out)


class IdctabSettings(FormatSettings):
    """Configuration of an IDCTAB reference file."""

    instrument: str
    detector: str
    v2ref: float = 0.0
    v3ref: float = 0.0
    vafactor: PositiveFloat = 1.0
    filters: list[str] | list[list[str]] | None = None
    useafter: str | None = None
    pedigree: str | None = None


def _parse(content: Content) -> IdcTab | None:
    hdus = content.tables
    if len(hdus) < 2:
        return None
    columns = {str(value).strip() for value in hdus[1].header.values()}
    if not {"XREF", "YREF"} <= columns or not {"CX10", "A10"} & columns:
        return None
    return IdcTab(hdus, content.name)


def _build(
    calibration: Calibration, settings: IdctabSettings, options: BuildOptions
) -> tuple[Built, ...]:
    tab = idctab_from_solution(
        calibration,
        scale_arcsec=options.scale_arcsec,
        history=calibration.notes,
        **settings.model_dump(exclude_none=True),
    )
    name = f"{settings.instrument}_{settings.detector}_idc.fits".lower()
    return (Built(name, "IDCTAB", b"".join(hdu.to_bytes() for hdu in tab.hdus), tab),)


Filters = Sequence[str] | None


def idctab_calibration(tab: IdcTab, filter: str | None = None) -> Calibration:
    """Calibration of one filter of an IDCTAB in arcseconds, with the reference chip first.

    It has a covariance if the file has one. The names in both wheels may be joined by a comma. A
    filter is required if the rows differ. InputError as for `IdcTab.row`, and for an unknown
    detector with several chips.
    """
    names = None if filter is None else [part.strip() for part in filter.split(",")]
    if not len(tab.rows):
        raise FormatError("has no rows", where=tab.name, do="fetch it again")
    numbers = tab.chips
    refuse_implausible(tab, [tab.row(number, names) for number in numbers])
    parity = parity_of(tab.instrument, tab.detector) if len(numbers) > 1 else (1, 1)
    base = tab.rows[tab.row(numbers[0], names)]
    maps = {}
    for number in numbers:
        record = tab.rows[tab.row(number, names)]
        shift = [
            sign * (float(record[name]) - float(base[name])) if number != numbers[0] else 0.0
            for sign, name in zip(parity, ("V2REF", "V3REF"), strict=True)
        ]
        maps[number] = _map(tab, number, names, (shift[0], shift[1]))
    dated = tab.tdd_scheme == "2015" and "TDD_DATE" in tab.tdd
    rates = {
        (number, axis, i, j): tab.tdd.get(f"{keyword}{number}", 0.0)
        for number in numbers
        for (axis, i, j), keyword in RATES.items()
    }
    scale = round(float(base["SCALE"]), 8)
    calibration = calibration_of_maps(
        maps,
        tab.name,
        rates=rates if dated else None,
        reference_date=tab.tdd["TDD_DATE"] if dated else None,
        plane=Plane("aperture", v2v3=_v2v3(base)),
        instrument=tab.instrument,
        detector=tab.detector,
        filter=filter or "",
        inverses={n: inverse for n in numbers if (inverse := _inverse(tab, n, names)) is not None},
        scale=scale if scale > 0 else None,
        scale_from="SCALE",
        undated=_undated(tab, drifts=dated and any(rates.values())),
        no_date=""
        if dated or not tab.is_acs_wfc
        else (f"time-dependent terms of the scheme {tab.tdd_scheme!r} are not evaluated here"),
    )
    return _with_covariance(calibration, tab, names, parity)


def _map(tab: IdcTab, number: int, names: Filters, shift: tuple[float, float]) -> ChipMap:
    """Polynomial of a chip at the reference date."""
    record = tab.rows[tab.row(number, names)]

    def positions(x: Float, y: Float) -> tuple[Float, Float]:
        X, Y = tab.evaluate(number, x, y, filter=names)
        return X + shift[0], Y + shift[1]

    return fitted_map(
        positions,
        tab.name,
        order=tab.norder,
        size=(float(record["XSIZE"]), float(record["YSIZE"])),
        reference_pixel=(float(record["XREF"]), float(record["YREF"])),
        unit="arcsec",
        chip=number,
    )


def _v2v3(record: np.void) -> tuple[float, float] | None:
    names = record.dtype.names or ()
    if "V2REF" not in names or "V3REF" not in names:
        return None
    return float(record["V2REF"]), float(record["V3REF"])


def _undated(tab: IdcTab, *, drifts: bool) -> str:
    """Note on the date to which positions refer if no date is given."""
    if drifts:
        return f"at the reference date {tab.tdd['TDD_DATE']:g} of its drift"
    if tab.tdd_scheme in ("2014", "order", "default"):
        return "without the drift that stwcs applies to it"
    return ""


def _inverse(tab: IdcTab, number: int, names: Filters) -> ExplicitInverse | None:
    """INVERSE row of a chip; None if there is none."""
    indices = tab.matching_rows(number, names, "INVERSE")
    if not indices.size:
        return None
    record = tab.rows[indices[0]]
    terms = []
    for axis, values in enumerate(tab.coefficients_of_row(int(indices[0]))):
        corrections = dict(zip(tab.terms[1:], values[1:].tolist(), strict=True))
        corrections[1 - axis, axis] -= 1.0  # the correction is added to the position
        terms.append(corrections)
    return ExplicitInverse((float(record["XREF"]), float(record["YREF"])), terms[0], terms[1])


# -- errors ---------------------------------------------------------------------------------------
def _with_covariance(
    calibration: Calibration, tab: IdcTab, names: Filters, parity: tuple[int, int]
) -> Calibration:
    """Calibration with the covariance of HDU COVAR, if it covers every chip."""
    entries, model = tab.covariance, calibration.model
    if entries is None:
        return calibration
    K, reference = model.n_terms, calibration.numbers[0]
    jacobian = np.zeros((model.n_params, len(entries)))  # with respect to COVAR's numbers
    zero = _numbers_of_row(tab, entries, tab.row(reference, names), reference)
    for number in calibration.numbers:
        place = _numbers_of_row(tab, entries, tab.row(number, names), number)
        by = np.zeros((2, K, len(entries)))
        for axis, prefix in enumerate(tab.prefixes):
            for k, (i, j) in enumerate(tab.terms):
                if (column := idctab_column(prefix, i, j)) in place:
                    by[axis, k, place[column]] = 1.0
        if not by.any():
            return calibration
        if number != reference:
            # the constant is the offset of the chip's zero point from that of the reference chip
            for axis, name in enumerate(("V2REF", "V3REF")):
                for indices, sign in ((place, 1.0), (zero, -1.0)):
                    if name in indices:
                        by[axis, 0, indices[name]] = sign * parity[axis]
        basis = model.basis(number)
        back = basis.from_monomials(np.eye(K)).T
        for axis in (0, 1):
            jacobian[model.coefficient_slice(number, axis)] = back @ by[axis]
        if model.time is not None:
            first, (hx, hy) = model.tdd_slice(number).start, basis.half_size
            for t, (letter, i, j) in enumerate(model.time.terms):
                if (rate := f"{RATES[letter, i, j]}{number}") in place:
                    jacobian[first + t, place[rate]] = hx**i * hy**j
    cov = jacobian @ np.asarray(entries["COV"], float) @ jacobian.T
    solution = GaussianSolution(model, np.asarray(calibration.solution.mean), (cov + cov.T) / 2)
    return replace(calibration, solution=solution, errors="covariance")


def _numbers_of_row(tab: IdcTab, entries: NDArray[np.void], row: int, chip: int) -> dict[str, int]:
    """Indices in COVAR of the numbers of a row, by name; empty if they are not in COVAR."""
    listed = [str(name).strip() for name in entries["PARAM"]]
    mine = np.flatnonzero(entries["DETCHIP"].astype(int) == chip)
    filter_columns = [c for c in FILTER_COLUMNS if c in (entries.dtype.names or ())]
    if filter_columns:
        # COVAR lists each set of numbers once for all its filters: identify the set by its values
        sets = {tuple(str(entries[c][k]).strip() for c in filter_columns) for k in mine}
        of_set = [
            [
                int(k)
                for k in mine
                if tuple(str(entries[c][k]).strip() for c in filter_columns) == combination
            ]
            for combination in sorted(sets)
        ]
        matching_sets = [s for s in of_set if _is_of_row(tab, entries, row, listed, s)]
        if not matching_sets:
            return {}
        # the drift is common to all filters, and is listed with the first one
        rates = [k for k in mine if listed[k].startswith("TDD")]
        mine = np.array([*rates, *matching_sets[0]])
    return {listed[k]: int(k) for k in mine}


def _is_of_row(
    tab: IdcTab, entries: NDArray[np.void], row: int, listed: list[str], some: Sequence[int]
) -> bool:
    return all(
        float(entries["VALUE"][k]) == float(tab.rows[listed[k]][row])
        for k in some
        if listed[k] in tab.columns and listed[k][0] in "CAB"
    )


FORMAT = Format(
    "idctab",
    "an IDCTAB",
    2,
    _parse,
    describe_idctab,
    lint_idctab,
    lambda tab, _, choice: idctab_calibration(tab, choice.filter),
    IdctabSettings,
    _build,
    highest_order=HIGHEST,
    holds_time=True,
    asks=("filter",),
    filters=lambda tab: {name for row in tab.filters() for name in row},
    mirrored=lambda tab: bool(np.prod(parity_of(tab.instrument, tab.detector)) < 0),
)
