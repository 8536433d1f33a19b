"""Sizes of local terms as draws: they are not known better than their own errors say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.terms import LocalTerm

__all__ = ["drawn_sizes", "resized"]

Float = NDArray[np.float64]


def drawn_sizes(local: Sequence[LocalTerm], n: int, rng: np.random.Generator) -> Float:
    """Factors (n, terms, 2) of both axes, log-normal and of mean square 1."""
    relative = np.array([term.relative_error or 0.0 for term in local])
    if not relative.any():
        return np.ones((n, relative.size, 2))
    relative = relative[:, None]  # what is known of one axis says nothing of the other
    return np.exp(relative * rng.standard_normal((n, relative.size, 2)) - relative**2)


def resized(single: Float, own: Sequence[Float], sizes: Float) -> Float:
    """Standard deviations of all that is independent from place to place, as drawn.

    Parameters
    ----------
    single : ndarray, shape (N, 2)
        With the local terms as large as they were found.
    own : sequence of ndarray, shape (N, 2)
        Those of the local terms.
    sizes : ndarray, shape (n, terms, 2)

    Returns
    -------
    ndarray, shape (n, N, 2), or (N, 2) where all sizes are the same
    """
    if not own or np.all(sizes == 1.0):
        return single
    factors = sizes[:, :, None] ** 2 - 1.0
    more = sum(factors[:, k] * sigma**2 for k, sigma in enumerate(own))
    return np.sqrt(np.maximum(single**2 + more, 0.0))
