"""Random numbers: reproducible streams, hashing, and draws of Gaussian random fields.

Streams are derived from the seed of a run.  Fields have the Matern correlation of smoothness 3/2,
so that they are once differentiable (Rasmussen and Williams 2006, Section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random, generator_of

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


# number of the random stream for the assessment among those derived from the seed of a run; the
# sampler uses the first one
ASSESSMENT = 2


def assessment_rng(seed: Random) -> np.random.Generator:
    """Random generator of the assessment, derived from the seed of a run.

    Parameters
    ----------
    seed : int or numpy.random.Generator
        Seed of the run, 0 or larger; a generator is returned unchanged.

    Returns
    -------
    numpy.random.Generator

    Raises
    ------
    InputError
        If `seed` is neither a seed nor a generator.

    Examples
    --------
    >>> bool(assessment_rng(3).normal() == np.random.default_rng([3, ASSESSMENT]).normal())
    True
    """
    if isinstance(seed, np.random.Generator):
        return seed
    generator_of(seed)  # raises an error for an invalid seed
    return np.random.default_rng([seed, ASSESSMENT])


def restarted(rng: np.random.Generator) -> np.random.Generator:
    """New generator that starts again at the beginning of another generator's stream.

    It allows results to be compared that are computed from the same random numbers, independently
    of the order of computation.

    Parameters
    ----------
    rng : numpy.random.Generator
        Generator that was made from a seed, as by `numpy.random.default_rng`.

    Returns
    -------
    numpy.random.Generator

    Raises
    ------
    TypeError
        If the generator was not made from a seed.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> rng.normal() == restarted(rng).normal()
    True
    """
    seeds = rng.bit_generator.seed_seq
    if not isinstance(seeds, np.random.SeedSequence):
        raise TypeError("the generator is not made from a seed")
    return np.random.default_rng(np.random.SeedSequence(seeds.entropy, spawn_key=seeds.spawn_key))


def mixed(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Hash of 64-bit integers: the finaliser of SplitMix64 (Steele, Lea and Flood 2014)."""
    out = bits + np.uint64(0x9E3779B97F4A7C15)
    out = (out ^ (out >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    out = (out ^ (out >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(out ^ (out >> np.uint64(31)))
