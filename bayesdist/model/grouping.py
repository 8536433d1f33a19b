"""Groups of stars with the same effective coefficients.

For one chip, exposure and epoch the complete model (polynomial, time dependence, frame) is a single
polynomial of the pixel position.  The data constrain the parameters only through these polynomials.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True, eq=False)
class Groups:
    """Membership of stars in groups.

    Parameters
    ----------
    index : ndarray of int, shape (N,)
        Group of each star.
    chip, exposure : ndarray of int, shape (G,)
        Chip and exposure of each group, as indices into the model's chips and exposures.
    epoch : ndarray, shape (G,)
        Decimal years; 0 if the model has no time dependence.
    """

    index: Int
    chip: Int
    exposure: Int
    epoch: Float

    def __len__(self) -> int:
        return len(self.chip)

    def same(self, other: Groups) -> bool:
        """True if two sets of groups are equal, apart from their members."""
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("chip", "exposure", "epoch")
        )

    def members(self) -> list[Int]:
        """Indices of the stars of each group, in ascending order."""
        if not len(self):
            return []
        order = np.argsort(self.index, kind="stable")
        ends = np.cumsum(np.bincount(self.index, minlength=len(self)))
        return np.split(order, ends[:-1])


def group_by(chip: Int, exposure: Int, epoch: Float) -> Groups:
    """Groups of stars with equal chip, exposure and epoch, sorted by these in this order.

    `chip` and `exposure` are codes and `epoch` is in decimal years, each of shape (N,).
    """
    # stars of a group are usually adjacent, so only the first star of each sequence is sorted
    heads = _starts_of_runs(chip, exposure, epoch)
    chip_of, exposure_of, epoch_of = chip[heads], exposure[heads], epoch[heads]
    order = np.lexsort((epoch_of, exposure_of, chip_of))
    starts = _starts_of_runs(chip_of[order], exposure_of[order], epoch_of[order])
    group_of = np.empty(len(order), np.int64)
    group_of[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(order)))
    first = order[starts]
    return Groups(
        index=np.repeat(group_of, np.diff(heads, append=len(chip))),
        chip=chip_of[first],
        exposure=exposure_of[first],
        epoch=epoch_of[first],
    )


def _starts_of_runs(*columns: Int | Float) -> Int:
    """Indices of the rows that differ from the previous row, including the first row."""
    starts = np.ones(len(columns[0]), bool)
    if len(starts):
        starts[1:] = np.logical_or.reduce([c[1:] != c[:-1] for c in columns])
    return np.flatnonzero(starts)


def merge_groups(a: Groups, b: Groups) -> tuple[Groups, Int, Int]:
    """Union of two sets of groups, in the order of `group_by`.

    Parameters
    ----------
    a, b : Groups

    Returns
    -------
    groups : Groups
        Union of the groups, without members.
    of_a, of_b : ndarray of int
        Indices of the groups of `a` and of `b` in the union.
    """
    union = group_by(
        np.concatenate([a.chip, b.chip]),
        np.concatenate([a.exposure, b.exposure]),
        np.concatenate([a.epoch, b.epoch]),
    )
    index = union.index
    return replace(union, index=np.zeros(0, np.int64)), index[: len(a)], index[len(a) :]
