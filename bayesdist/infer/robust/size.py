"""Which size of cells to go by: the smallest that larger ones do not contradict."""

from __future__ import annotations

from dataclasses import replace

from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.result import LEVEL, RobustCovariance

__all__ = ["by_fitting_cells"]

ABOVE = 0.5  # errors of a larger size's ratio by which it may be above


def by_fitting_cells(robust: RobustCovariance) -> RobustCovariance:
    """The same by cells as large as a pattern asks for.

    Cells smaller than a pattern cut what its stars have in common, and give too small a variance;
    large ones are few, and give one that is hardly known.  So the smallest are taken whose ratio to
    the formal variance none of the larger sizes exceeds by more than half its error (a rule as that
    of Lepski 1991), among the sizes that show by themselves that stars err together.

    Parameters
    ----------
    robust : RobustCovariance
        By cells as small as can be.

    Returns
    -------
    RobustCovariance
        The same one where these show no common errors.
    """
    ratios = [size.ratio for size in robust.by_size]
    show = [k for k, ratio in enumerate(ratios) if ratio.p_value < LEVEL]
    if not robust.exceeds:
        return robust
    k = show[-1]
    for one in show:
        if all(r.value - ratios[one].value <= ABOVE * r.error for r in ratios[one + 1 :]):
            k = one
            break
    factor = robust.levels[k].factor
    return replace(
        robust,
        cells=Cells(tuple(robust.cells.merged(factor)[0])),
        levels=tuple(replace(level, factor=level.factor // factor) for level in robust.levels[k:]),
        known=robust.known[k:],
    )
