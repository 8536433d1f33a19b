"""Matched stars as columns for the passes: sorted by group, scaled to [-1, 1]."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer import kernel
from bayesdist.infer.kernel import Constants
from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.arrays import Float, Int

NOBODY = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Stars:
    """Matched stars in the order of their groups."""

    model: DistortionModel
    groups: Groups  # those that have stars here, without members, which follow from `starts`
    starts: Int  # first star (G + 1,) of each group
    X: Float  # scaled detector position (N,)
    Y: Float
    u: Float  # reference position (N,)
    v: Float
    var_u: Float  # squared errors (N,); one array where they are equal
    var_v: Float
    # nominal position, about which the star was matched, minus reference position (N,); None where
    # it is not known
    off_u: Float | None = None
    off_v: Float | None = None

    def __len__(self) -> int:
        return len(self.X)

    @property
    def columns(self) -> tuple[Float, ...]:
        """X, Y, u, v, var_u, var_v."""
        return self.X, self.Y, self.u, self.v, self.var_u, self.var_v

    @property
    def offsets(self) -> tuple[Float, ...]:
        """off_u and off_v; empty where there are none."""
        return () if self.off_u is None or self.off_v is None else (self.off_u, self.off_v)

    def circle(self, constants: Constants) -> tuple[Float, ...]:
        """Offsets of the circles in which stars were matched; empty where they are not needed."""
        return self.offsets if constants.radius else ()

    @property
    def nbytes(self) -> int:
        """Bytes of all columns."""
        shared = self.var_u is self.var_v
        return 8 * len(self) * ((5 if shared else 6) + len(self.offsets))

    def __sizeof__(self) -> int:
        """Bytes of all columns, without which Dask would move a shard as if it were nothing."""
        return self.nbytes

    @cached_property
    def blocks(self) -> Int:
        """Pieces (n, 3) that fit into the cache."""
        return kernel.pieces_of(self.starts, kernel.BLOCK)

    @cached_property
    def pieces(self) -> Int:
        """Pieces (n, 3) with separate sums."""
        return kernel.pieces_of(self.starts, kernel.PIECE)

    def powers(self, theta: Float | None) -> Float:
        """Effective coefficients (..., G, 2, K) of the scaled powers; None stands for zero."""
        if theta is None:
            return np.zeros((len(self.groups), 2, self.model.n_terms))
        # all chips share the order, hence the map to powers
        basis = self.model.basis(self.model.chips[0].number)
        return basis.to_scaled_powers(self.model.effective(theta, self.groups))

    def residuals(self, theta: Float) -> Float:
        """Data minus model (N, 2), in the order of this object."""
        return kernel.residuals(self.blocks, self.columns, self.powers(theta), self.model.order)

    def pixels(self) -> tuple[Float, Float]:
        """Detector positions x, y (N,), FITS 1-based."""
        x, y = np.empty(len(self)), np.empty(len(self))
        for g, chip in enumerate(self.groups.chip):
            rows = slice(self.starts[g], self.starts[g + 1])
            size = self.model.chips[chip].size
            x[rows] = (self.X[rows] * size[0] + size[0] + 1) / 2
            y[rows] = (self.Y[rows] * size[1] + size[1] + 1) / 2
        return x, y


def prepare(model: DistortionModel, matches: Matches) -> tuple[Stars, Int]:
    """Stars of a table of matches, sorted for the passes, and the table row (N,) of each.

    The model's exposures are the table's `exposure_names`, its chips contain the table's.
    InputError when the table has no errors, another unit, or lacks an epoch that the model needs.
    """
    sigma_u, sigma_v = errors_of(matches)
    groups = groups_of(model, matches)
    order: Int | slice = slice(None)  # one group: the usual case, without copies
    if len(groups) > 1:
        order = np.argsort(groups.index, kind="stable")
    counts = np.bincount(groups.index, minlength=len(groups))
    starts = np.concatenate([[0], np.cumsum(counts)])
    x, y = matches.x[order], matches.y[order]
    X, Y = np.empty(len(x)), np.empty(len(x))
    for g in range(len(groups)):
        rows = slice(starts[g], starts[g + 1])
        basis = model.basis(model.chips[groups.chip[g]].number)
        X[rows], Y[rows] = basis.scaled(x[rows], y[rows])
    var_u = sigma_u[order] ** 2
    equal = np.array_equal(sigma_u, sigma_v)
    stars = Stars(
        model=model,
        groups=replace(groups, index=NOBODY),
        starts=starts,
        X=X,
        Y=Y,
        u=matches.u[order],
        v=matches.v[order],
        var_u=var_u,
        var_v=var_u if equal else sigma_v[order] ** 2,
        off_u=None if matches.u_nominal is None else (matches.u_nominal - matches.u)[order],
        off_v=None if matches.v_nominal is None else (matches.v_nominal - matches.v)[order],
    )
    return stars, np.arange(len(x))[order]


def errors_of(matches: Matches) -> tuple[Float, Float]:
    """Errors (N,) on u and v of matches; InputError when the table has none."""
    if matches.sigma_u is None or matches.sigma_v is None:
        do = "give sigma columns, a number, or sigma = 'by_magnitude'"
        if matches.has_mag:  # as matches that were read with sigma = 'by_magnitude'
            do = (
                "estimate them from the residuals by magnitude with bayesdist.fit_by_magnitude or "
                "bayesdist.calibrate, or give sigma columns or a number"
            )
        raise InputError("the matches carry no errors", do=do)
    return matches.sigma_u, matches.sigma_v


def groups_of(model: DistortionModel, matches: Matches) -> Groups:
    """Groups of matches with equal effective coefficients.

    InputError when the table has another unit than the model, a chip or an exposure that is not in
    the model, or lacks an epoch that it needs.
    """
    if matches.unit != model.unit:
        raise InputError(f"the matches are in {matches.unit} and the model is in {model.unit}")
    return model.groups(
        len(matches), epoch=matches.epoch, exposure=matches.exposure, chip=matches.chip_number
    )


def in_table_order(values: NDArray[Any], order: Int) -> NDArray[Any]:
    """Values of each star, reordered to the table along the first axis."""
    out = np.empty_like(values)
    out[order] = values
    return out
