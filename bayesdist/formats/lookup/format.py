"""Format of D2IMFILE and NPOLFILE, and their checks."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from bayesdist.errors import FormatError
from bayesdist.formats.lookup.file import AXES, LookupFile, check_kind
from bayesdist.model import LookupTable
from bayesdist.products.common.content import Content, TablePlane
from bayesdist.products.common.document import (
    Finding,
    Format,
    finding_lines,
    identity_lines,
)
from bayesdist.products.common.rules import (
    IDENTITY,
    Missing,
    missing,
    no_grid,
    no_sigmas,
    not_finite,
)


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


# -- checks ---------------------------------------------------------------------------------------


_PLACE = ("CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2")
_KEYWORDS = (
    *(Missing(keyword, ", and stwcs stops without it") for keyword in ("INSTRUME", "DETECTOR")),
    *IDENTITY,
)


def lint_lookup_file(file: LookupFile) -> tuple[Finding, ...]:
    """Check a D2IMFILE or NPOLFILE against the behaviour of stwcs and astropy.wcs.

    Parameters
    ----------
    file : LookupFile
        File to check.

    Returns
    -------
    tuple of Finding
        Errors, warnings and notes.

    Raises
    ------
    FormatError
        If a keyword that must be numeric is not.
    """
    return (
        *_header(file),
        *_registration(file),
        *_chips(file),
        *_values(file),
        *_sigma(file),
    )


def _is_wfc(file: LookupFile) -> bool:
    return (file.instrument, file.detector) == ("ACS", "WFC")


def _header(file: LookupFile) -> Iterator[Finding]:
    yield from missing(file.header, _KEYWORDS)
    if file.kind == "npol" and not file.filters:
        unknown = ": the file does not say what filter it is of"
        yield Missing("FILTER1", unknown, "warning").finding
    if file.kind == "d2im" and file.filters:
        yield Finding("warning", "FILTER1", "a D2IMFILE is applied whatever the filter")


def _registration(file: LookupFile) -> Iterator[Finding]:
    """Findings on node positions, one per group of extensions with the same missing keywords."""
    groups: dict[tuple[str, ...], list[TablePlane]] = {}
    for plane in file.planes:
        groups.setdefault(plane.missing, []).append(plane)
    for absent, planes in groups.items():
        location = _names(planes)
        steps = [name for name in absent if name.startswith("CDELT")]
        if steps:
            yield Finding(
                "error",
                location,
                f"{', '.join(steps)} missing: nodes are taken to be 1 pixel apart",
            )
        elif set(absent) == set(_PLACE):
            (x, y), (dx, dy) = planes[0].first, planes[0].step
            yield Finding(
                "warning",
                location,
                f"registration: without CRPIX and CRVAL astropy.wcs puts the first node at pixel "
                f"({x:g}, {y:g}), before its version 6.1 at (1, 1); centres of bins would be at "
                f"({dx / 2 + 0.5:g}, {dy / 2 + 0.5:g})",
            )
        elif absent:
            yield Finding(
                "warning", location, f"registration: {', '.join(absent)} missing, taken 0"
            )
    for plane in file.planes:
        yield from _cover(plane)


def _cover(plane: TablePlane) -> Iterator[Finding]:
    """Findings on tables that end more than a step inside an edge and are constant beyond."""
    sizes = [plane.number(f"ONAXIS{a}", 0) for a in (1, 2)]
    for axis, (n, first, step, size) in enumerate(
        zip(plane.nodes.shape[::-1], plane.first, plane.step, sizes, strict=True)
    ):
        last = first + (n - 1) * step
        if size and step > 0 and (first - 1 > step or size - last > step):
            yield Finding(
                "warning",
                _names([plane]),
                f"the nodes span pixels {first:g} to {last:g} of {'xy'[axis]}, the chip 1 to "
                f"{size:g}: beyond them the table is constant",
            )


def _chips(file: LookupFile) -> Iterator[Finding]:
    without = [p for p in file.planes if "CCDCHIP" not in p.header]
    if without:
        consequence = "stwcs stops without it" if _is_wfc(file) else "stwcs takes chip 1"
        yield Finding(
            "error" if _is_wfc(file) else "note", _names(without), f"no CCDCHIP: {consequence}"
        )
    elif _is_wfc(file):
        swapped = [p for p in file.planes if p.version != 3 - p.chip and p.chip in (1, 2)]
        if swapped:
            yield Finding(
                "warning",
                _names(swapped),
                "EXTVER 1 is chip 2 of ACS/WFC and EXTVER 2 chip 1, but CCDCHIP, by which stwcs "
                "goes, says the opposite: the chips may be swapped",
            )
        for chip in {1, 2} - set(file.chips):
            yield _absent(file, chip, "DX, DY")
    for chip in file.chips:
        names = [p.name for p in file.planes if p.chip == chip]
        for axis in AXES:
            if axis not in names:
                yield _absent(file, chip, axis)
            elif names.count(axis) > 1:
                yield Finding(
                    "warning",
                    f"chip {chip}",
                    f"{names.count(axis)} extensions {axis}: stwcs takes the values of the last "
                    "and the registration of the first",
                )
        if sorted(names) == sorted(AXES):
            try:
                file.pair(chip)
            except FormatError as error:
                yield Finding("error", f"chip {chip}", error.cause)


def _absent(file: LookupFile, chip: int, axes: str) -> Finding:
    if file.kind == "npol":
        return Finding("error", f"chip {chip}", f"no {axes}, and stwcs stops at that chip")
    return Finding("warning", f"chip {chip}", f"no {axes}: stwcs leaves it as it is")


def _values(file: LookupFile) -> Iterator[Finding]:
    good = []
    for plane in file.planes:
        values = plane.values
        unusable = no_grid(values, _names([plane])) or not_finite(
            values, _names([plane]), "{count} nodes are not finite: so is the sky around them"
        )
        yield from unusable
        if not unusable:
            good.append(plane)
    for plane in good:
        if plane.values.max() < 0:
            keyword = "CPERR" if file.kind == "npol" else "D2IMERR"
            yield Finding(
                "error",
                _names([plane]),
                f"all nodes are negative: stwcs writes their maximum, {plane.values.max():.4g}, as "
                f"{keyword}, and astropy.wcs leaves out a table whose {keyword} is below zero",
            )
    for a, b in combinations(good, 2):
        if a.nodes.shape == b.nodes.shape and a.nodes.any() and (a.nodes == b.nodes).all():
            yield Finding("warning", _names([a, b]), "the same values: one may be a copy")


def _sigma(file: LookupFile) -> Iterator[Finding]:
    shapes = {(p.chip, p.name): p.nodes.shape for p in file.planes}
    for plane in file.sigma_planes:
        yield from no_sigmas(
            plane.values,
            shapes.get((plane.chip, plane.name.removeprefix("SIGMA_"))),
            _names([plane]),
            "some sigmas are negative or not finite",
            "the shape is not that of the table",
        )
    for chip in file.chips:
        given = {p.name for p in file.sigma_planes if p.chip == chip}
        if len(given) == 1:
            [name], wanted = given, {f"SIGMA_{axis}" for axis in AXES}
            [missing] = wanted - given
            text = f"{name} has no {missing} beside it, and the errors of the chip are not read"
            yield Finding("warning", f"chip {chip}", text)


def _names(planes: list[TablePlane]) -> str:
    """Names of extensions, such as "DX,1"."""
    return ", ".join(f"{p.name},{p.version}" for p in planes)


FORMAT = Format(
    "lookup",
    "a D2IMFILE or NPOLFILE",
    3,
    _parse,
    _describe,
    lint_lookup_file,
    tables=_tables,
)
