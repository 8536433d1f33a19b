"""Probabilities of what is found by chance: in words, and corrected for the number of tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["LEAST_P", "holm", "p_words"]

Float = NDArray[np.float64]

LEAST_P = 1e-300  # tails underflow: no probability is zero


def p_words(p: float) -> str:
    """A probability in words: 'p = 0.02'.

    Parameters
    ----------
    p : float

    Returns
    -------
    str
    """
    return f"p < {LEAST_P:g}" if p < LEAST_P else f"p = {p:.1g}"


def holm(p_values: ArrayLike) -> Float:
    """Probabilities corrected for their number (Holm 1979).

    Parameters
    ----------
    p_values : array_like, shape (m,)

    Returns
    -------
    ndarray, shape (m,)
        At or under a level where the test is significant at that level among all of them.
    """
    p = np.asarray(p_values, float)
    order = np.argsort(p, kind="stable")
    out = np.empty(len(p))
    steps = np.arange(len(p), 0, -1) * p[order]
    out[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return out
