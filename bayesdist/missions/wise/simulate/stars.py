"""Magnitudes, errors and colours of the pairs of a band.

Errors are set so that the mean radial residual is that of Table 5-1 of WSDC D-T033.  The report
does not say how they depend on the magnitude: that is made up, with star counts rising as
10^(0.3 m), a floor for bright sources and centroids of faint ones limited by the background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.utils.arrays import Bool, Float

COUNTS = 0.3  # slope of the logarithm of star counts by magnitude
REFERENCE_ARCSEC = 0.08  # 2MASS positions on each axis
STAR_COLOUR = (0.0, 0.15)  # mean and standard deviation, magnitudes
RED_COLOUR = (2.5, 0.8)  # galaxies and the like that 2MASS does not list
RED = 0.5  # fraction of them among the false matches


@dataclass(frozen=True)
class Population:
    """Paired sources of a band."""

    scale: float  # arcsec per pixel
    bright: float  # limit of saturation, mag
    faint: float  # limit of single exposures, about, mag
    floor: float  # centroid error of bright sources on each axis, pixels
    at_limit: float  # centroid error by the background at the faint limit, pixels

    @property
    def reference(self) -> float:
        """Error of 2MASS positions on each axis, in pixels."""
        return REFERENCE_ARCSEC / self.scale

    @property
    def brightest(self) -> float:
        """Fraction of the counts that lies beyond the bright limit."""
        return float(10 ** (COUNTS * (self.bright - self.faint)))

    def magnitudes(self, counts: Float) -> Float:
        """Magnitudes, by the fraction of the counts that is brighter."""
        return self.faint + np.log10(counts) / COUNTS

    def sigma(self, counts: Float) -> Float:
        """Error of pairs on each axis, pixels, WISE's and 2MASS's together.

        `counts`, the fraction of the counts that is brighter, is uniform from `brightest` to 1.
        """
        # limited by the background: the error goes with 10^(0.4 m), which is counts^(4/3)
        noise = self.at_limit * counts * np.cbrt(counts)
        return np.sqrt(noise**2 + (self.floor**2 + self.reference**2))

    def colours(self, false: Bool, rng: np.random.Generator) -> Float:
        """Magnitudes (N,) at the shortest wavelength less those at the longest, of pairs.

        Half of the false matches are red.
        """
        out = STAR_COLOUR[0] + STAR_COLOUR[1] * rng.standard_normal(false.size)
        red = np.flatnonzero(false)
        red = red[rng.uniform(size=red.size) < RED]
        out[red] = RED_COLOUR[0] + RED_COLOUR[1] * rng.standard_normal(red.size)
        return out


POPULATIONS = {
    "W1": Population(WISE_ARRAYS["W1"].scale, 8.1, 15.5, 0.03, 0.1556),
    "W2": Population(WISE_ARRAYS["W2"].scale, 6.7, 15.0, 0.03, 0.1775),
    "W3": Population(WISE_ARRAYS["W3"].scale, 3.8, 11.5, 0.05, 0.5216),
    "W4": Population(WISE_ARRAYS["W4"].scale, -0.4, 8.0, 0.05, 0.8765),
}
