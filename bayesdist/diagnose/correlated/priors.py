"""Prior of the discrepancy: functions that represent structure, and distributions of amplitudes.

Structure that the polynomial lacks is a sum of functions over a chip: Legendre products above the
model's order, and sines on a box larger than the chip.  The coefficients of the sines are
independent, and their variances are the spectrum of a Matern field (Solin and Sarkka 2020,
Statistics and Computing 30, 419).  The projection of the sines on the model's polynomials over the
whole chip is subtracted.

A calibration is either nearly free of a discrepancy, or has one of any size up to the errors of
single stars.  The priors of the amplitudes therefore favour small ones and have heavy tails (like
those of half-Cauchy scales: Gelman 2006, Bayesian Analysis 1, 515; Carvalho, Polson and Scott 2010,
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
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from scipy.special import stdtrit

from bayesdist.errors import InputError
from bayesdist.model.basis import n_terms, polynomial_terms
from bayesdist.utils.arrays import Float, Int

ORDERS = 3  # number of Legendre orders above the model's
FALL = 0.5  # rms of an order relative to the previous one
MARGIN = 0.3  # extension of the box beyond the chip, as a fraction of the longer half side
SMOOTHNESS = 1.5  # of the Matern field, which is therefore differentiable
FINE = 48  # number of waves that represent structure finer than the sines
SHORTEST = 0.02  # correlation length, in longer half sides
HIGHEST = 5.0  # largest frequency of a wave, in units of the frequency where the spectrum bends
GOLDEN = (np.sqrt(5.0) - 1) / 2
MIN_SIDE, MAX_SIDE = 6, 20  # limits to the number of sines along a square chip
STARS_PER_SINE = 4.0


@dataclass(frozen=True)
class StructureFunctions:
    """Functions over one chip, of unit mean square before their coefficients are scaled."""

    order: int  # of the fitted polynomial
    size: tuple[float, float]  # numbers of columns and rows of the chip
    n_side: int  # number of sines along the longer side of the box

    @classmethod
    def for_stars(cls, order: int, size: tuple[float, float], n: int) -> StructureFunctions:
        """Functions as fine as n stars on the chip can resolve."""
        side = int(np.clip(np.sqrt(n / STARS_PER_SINE), MIN_SIDE, MAX_SIDE))
        return cls(order, size, side)

    @cached_property
    def _half(self) -> Float:
        """Half sides of the chip, in units of the longer one."""
        return np.asarray(self.size) / max(self.size)

    @cached_property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers of the Legendre products above the model's order."""
        had = n_terms(self.order)
        return polynomial_terms(self.order + ORDERS)[had:]

    @property
    def n_terms(self) -> int:
        """Number of Legendre products."""
        return len(self.terms)

    @cached_property
    def _waves(self) -> Int:
        """Numbers of half waves (m, 2) of each sine along the box."""
        box = self._half + MARGIN
        limits = np.ceil(self.n_side * box / box.max()).astype(int)
        i, j = (
            k.ravel() for k in np.meshgrid(*(np.arange(1, n + 1) for n in limits), indexing="ij")
        )
        wave = np.column_stack([i, j])
        return wave[np.hypot(*(np.pi * wave / (2 * box)).T) <= self.cut]

    @property
    def cut(self) -> float:
        """Largest angular frequency of the sines, in units of the inverse longer half side."""
        return float(np.pi * (self.n_side + 0.5) / (2 * (1 + MARGIN)))

    @cached_property
    def frequency(self) -> Float:
        """Angular frequency (m,) of each sine, in the unit of `cut`."""
        return np.hypot(*(np.pi * self._waves / (2 * (self._half + MARGIN))).T)

    @property
    def n_sines(self) -> int:
        """Number of sines."""
        return len(self._waves)

    @property
    def n_known(self) -> int:
        """Number of functions that the data can determine: terms and sines."""
        return self.n_terms + self.n_sines

    def decline(self) -> Float:
        """Standard deviations (n_terms,) of the terms, relative to the rms of the first order."""
        degree = np.array([sum(t) for t in self.terms])
        return np.asarray(FALL ** (degree - self.order - 1) / np.sqrt(degree + 1))

    def spectrum(self, length: float) -> Float:
        """Variances (n_sines,) for a field of unit variance; `length` is in longer half sides.

        They are the spectral density of the Matern field in two dimensions (Rasmussen and Williams
        2006, Equation 4.15).
        """
        nu, k2 = SMOOTHNESS, 2 * SMOOTHNESS / length**2
        return np.asarray(4 * np.pi * nu * k2**nu * (k2 + self.frequency**2) ** (-nu - 1))

    def finer(self, length: float) -> float:
        """Fraction of the field's variance at frequencies above those of the sines."""
        k2 = 2 * SMOOTHNESS / length**2
        return float((k2 / (k2 + self.cut**2)) ** SMOOTHNESS)

    def evaluate(self, X: Float, Y: Float) -> Float:
        """Terms and sines (N, n_known) at scaled positions, -1 to 1 along each side."""
        return np.concatenate([legendre_products(X, Y, self.terms), self._sines(X, Y)], axis=1)

    def _sines(self, X: Float, Y: Float) -> Float:
        i, j = self._waves.T - 1
        by_x, by_y = self._along(0, X), self._along(1, Y)
        low = polynomial_terms(self.order)
        out = by_x[:, i] * by_y[:, j]
        out -= legendre_products(X, Y, low) @ self._in_polynomials
        return out

    def _along(self, axis: int, Z: Float) -> Float:
        """Sines (N, n) along one side."""
        half = float(self._half[axis])
        box, n = half + MARGIN, int(self._waves[:, axis].max())
        angle = np.outer(half * Z + box, np.pi * np.arange(1, n + 1) / (2 * box))
        return np.sin(angle) / np.sqrt(box)

    @cached_property
    def _in_polynomials(self) -> Float:
        """Projections (K, n_sines) of the sines on the model's polynomials."""
        low = polynomial_terms(self.order)
        nodes, weights = legendre.leggauss(2 * self.n_side + self.order + 8)
        by_axis = [
            (self._along(axis, nodes) * weights[:, None] / 2).T @ _orthonormal(nodes, self.order)
            for axis in (0, 1)
        ]
        i, j = self._waves.T - 1
        return np.stack([by_axis[0][i, a] * by_axis[1][j, b] for a, b in low])

    def low_orders(self, sines: Float) -> Float:
        """Coefficients (..., K) of the model's Legendre products in a field of the raw sines.

        `sines` (..., n_sines) are the coefficients of the sines.  `evaluate` subtracts these
        polynomials.
        """
        i, j = np.array(polynomial_terms(self.order)).T
        orthonormal = sines @ self._in_polynomials.T
        return np.asarray(orthonormal * np.sqrt((2 * i + 1) * (2 * j + 1)))

    def finer_waves(self, rng: np.random.Generator) -> Float:
        """Wave vectors (FINE, 2) of structure finer than the sines, in inverse half sides.

        Frequencies are evenly distributed in their logarithm over the range of fields of any
        length, and directions evenly over the half circle, independently of each other.
        """
        k = np.arange(FINE)
        highest = HIGHEST * max(self.cut, np.sqrt(2 * SMOOTHNESS) / SHORTEST)
        frequency = self.cut * (highest / self.cut) ** ((k + rng.uniform(size=FINE)) / FINE)
        angle = np.pi * ((k * GOLDEN + rng.uniform()) % 1.0)
        return frequency[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])

    def finer_spectrum(self, length: float, waves: Float) -> Float:
        """Variances (FINE,) of the waves of a unit-variance field.

        `length` is in longer half sides.

        Their mean is `finer(length)`, because `evaluate_finer` divides by the number of waves.
        """
        k2, square = 2 * SMOOTHNESS / length**2, (waves**2).sum(axis=1)
        # per logarithmic interval of frequency
        density = square * (k2 + square) ** (-SMOOTHNESS - 1)
        return np.asarray(self.finer(length) * density / density.mean())

    def evaluate_finer(self, waves: Float, X: Float, Y: Float) -> Float:
        """Cosines and sines (N, 2 FINE) of waves at scaled positions.

        Their mean squares add to 1.
        """
        phase = np.outer(self._half[0] * X, waves[:, 0]) + np.outer(self._half[1] * Y, waves[:, 1])
        return np.concatenate([np.cos(phase), np.sin(phase)], axis=1) / np.sqrt(len(waves))


def _orthonormal(Z: Float, order: int) -> Float:
    """Legendre polynomials (N, order + 1) with unit mean square over -1 to 1."""
    return np.asarray(legendre.legvander(Z, order) * np.sqrt(2 * np.arange(order + 1) + 1))


def legendre_products(X: Float, Y: Float, terms: tuple[tuple[int, int], ...]) -> Float:
    """Products (N, n) of Legendre polynomials with unit mean square.

    `terms` are their powers (i, j).
    """
    order = max(max(t) for t in terms)
    by_x, by_y = _orthonormal(X, order), _orthonormal(Y, order)
    i, j = np.array(terms).T
    return np.asarray(by_x[:, i] * by_y[:, j])


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
