"""STDGDC files: tables with a value for every pixel, as read by hst1pass.

Extensions in this order, with their dimensions in the primary header:

1. XGC, YGC: corrected x and y of each pixel, in FITS 1-based pixels, interpolated bilinearly
2. (the third extension) MGC: correction of magnitudes for the area of the pixel
3. XCG, YCG: pixel x and y of each corrected position: the inverse

Files written by bayesdist have further extensions, which other programs ignore: SXGC and SYGC, the
standard errors of XGC and YGC; CXYGC, their correlation; and BDPARAM, the parameters of the
solution with their covariance.

The corrected frame is that of a detector without distortion:

    corrected = reference + S^-1 ((u, v) - zero)

where S is the similarity (a scale, a rotation and possibly a mirror) closest to the map at its
reference pixel. The corrected frame is therefore aligned with the detector and has its scale, while
the skew of the map remains part of the distortion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.calibration.area import pixel_areas
from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import check_one_to_one, detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError, InputError
from bayesdist.model import LookupTable
from bayesdist.products.common.cards import (
    append_cards,
    convergence_cards,
    named_in,
    number_card,
    set_text,
    wrapped_cards,
)
from bayesdist.products.common.content import Content, Hdu, fits_bytes
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
    finding_lines,
)
from bayesdist.products.common.parameters import (
    parameters_hdu,
    refuse_changed,
    stored_calibration,
    stored_in,
)
from bayesdist.products.common.rules import Missing, not_finite
from bayesdist.utils.arrays import Float

_S = ("BDS1_1", "BDS1_2", "BDS2_1", "BDS2_2")


@dataclass(frozen=True, eq=False)
class CorrectedFrame:
    """Relation between positions (u, v) and corrected pixels."""

    reference: tuple[float, float]  # FITS 1-based pixel that does not move
    zero: Float  # (2,), (u, v) at that pixel
    similarity: Float  # (2, 2), S

    def corrected(self, at: Float) -> Float:
        """Corrected pixels (2, N) at positions (2, N)."""
        inside = np.linalg.solve(self.similarity, at - self.zero[:, None])
        return inside + np.array(self.reference)[:, None]

    def positions(self, corrected: Float) -> Float:
        """Positions (2, N) at corrected pixels (2, N)."""
        inside = corrected - np.array(self.reference)[:, None]
        return self.similarity @ inside + self.zero[:, None]

    def keywords(self) -> dict[str, tuple[float, str]]:
        """Header keywords of the frame, with their values and comments."""
        out = {
            "BDREF1": (float(self.reference[0]), "[pix] pixel that is not moved"),
            "BDREF2": (float(self.reference[1]), "[pix]"),
            "BDZERO1": (float(self.zero[0]), "u there"),
            "BDZERO2": (float(self.zero[1]), "v there"),
        }
        comment = "(u, v) by corrected pixels"
        values = zip(_S, self.similarity.ravel(), strict=True)
        return out | {keyword: (float(value), comment) for keyword, value in values}

    @classmethod
    def of_header(cls, header: fits.Header) -> CorrectedFrame | None:
        """Frame stated in a header; None if the header states none."""
        names = ("BDREF1", "BDREF2", "BDZERO1", "BDZERO2", *_S)
        if not all(isinstance(header.get(name), float | int) for name in names):
            return None
        a, b, c, d, *s = (float(header[name]) for name in names)
        return cls((a, b), np.array([c, d]), np.array(s).reshape(2, 2))


def frame_of(one: ChipMap, scale: float | None) -> CorrectedFrame:
    """Corrected frame of a map, with the given scale or that of the map at its reference pixel."""
    x, y = one.basis.reference_pixel
    linear = one.linear
    left_vectors, singular, right = np.linalg.svd(linear)
    size = float(np.sqrt(np.prod(singular))) if scale is None else scale
    return CorrectedFrame((x, y), one.at([x], [y])[:, 0], size * left_vectors @ right)


EXTENSIONS = ("XGC", "YGC", "MGC", "XCG", "YCG")
SIGMAS = ("SXGC", "SYGC", "CXYGC")


@dataclass(frozen=True, eq=False)
class StdGdc:
    """STDGDC tables of one detector."""

    content: Content

    @property
    def name(self) -> str:
        """Name of the file, for messages."""
        return self.content.name

    @cached_property
    def header(self) -> fits.Header:
        """Primary header."""
        return self.content.hdus[0].header

    def hdu(self, name: str) -> Hdu | None:
        """Extension with this name; None if there is none."""
        return next((hdu for hdu in self.content.hdus[1:] if hdu.name == name), None)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of missing extensions."""
        return tuple(name for name in EXTENSIONS if self.hdu(name) is None)

    def table(self, name: str) -> Float:
        """Values (ny, nx) of an extension; FormatError if it is missing or not an image."""
        hdu = self.hdu(name)
        if hdu is None:
            raise FormatError(
                f"has no extension {name}", where=self.name, do="give a whole STDGDC file"
            )
        if hdu.image.ndim != 2 or min(hdu.image.shape) < 2:
            raise FormatError(
                f"has the shape {hdu.image.shape}", where=f"{self.name}, {name}", do="check it"
            )
        return hdu.image

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the detector."""
        ny, nx = self.table("XGC").shape
        return nx, ny


def stdgdc_of(content: Content) -> StdGdc | None:
    """STDGDC file in the content of a file; None for any other content."""
    names = {hdu.name for hdu in content.tables[1:]}
    stated = bool(content.tables) and "NDIM_XGC" in " ".join(content.tables[0].cards)
    return StdGdc(content) if len(names & set(EXTENSIONS)) >= 2 or stated else None


# -- calibration ----------------------------------------------------------------------------------
def corrections(file: StdGdc) -> LookupTable:
    """Corrected minus detector pixels as a look-up table, exactly bilinear as programs use it.

    FormatError if the tables differ in shape or have values that are not finite.
    """
    xgc, ygc = file.table("XGC"), file.table("YGC")
    if xgc.shape != ygc.shape:
        raise FormatError("XGC and YGC differ in shape", where=file.name, do="check the file")
    if not (np.isfinite(xgc).all() and np.isfinite(ygc).all()):
        raise FormatError(
            "XGC or YGC hold numbers that are not finite", where=file.name, do="check the file"
        )
    y, x = np.indices(xgc.shape, float)
    shifts = np.stack([xgc - (x + 1), ygc - (y + 1)])
    number = int(file.header.get("BDCHIP", 1))
    return LookupTable(number, shifts, first=(1.0, 1.0), step=(1.0, 1.0))


def stdgdc_calibration(file: StdGdc, name: str, choice: Choice) -> Calibration:
    """Calibration of the tables, or the stored calibration of a bayesdist file.

    With ``choice.as_used``, only the tables are used; for a bayesdist file they are converted to
    the plane of its calibration. FormatError if the stored parameters and the tables differ by more
    than the file states.
    """
    table = corrections(file)
    hdu, frame = stored_in(file.content), CorrectedFrame.of_header(file.header)
    plane, unit = Plane("detector"), "pix"
    scale: float | None = 1.0
    source = "pixels of the corrected frame"
    if hdu is None or frame is None:
        frame = CorrectedFrame((0.0, 0.0), np.zeros(2), np.eye(2))
    else:
        stored = stored_calibration(hdu, name)
        if not choice.as_used:
            return _of_ours(file, stored, frame, table)
        plane, unit, scale, source = stored.plane, stored.unit, stored.scale, stored.scale_from
    size = (float(file.size[0]), float(file.size[1]))
    chip_map = fitted_map(
        lambda x, y: frame.positions(np.stack([x, y])),
        name,
        order=1,
        size=size,
        reference_pixel=((size[0] + 1) / 2, (size[1] + 1) / 2),
        unit=unit,
    )
    return calibration_of_maps(
        {table.chip: chip_map},
        name,
        plane=plane,
        numbered="BDCHIP" in file.header,
        detector=named_in(file.header, "DETECTOR", name),
        before=(table,),
        scale=scale,
        scale_from=source,
    )


def _of_ours(
    file: StdGdc, stored: Calibration, frame: CorrectedFrame, table: LookupTable
) -> Calibration:
    """Stored calibration, with its look-up tables taken from the file, or after a check of them."""
    number = stored.numbers[0]
    if file.header.get("BDTABLES", False):
        y, x = np.indices(table.shape, float)
        x, y = x.ravel() + 1, y.ravel() + 1
        corrected = np.stack([x, y]) + table.values.reshape(2, -1)
        residual = frame.positions(corrected) - stored.forward(x, y, chip=number).T
        after = replace(table, chip=number, values=residual.reshape(2, *table.shape))
        return replace(stored, after=(after,))
    x, y = detector_grid(stored.model.chips[0].size, 129)
    theirs = np.stack([x, y]) + table.evaluate(x, y).T
    ours = frame.corrected(stored.forward(x, y, chip=number).T)
    refuse_changed(float(np.hypot(*(ours - theirs)).max()), file.header, file.name)
    return stored


_BETWEEN = 997  # largest number of points per axis, between pixels, at which the tables are checked
_LARGEST = 2**26  # pixels; a larger detector is a misprint


class StdgdcSettings(FormatSettings):
    """Configuration of an STDGDC file."""

    precision: Literal["single", "double"] = "single"


def build(
    calibration: Calibration, settings: StdgdcSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build the file; its summary gives the largest rounding and interpolation error in pixels."""
    if len(calibration.numbers) > 1:
        raise InputError(
            "an STDGDC file is of one detector, but this one has the chips "
            f"{', '.join(map(str, calibration.numbers))}",
            where="products.stdgdc",
            do="write them one by one (Calibration.only in Python, --chip of convert)",
        )
    number = calibration.numbers[0]
    chip_map = calibration.with_tables(calibration.at(options.epoch, origin="stated"))[number]
    nx, ny = (int(n) for n in chip_map.basis.size)
    if nx * ny > _LARGEST:
        raise InputError(
            f"the detector has {nx} x {ny} pixels, more than the {_LARGEST:,} of an STDGDC file",
            where="products.stdgdc",
            do="choose another format",
        )
    x, y = detector_grid(chip_map.basis.size, 65)
    areas = np.linalg.det(chip_map.slope(x, y)) / np.linalg.det(chip_map.linear)
    U, V = chip_map.at(x, y)
    check_one_to_one(U, V, 65, areas)
    frame = frame_of(chip_map, calibration.scale)
    planes = _planes(chip_map, frame, (nx, ny), settings.precision)
    worst = _error(
        chip_map, frame, np.asarray(planes["XGC"], float), np.asarray(planes["YGC"], float)
    )
    primary = fits.PrimaryHDU()
    header = primary.header
    for name in ("XGC", "YGC", "XCG", "YCG"):
        header[f"HIERARCH NDIM_{name}"] = nx if name[0] == "X" else ny
    for name in ("XGC", "YGC"):
        header[f"HIERARCH {name}_0"] = 0
    header["BDCHIP"] = number, "chip number"
    if chip_map.before or chip_map.after:
        header["BDTABLES"] = True, "XGC and YGC hold look-up tables, too"
    for keyword, text in (("DETECTOR", calibration.detector), ("FILTER", calibration.filter)):
        if text:
            set_text(header, keyword, text)
    stated = frame.keywords() | {"BDWORST": (worst, "[pix] of rounding and between nodes")}
    append_cards(primary, (number_card(keyword, *value) for keyword, value in stated.items()))
    append_cards(primary, wrapped_cards("COMMENT", calibration.remarks))
    append_cards(primary, convergence_cards(calibration.solution))
    images = [fits.ImageHDU(plane, name=name) for name, plane in planes.items()]
    content = fits_bytes([primary, *images, parameters_hdu(calibration, options.epoch)])
    return (Built("stdgdc.fits", "STDGDC", content, calibration, None, {"tables_pix": worst}),)


