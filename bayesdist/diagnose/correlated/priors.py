"""Priors of the discrepancy: half-t distributions of a few amplitudes.

A calibration is either nearly free of a discrepancy, or has one of any size up to the errors of
single stars.  The priors therefore favour small amplitudes and have heavy tails (like those of
half-Cauchy scales: Gelman 2006, Bayesian Analysis 1, 515; Carvalho, Polson and Scott 2010,
Biometrika 97, 465).  A larger median increases the errors of calibrations without a visible
discrepancy; a lighter tail resists a discrepancy that stars begin to show.  The tails differ
according to the information in the data:

- structure, and second-order terms and fields of single exposures: half-t with `STRUCTURE_DOF`
  degrees of freedom, nearly flat in the logarithm from the median up to the error of a star (at
  which that of structure ends).  The data dominate as soon as stars show structure.
- scatter of linear terms of exposures, curvature of drifts, errors of catalogue stars: half-Cauchy.
  Two or three exposures hardly constrain a scatter, and a heavier tail would dominate the result.

The scale is given by the median.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy.special import stdtrit

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

TERM_STEPS = 30  # number of grid points in the amplitude of the higher orders
# Half of the calibrations have structure above the median, and one in 13 above 2000 times as much.
STRUCTURE_DOF = 0.25


@dataclass(frozen=True)
class DiscrepancyPriors:
    """Prior medians of the discrepancy's amplitudes.

    The defaults are far below the residuals of published calibrations (0.01 to 0.03 pixels rms in
    Kozhurina-Platais et al. 2015 after its look-up tables, 0.02 in the partition pattern of
    WSDC D-T033, scale changes of some 1e-5 between exposures for HST).  The tail of the
    distribution includes such values, but its bulk does not increase the errors of a calibration
    without a visible discrepancy.

    Parameters
    ----------
    higher_order : float
        Rms over the detector of the terms one order above the model's, in pixels; those of the next
        two orders are a half and a quarter of it.
    structure : float
        Rms of a smooth field of unknown correlation length, in pixels.
    exposure : float
        Scatter of scale and shears between exposures (dimensionless); shifts scatter by as much at
        the edge of the detector.
    curvature : float
        Acceleration of the time-dependent linear terms, per squared year.
    star : float
        Errors that a star of the catalogue has in all of its exposures, in pixels.

    Raises
    ------
    InputError
        If a median is not positive.
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
    """Log weights of ascending amplitudes for an integral over their logarithm.

    The weights are those of the trapezoidal rule, plus the mass beyond both ends of a half-Cauchy
    density, which is proportional to the amplitude at the lower end and to its inverse at the upper
    end.  `beyond` is the mass beyond the upper end in units of the density there: 0 for a density
    that ends at the last amplitude.
    """
    x = np.log(grid)
    width = np.empty(len(x))
    width[1:-1] = (x[2:] - x[:-2]) / 2
    width[0], width[-1] = (x[1] - x[0]) / 2 + 1, (x[-1] - x[-2]) / 2 + beyond
    return np.asarray(np.log(width))


def log_half_t(value: Float, median: float, dof: float = 1.0) -> Float:
    """Log density of log(value), up to a constant, if value has a half-t distribution."""
    z = np.asarray(value, float) * (stdtrit(dof, 0.75) / median)
    return np.asarray(np.log(z) - (dof + 1) / 2 * np.log1p(z**2 / dof))


@dataclass(frozen=True, eq=False)
class AmplitudeGrid:
    """Grid of amplitudes over which structure is integrated, in the unit of the positions."""

    low: float  # range of the field's amplitude
    high: float
    terms: Float  # (TERM_STEPS,) amplitudes of the higher orders
    log_prior: Float  # (TERM_STEPS,) their log prior weights in an integral

    @classmethod
    def of(
        cls, information: Float, *, noise: float, higher_order: float, structure: float
    ) -> AmplitudeGrid:
        """Grid around prior medians and the resolution of the data.

        `information` (T,) is that of single terms.  `noise` is the typical error of one star,
        jitter included; it limits the amplitudes because structure is part of the scatter of the
        residuals.
        """
        resolved = 1 / np.sqrt(max(float(np.median(information)), 1e-300))
        low, high = 0.2 * min(higher_order, structure, resolved), max(noise, 10 * structure)
        terms = np.geomspace(low, high, TERM_STEPS)
        log_prior = log_half_t(terms, higher_order, STRUCTURE_DOF)
        return cls(low, high, terms, log_prior + log_widths(terms, beyond=0.0))
