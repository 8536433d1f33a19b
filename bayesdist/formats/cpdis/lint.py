"""Checks of CPDIS look-up tables against the behaviour of astropy.wcs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.errors import FormatError
from bayesdist.formats.cpdis.file import (
    ERRORS,
    TABLES,
    CpdisFile,
    CpdisImage,
    cpdis_calibration,
)
from bayesdist.products.common.document import (
    Choice,
    Finding,
    MissingSizeError,
    of_part,
)
from bayesdist.products.common.lookup_plane import Plane

_TINY = 1e-3  # pixels; if all shifts are smaller, the table is probably in another unit
_ASKEW = 0.75  # steps; half the difference between the margins at both ends that is reported
# expected sign of det(CD) by CTYPE1: RA increases to the left, solar longitude to the right
_HANDED = {"RA--": -1, "HPLN": 1}
_WIDE = 180.0  # degrees; an image this wide means that CD is in arcseconds


def lint_cpdis(file: CpdisFile) -> tuple[Finding, ...]:
    """Findings in a file with CPDIS look-up tables."""
    out: list[Finding] = []
    for image in file.images:
        part = image.hdu.label if len(file.images) > 1 else ""
        findings = (*_records(image), *_tables(image), *_linear(image), *_alternates(image))
        out += of_part(part, findings)
    if not [f for f in out if f.level == "error"]:
        try:
            cpdis_calibration(file, file.name, Choice())
        except MissingSizeError:
            out.append(Finding("note", "NAXIS1", "the size of the image is not stated"))
        except FormatError as error:
            out.append(Finding("error", "BDPARAM", error.cause))
    return tuple(out)


def _records(image: CpdisImage) -> Iterator[Finding]:
    for axis in (1, 2):
        function = image.function(axis)
        if not function:
            yield Finding("warning", f"CPDIS{axis}", "is missing: that axis has no distortion")
            continue
        if function != "LOOKUP":
            yield Finding(
                "error", f"CPDIS{axis}", f"is {function}: astropy.wcs leaves it out with a warning"
            )
            continue
        if f"DP{axis}.EXTVER" not in image.header:
            yield Finding(
                "warning",
                f"DP{axis}.EXTVER",
                "is missing, and taken for 1: both axes share a table",
            )
        axes = image.axes(axis)
        if None in axes:
            yield Finding("error", f"DP{axis}.AXIS", "is missing, and astropy.wcs stops without it")
        elif axes != (1, 2):
            yield Finding(
                "error", f"DP{axis}.AXIS",
                f"says {axes}: astropy.wcs transposes the table of axis 1 and not its registration",
            )  # fmt: skip
        if image.plane(axis) is None:
            yield Finding(
                "error", f"DP{axis}.EXTVER",
                f"there is no extension {TABLES},{image.version(axis)}, and astropy.wcs stops",
            )  # fmt: skip
        if float(image.header.get(f"CPERR{axis}", 0.0)) < 0:
            yield Finding(
                "error", f"CPERR{axis}", "is below zero, and astropy.wcs leaves the table out"
            )
    are_tables = image.function(1) == image.function(2) == "LOOKUP"
    if are_tables and image.version(1) == image.version(2):
        yield Finding("warning", "DP2.EXTVER", "both axes have the table of one extension")


def _tables(image: CpdisImage) -> Iterator[Finding]:
    planes = {axis: p for axis in (1, 2) if (p := image.plane(axis)) is not None}
    largest = []
    for axis, plane in planes.items():
        location = f"{TABLES},{image.version(axis)}"
        values = plane.values
        if values.ndim != 2 or min(values.shape) < 2:
            yield Finding("error", location, f"shape {values.shape} is no grid of nodes")
            return
        if not np.isfinite(values).all():
            yield Finding("error", location, "holds nodes that are not finite")
            return
        largest.append(float(np.abs(values).max()))
        if plane.missing:
            yield Finding(
                "warning", location,
                f"{', '.join(plane.missing)} missing: the registration is then that of "
                "astropy.wcs, another one since its version 6.1 than before",
            )  # fmt: skip
        else:
            yield from _registration(image, plane, location)
        sigma = image.tables.get((ERRORS, image.version(axis)))
        if sigma is not None and (
            sigma.image.shape != values.shape or not (sigma.image >= 0).all()
        ):
            yield Finding(
                "warning", f"{ERRORS},{image.version(axis)}", "is no table of errors of the nodes"
            )
    if largest and 0 < max(largest) < _TINY:
        yield Finding(
            "warning", TABLES, f"hold shifts of {max(largest):.2g} at most: their unit is the pixel"
        )


def _registration(image: CpdisImage, plane: Plane, where: str) -> Iterator[Finding]:
    """Findings on nodes that are nearer to one edge of the image than to the other."""
    if image.size is None:
        return
    for axis, (n, first, step, size) in enumerate(
        zip(plane.nodes.shape[::-1], plane.first, plane.step, image.size, strict=True)
    ):
        if step <= 0:
            yield Finding("error", where, f"CDELT{axis + 1} is {step:g}, no step between nodes")
            continue
        low, high = first - 0.5, size + 0.5 - (first + (n - 1) * step)
        if abs(low - high) / 2 > _ASKEW * step or max(low, high) > 1.5 * step:
            yield Finding(
                "warning", where,
                f"the nodes along {'xy'[axis]} begin {low:.4g} pixels inside the image and end "
                f"{high:.4g} inside, in steps of {step:g}: they may be registered a node off",
            )  # fmt: skip


def _linear(image: CpdisImage) -> Iterator[Finding]:
    det = float(np.linalg.det(image.cd))
    if det == 0:
        yield Finding("error", "CD", "is singular")
    elif "-" not in str(image.header.get("CTYPE1", "")):  # as in RA---TAN
        yield Finding(
            "note",
            "CTYPE",
            "names no position on the sky: u, v are on a plane of unknown position, and CD is in "
            "degrees unless CUNIT says otherwise",
        )
    elif image.size is not None and np.sqrt(abs(det)) * max(image.size) > _WIDE:
        yield Finding("error", "CD", "makes the image wider than the sky: check its unit")
    elif det * _HANDED.get(str(image.header.get("CTYPE1", ""))[:4], 0) < 0:
        yield Finding("note", "CD", "has the parity of a mirror image")


def _alternates(image: CpdisImage) -> Iterator[Finding]:
    """Findings on alternate coordinate systems, to which not all programs apply the tables."""
    keys = sorted({k[-1] for k in image.header if k[:5] == "CTYPE" and k[-1].isalpha()})
    without = [k for k in keys if f"CPDIS1{k}" not in image.header]
    if without:
        yield Finding(
            "warning", ", ".join(f"CPDIS1{k}" for k in without),
            "is missing: the standard leaves such a system without the tables, and astropy.wcs "
            "up to its version 8.0 applies those of the primary one",
        )  # fmt: skip
    if len(without) < len(keys):
        stated = ", ".join(f"CPDIS1{k}" for k in keys if k not in without)
        yield Finding("note", stated, "astropy.wcs up to its version 8.0 cannot read that system")
