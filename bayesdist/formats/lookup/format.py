"""Format of D2IMFILE and NPOLFILE."""

from __future__ import annotations

import numpy as np

from bayesdist.formats.lookup.file import AXES, LookupFile, check_kind
from bayesdist.formats.lookup.lint import lint_lookup_file
from bayesdist.model import LookupTable
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Format, finding_lines, identity_lines


def _parse(content: Content) -> LookupFile | None:
    hdus = content.tables
    if not any(hdu.name in AXES for hdu in hdus[1:]):
        return None
    return LookupFile(hdus, content.name)


def _describe(file: LookupFile) -> list[str]:
    """Lines of text on a D2IMFILE or NPOLFILE, with the findings at the end."""
    header = file.header
    kind, unit = {
        "d2im": ("D2IMFILE", "pixels, before the polynomial"),
        "npol": ("NPOLFILE", "undistorted pixels of SCALE, after the polynomial"),
    }[file.kind]
    lines = [
        f"{file.name}: {kind} of {file.instrument or '(no INSTRUME)'}/"
        f"{file.detector or '(no DETECTOR)'}, {len(file.chips)} chip(s)",
    ]
    lines += identity_lines(header)
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
    return [*lines, "", *finding_lines(lint_lookup_file(file))]


def _tables(file: LookupFile) -> tuple[LookupTable, ...]:
    """Look-up tables of the detector."""
    check_kind(file, "d2im")
    return tuple(file.table(chip) for chip in file.chips)


FORMAT = Format(
    "lookup",
    "a D2IMFILE or NPOLFILE",
    3,
    _parse,
    _describe,
    lint_lookup_file,
    tables=_tables,
)
