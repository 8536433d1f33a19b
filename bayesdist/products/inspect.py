"""A product in words: what a file holds, and what is wrong in it."""

from __future__ import annotations

import os
from collections.abc import Iterable

import numpy as np

from bayesdist.errors import InputError
from bayesdist.products.formats.common.coefficients import idctab_column, largest_magnitude
from bayesdist.products.formats.common.content import read_content
from bayesdist.products.formats.common.document import finding_lines
from bayesdist.products.idctab import FILTER_COLUMNS, IdcTab
from bayesdist.products.idctab_lint import lint_idctab
from bayesdist.products.lookup_file import AXES, LookupFile
from bayesdist.products.lookup_lint import lint_lookup_file
from bayesdist.products.sip_text import describe_wise_meta
from bayesdist.products.wcs_text import describe_wcs, holds_wcs
from bayesdist.products.wise_meta import holds_wise_meta, read_wise_meta

__all__ = [
    "UNDERSTOOD",
    "describe",
    "describe_idctab",
    "describe_lookup_file",
]

UNDERSTOOD = (
    "an IDCTAB, a D2IMFILE or NPOLFILE, or a FITS file or text file of cards with WCS keywords, "
    "or WISE meta-data"
)

_SCHEMES = {
    "2015": "scheme of 2015: CX11 += CXB dt, CY11 += CTB dt, CY10 += CYB dt",
    "2014": "scheme of 2014 (TDD_CXB, TDD_CYB)",
    "order": "skew terms TDD_A, TDD_B",
    "default": "no keywords: stwcs applies its own terms of 2004.5",
    "none": "none",
}


def describe(path: str | os.PathLike[str]) -> str:
    """Readable text of what a file holds, with the findings of the lint at its end.

    The kind of file is told by its content.

    Parameters
    ----------
    path : path-like
        An IDCTAB, a D2IMFILE or NPOLFILE, a FITS file or text header with WCS keywords, or a WISE
        meta-data file.

    Returns
    -------
    str
        Several lines.

    Raises
    ------
    InputError
        When the file cannot be read or is of none of these kinds.
    """
    name = str(path)
    content = read_content(path)
    damaged = content.damage
    hdus = () if damaged or not content.is_fits else content.whole()
    if len(hdus) > 1 and _is_idctab(hdus[1].header.values()):
        return describe_idctab(IdcTab(hdus, name))
    if any(hdu.name in AXES for hdu in hdus[1:]):
        return describe_lookup_file(LookupFile(hdus, name))
    if any(holds_wcs(hdu.header) for hdu in content.hdus):
        return describe_wcs(content)
    if holds_wise_meta(path):
        return describe_wise_meta(read_wise_meta(path), name)
    if damaged is not None:
        raise damaged
    raise InputError("is of no kind that is understood here", where=name, do=f"give {UNDERSTOOD}")


def _is_idctab(values: Iterable[object]) -> bool:
    columns = {str(v).strip() for v in values}
    return {"XREF", "YREF"} <= columns and bool({"CX10", "A10"} & columns)


# -- IDCTAB --------------------------------------------------------------------------------------


def describe_idctab(tab: IdcTab) -> str:
    """Text of an IDCTAB.

    Parameters
    ----------
    tab : IdcTab

    Returns
    -------
    str
    """
    header = tab.header
    lines = [
        f"{tab.name}: IDCTAB of {tab.instrument}/{tab.detector or '(no DETECTOR)'}, "
        f"order {tab.norder}, {len(tab.rows)} rows",
    ]
    lines += [f"  {k:<9} {header[k]}" for k in ("DESCRIP", "USEAFTER", "PEDIGREE") if k in header]
    lines.append(f"  time      {_SCHEMES[tab.tdd_scheme]}")
    lines += [f"            {k} = {v:.10g}" for k, v in tab.tdd.items()]
    filters = sorted({" ".join(f) for f in tab.filters()} - {""})
    if filters:
        shown = ", ".join(filters[:4]) + (" ..." if len(filters) > 4 else "")
        lines.append(f"  filters   {len(filters)} combinations: {shown}")
    else:
        lines.append("  filters   no columns: the rows serve every filter")
    kept = "standard deviations and covariance" if tab.covariance is not None else "none"
    lines.append(f"  errors    {kept}")
    if "BDANGLE" in header:
        lines.append(
            f"  V2/V3     turned by {header['BDANGLE']:.6g} +- {header['BDANGSIG']:.2g} deg, "
            f"scale {header['BDSCALE']:.8g} +- {header['BDSCASIG']:.2g} arcsec"
        )
    for row in _first_rows(tab):
        lines += ["", *_row_text(tab, row)]
    return "\n".join([*lines, "", *finding_lines(lint_idctab(tab))])


