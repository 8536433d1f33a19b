"""Format of IDCTABs, and their description as text."""

from __future__ import annotations

import numpy as np
from pydantic import PositiveFloat

from bayesdist.calibration.calibration import Calibration
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.calibration import idctab_calibration
from bayesdist.formats.idctab.lint import LIMITS, lint_idctab
from bayesdist.formats.idctab.table import FILTER_COLUMNS, HIGHEST, IdcTab, idctab_column, parity_of
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
