"""Detections in pieces of whole stars, for the passes over them that the posterior needs.

A piece has its stars at the mode.  What it contributes at other parameters depends on these alone,
for the search for its stars begins where their detections move them: so no star travels, and a
piece that is lost is made again from the same detections.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.selfcal.elimination import Mixture, StarModes, expand, log_marginal
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.infer.stars.shards import Compute, Pieces, Task
from bayesdist.infer.stars.sums import Sums

__all__ = ["Slope", "StarPiece", "in_pieces", "log_density", "slope"]

Float = NDArray[np.float64]

PIECE = 2**17  # detections: some tenths of a second for the draws that are evaluated together


@dataclass(frozen=True, eq=False)
class StarPiece:
    """Some stars with all their detections, at the mode of a self-calibration."""

    problem: Problem
    modes: StarModes

    @classmethod
    def at(cls, solution: SelfCalibrationMode) -> StarPiece:
        """All stars of a solution."""
        s = solution
        return cls(s.problem, StarModes.at(s.problem, s.theta, s.mixture, s.stars))

    def __sizeof__(self) -> int:
        """Bytes of all columns, without which Dask would move a piece as if it were nothing."""
        m = self.modes
        columns = (*self.problem.columns, m.stars, m.weight, m.middles, m.state)
        return sum(column.nbytes for column in columns)

    def split(self, detections: int) -> Iterator[StarPiece]:
        """Pieces of consecutive stars with about so many detections."""
        p, m = self.problem, self.modes
        ends = np.searchsorted(p.starts, np.arange(detections, len(p), detections))
        for stars in np.split(np.arange(p.n_stars), np.unique(ends)):
            if not len(stars):
                continue
            rows = slice(p.starts[stars[0]], p.starts[stars[-1] + 1])
            # of a star's detections nothing is needed but the columns of the passes
            part = replace(p.of_stars(stars), seen=np.empty((2, 0)), rows=np.empty(0, np.int64))
            part.__dict__["least_root"] = p.least_root  # from pixels of the whole
            some = m.stars[stars], m.weight[rows], m.middles[stars], m.state[rows]
            yield StarPiece(part, StarModes(*some))


@dataclass(frozen=True, eq=False)
class Slope(Sums):
    """Gradient and curvature of the log density at a solution, the stars eliminated."""

    gradient: Float  # (D,)
    curvature: Float  # minus the Hessian (D, D)


def log_density(piece: StarPiece, theta: Float, mixtures: Float) -> Float:
    """Log densities (n,) as of `log_marginal`: a task for `Pieces.sum`."""
    return log_marginal(piece.problem, theta, mixtures, piece.modes)


def slope(piece: StarPiece, theta: Float, mixture: Mixture, observed: bool) -> Slope:
    """Gradient and curvature at theta (D,), as of `expand`: a task for `Pieces.sum`."""
    stars = piece.modes.moved(piece.problem, theta)
    found = expand(piece.problem, theta, mixture, stars, observed=observed)
    return Slope(found.gradient, found.curvature)


@contextmanager
def in_pieces(solution: SelfCalibrationMode, compute: Compute | None = None) -> Iterator[Pieces]:
    """Context with the detections of a solution: one piece in this process, or many on a cluster.

    InputError as `ClusterPieces`.
    """
    whole = StarPiece.at(solution)
    pieces: Pieces = _Whole(whole)
    if compute is not None and compute.engine == "dask":
        # dask is imported where it is asked for
        from bayesdist.infer.stars.cluster import ClusterPieces

        pieces = ClusterPieces(_received, whole.split(PIECE), compute)
    try:
        yield pieces
    finally:
        pieces.close()


class _Whole(Pieces):
    """One piece in this process, whose passes use its threads."""

    def __init__(self, piece: StarPiece) -> None:
        self._piece = piece

    def sum(self, task: Task, *args: Any) -> Any:
        """Result of the task."""
        return task(self._piece, *args)

    def close(self) -> None:
        """Nothing is to be released."""


def _received(piece: StarPiece) -> StarPiece:
    """On a worker: the piece as it was sent, to be kept there."""
    return piece
