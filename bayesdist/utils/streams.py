"""Random numbers that several results share, and those that follow from given bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.utils.quantities import Random, generator_of

ASSESSMENT = (
    2  # of the random streams that follow from the seed of a run; the sampler has the first
)


def assessment_rng(seed: Random) -> np.random.Generator:
    """Random numbers of the assessment: of the seed of a run, or a generator that is given.

    Parameters
    ----------
    seed : int or numpy.random.Generator
        Seed of a run, 0 or more; a generator is returned unchanged.

    Raises
    ------
    InputError
        For anything else.

    Examples
    --------
    >>> bool(assessment_rng(3).normal() == np.random.default_rng([3, ASSESSMENT]).normal())
    True
    """
    if isinstance(seed, np.random.Generator):
        return seed
    generator_of(seed)  # refuses what is no seed
    return np.random.default_rng([seed, ASSESSMENT])


def restarted(rng: np.random.Generator) -> np.random.Generator:
    """A generator of the same numbers from their beginning.

    Results that are compared are made from the same numbers, in whatever order they are made.

    Parameters
    ----------
    rng : numpy.random.Generator
        As `numpy.random.default_rng` makes it.

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
    """Bits that depend on all bits: the finaliser of SplitMix64 (Steele, Lea and Flood 2014)."""
    out = bits + np.uint64(0x9E3779B97F4A7C15)
    out = (out ^ (out >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    out = (out ^ (out >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(out ^ (out >> np.uint64(31)))
