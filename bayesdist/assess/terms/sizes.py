"""Sizes of local terms as draws: they are not known better than their own errors say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.terms.given import LocalTerm

__all__ = ["drawn_squares", "resized"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


def drawn_squares(
    local: Sequence[LocalTerm], chips: Sequence[int], n: int, rng: np.random.Generator
) -> Float:
    """Factors (n, terms, chips, 2) of mean 1 by which the squares of local terms are multiplied.

    Chips and axes are drawn by themselves: what is known of one says nothing of the others.
    """
    out = np.ones((n, len(local), len(chips), 2))
    for k, term in enumerate(local):
        for c, chip in enumerate(chips):
            if chip in term.squares:
                out[:, k, c] = term.squares[chip].relative_draws(n, rng)
    return out


def resized(single: Float, own: Sequence[Float], squares: Float, chip: Int) -> Float:
    """Standard deviations of all that is independent from place to place, as drawn.

    Parameters
    ----------
    single : ndarray, shape (N, 2)
        With the local terms as large as they were found.
    own : sequence of ndarray, shape (N, 2)
        Those of the local terms.
    squares : ndarray, shape (n, terms, chips, 2)
        As of `drawn_squares`.
    chip : ndarray of int, shape (N,)
        Which of these chips a place is on.

    Returns
    -------
    ndarray, shape (n, N, 2), or (N, 2) where all sizes are the same
    """
    if np.all(squares == 1.0):
        return single
    more = sum((squares[:, k, chip] - 1.0) * sigma**2 for k, sigma in enumerate(own))
    return np.sqrt(np.maximum(single**2 + more, 0.0))
