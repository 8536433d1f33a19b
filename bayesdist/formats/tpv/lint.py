"""Checks of TPV headers against the behaviour of programs that read them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.calibration.inverse import detector_grid
from bayesdist.formats.tpv.head import POWERS, TpvFile, TpvHead, pv_value
from bayesdist.products.common.document import Finding, of_part, repeated_values

_LARGE = 0.3  # fraction of the distance from CRPIX; no camera has a larger distortion
_WIDE = 180.0  # degrees; an image this wide means that CD is in arcseconds
_ROUGH = 4096  # pixels; size assumed for a header without one


def lint_tpv(file: TpvFile) -> tuple[Finding, ...]:
    """Findings in TPV headers."""
    out: list[Finding] = []
    several = len(file.heads) > 1
    for head in file.heads:
        findings = (*_types(head), *_first_terms(head), *_scale(head), *_copies(head))
        out += of_part(f"chip {head.number}" if several else "", findings)
    out += list(_mosaic(file))
    if file.side_file and file.content.path and file.content.beside(file.side_file) is None:
        out.append(
            Finding("warning", "BDPARAM", f"{file.side_file}, with the covariance, is not here")
        )
    return tuple(out)


def _types(head: TpvHead) -> Iterator[Finding]:
    types = ", ".join(head.ctype)
    if not head.ctype[0].startswith(("RA", "GLON", "ELON")):
        yield Finding("error", "CTYPE1", f"the axes are {types}: PV1 belong to the longitude")
    if all(t.endswith("-TAN") for t in head.ctype):
        yield Finding(
            "warning", "CTYPE1",
            "is TAN with the PV of a TPV, as SCAMP wrote it before: wcslib takes it for TPV, and "
            "programs that keep to the standard leave the distortion out",
        )  # fmt: skip
    elif not all(t.endswith("-TPV") for t in head.ctype):
        yield Finding("error", "CTYPE1", f"the axes are {types}: only one of them is TPV")
    if head.size is None:
        yield Finding("note", "NAXIS1", "the size of the image is not stated")


def _first_terms(head: TpvHead) -> Iterator[Finding]:
    for axis, pv in enumerate(head.pv, start=1):
        first = pv.get(1)
        if first is None:
            yield Finding(
                "error", f"PV{axis}_1",
                "is missing: astropy.wcs takes it for 0, which maps the axis to a line, and other "
                "programs for 1",
            )  # fmt: skip
        elif first < 0:
            yield Finding("error", f"PV{axis}_1", f"is {first:g}: the axis runs backwards (parity)")
        elif not 0.5 < first < 2:
            yield Finding("warning", f"PV{axis}_1", f"is {first:g}, and 1 is usual")
        second = pv.get(2, 0.0)
        if first is not None and abs(second) > abs(first):
            yield Finding(
                "error", f"PV{axis}_2",
                f"is {second:g}, larger than PV{axis}_1: the order of the coefficients of axis 2 "
                "is that of Y before X",
            )  # fmt: skip


def _scale(head: TpvHead) -> Iterator[Finding]:
    det = float(np.linalg.det(head.cd))
    if abs(det) <= 1e-12 * np.abs(head.cd).max() ** 2:
        yield Finding("error", "CD", "is singular")
        return
    if det > 0:
        yield Finding(
            "note", "CD", "has the parity of a mirror image: east lies to the right of north"
        )
    size = head.size or (_ROUGH, _ROUGH)
    width = np.sqrt(abs(det)) * max(size)
    if width > _WIDE:
        yield Finding(
            "error", "CD", f"makes the image {width:.3g} degrees wide: its unit is the degree"
        )
        return
    if 1 not in head.pv[0] or 1 not in head.pv[1]:
        return
    x, y = detector_grid((float(size[0]), float(size[1])), 17)
    at, in_plane = head.intermediate(x, y), np.stack(head.plane(x, y))
    constant = np.array([pv.get(0, 0.0) for pv in head.pv])[:, None]
    first = [{m: pv.get(m, 0.0) for m in (1, 2)} for pv in head.pv]
    linear = np.stack([pv_value(axis, first[axis], *at) for axis in (0, 1)])
    bend = float(np.hypot(*(in_plane - constant - linear)).max())
    half = float(np.hypot(*at).max())
    if bend > _LARGE * half:
        yield Finding(
            "error", "PV",
            f"bend the field by {bend:.3g} of {half:.3g} degrees: they multiply powers of degrees, "
            "not of arcseconds or pixels, and their order is that of TPV",
        )  # fmt: skip


def _copies(head: TpvHead) -> Iterator[Finding]:
    named = {
        f"PV{axis}_{m}": value
        for axis, pv in enumerate(head.pv, start=1)
        for m, value in pv.items()
        if m not in (1, 2)
    }
    for group in repeated_values(named):
        yield Finding("warning", ", ".join(group), "have one value: one may be a copy")
    if head.radial:
        yield Finding("note", "PV", "has powers of r, which no polynomial follows exactly")
    high = [k for pv in head.pv for k, c in pv.items() if c and k in POWERS and sum(POWERS[k]) > 1]
    if not high and not head.radial:
        yield Finding("note", "PV", "no term above the linear ones: there is no distortion")


def _mosaic(file: TpvFile) -> Iterator[Finding]:
    signs = {float(np.sign(np.linalg.det(head.cd))) for head in file.heads}
    if len(signs) > 1:
        yield Finding("warning", "CD", "chips are of different parity: check their order")
    points = {head.crval for head in file.heads}
    if len(points) > 1:
        yield Finding("note", "CRVAL", "chips touch the sky at different points")
