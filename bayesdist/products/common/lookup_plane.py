"""Image extension of a D2IMFILE or NPOLFILE, and the positions of its nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError
from bayesdist.products.common.content import Hdu
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class TablePlane:
    """Image extension with the shifts along one axis of one chip, or their standard errors."""

    hdu: Hdu
    name: str  # EXTNAME: DX, DY, SIGMA_DX or SIGMA_DY
    where: str  # name of the extension in error messages

    @cached_property
    def header(self) -> fits.Header:
        """Header of the extension."""
        return self.hdu.header

    def number(self, keyword: str, default: float) -> float:
        """Value of a keyword, `default` if it is missing.

        Raises FormatError if it is not a finite number.
        """
        value = self.header.get(keyword, default)
        a_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not a_number or not np.isfinite(value):
            raise FormatError(
                f"is {value!r}", where=f"{self.where}, keyword {keyword}", do="give a finite number"
            )
        return value

    @property
    def chip(self) -> int:
        """CCDCHIP, or 1 without it, as in stwcs."""
        return int(self.number("CCDCHIP", 1))

    @property
    def version(self) -> int:
        """EXTVER, or 1 without it, as in the FITS standard."""
        return int(self.number("EXTVER", 1))

    @property
    def values(self) -> Float:
        """Values at the nodes including padding, shape (ny, nx)."""
        return self.hdu.image

    @property
    def nodes(self) -> Float:
        """Values at the nodes without padding, shape (ny, nx)."""
        pad = int(self.number("BDPAD", 0))
        return self.values[..., :-pad] if pad > 0 else self.values

    @property
    def missing(self) -> tuple[str, ...]:
        """Registration keywords that are missing from the header."""
        names = ("CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2", "CDELT1", "CDELT2")
        return tuple(name for name in names if name not in self.header)

    @property
    def first(self) -> tuple[float, float]:
        """Pixel (x, y) of the first node, computed as in astropy.wcs."""
        x, y = (
            self.number(f"CRVAL{a}", 0.0) + (1.0 - self.number(f"CRPIX{a}", 0.0)) * step
            for a, step in zip((1, 2), self.step, strict=True)
        )
        return x, y

    @property
    def step(self) -> tuple[float, float]:
        """Pixels between nodes along x and y."""
        return float(self.number("CDELT1", 1.0)), float(self.number("CDELT2", 1.0))

    @property
    def grid(self) -> str:
        """Description of the grid in words."""
        (ny, nx), (x, y), (dx, dy) = self.nodes.shape, self.first, self.step
        return f"{nx} x {ny} nodes from pixel ({x:.10g}, {y:.10g}), {dx:.10g} x {dy:.10g} apart"
