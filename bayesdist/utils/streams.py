"""Reproducible random numbers: streams derived from the seed of a run, restarts, and hashing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.utils.quantities import Random, generator_of

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
