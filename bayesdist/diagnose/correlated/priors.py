"""Priors of the discrepancy: half-t distributions of a few amplitudes.

A calibration either is nearly free of a discrepancy or shows one of any size up to the errors of
single stars, so the priors have their bulk at small amplitudes and heavy tails (as those of
half-Cauchy scales: Gelman 2006, Bayesian Analysis 1, 515; Carvalho, Polson and Scott 2010,
Biometrika 97, 465).  A larger median widens the errors of calibrations that show nothing; a lighter
tail resists a discrepancy that stars begin to show.  Tails differ by what the data say:

- structure: half-t with `STRUCTURE_DOF` degrees of freedom, nearly flat in the logarithm from the
  median up to the error of a star, where it ends.  It moves aside as soon as stars show structure.
- scatter of exposures, curvature of drifts, errors of catalogue stars: half-Cauchy.  Two or three
  exposures say little of a scatter, and a heavier tail would be most of what is stated.

The scale is given by the median.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy.special import stdtrit

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

TERM_STEPS = 30  # of the amplitude of the higher orders
# Half of the calibrations have structure above the median, and one in 13 above 2000 times as much.
STRUCTURE_DOF = 0.25


@dataclass(frozen=True)
class DiscrepancyPriors:
    """Prior medians of the discrepancy's amplitudes.

    The defaults are far below what published calibrations leave in residuals (0.01 to 0.03 pixels
    rms in ACS ISR 2015-06 after its look-up tables, 0.02 in the WISE partition pattern of WSDC
    D-T033, scale changes of some 1e-5 from exposure to exposure for HST): the tail of the
    distribution reaches these, and its bulk does not widen the errors of a calibration that shows
    nothing.

    Parameters
    ----------
    higher_order : float
        Rms over the detector of the terms one order above the model's, in pixels; those of the next
        two orders have a half and a quarter of it.
    structure : float
        Rms of a smooth field of unknown correlation length, in pixels.
    exposure : float
        Scatter of scale and shears from exposure to exposure, relative to 1; shifts scatter by as
        much at the edge of the detector.
    curvature : float
        Acceleration of the time-dependent linear terms, relative to 1, per squared year.
    star : float
        Errors that a star of the catalogue has in all of its exposures, in pixels.

    Raises
    ------
    InputError
        For a median that is not positive.
    """

    higher_order: float = 1e-5
    structure: float = 5e-6
    exposure: float = 3e-7
    curvature: float = 5e-8
    star: float = 1e-3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(
                    f"the prior median is {value}",
                    where=f"discrepancy.{field.name}",
                    do="give a positive number",
                )


def log_widths(grid: Float, *, beyond: float = 1.0) -> Float:
    """Logarithms of the weights of ascending amplitudes in an integral over their logarithm.

    They are those of the trapezoidal rule, plus the mass beyond both ends of a half-Cauchy density,
    which is proportional to the amplitude there, or to its inverse.  `beyond` is the mass beyond
    the upper end in units of the density there: 0 for a density that ends at the last amplitude.
    """
    x = np.log(grid)
    width = np.empty(len(x))
    width[1:-1] = (x[2:] - x[:-2]) / 2
    width[0], width[-1] = (x[1] - x[0]) / 2 + 1, (x[-1] - x[-2]) / 2 + beyond
    return np.asarray(np.log(width))


def log_half_t(value: Float, median: float, dof: float = 1.0) -> Float:
    """Log density of log(value), up to a constant, if value is half-t with this median."""
    z = np.asarray(value, float) * (stdtrit(dof, 0.75) / median)
    return np.asarray(np.log(z) - (dof + 1) / 2 * np.log1p(z**2 / dof))


@dataclass(frozen=True, eq=False)
class AmplitudeGrid:
    """Amplitudes over which structure is integrated, in the unit of the positions."""

    low: float  # of the field
    high: float
    terms: Float  # (TERM_STEPS,) of the higher orders
    log_prior: Float  # (TERM_STEPS,) log weight of these in an integral over them

    @classmethod
    def of(
        cls, information: Float, *, noise: float, higher_order: float, structure: float
    ) -> AmplitudeGrid:
        """Grid about prior medians, and about what the information (T,) of single terms resolves.

        `noise` is the typical error of one star, jitter included, which limits the amplitudes: the
        scatter of the residuals holds the structure too.
        """
        resolved = 1 / np.sqrt(max(float(np.median(information)), 1e-300))
        low, high = 0.2 * min(higher_order, structure, resolved), max(noise, 10 * structure)
        terms = np.geomspace(low, high, TERM_STEPS)
        log_prior = log_half_t(terms, higher_order, STRUCTURE_DOF)
        return cls(low, high, terms, log_prior + log_widths(terms, beyond=0.0))