def _planes(
    one: ChipMap, frame: CorrectedFrame, size: tuple[int, int], precision: str
) -> dict[str, NDArray[Any]]:
    """Values (ny, nx) of all extensions; standard errors are in single precision."""
    shape = size[::-1]
    rows, columns = np.indices(shape, float)
    x, y = columns.ravel() + 1, rows.ravel() + 1
    corrected = frame.corrected(one.at(x, y)).reshape(2, *shape)
    area, _ = pixel_areas(one, np.arange(1.0, size[0] + 1), np.arange(1.0, size[1] + 1))
    area = area / abs(np.linalg.det(frame.similarity))
    back, _ = one.pixels(frame.positions(np.stack([x, y])))
    # outside of the detector's image the map may have no inverse
    back = np.where(np.isfinite(back), back, np.stack([x, y]))
    tables = (*corrected, -2.5 * np.log10(area), *np.reshape(back, (2, *shape)))
    kind = np.float32 if precision == "single" else np.float64
    planes: dict[str, NDArray[Any]] = dict(
        zip(EXTENSIONS, (np.asarray(t, kind) for t in tables), strict=True)
    )
    cov = one.covariance_at(x, y)
    if cov is None:
        return planes
    turn = np.linalg.inv(frame.similarity)
    cov = turn @ cov @ turn.T
    sx, sy = np.sqrt(cov[:, 0, 0]), np.sqrt(cov[:, 1, 1])
    product = sx * sy
    correlation = np.divide(cov[:, 0, 1], product, out=np.zeros_like(product), where=product > 0)
    sigmas = (
        np.asarray(t.reshape(shape), np.float32) for t in (sx, sy, np.clip(correlation, -1.0, 1.0))
    )
    return planes | dict(zip(SIGMAS, sigmas, strict=True))


