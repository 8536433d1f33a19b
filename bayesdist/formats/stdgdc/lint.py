"""Checks of an STDGDC file against the behaviour of programs that read it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.calibration.inverse import detector_grid
from bayesdist.errors import FormatError
from bayesdist.formats.stdgdc.file import (
    EXTENSIONS,
    SIGMAS,
    StdGdc,
    stdgdc_calibration,
)
from bayesdist.model import LookupTable
from bayesdist.products.common.document import Choice, Finding
from bayesdist.utils.arrays import Float

_CLOSE = 0.3  # pixels; an inverse with a larger closure is counted from another pixel
_TOO_FAR = 0.5  # fraction of the detector; no camera moves pixels that far
_AREA = 0.02  # magnitudes; tolerance between MGC and the area of the pixels
_INSIDE = 0.95  # quantile of the closure that is checked: some pixels are outside the inverse table


def lint_stdgdc(file: StdGdc) -> tuple[Finding, ...]:
    """Findings in an STDGDC file."""
    return (*_extensions(file), *(_tables(file) if _readable(file) else ()))


def _readable(file: StdGdc) -> bool:
    try:
        return file.table("XGC").shape == file.table("YGC").shape
    except FormatError:
        return False


def _extensions(file: StdGdc) -> Iterator[Finding]:
    for name in file.missing:
        level = "error" if name in EXTENSIONS[:3] else "warning"
        yield Finding(level, name, "the extension is missing, and programs count on five")
    names = [hdu.name for hdu in file.content.hdus[1:6]]
    if not file.missing and tuple(names) != EXTENSIONS:
        yield Finding(
            "error",
            ", ".join(names),
            "extensions are read by their position: XGC, YGC, MGC, XCG, YCG",
        )
    if not _readable(file):
        yield Finding("error", "XGC, YGC", "are no pair of tables of one shape")
        return
    nx, ny = file.size
    for axis, n in (("XGC", nx), ("YGC", ny)):
        stated = file.header.get(f"NDIM_{axis}")
        if stated is None:
            yield Finding("error", f"NDIM_{axis}", "is missing, and programs stop without it")
        elif int(stated) != n:
            yield Finding("error", f"NDIM_{axis}", f"is {stated}, and the table has {n}")


def _tables(file: StdGdc) -> Iterator[Finding]:
    xgc, ygc = file.table("XGC"), file.table("YGC")
    for name in EXTENSIONS:
        if name not in file.missing and not np.isfinite(file.table(name)).all():
            yield Finding("error", name, "holds numbers that are not finite")
            if name in ("XGC", "YGC"):
                return
    dx, dy = np.gradient(xgc, axis=1).mean(), np.gradient(ygc, axis=0).mean()
    across = np.gradient(xgc, axis=0).mean(), np.gradient(ygc, axis=1).mean()
    if min(np.abs(across)) > max(abs(dx), abs(dy)):
        yield Finding("error", "XGC, YGC", "x and y are exchanged, or the tables transposed")
        return
    for axis, slope in (("XGC", dx), ("YGC", dy)):
        if slope < 0:
            yield Finding("error", axis, "runs backwards along the detector (parity)")
            return
        if not 0.5 < slope < 2:
            yield Finding(
                "error",
                axis,
                f"grows by {slope:.3g} a pixel: its unit is the pixel of the detector",
            )
            return
    ny, nx = xgc.shape
    far = np.hypot(xgc - np.arange(1, nx + 1), ygc - np.arange(1, ny + 1)[:, None])
    if far.max() > _TOO_FAR * max(nx, ny):
        yield Finding("warning", "XGC, YGC", f"move pixels by up to {far.max():.3g}")
    yield from _inverse(file, xgc, ygc)
    yield from _area(file, xgc, ygc)
    yield from _stored(file)


def _inverse(file: StdGdc, xgc: Float, ygc: Float) -> Iterator[Finding]:
    """Findings on an inverse that does not return to the original pixels."""
    if "XCG" in file.missing or "YCG" in file.missing:
        return
    back = file.table("XCG"), file.table("YCG")
    if back[0].shape != back[1].shape:
        yield Finding("error", "XCG, YCG", "are no pair of tables of one shape")
        return
    if not all(np.isfinite(b).all() for b in back):
        return
    forward = LookupTable(1, np.stack([xgc, ygc]), first=(1.0, 1.0), step=(1.0, 1.0))
    inverse = LookupTable(1, np.stack(back), first=(1.0, 1.0), step=(1.0, 1.0))
    ny, nx = xgc.shape
    x, y = detector_grid((nx, ny), 65)
    X, Y = forward.evaluate(x, y).T
    my, mx = back[0].shape
    inside = (X > 1) & (mx > X) & (Y > 1) & (my > Y)
    if not inside.any():
        return
    closure = inverse.evaluate(X[inside], Y[inside]) - np.stack([x[inside], y[inside]], axis=-1)
    off = float(np.quantile(np.hypot(*closure.T), _INSIDE))
    if off > _CLOSE:
        mean = closure.mean(axis=0)
        yield Finding(
            "error", "XCG, YCG",
            f"are off by {off:.3g} pixels as the inverse of XGC, YGC, on average by "
            f"({mean[0]:.2g}, {mean[1]:.2g}): they are counted from another pixel, or are "
            "of another solution",
        )  # fmt: skip


def _area(file: StdGdc, xgc: Float, ygc: Float) -> Iterator[Finding]:
    if "MGC" in file.missing:
        return
    mgc = file.table("MGC")
    if mgc.shape != xgc.shape or not np.isfinite(mgc).all():
        return
    xy, xx = np.gradient(xgc)
    yy, yx = np.gradient(ygc)
    expected = -2.5 * np.log10(np.maximum(np.abs(xx * yy - xy * yx), 1e-9))
    off, as_flux = np.median(np.abs(mgc - expected)), np.median(np.abs(mgc + expected))
    if off > _AREA or (as_flux < off and np.abs(expected).max() > _AREA):
        yield Finding(
            "warning", "MGC",
            f"is off by {off:.2g} magnitudes from -2.5 lg of the pixels' areas, which is added to "
            "magnitudes" + (": its sign is the opposite" if as_flux < off else ""),
        )  # fmt: skip


def _stored(file: StdGdc) -> Iterator[Finding]:
    for name in SIGMAS:
        hdu = file.hdu(name)
        if hdu is None:
            continue
        values = file.table(name)
        wrong = np.abs(values) > 1 if name == "CXYGC" else values < 0
        if wrong.any() or not np.isfinite(values).all():
            yield Finding("warning", name, "holds values that are no errors")
        if values.shape != file.table("XGC").shape:
            yield Finding("warning", name, "has not the shape of the tables")
    try:
        stdgdc_calibration(file, file.name, Choice())
    except FormatError as error:
        yield Finding("error", "BDPARAM", error.cause)
