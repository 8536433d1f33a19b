"""The covariance of all numbers of an IDCTAB, also between filters.

Solutions of different filters come from different stars, but were turned by one orientation.  Given
the orientation p they are independent, so that

    Cov(a, b) = Cov(a, p) Cov(p)^-1 Cov(p, b)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution
from bayesdist.products.formats.idctab.hdus import Piece

__all__ = ["joint_covariance"]

Float = NDArray[np.float64]


def joint_covariance(solutions: Sequence[Solution], pieces: Sequence[Piece]) -> Float:
    """Of the numbers of all pieces, with what solutions of one orientation share."""
    jacobians = [np.concatenate([f.jacobian for f in p.fitted]) for p in pieces]
    ends = np.cumsum([len(j) for j in jacobians])
    places = [slice(int(e) - len(j), int(e)) for e, j in zip(ends, jacobians, strict=True)]
    out = np.zeros((int(ends[-1]), int(ends[-1])))
    for solution, jacobian, place in zip(solutions, jacobians, places, strict=True):
        out[place, place] = jacobian @ np.asarray(solution.cov, float) @ jacobian.T
    turned = [
        (k, s.orientation, jacobians[k] @ s.with_orientation)
        for k, s in enumerate(solutions)
        if getattr(s, "orientation", None) is not None
    ]
    for a, orientation, by_a in turned:
        for b, other, by_b in turned:
            if b > a and orientation is other:
                shared = by_a @ _inverse(orientation.cov) @ by_b.T
                out[places[a], places[b]] = shared
                out[places[b], places[a]] = shared.T
    return out


def _inverse(cov: Float) -> Float:
    """Inverse of the orientation's covariance, whose scale may be held and so have variance 0."""
    sigma = np.sqrt(np.diag(cov))
    known = sigma > 0
    out = np.zeros_like(cov)
    pick = np.ix_(known, known)
    norm = np.outer(sigma[known], sigma[known])
    out[pick] = np.linalg.pinv(cov[pick] / norm, hermitian=True) / norm
    return out