def _error(one: ChipMap, frame: CorrectedFrame, xgc: Float, ygc: Float) -> float:
    """Largest distance between the tables and the map, at nodes and between them, in pixels."""
    x, y = detector_grid(one.basis.size, min(_BETWEEN, 3 * int(max(one.basis.size))))
    table = LookupTable(1, np.stack([xgc, ygc]), first=(1.0, 1.0), step=(1.0, 1.0))
    return float(np.hypot(*(table.evaluate(x, y).T - frame.corrected(one.at(x, y)))).max())


def _describe(file: StdGdc) -> list[str]:
    """Lines of text on the tables, with the findings at the end."""
    findings = lint_stdgdc(file)
    lines = [f"{file.name}: STDGDC"]
    if not {"XGC", "YGC"} & set(file.missing):
        nx, ny = file.size
        lines[0] += f" of {nx} x {ny} px"
        xgc, ygc = file.table("XGC"), file.table("YGC")
        if xgc.shape == ygc.shape:
            far = np.hypot(xgc - np.arange(1, nx + 1), ygc - np.arange(1, ny + 1)[:, None])
            lines.append(f"  moves     pixels by up to {far.max():.4g} px")
    if "MGC" not in file.missing:
        mgc = file.table("MGC")
        lines.append(f"  MGC       {mgc.min():.4f} to {mgc.max():.4f} mag")
    if "BDWORST" in file.header:
        lines.append(f"  precision {file.header['BDWORST']:.2g} px, rounding and between nodes")
    if file.hdu(SIGMAS[0]) is not None:
        medians = [float(np.median(file.table(name))) for name in SIGMAS[:2]]
        lines.append(f"  errors    {medians[0]:.3g} and {medians[1]:.3g} px in the median")
    return [*lines, "", *finding_lines(findings)]


