"""Configuration that distortion reference files of all observatories have in common."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from bayesdist.products.formats.common.document import FormatSettings

__all__ = ["DESCRIPTION", "PlacedSettings"]

DESCRIPTION = "Geometric distortion with its uncertainty, by bayesdist"


class PlacedSettings(FormatSettings):
    """Identity of the file, and position of the plane of (u, v) in V2, V3.

    V2Ref, V3Ref [arcsec], V3IdlYAngle [deg] and VIdlParity are those of (u, v) = 0 and of the axes
    of (u, v), which are those of the aperture's Ideal system; a calibration in an aperture has its
    own.
    """

    detector: str | None = None  # by default the names of the chips, or of the calibration
    useafter: str
    pedigree: str
    author: str
    description: str = DESCRIPTION
    v2ref: float | None = None
    v3ref: float | None = None
    v3idlyangle: float | None = None
    parity: Literal[-1, 1] | None = None
    inverse_order: Annotated[int, Field(ge=1, le=12)] | None = None
