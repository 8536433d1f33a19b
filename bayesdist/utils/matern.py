"""Matern correlation functions and draws of Gaussian random fields.

The smoothness is 3/2, so that fields are once differentiable (Rasmussen and Williams 2006,
Section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.utils.arrays import Float

SMOOTHNESS = 1.5

# components of a field: (fraction of the variance, correlation length) of each
Correlation = Sequence[tuple[float, float]]


def matern(separation: Float) -> Float:
    """Matern 3/2 correlation at separations (any shape) in units of the correlation length."""
    z = np.sqrt(2 * SMOOTHNESS) * separation
    return np.asarray((1 + z) * np.exp(-z))


def correlation_at(separation: Float, correlation: Correlation) -> Float:
    """Correlation at separations (any shape) of a sum of fields with the given lengths.

    `correlation` has the fraction of the variance and the correlation length of each field; lengths
    and separations have the same unit.  If the fractions add up to less than 1, the remaining
    variance is uncorrelated.
    """
    out = np.zeros(np.shape(separation))
    for fraction, length in correlation:
        out = out + fraction * matern(separation / length)
    return out


def drawn_fields(
    at: Float, correlation: Correlation, n: int, rng: np.random.Generator, waves: int = 256
) -> Float:
    """Draws (N, n) of the correlated part of a field of unit variance, at positions `at` (N, 2).

    `correlation` has the fraction of the variance and the correlation length of each component.
    Each draw is a sum of `waves` waves with random phases and with frequencies drawn from the
    spectral density of the field (random Fourier features, Rahimi and Recht 2007).  The covariance,
    averaged over all draws, is exact.
    """
    out = np.zeros((len(at), n))
    for fraction, length in correlation:
        # draws that use the same frequencies are uncorrelated; new frequencies for every 50 draws
        # reduce the error of the covariance that comes from the finite number of frequencies
        step = max(1, min(n, 50))
        for start in range(0, n, step):
            stop = min(start + step, n)
            chi2 = rng.chisquare(2 * SMOOTHNESS, waves)
            k = rng.standard_normal((waves, 2)) / length * np.sqrt(2 * SMOOTHNESS / chi2)[:, None]
            phase = at @ k.T
            size = np.sqrt(fraction / waves)
            for part in (np.cos(phase), np.sin(phase)):
                out[:, start:stop] += size * part @ rng.standard_normal((waves, stop - start))
    return out