# -- checks ---------------------------------------------------------------------------------------
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
        yield Finding(level, name, "the extension is missing, but programs expect five")
    names = [hdu.name for hdu in file.content.hdus[1:6]]
    if not file.missing and tuple(names) != EXTENSIONS:
        yield Finding(
            "error",
            ", ".join(names),
            "extensions are read by their position: XGC, YGC, MGC, XCG, YCG",
        )
    if not _readable(file):
        yield Finding("error", "XGC, YGC", "are not a pair of tables of the same shape")
        return
    nx, ny = file.size
    for axis, n in (("XGC", nx), ("YGC", ny)):
        stated = file.header.get(f"NDIM_{axis}")
        if stated is None:
            yield Missing(f"NDIM_{axis}", ", and programs stop without it").finding
        elif int(stated) != n:
            yield Finding("error", f"NDIM_{axis}", f"is {stated}, but the table has {n}")


def _tables(file: StdGdc) -> Iterator[Finding]:
    xgc, ygc = file.table("XGC"), file.table("YGC")
    for name in EXTENSIONS:
        if name in file.missing:
            continue
        bad = not_finite(file.table(name), name, "holds numbers that are not finite")
        yield from bad
        if bad and name in ("XGC", "YGC"):
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
                f"increases by {slope:.3g} per pixel: its unit is the pixel of the detector",
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
        yield Finding("error", "XCG, YCG", "are not a pair of tables of the same shape")
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
            yield Finding("warning", name, "holds values that are not errors")
        if values.shape != file.table("XGC").shape:
            yield Finding("warning", name, "differs in shape from the tables")
    try:
        stdgdc_calibration(file, file.name, Choice())
    except FormatError as error:
        yield Finding("error", "BDPARAM", error.cause)


FORMAT = Format(
    "stdgdc", "an STDGDC file", 32, stdgdc_of, _describe, lint_stdgdc, stdgdc_calibration,
    StdgdcSettings, build, holds_tables=True,
)  # fmt: skip
