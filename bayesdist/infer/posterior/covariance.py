"""Solutions with another covariance, for errors that their fit did not know or counted too much."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.equations.scaled import scaled_cholesky
from bayesdist.infer.solution import Solution, TransformedSolution

__all__ = ["recolouring", "with_covariance"]

Float = NDArray[np.float64]


def with_covariance(solution: Solution, cov: Float) -> TransformedSolution:
    """Solution whose draws are rescaled to a covariance (D, D), in which they keep their shape.

    A sum with independent noise would not do: the difference of the covariances may have negative
    eigenvalues, where errors that a fit takes for independent cancel.
    """
    mean = np.asarray(solution.mean)

    @cache
    def spread() -> Float:
        return recolouring(np.asarray(solution.cov), cov)

    def transform(theta: Float) -> Float:
        return np.asarray(mean + (theta - mean) @ spread().T)

    return TransformedSolution(solution.model, mean, cov, solution, transform)


def recolouring(before: Float, after: Float) -> Float:
    """Linear map A (D, D) with A before A^T = after; the identity where the two are equal.

    Both are positive definite, but for parameters without variance, which A leaves as they are.
    """
    free = np.flatnonzero(np.diag(before) > 0)
    inner = np.ix_(free, free)
    old, new = (scaled_cholesky(cov[inner]) for cov in (before, after))
    out = np.eye(len(before))
    out[inner] = np.linalg.solve(old.T, new.T).T
    return out
