"""Correlation of Gaussian fields, by separation and correlation length.

The Matern field of smoothness 3/2 has a slope everywhere (Rasmussen and Williams 2006,
Section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.utils.arrays import Float

SMOOTHNESS = 1.5

# fractions of a variance, each with the correlation length of its field
Correlation = Sequence[tuple[float, float]]


def matern(separation: Float) -> Float:
    """Correlation by separation in correlation lengths."""
    z = np.sqrt(2 * SMOOTHNESS) * separation
    return np.asarray((1 + z) * np.exp(-z))


def correlation_at(separation: Float, correlation: Correlation) -> Float:
    """Correlation of a sum of fields; what the fractions leave of 1 is independent."""
    out = np.zeros(np.shape(separation))
    for fraction, length in correlation:
        out = out + fraction * matern(separation / length)
    return out


def drawn_fields(
    at: Float, correlation: Correlation, n: int, rng: np.random.Generator, waves: int = 256
) -> Float:
    """Draws (N, n) of the correlated part of a field of unit variance, at positions (N, 2).

    Each is a sum of waves with random phases, whose frequencies have the spectral density of the
    field: over all draws the covariance is exact (Rahimi and Recht 2007).
    """
    out = np.zeros((len(at), n))
    for fraction, length in correlation:
        # draws with the same frequencies are independent; over many frequencies none matters
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
