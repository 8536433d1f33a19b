"""Directions in which a model may lack something: which are left, and how large a finding is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["beside_others", "independent_directions", "squares_of"]

Float = NDArray[np.float64]


def beside_others(information: Float, own: NDArray[np.bool_], directions: Float) -> Float:
    """Directions (n, q) of the `own` regressors (n,), without what the others say of them.

    `information` (n, n) is that of all, the parameters projected out; `directions` are combinations
    of the own ones.
    """
    out = np.zeros((len(own), directions.shape[1]))
    out[own] = directions
    across = information[np.ix_(~own, own)] @ directions
    out[~own] = -np.linalg.lstsq(information[np.ix_(~own, ~own)], across)[0]
    return out


def independent_directions(whole: Float, left: Float, least: float) -> Float:
    """Directions (n, q) of regressors that the parameters have left.

    `whole` and `left` (n, n) are the information of the regressors before and after the parameters
    are projected out, `least` the fraction of it that a direction must keep. Directions are in
    units in which `whole` is the unit matrix.
    """
    diagonal = np.diag(whole)
    scale = np.zeros(len(diagonal))
    scale[diagonal > 0] = diagonal[diagonal > 0] ** -0.5
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    good = values > 1e-8 * values.max(initial=1e-300)
    basis = scale[:, None] * vectors[:, good] / np.sqrt(values[good])
    fraction, turn = np.linalg.eigh(basis.T @ left @ basis)
    return np.asarray(basis @ turn[:, fraction > least])


def squares_of(
    score: Float, information: Float, covariance: Float, square: Float
) -> tuple[float, float]:
    """Mean squares of the pattern that a score stands for, and of what noise makes of it.

    The first holds the second. `information` and `covariance` (q, q) are those of the directions
    and of their `score` (q,), `square` (q, q) the mean products of the directions over the
    detector.
    """
    inverse = np.linalg.inv(information)
    step = inverse @ score
    noise = np.trace(square @ inverse @ covariance @ inverse)
    return float(step @ square @ step), float(noise)
