"""Magnitudes, errors and colours of the pairs of a band.

Errors are set so that the mean radial residual is that of Table 5-1 of WSDC D-T033.  The report
does not say how they depend on the magnitude: that is made up, with star counts rising as
10^(0.3 m), a floor for bright sources and centroids of faint ones limited by the background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.missions.wise.simulate.published import WISE_ARRAYS

__all__ = ["POPULATIONS", "Population"]

Float = NDArray[np.float64]

COUNTS = 0.3  # slope of the logarithm of star counts by magnitude
REFERENCE_ARCSEC = 0.08  # 2MASS positions on each axis
STAR_COLOUR = (0.0, 0.15)  # mean and standard deviation, magnitudes
RED_COLOUR = (2.5, 0.8)  # galaxies and the like that 2MASS does not list
RED = 0.5  # share of them among the false matches


@dataclass(frozen=True)
class Population:
    """Sources of a band that have been paired.

    Parameters
    ----------
    scale : float
        Arcsec per pixel.
    bright, faint : float
        Limits in magnitudes: saturation, and about what single exposures reach.
    floor : float
        Centroid error of bright sources on each axis, in pixels.
    at_limit : float
        Centroid error that the background adds for the faintest ones, in pixels.
    """

    scale: float
    bright: float
    faint: float
    floor: float
    at_limit: float

    @property
    def reference(self) -> float:
        """Error of 2MASS positions on each axis, in pixels."""
        return REFERENCE_ARCSEC / self.scale

    @property
    def brightest(self) -> float:
        """Share of the counts that lies beyond the bright limit."""
        return float(10 ** (COUNTS * (self.bright - self.faint)))

    def magnitudes(self, counts: Float) -> Float:
        """Magnitudes, by the share of the counts that is brighter."""
        return self.faint + np.log10(counts) / COUNTS

    def sigma(self, counts: Float) -> Float:
        """Error of pairs on each axis, in pixels: WISE's and 2MASS's together.

        Parameters
        ----------
        counts : ndarray
            Share of the counts that is brighter; uniform from `brightest` to 1 over the pairs.

        Returns
        -------
        ndarray
        """
        # limited by the background: the error goes with 10^(0.4 m), which is counts^(4/3)
        noise = self.at_limit * counts * np.cbrt(counts)
        return np.sqrt(noise**2 + (self.floor**2 + self.reference**2))

    def colours(self, false: NDArray[np.bool_], rng: np.random.Generator) -> Float:
        """Magnitude at the shortest wavelength detected less that at the longest.

        Parameters
        ----------
        false : ndarray of bool, shape (N,)
            Half of the false matches are red.
        rng : numpy.random.Generator

        Returns
        -------
        ndarray, shape (N,)
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
