"""Frames of the pairs: their epochs, and the density of stars on their sky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["FRAMES", "Survey", "survey"]

Float = NDArray[np.float64]

FRAMES = 5000  # framesets; one serves all bands
CADENCE_S = 11.0
PER_SCAN = 259  # half an orbit of 95 minutes
FIRST_SCAN = 350
START = 2010.02  # in-orbit checkout
YEAR_S = 365.25 * 86_400

POLE = 2500.0  # 2MASS sources per square degree at the galactic poles
THINNEST = 0.05  # the sine of the latitude below which the plane-parallel layer is cut off
HIGHEST = 0.98  # sine of the highest galactic latitude on the orbit
ARCSEC2 = 3600.0**2


@dataclass(frozen=True, eq=False)
class Survey:
    """Frames: names, epochs and densities of stars."""

    names: tuple[str, ...]  # scan and frame, as '00350a001'
    epoch: Float  # (F,), decimal years
    density: Float  # (F,), 2MASS sources per square arcsec

    def share(self) -> Float:
        """Fraction of the pairs in each frame, proportional to the density."""
        return self.density / self.density.sum()


def survey(n_frames: int = FRAMES) -> Survey:
    """Frames one after the other along a polar orbit.

    The stars are a plane-parallel layer: their number goes with the cosecant of the galactic
    latitude, 2500 per square degree at the poles and at most 20 times as many.
    """
    number = np.arange(n_frames)
    scan, frame = np.divmod(number, PER_SCAN)
    # half orbits go from pole to pole; frames lie in the middles of their steps
    along = np.pi * (frame + 0.5) / PER_SCAN
    sine = np.maximum(np.abs(HIGHEST * np.cos(along)), THINNEST)
    names = tuple(
        f"{FIRST_SCAN + s:05d}a{f + 1:03d}"
        for s, f in zip(scan.tolist(), frame.tolist(), strict=True)
    )
    return Survey(names, START + number * CADENCE_S / YEAR_S, POLE / sine / ARCSEC2)
