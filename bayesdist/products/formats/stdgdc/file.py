"""STDGDC files: corrected positions of every pixel, as hst1pass and its relatives use them.

Extensions in this order, the primary header giving their dimensions:

1. XGC, YGC: corrected x and y of each pixel, in FITS 1-based pixels; between pixels bilinear
2. (as the third) MGC: what is added to magnitudes for the area of the pixel
3. XCG, YCG: pixel x and y of each corrected position: the inverse

A file of ours has in addition, where no consumer looks: SXGC, SYGC, standard errors of XGC and YGC,
CXYGC, their correlation, and BDPARAM, the parameters behind it all with their covariance.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.errors import FormatError
from bayesdist.products.formats.common.content import Content, Hdu, read_content

__all__ = ["EXTENSIONS", "SIGMAS", "StdGdc", "read_stdgdc", "stdgdc_of"]

Float = NDArray[np.float64]

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


def read_stdgdc(path: str | os.PathLike[str]) -> StdGdc:
    """Read an STDGDC file; FormatError where it is none."""
    found = stdgdc_of(read_content(path))
    if found is None:
        raise FormatError("is no STDGDC file", where=str(path), do="give one with XGC and YGC")
    return found


def stdgdc_of(content: Content) -> StdGdc | None:
    """STDGDC file of a content; None for a file of another kind."""
    names = {hdu.name for hdu in content.tables[1:]}
    stated = bool(content.tables) and "NDIM_XGC" in " ".join(content.tables[0].cards)
    return StdGdc(content) if len(names & set(EXTENSIONS)) >= 2 or stated else None
