"""STDGDC files, and the frame of the corrected positions in them.

Extensions in this order, the primary header giving their dimensions:

1. XGC, YGC: corrected x and y of each pixel, in FITS 1-based pixels; between pixels bilinear
2. (as the third) MGC: what is added to magnitudes for the area of the pixel
3. XCG, YCG: pixel x and y of each corrected position: the inverse

A file of ours has in addition, where no consumer looks: SXGC, SYGC, standard errors of XGC and YGC,
CXYGC, their correlation, and BDPARAM, the parameters behind it all with their covariance.

The corrected frame is that of the detector, without distortion:

    corrected = reference + S^-1 ((u, v) - zero)

where S is the similarity (a scale, a rotation, perhaps a mirror) nearest to the map at its
reference pixel, so that the corrected frame lies along the detector and has its scale; the skew of
the map stays in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.io import fits

from bayesdist.arrays import Float
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import FormatError
from bayesdist.products.formats.common.content import Content, Hdu

__all__ = ["EXTENSIONS", "SIGMAS", "CorrectedFrame", "StdGdc", "frame_of", "stdgdc_of"]

_S = ("BDS1_1", "BDS1_2", "BDS2_1", "BDS2_2")


@dataclass(frozen=True, eq=False)
class CorrectedFrame:
    """Relation between positions (u, v) and corrected pixels."""

    reference: tuple[float, float]  # FITS 1-based pixel that is not moved
    zero: Float  # (2,), (u, v) there
    similarity: Float  # (2, 2), S

    def corrected(self, at: Float) -> Float:
        """Corrected pixels (2, N) of positions (2, N)."""
        inside = np.linalg.solve(self.similarity, at - self.zero[:, None])
        return inside + np.array(self.reference)[:, None]

    def positions(self, corrected: Float) -> Float:
        """Positions (2, N) of corrected pixels (2, N)."""
        inside = corrected - np.array(self.reference)[:, None]
        return self.similarity @ inside + self.zero[:, None]

    def keywords(self) -> dict[str, tuple[float, str]]:
        """Keywords of a header, with their comments."""
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
        """Frame that a header states; None for one that does not."""
        names = ("BDREF1", "BDREF2", "BDZERO1", "BDZERO2", *_S)
        if not all(isinstance(header.get(name), float | int) for name in names):
            return None
        a, b, c, d, *s = (float(header[name]) for name in names)
        return cls((a, b), np.array([c, d]), np.array(s).reshape(2, 2))


def frame_of(one: ChipMap, scale: float | None) -> CorrectedFrame:
    """Frame for a map, of a stated scale or of that of the pixel at the reference pixel."""
    x, y = one.basis.reference_pixel
    linear = one.linear
    left, singular, right = np.linalg.svd(linear)
    size = float(np.sqrt(np.prod(singular))) if scale is None else scale
    return CorrectedFrame((x, y), one.at([x], [y])[:, 0], size * left @ right)


EXTENSIONS = ("XGC", "YGC", "MGC", "XCG", "YCG")
SIGMAS = ("SXGC", "SYGC", "CXYGC")


@dataclass(frozen=True, eq=False)
class StdGdc:
    """Tables of one detector."""

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
        """Extension of a name; None where there is none."""
        return next((hdu for hdu in self.content.hdus[1:] if hdu.name == name), None)

    @property
    def missing(self) -> tuple[str, ...]:
        """Extensions that are not there."""
        return tuple(name for name in EXTENSIONS if self.hdu(name) is None)

    @cached_property
    def _tables(self) -> dict[str, Float]:
        return {}

    def table(self, name: str) -> Float:
        """Values (ny, nx) of an extension; FormatError where it is missing or no table."""
        if name not in self._tables:
            hdu = self.hdu(name)
            if hdu is None:
                raise FormatError(
                    f"has no extension {name}", where=self.name, do="give a whole STDGDC file"
                )
            values = hdu.image
            if values.ndim != 2 or min(values.shape) < 2:
                raise FormatError(
                    f"has the shape {values.shape}", where=f"{self.name}, {name}", do="check it"
                )
            self._tables[name] = values
        return self._tables[name]

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the detector."""
        ny, nx = self.table("XGC").shape
        return nx, ny


def stdgdc_of(content: Content) -> StdGdc | None:
    """STDGDC file of a content; None for a file of another kind."""
    names = {hdu.name for hdu in content.tables[1:]}
    stated = bool(content.tables) and "NDIM_XGC" in " ".join(content.tables[0].cards)
    return StdGdc(content) if len(names & set(EXTENSIONS)) >= 2 or stated else None