def _first_rows(tab: IdcTab) -> list[int]:
    """The first row of each chip and direction."""
    names = [c for c in ("DETCHIP", "DIRECTION") if c in tab.columns]
    seen: dict[tuple, int] = {}
    for k, row in enumerate(tab.rows):
        seen.setdefault(tuple(row[c] for c in names), k)
    return list(seen.values())


def _row_text(tab: IdcTab, row: int) -> list[str]:
    record = tab.rows[row]
    parts = [f"row {row + 1}"]
    for label in ("DETCHIP", "DIRECTION", *FILTER_COLUMNS):
        if label in tab.columns:
            parts.append(f"{label} {str(record[label]).strip()}")
    lines = ["  " + ", ".join(parts)]
    geometry = [n for n in ("XSIZE", "YSIZE", "XREF", "YREF", "V2REF", "V3REF", "SCALE", "THETA")
                if n in tab.columns]  # fmt: skip
    lines.append("    " + "  ".join(f"{n} {float(record[n]):.10g}" for n in geometry))
    inverse = "DIRECTION" in tab.columns and str(record["DIRECTION"]).strip().upper() == "INVERSE"
    if not inverse:
        lines.append(f"    non-linear part: {_non_linear(tab, row)} px at most")
    sigma = tab.sigma
    same = None if sigma is None or len(sigma) != len(tab.rows) else sigma[row]
    unit = "px/arcsec^n" if inverse else "arcsec/px^n"
    head = f"    column        value [{unit}]" + ("       sigma" if same is not None else "")
    lines.append(head)
    for prefix in tab.prefixes:
        for i, j in tab.terms:
            if i + j:
                name = idctab_column(prefix, i, j)
                error = f"  {float(same[name]):10.3e}" if same is not None else ""
                power = f"X^{i} Y^{j}" if inverse else f"x^{i} y^{j}"
                lines.append(f"    {name:<5} {power:<8} {float(record[name]):21.13e}{error}")
    return lines


def _non_linear(tab: IdcTab, row: int) -> str:
    """Largest terms above order 1, in pixels of SCALE, of Xc and Yc."""
    record = tab.rows[row]
    scale = float(record["SCALE"])
    if scale == 0 or not np.isfinite(scale):
        return "?"
    ranges = [
        (1 - float(record[f"{a}REF"]), float(record[f"{a}SIZE"]) - float(record[f"{a}REF"]))
        for a in "XY"
    ]
    out = []
    for values in tab.coefficients_of_row(row):
        terms = {t: c for t, c in zip(tab.terms, values.tolist(), strict=True) if sum(t) > 1}
        out.append(f"{largest_magnitude(terms, *ranges) / abs(scale):.4g}")
    return " and ".join(out)


# -- look-up tables ------------------------------------------------------------------------------


def describe_lookup_file(file: LookupFile) -> str:
    """Text of a D2IMFILE or NPOLFILE.

    Parameters
    ----------
    file : LookupFile

    Returns
    -------
    str
    """
    header = file.header
    kind, unit = {
        "d2im": ("D2IMFILE", "pixels, before the polynomial"),
        "npol": ("NPOLFILE", "undistorted pixels of SCALE, after the polynomial"),
    }[file.kind]
    lines = [
        f"{file.name}: {kind} of {file.instrument or '(no INSTRUME)'}/"
        f"{file.detector or '(no DETECTOR)'}, {len(file.chips)} chip(s)",
    ]
    lines += [f"  {k:<9} {header[k]}" for k in ("DESCRIP", "USEAFTER", "PEDIGREE") if k in header]
    if file.filters:
        lines.append(f"  filters   {' '.join(file.filters)}")
    if "BDNPLERR" in header:
        lines.append(f"  linear    error of the linear form {header['BDNPLERR']:.2g} mas at most")
    lines.append(f"  unit      {unit}")
    for chip in file.chips:
        planes = [p for p in file.planes if p.chip == chip]
        sigma = {p.name.removeprefix("SIGMA_"): p for p in file.sigma_planes if p.chip == chip}
        ny, nx = planes[0].nodes.shape
        (x, y), (dx, dy) = planes[0].first, planes[0].step
        padded = ", padded" if "BDPAD" in planes[0].header else ""
        lines += [
            "",
            f"  chip {chip}: {nx} x {ny} nodes{padded}, first at pixel ({x:g}, {y:g}), "
            f"step {dx:g} x {dy:g}",
            "          smallest   largest       rms" + ("   median sigma" if sigma else ""),
        ]
        for plane in planes:
            values = plane.nodes
            row = f"    {plane.name}  {values.min():10.4f}{values.max():10.4f}"
            row += f"{np.sqrt(np.mean(values**2)):10.4f}"
            if plane.name in sigma:
                row += f"{np.median(sigma[plane.name].nodes):15.4f}"
            lines.append(row)
    return "\n".join([*lines, "", *finding_lines(lint_lookup_file(file))])
