"""Random numbers that several results share."""

from __future__ import annotations

import numpy as np

__all__ = ["restarted"]


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
