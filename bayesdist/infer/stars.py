"""The data as the passes want them: sorted by group, scaled to [-1, 1], in contiguous columns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel, Groups

__all__ = ["Stars", "prepare"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CHUNK = 8192  # rows of a design matrix held at a time: fits the cache at order 9


@dataclass(frozen=True, eq=False)
class Stars:
    """Matched stars in the order of their groups.

    Parameters
    ----------
    model : DistortionModel
    groups : Groups
        Index in the order of the *table*.
    order : ndarray of int, shape (N,)
        Table row of each star here.
    starts : ndarray of int, shape (G + 1,)
        Where each group begins.
    X, Y : ndarray, shape (N,)
        Scaled detector position.
    u, v : ndarray, shape (N,)
        Reference position.
    var_u, var_v : ndarray, shape (N,)
        Squared errors.
    """

    model: DistortionModel
    groups: Groups
    order: Int
    starts: Int
    X: Float
    Y: Float
    u: Float
    v: Float
    var_u: Float
    var_v: Float

    def __len__(self) -> int:
        return len(self.X)

    def chunks(self) -> Iterator[tuple[int, slice, Float]]:
        """Group, rows and design matrix (n, K) of one piece after the other."""
        for g in range(len(self.groups)):
            basis = self.model.basis(self.model.chips[self.groups.chip[g]].number)
            for a in range(self.starts[g], self.starts[g + 1], CHUNK):
                rows = slice(a, min(a + CHUNK, int(self.starts[g + 1])))
                yield g, rows, basis.evaluate_scaled(self.X[rows], self.Y[rows])

    def predict(self, theta: Float) -> Float:
        """Model positions (N, 2) of one parameter vector, in the order of this object."""
        E = self.model.effective(theta, self.groups)
        out = np.empty((len(self), 2))
        for g, rows, phi in self.chunks():
            out[rows] = phi @ E[g].T
        return out

    def residuals(self, theta: Float) -> Float:
        """Data minus model (N, 2), in the order of this object."""
        out = self.predict(theta)
        np.subtract(self.u, out[:, 0], out=out[:, 0])
        np.subtract(self.v, out[:, 1], out=out[:, 1])
        return out

    def in_table_order(self, values: Float) -> Float:
        """Per-star values in the order of the table."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    @cached_property
    def reference_sigma(self) -> float:
        """Median quoted error of one axis: the scale of the priors."""
        return float(np.sqrt(np.median(np.concatenate([self.var_u, self.var_v]))))


def prepare(model: DistortionModel, matches: MatchTable) -> Stars:
    """Sort a table of matches for the passes.

    Parameters
    ----------
    model : DistortionModel
        Its exposures are the table's `exposure_names`, its chips contain the table's.
    matches : MatchTable

    Returns
    -------
    Stars

    Raises
    ------
    InputError
        When the table has no errors, another unit, or lacks an epoch that the model needs.
    """
    if matches.sigma_u is None or matches.sigma_v is None:
        raise InputError(
            "the matches carry no errors",
            do="give sigma columns, a number, or sigma = 'by_magnitude'",
        )
    if matches.unit != model.unit:
        raise InputError(f"the matches are in {matches.unit} and the model is in {model.unit}")
    numbers = np.asarray(matches.chip_numbers)[matches.chip]
    groups = model.groups(
        len(matches), epoch=matches.epoch, exposure=matches.exposure, chip=numbers
    )
    order = np.argsort(groups.index, kind="stable")
    counts = np.bincount(groups.index, minlength=len(groups))
    starts = np.concatenate([[0], np.cumsum(counts)])
    x, y = matches.x[order], matches.y[order]
    X, Y = np.empty(len(x)), np.empty(len(x))
    for g in range(len(groups)):
        rows = slice(starts[g], starts[g + 1])
        basis = model.basis(model.chips[groups.chip[g]].number)
        X[rows], Y[rows] = basis.scaled(x[rows], y[rows])
    return Stars(
        model=model,
        groups=groups,
        order=order,
        starts=starts,
        X=X,
        Y=Y,
        u=matches.u[order],
        v=matches.v[order],
        var_u=matches.sigma_u[order] ** 2,
        var_v=matches.sigma_v[order] ** 2,
    )
