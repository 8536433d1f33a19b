"""Corrected frame of an STDGDC file: that of the detector, without distortion.

    corrected = reference + S^-1 ((u, v) - zero)

where S is the similarity (a scale, a rotation, perhaps a mirror) nearest to the map at its
reference pixel, so that the corrected frame lies along the detector and has its scale; the skew of
the map stays in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.calibration.chip_map import ChipMap

__all__ = ["CorrectedFrame", "frame_of"]

Float = NDArray[np.float64]

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
