"""Random numbers that several results share, and those that follow from given bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
