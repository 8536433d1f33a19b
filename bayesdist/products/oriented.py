"""A solution turned into the plane of an IDCTAB, with the error of the turn in its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution
from bayesdist.errors import InputError
from bayesdist.infer.views import Derived
from bayesdist.model import DistortionModel
from bayesdist.model.similarity import turned, turned_model
from bayesdist.products.orientation import Orientation, check_frames

__all__ = ["Oriented", "oriented"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Oriented(Derived):
    """A solution whose (u, v) are (Xc, Yc) of an IDCTAB, in arcseconds.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
    cov : ndarray, shape (D, D)
    source : Solution
        The solution before it was turned.
    orientation : Orientation
    with_orientation : ndarray, shape (D, 4)
        Covariance of the parameters with those of the orientation, which solutions of other
        filters share.
    """

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution
    orientation: Orientation
    with_orientation: Float

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors, shape (n, D): each draw turned by a draw of the orientation."""
        o = self.orientation
        theta = np.asarray(self.source.draws(n, rng), float)
        if self.source is o.base:
            moved = (theta - np.asarray(o.base.mean)) @ o.derivative.T
            spread = o.reference_cov
        else:
            moved, spread = np.zeros((n, 4)), o.cov
        moved = moved + rng.multivariate_normal(np.zeros(4), spread, size=n, method="eigh")
        turn = o.scale * np.exp(moved[:, 2] + 1j * (o.angle + moved[:, 3]))
        shift = complex(*o.shift) + moved[:, 0] + 1j * moved[:, 1]
        return turned(self.source.model, theta, turn, shift)


def oriented(solution: Solution, orientation: Orientation) -> Oriented:
    """Turn a solution into the plane of an IDCTAB.

    Every term of both axes is rotated together, those that depend on time as well: where (u, i, j)
    drifts, (v, i, j) does after the turn, so that the model of the result has both.

    Parameters
    ----------
    solution : Solution
        Without exposure frames; that on which the orientation rests, or that of another filter in
        the same system.
    orientation : Orientation

    Returns
    -------
    Oriented
        Its covariance holds the error of the orientation.  A solution other than the orientation's
        own is taken as independent of it.

    Raises
    ------
    InputError
        For a model with exposure frames, or in another unit than the orientation's.
    """
    model, base = solution.model, orientation.base
    check_frames(solution)
    if model.unit != base.model.unit:
        raise InputError(
            f"the solution is in {model.unit} and the orientation is for {base.model.unit}",
            where="model.unit",
            do="orient solutions of one system only",
        )
    mean, cov = np.asarray(solution.mean, float), np.asarray(solution.cov, float)
    turn = orientation.scale * np.exp(1j * orientation.angle)
    linear = turned(model, np.eye(model.n_params), turn, 0.0).T
    moved = turned(model, mean, turn, complex(*orientation.shift))
    # derivatives by shift_x, shift_y, log_scale, angle
    by = np.stack(
        [
            turned(model, 0 * mean, turn, 1.0),
            turned(model, 0 * mean, turn, 1j),
            turned(model, mean, turn, 0.0),
            turned(model, mean, 1j * turn, 0.0),
        ],
        axis=1,
    )
    if solution is base:
        total = linear + by @ orientation.derivative
        with_orientation = total @ cov @ orientation.derivative.T + by @ orientation.reference_cov
        own = total @ cov @ total.T + by @ orientation.reference_cov @ by.T
    else:
        with_orientation = by @ orientation.cov
        own = linear @ cov @ linear.T + with_orientation @ by.T
    new = replace(turned_model(model), unit="arcsec")
    return Oriented(new, moved, (own + own.T) / 2, solution, orientation, with_orientation)
