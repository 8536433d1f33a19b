"""Published constants of the detectors of ACS: sizes, zero points, scales, overscan.

Sizes, zero points at the centre of each chip and default output scales are those of section 4.1 of
the ACS handbook; the overscan of raw images is that of the ACS instrument handbook.
"""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.errors import InputError
from bayesdist.products.formats.idctab.hst import parity_of

__all__ = ["ACS", "Detector", "acs_detector"]


@dataclass(frozen=True)
class Detector:
    """Detector of ACS."""

    name: str  # WFC, HRC or SBC
    chips: tuple[int, ...]  # numbers; output images are referred to the zero point of the first
    size: tuple[int, int]  # columns and rows of each chip in calibrated images
    reference_pixel: tuple[float, float]  # zero point (XREF, YREF), FITS 1-based
    output_scale: float  # default size of a corrected pixel, arcsec
    overscan: int  # columns of physical overscan left of the first column in raw images

    @property
    def parity(self) -> tuple[int, int]:
        """Sense of V2 and V3 against Xc and Yc."""
        return parity_of("ACS", self.name)


ACS = {
    one.name: one
    for one in (
        Detector("WFC", (2, 1), (4096, 2048), (2048.0, 1024.0), 0.05, 24),
        Detector("HRC", (1,), (1024, 1024), (512.0, 512.0), 0.025, 19),
        Detector("SBC", (1,), (1024, 1024), (512.0, 512.0), 0.025, 0),
    )
}


def acs_detector(name: str) -> Detector:
    """Detector of ACS by its name: WFC, HRC or SBC; any other is refused."""
    try:
        return ACS[name.strip().upper()]
    except KeyError:
        raise InputError(
            f"ACS has no detector {name!r}", where="detector", do=f"choose one of {', '.join(ACS)}"
        ) from None
