"""Division of the detections into pieces, in this process or on a cluster, for the passes.

A piece contains all detections of some stars, and the stars at the current solution.  Its next
state and its contribution to any sum depend only on the piece and on the parameters.  Therefore
stars are not transferred, and a lost piece can be computed again from its detections.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from bayesdist.infer.selfcal.elimination import (
    Expansion,
    Mixture,
    StarModes,
    expand,
    log_marginal,
)
from bayesdist.infer.selfcal.problem import Problem, StarPriors
from bayesdist.infer.stars.shards import Compute, MappedPieces, Task
from bayesdist.utils.arrays import Float

PIECE = 2**17  # detections per piece: a few tenths of a second for a batch of draws


@dataclass(frozen=True, eq=False)
class StarPiece:
    """Stars with all their detections."""

    problem: Problem  # linearised at the stars of the last step
    stars: Float  # parameters (S, q) of the stars

    def __sizeof__(self) -> int:
        """Size of all columns in bytes, which Dask uses to estimate the cost of moving a piece."""
        columns = (*self.problem.columns, self.problem.seen, self.stars)
        return sum(column.nbytes for column in columns)

    def split(self, detections: int) -> Iterator[StarPiece]:
        """Divide into pieces of consecutive stars with about `detections` detections each."""
        p = self.problem
        ends = np.searchsorted(p.starts, np.arange(detections, len(p), detections))
        for stars in np.split(np.arange(p.n_stars), np.unique(ends)):
            if len(stars):
                part = replace(p.of_stars(stars), rows=np.empty(0, np.int64))
                yield StarPiece(part, self.stars[stars])


@dataclass(frozen=True, eq=False)
class Expanded(StarPiece):
    """Stars at their modes, with the expansion of the log density there."""

    expansion: Expansion


# -- next states ----------------------------------------------------------------------------------


def at_stars(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece linearised at theta (D,) and at its current stars."""
    return StarPiece(piece.problem.at(theta, piece.stars), piece.stars)


