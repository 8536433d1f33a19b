"""STDGDC files, the frame of their corrected positions, and their calibration.

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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError
from bayesdist.model import LookupTable
from bayesdist.products.common.cards import named_in
from bayesdist.products.common.content import Content, Hdu
from bayesdist.products.common.document import Choice
from bayesdist.products.common.parameters import (
    refuse_changed,
    stored_calibration,
    stored_in,
)
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
