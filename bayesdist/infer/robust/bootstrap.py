"""Bootstrap over cells of the detector, from their sums: no star is read again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError
from bayesdist.infer.robust.result import RobustCovariance

__all__ = ["resampled_cells", "wild_cells"]

Float = NDArray[np.float64]


def resampled_cells(
    robust: RobustCovariance, n: int, rng: np.random.Generator, *, level: int = 1
) -> Float:
    """How solutions of detectors put together from random cells deviate from the solution.

    As many cells as there are on a chip are drawn with replacement, with all of their stars, and
    the coefficients are solved for again.  The mixture is held: one Newton step.

    Parameters
    ----------
    robust : RobustCovariance
        Of a model of polynomials alone, without priors.
    n : int
        Draws.
    rng : numpy.random.Generator
    level : int
        Which of the sizes of cells: 0 the smallest, 1 those of two by two.

    Returns
    -------
    ndarray, shape (n, D)

    Raises
    ------
    InputError
        For a model with frames or drift, or for priors.
    """
    model, cells = robust.model, robust.levels[level]
    if model.n_params != model.n_polynomial or robust.by_priors.any():
        raise InputError(
            "cells hold what is needed to solve again for polynomials alone",
            where="resampled_cells",
            do="take wild_cells for models with frames, drift or priors",
        )
    out = np.empty((n, model.n_params))
    for k, (leverage, score) in enumerate(zip(cells.leverage, cells.score, strict=True)):
        C = len(score)
        times = rng.multinomial(C, np.full(C, 1 / C), size=n).astype(float)
        matrix = np.einsum("nc,cij->nij", times, leverage.information, optimize=True)
        width = score.shape[1]
        out[:, k * width : (k + 1) * width] = np.linalg.solve(matrix, (times @ score)[..., None])[
            ..., 0
        ]
    return out


def wild_cells(
    robust: RobustCovariance, n: int, rng: np.random.Generator, *, level: int = 1
) -> Float:
    """How solutions deviate where the errors of every cell get a random sign, all alike.

    Parameters
    ----------
    robust, n, rng, level
        As `resampled_cells`; any model.

    Returns
    -------
    ndarray, shape (n, D)
        Their covariance is the sandwich of these cells, leverage corrected.
    """
    influence = robust.levels[level].influence
    return np.asarray(rng.choice([-1.0, 1.0], size=(n, len(influence))) @ influence)