def at_means(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece with the stars at the means of their detections."""
    return at_stars(replace(piece, stars=piece.problem.mean_places(theta)), theta)


def at_medians(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece with the stars at the medians of their detections."""
    return at_stars(replace(piece, stars=piece.problem.median_places(theta)), theta)


def at_modes(piece: StarPiece, theta: Float, mixture: Mixture, observed: bool) -> Expanded:
    """Piece with the stars at their modes, and the expansion there (see `expand`).

    Stars that have moved away from all their detections are reset.
    """
    result, stars = expand(piece.problem, theta, mixture, piece.stars, observed=observed)
    return Expanded(piece.problem, piece.problem.found_again(theta, stars), result)


def moved(piece: StarPiece, before: Float, after: Float) -> StarPiece:
    """Piece re-linearised at parameters (D,); stars move like the means of their detections."""
    p, stars = piece.problem, piece.stars.copy()
    stars[:, :2] += p.shifts(before, after)
    return StarPiece(p.at(after, stars), stars)


@dataclass(frozen=True, eq=False)
class ModePiece(StarPiece):
    """Stars at the modes of a solution, with their response to changes of the parameters."""

    modes: StarModes

    def __sizeof__(self) -> int:
        """Size of all columns in bytes; see `StarPiece`."""
        m = self.modes
        return super().__sizeof__() + sum(c.nbytes for c in (m.response, m.middles, m.state))


def to_sample(piece: StarPiece, theta: Float, mixture: Mixture) -> ModePiece:
    """Prepare a piece of a solution for computing the densities of draws near it."""
    # only the columns that the passes use are needed
    p = replace(piece.problem, seen=np.empty((2, 0)))
    return ModePiece(p, piece.stars, StarModes.at(p, theta, mixture, piece.stars))


# -- sums -----------------------------------------------------------------------------------------


def expansion_of(piece: Expanded) -> Expansion:
    """Expansion that is stored with a piece."""
    return piece.expansion


def expansion(
    piece: StarPiece, theta: Float, mixture: Mixture, observed: bool, priors: bool
) -> Expansion:
    """Expansion of the log density (see `expand`), with or without the priors of the stars."""
    p = piece.problem
    if not priors:
        p = replace(p, priors=StarPriors.none(p.n_stars, p.n_star))
    return expand(p, theta, mixture, piece.stars, observed=observed)[0]


def log_density(piece: ModePiece, theta: Float, mixtures: Float) -> Float:
    """Log densities (n,) of theta (n, D); see `log_marginal`."""
    return log_marginal(piece.problem, theta, mixtures, piece.modes)


def slope(piece: ModePiece, theta: Float, mixture: Mixture, observed: bool) -> Expansion:
    """Expansion of the log density at theta (D,); see `expand`."""
    stars = piece.modes.moved(piece.problem, theta)
    return expand(piece.problem, theta, mixture, stars, observed=observed)[0]


# -- results per piece ----------------------------------------------------------------------------


def squares(piece: StarPiece, theta: Float) -> Float:
    """Squared distances (N,) of the detections from their stars, in square pixels."""
    return piece.problem.squares(theta, piece.stars)


def _state(piece: StarPiece) -> tuple[Float, ...]:
    p = piece.problem
    return p.X, p.Y, p.offset, p.W, piece.stars


def gathered(problem: Problem, pieces: MappedPieces) -> StarPiece:
    """Collect the pieces of a problem in a single piece."""
    states = pieces.each(_state)
    X, Y, offset, W, stars = (
        columns[0] if len(columns) == 1 else np.concatenate(columns)
        for columns in zip(*states, strict=True)
    )
    return StarPiece(replace(problem, X=X, Y=Y, offset=offset, W=W), stars)


# -- location of the pieces -----------------------------------------------------------------------


@contextmanager
def in_pieces(
    problem: Problem, stars: Float, compute: Compute | None = None
) -> Iterator[MappedPieces]:
    """Context with the detections and stars (S, q) as a single piece here or many on a cluster.

    Raises InputError like `ClusterPieces`.
    """
    piece = StarPiece(problem, stars)
    pieces: MappedPieces = _Whole(piece)
    if compute is not None and compute.engine == "dask":
        # dask is imported only if its engine is requested
        from bayesdist.infer.stars.cluster import ClusterPieces

        pieces = ClusterPieces(_same, piece.split(PIECE), compute)
    try:
        yield pieces
    finally:
        pieces.close()


def each_of(compute: Compute | None, function: Task, sources: Iterable[Any]) -> Iterable[Any]:
    """Results of a function for each source, in their order, computed here or on a cluster.

    Raises InputError like `ClusterPieces`.
    """
    if compute is None or compute.engine != "dask":
        return map(function, sources)
    from bayesdist.infer.stars.cluster import ClusterPieces

    with closing(ClusterPieces(function, sources, compute)) as pieces:
        return list(pieces.each(_same))


@contextmanager
def one_cluster(compute: Compute | None) -> Iterator[Compute | None]:
    """Context in which all calls of `in_pieces` with the yielded compute share one cluster."""
    if compute is None or compute.engine != "dask":
        yield compute
        return
    from bayesdist.infer.stars import cluster

    with cluster.one_cluster(compute) as shared:
        yield shared


class _Whole(MappedPieces):
    """A single piece in this process; passes use its threads."""

    def __init__(self, piece: Any) -> None:
        self._piece = piece

    def sum(self, task: Task, *args: Any) -> Any:
        """Result of the task."""
        return task(self._piece, *args)

    def each(self, task: Task, *args: Any) -> tuple[Any]:
        """Result of the task as a tuple of one item."""
        return (task(self._piece, *args),)

    def map(self, task: Task, *args: Any) -> Self:
        """New piece from the task."""
        return type(self)(task(self._piece, *args))

    def close(self) -> None:
        """Do nothing, as there is nothing to release."""


def _same(piece: Any) -> Any:
    """Return the piece (runs on a worker), to keep it there or to fetch it."""
    return piece
