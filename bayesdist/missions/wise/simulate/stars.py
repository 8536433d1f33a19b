"""Simulated magnitudes, errors and colours of the pairs of a band.

The errors give the mean radial residual in Table 5-1 of WSDC D-T033.  The report does not state
their dependence on magnitude, which is invented: star counts increase as 10^(0.3 m), bright sources
have a constant error, and the errors of faint sources are limited by the background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.utils.arrays import Bool, Float

COUNTS = 0.3  # slope of the logarithm of star counts with magnitude
REFERENCE_ARCSEC = 0.08  # error per axis of 2MASS positions
STAR_COLOUR = (0.0, 0.15)  # mean and standard deviation, magnitudes
RED_COLOUR = (2.5, 0.8)  # of galaxies etc. that are not in 2MASS
RED = 0.5  # fraction of these among the false matches


@dataclass(frozen=True)
class Population:
    """Distribution of magnitudes, errors and colours of the pairs of a band."""

    scale: float  # arcsec per pixel
    bright: float  # saturation limit, mag
    faint: float  # approximate limit of single exposures, mag
    floor: float  # centroid error per axis of bright sources, pixels
    at_limit: float  # centroid error per axis due to the background at the faint limit, pixels

    @property
    def reference(self) -> float:
        """Error per axis of 2MASS positions, in pixels."""
        return REFERENCE_ARCSEC / self.scale

    @property
    def brightest(self) -> float:
        """Fraction of the star counts that is brighter than the bright limit."""
        return float(10 ** (COUNTS * (self.bright - self.faint)))

    def magnitudes(self, counts: Float) -> Float:
        """Magnitudes from the fraction of the star counts that is brighter."""
        return self.faint + np.log10(counts) / COUNTS

    def sigma(self, counts: Float) -> Float:
        """Error per axis of pairs in pixels, for WISE and 2MASS combined.

        `counts` is the fraction of the star counts that is brighter, from `brightest` to 1.
        """
        # background-limited errors are proportional to 10^(0.4 m), which is counts^(4/3)
        noise = self.at_limit * counts * np.cbrt(counts)
        return np.sqrt(noise**2 + (self.floor**2 + self.reference**2))

    def colours(self, false: Bool, rng: np.random.Generator) -> Float:
        """Colours (N,): magnitude at the shortest minus that at the longest wavelength.

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
