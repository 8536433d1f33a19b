"""Checks of an IDCTAB against the behaviour of stwcs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.idctab.table import (
    FILTER_COLUMNS,
    IdcTab,
    idctab_column,
    idctab_powers,
    parity_of,
)
from bayesdist.products.common.document import Finding
from bayesdist.products.common.rules import (
    IDENTITY,
    Missing,
    above_order,
    missing,
    not_finite,
    repeated_values,
)

_SCALE_RATIO = 1.25


def lint_idctab(tab: IdcTab) -> tuple[Finding, ...]:
    """Check an IDCTAB against the behaviour of stwcs.

    Parameters
    ----------
    tab : IdcTab
        IDCTAB to check.

    Returns
    -------
    tuple of Finding
        Errors, warnings and notes; a finding that concerns several rows appears once.
    """
    finite = [*_not_finite(tab), *implausible(tab)]
    return (
        *finite,
        *_header(tab),
        *_time(tab),
        *(() if finite else (*_table(tab), *_coefficients(tab), *_chips(tab), *_uncertainty(tab))),
    )


def _not_finite(tab: IdcTab) -> list[Finding]:
    out = []
    for rows, of in ((tab.rows, ""), (tab.sigma, " of SIGMA"), (tab.covariance, " of COVAR")):
        if rows is None:
            continue
        for name in rows.dtype.names or ():
            column = rows[name]
            if column.dtype.kind == "f":
                bad = np.unique(np.nonzero(~np.isfinite(column))[0])
                location = f"{rows_text(bad)}{of}, column {name}"
                out += not_finite(column, location, "not a finite number")
    return out


def _header(tab: IdcTab) -> Iterator[Finding]:
    header = tab.header
    yield from missing(header, IDENTITY)
    if not tab.detector:
        without = ": stwcs then reads no time-dependent terms"
        yield Missing("DETECTOR", without, "warning").finding
    elif tab.tdd and not tab.is_acs_wfc:
        yield Finding(
            "warning",
            ", ".join(tab.tdd),
            f"is not read by stwcs for {tab.instrument}/{tab.detector}",
        )
    try:
        parity = parity_of(tab.instrument, tab.detector)
    except InputError:
        return
    if header.get("PARITY", parity[0] * parity[1]) != parity[0] * parity[1]:
        yield Finding(
            "warning", "PARITY", f"is {header['PARITY']}, and V2, V3 are {parity} times Xc, Yc"
        )


def _time(tab: IdcTab) -> Iterator[Finding]:
    """Findings on the time-dependent terms of ACS/WFC (stwcs: read_tdd_coeffs and TDDCorr)."""
    scheme = tab.tdd_scheme
    if scheme == "none":
        return
    if scheme == "default":
        yield Finding(
            "warning",
            "TDD_CTB1",
            "there are no time-dependent terms, so stwcs applies its own of 2004.5, wrong by 30 to "
            "50 mas in 2016 (no drift is written as TDD_CTB1 = TDD_CTB2 = 0)",
        )
    else:
        yield from missing(tab.tdd, [Missing("TDD_DATE", ", and stwcs stops without it")])
    if scheme == "2015":
        yield from missing(
            tab.tdd,
            [
                Missing(f"TDD_CTB{chip}", ", and stwcs stops at that chip without it")
                for chip in tab.stated_chips or (1,)
            ],
        )
        alphas = [k for k, v in tab.tdd.items() if k[:7] in ("TDD_CTA", "TDD_CXA", "TDD_CYA") and v]
        if alphas:
            yield Finding("warning", ", ".join(alphas), "stwcs reads but never applies it")
    else:
        strays = [k for k in tab.tdd if k[:7] in ("TDD_CTB", "TDD_CXB")]
        if strays and scheme != "2014":
            yield Finding(
                "error",
                ", ".join(strays),
                "is not applied: stwcs looks for TDD_CTB1 to know the scheme",
            )


def _table(tab: IdcTab) -> Iterator[Finding]:
    rows, columns = tab.rows, tab.columns
    if not (tab.directions == "FORWARD").any():
        yield Finding("error", "DIRECTION", "there is no FORWARD row")
    for axis in "XY":
        n, ref = rows[f"{axis}SIZE"].astype(float), rows[f"{axis}REF"].astype(float)
        outside = np.flatnonzero((ref < 0.5) | (ref > n + 0.5))
        if outside.size:
            yield Finding(
                "warning",
                f"{rows_text(outside)}, column {axis}REF",
                f"lies outside 1 .. {axis}SIZE",
            )
    unused = [c for p in tab.prefixes if (c := f"{p}00") in columns and rows[c].any()]
    if unused:
        yield Finding("note", ", ".join(unused), "stwcs does not use it: offsets are V2REF, V3REF")
    powers = {c: p for c in columns if (p := idctab_powers(c)) and p[0] in tab.prefixes}
    above = [c for c, (_, i, j) in powers.items() if i + j > tab.norder]
    if above:
        shown = f"{above[0]} .. {above[-1]}"
        yield from above_order(above, shown, f"NORDER {tab.norder}", "note")
    single = [c for c in columns if rows[c].dtype == np.float32]
    if single:
        yield Finding(
            "note", f"{len(single)} columns",
            f"single precision: positions are rounded by up to {_rounding(tab):.2g} mas",
        )  # fmt: skip
    yield from _repeated_rows(tab)


def _rounding(tab: IdcTab) -> float:
    """Largest effect in mas of rounding every coefficient by half a unit in its last digit."""
    rows = tab.rows[_forward(tab)]
    hx, hy = (np.maximum(rows[f"{a}REF"], rows[f"{a}SIZE"] - rows[f"{a}REF"]) for a in "XY")
    worst = 0.0
    for prefix in tab.prefixes:
        effect = sum(
            np.spacing(np.abs(rows[idctab_column(prefix, i, j)])).astype(float)
            / 2 * hx.astype(float) ** i * hy.astype(float) ** j
            for i, j in tab.terms if i + j
        )  # fmt: skip
        worst = max(worst, float(np.max(effect)) * 1e3)
    return worst


def _repeated_rows(tab: IdcTab) -> Iterator[Finding]:
    keys: dict[tuple[str, ...], list[int]] = {}
    names = [c for c in ("DETCHIP", "DIRECTION", *FILTER_COLUMNS) if c in tab.columns]
    for k, row in enumerate(tab.rows):
        keys.setdefault(tuple(str(row[c]).strip() for c in names), []).append(k)
    repeated = [group for group in keys.values() if len(group) > 1]
    values = [c for c in tab.columns if c not in names]
    content = tab.rows[values]
    differ = [g for g in repeated if any(content[k] != content[g[0]] for k in g[1:])]
    if differ:
        extra = sorted(k for g in differ for k in g[1:])
        yield Finding(
            "warning",
            rows_text(extra),
            "a row before has the same chip and filters with other values: stwcs takes the first",
        )
    if len(repeated) > len(differ):
        extra = sorted(k for g in repeated if g not in differ for k in g[1:])
        yield Finding("note", rows_text(extra), "repeats a row before it")


def _coefficients(tab: IdcTab) -> Iterator[Finding]:
    """Findings on scale, index order and parity of the linear terms, and on repeated values."""
    x, y = tab.prefixes
    forward = _forward(tab)
    rows = tab.rows[forward]
    cx11, cx10, cy11, cy10 = (
        rows[f"{p}{n}"].astype(float) for p, n in ((x, 11), (x, 10), (y, 11), (y, 10))
    )
    scale = rows["SCALE"].astype(float)
    determinant = cx11 * cy10 - cx10 * cy11
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(np.abs(determinant)) / np.abs(scale)
    unit = (cx11 == 1.0) & (scale != 1.0)
    exchanged = (np.abs(cx10) > np.abs(cx11)) & (np.abs(cy11) > np.abs(cy10))
    off = (scale != 0) & (determinant != 0) & ~unit
    off &= (ratio > _SCALE_RATIO) | (ratio * _SCALE_RATIO < 1)
    checks = (
        ("error", scale == 0, "SCALE", "is zero"),
        ("error", determinant == 0, f"{x}1n, {y}1n", "the linear part is singular"),
        ("warning", unit, f"{x}11", "is exactly 1 and SCALE is not: stwcs multiplies all by SCALE"),
        (
            "warning",
            exchanged,
            f"{x}10, {x}11",
            f"index order: {x}11 multiplies x, yet {x}10 is larger, as if x and y were exchanged",
        ),
        (
            "warning",
            (determinant < 0) & ~exchanged,
            f"{x}1n, {y}1n",
            "parity: the linear part mirrors the detector, which stwcs does by itself in V2, V3",
        ),
        (
            "warning",
            off,
            "SCALE",
            "does not fit the linear terms: are the coefficients in arcseconds?",
        ),
    )
    for level, bad, column, message in checks:
        if bad.any():
            yield Finding(level, f"{rows_text(forward[bad])}, column {column}", message)
    yield from _repeated_values(tab)


def _forward(tab: IdcTab) -> NDArray[np.intp]:
    """Indices of the rows that convert pixels to arcseconds."""
    return np.flatnonzero(tab.directions != "INVERSE")


def _repeated_values(tab: IdcTab) -> Iterator[Finding]:
    names = [idctab_column(p, i, j) for p in tab.prefixes for i, j in tab.terms if i + j]
    table = np.stack([tab.rows[n].astype(float) for n in names], axis=1)
    groups: dict[tuple[str, ...], list[int]] = {}
    for k, row in enumerate(table):
        for group in repeated_values(dict(zip(names, row.tolist(), strict=True))):
            groups.setdefault(group, []).append(k)
    for group, rows in groups.items():
        # without rotation, CX10 = CY11 or CX11 = CY10 by construction
        if all(name[2] == "1" for name in group if len(name) == 4):
            continue
        yield Finding(
            "warning", f"{rows_text(rows)}, columns {', '.join(group)}",
            "the same value: one may have been copied over the other",
        )  # fmt: skip


def _chips(tab: IdcTab) -> Iterator[Finding]:
    """Findings on the chip positions of ACS/WFC: chip 1 is above chip 2 in y, so at lower V3."""
    if not tab.is_acs_wfc or "V3REF" not in tab.columns:
        return
    if 2 not in tab.stated_chips:
        yield Finding("warning", "DETCHIP", "there is no chip 2, to which stwcs refers both chips")
    keys = tab.filters()
    lower = {keys[k]: tab.rows["V3REF"][k] for k in tab.matching_rows(2)[::-1]}
    upper = tab.matching_rows(1)
    difference = np.array(
        [float(tab.rows["V3REF"][k]) - float(lower.get(keys[k], np.nan)) for k in upper]
    )
    if (difference == 0).any():
        yield Finding(
            "error", f"{rows_text(upper[difference == 0])}, column V3REF",
            "is that of chip 2: the chips are laid one over the other",
        )  # fmt: skip
    if (difference > 0).any():
        yield Finding(
            "warning", f"{rows_text(upper[difference > 0])}, column V3REF",
            "parity: chip 1 lies at higher V3 than chip 2, which is the wrong way round",
        )  # fmt: skip


def _uncertainty(tab: IdcTab) -> Iterator[Finding]:
    sigma, covariance = tab.sigma, tab.covariance
    if sigma is None or covariance is None:
        return
    location = "SIGMA, COVAR"
    cov = covariance["COV"]
    if cov.shape != (len(covariance), len(covariance)):
        yield Finding("error", location, f"the covariance has shape {cov.shape}")
        return
    worst = 0.0
    keys = [c for c in ("DETCHIP", *FILTER_COLUMNS) if c in (covariance.dtype.names or ())]
    forward = _forward(tab) if len(sigma) == len(tab.rows) else np.arange(len(sigma))
    for entry, variance in zip(covariance, np.diag(cov), strict=True):
        name = entry["PARAM"]
        if name in (sigma.dtype.names or ()):
            in_row = np.all([sigma[key][forward] == entry[key] for key in keys], axis=0)
            stated = sigma[name][forward][in_row]
            scale = max(float(np.max(np.abs(stated), initial=0.0)), np.sqrt(abs(variance)))
            if scale > 0:
                difference = np.abs(stated - np.sqrt(abs(variance)))
                worst = max(worst, float(np.max(difference, initial=0.0)) / scale)
    if worst > 1e-9:
        yield Finding(
            "error", location, f"sigma and covariance differ by up to {100 * worst:.2g} %"
        )


# -- plausible ranges -----------------------------------------------------------------------------


# smallest and largest plausible value of a column, and its unit
LIMITS = {
    "XSIZE": (1.0, 1e6, "pixels"),
    "YSIZE": (1.0, 1e6, "pixels"),
    "XREF": (-1e6, 1e6, "a pixel"),
    "YREF": (-1e6, 1e6, "a pixel"),
    "V2REF": (-648_000.0, 648_000.0, "arcseconds"),
    "V3REF": (-648_000.0, 648_000.0, "arcseconds"),
    "SCALE": (1e-6, 1e5, "arcseconds in a pixel"),
}


def rows_text(indices: Iterable[int]) -> str:
    """Row numbers counted from 1: the first three, and the number of further ones."""
    numbers = [int(k) + 1 for k in indices]
    shown = ", ".join(map(str, numbers[:3]))
    further = f" and {len(numbers) - 3} more" if len(numbers) > 3 else ""
    return f"row{'s' if len(numbers) > 1 else ''} {shown}{further}"


def _beyond(value: float, name: str) -> str:
    lowest, highest, unit = LIMITS[name]
    return f"{value:g} is not between {lowest:g} and {highest:g} {unit}"


def implausible(tab: IdcTab) -> Iterator[Finding]:
    """Findings on finite values that are implausible."""
    if not len(tab.rows):
        yield Finding("error", "rows", "there are none")
    for name, (lowest, highest, _) in LIMITS.items():
        if name in tab.columns:
            values = tab.rows[name].astype(float)
            bad = np.flatnonzero((values < lowest) | (values > highest))
            if name == "SCALE":
                bad = bad[values[bad] != 0]  # `lint` reports a zero SCALE
            if bad.size:
                location = f"{rows_text(bad)}, column {name}"
                yield Finding("error", location, _beyond(values[bad[0]], name))


def refuse_implausible(tab: IdcTab, rows: Iterable[int]) -> None:
    """Raise FormatError if rows that a calibration needs have implausible values."""
    for row in rows:
        for name, (lowest, highest, _) in LIMITS.items():
            value = float(tab.rows[name][row]) if name in tab.columns else lowest
            if not lowest <= value <= highest:
                raise FormatError(
                    _beyond(value, name),
                    where=f"{tab.name}, row {row + 1}, column {name}",
                    do="correct the table, or fetch it again",
                )
