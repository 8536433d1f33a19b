"""Detections in pieces of whole stars, for all passes over them: here or on a cluster.

A piece has its stars at a current solution.  Its next state and its part of every sum depend on the
piece and on the parameters alone: so no star travels, and a piece that is lost is made again from
its detections.
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

PIECE = 2**17  # detections: some tenths of a second for the draws that are evaluated together


@dataclass(frozen=True, eq=False)
class StarPiece:
    """Some stars with all their detections."""

    problem: Problem  # linearised at the stars of the last step
    stars: Float  # (S, q)

    def __sizeof__(self) -> int:
        """Bytes of all columns, without which Dask would move a piece as if it were nothing."""
        columns = (*self.problem.columns, self.problem.seen, self.stars)
        return sum(column.nbytes for column in columns)

    def split(self, detections: int) -> Iterator[StarPiece]:
        """Pieces of consecutive stars with about so many detections."""
        p = self.problem
        ends = np.searchsorted(p.starts, np.arange(detections, len(p), detections))
        for stars in np.split(np.arange(p.n_stars), np.unique(ends)):
            if len(stars):
                part = replace(p.of_stars(stars), rows=np.empty(0, np.int64))
                yield StarPiece(part, self.stars[stars])


@dataclass(frozen=True, eq=False)
class Expanded(StarPiece):
    """Stars at their modes, with the expansion there."""

    expansion: Expansion


# -- next states ----------------------------------------------------------------------------------


def at_stars(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece linearised at theta (D,) and its own stars."""
    return StarPiece(piece.problem.at(theta, piece.stars), piece.stars)


def at_means(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece with the stars at the means of their detections."""
    return at_stars(replace(piece, stars=piece.problem.mean_places(theta)), theta)


def at_medians(piece: StarPiece, theta: Float) -> StarPiece:
    """Piece with the stars at the medians of their detections."""
    return at_stars(replace(piece, stars=piece.problem.median_places(theta)), theta)


def at_modes(piece: StarPiece, theta: Float, mixture: Mixture, observed: bool) -> Expanded:
    """Piece with the stars at their modes, lost ones found again, and its expansion as `expand`."""
    found, stars = expand(piece.problem, theta, mixture, piece.stars, observed=observed)
    return Expanded(piece.problem, piece.problem.found_again(theta, stars), found)


def moved(piece: StarPiece, before: Float, after: Float) -> StarPiece:
    """Piece at other parameters (D,), the stars moved as the means of their detections are."""
    p, stars = piece.problem, piece.stars.copy()
    stars[:, :2] += p.shifts(before, after)
    return StarPiece(p.at(after, stars), stars)


@dataclass(frozen=True, eq=False)
class ModePiece(StarPiece):
    """Stars at the modes of a solution, and how they follow their detections from there."""

    modes: StarModes

    def __sizeof__(self) -> int:
        """As `StarPiece`."""
        m = self.modes
        return super().__sizeof__() + sum(c.nbytes for c in (m.response, m.middles, m.state))


def to_sample(piece: StarPiece, theta: Float, mixture: Mixture) -> ModePiece:
    """Piece of a solution, for densities of draws about it."""
    # of a star's detections nothing is needed but the columns of the passes
    p = replace(piece.problem, seen=np.empty((2, 0)))
    return ModePiece(p, piece.stars, StarModes.at(p, theta, mixture, piece.stars))


# -- sums -----------------------------------------------------------------------------------------


def expansion_of(piece: Expanded) -> Expansion:
    """Expansion of a piece that has one."""
    return piece.expansion


def expansion(
    piece: StarPiece, theta: Float, mixture: Mixture, observed: bool, priors: bool
) -> Expansion:
    """Expansion as of `expand`, with or without the priors of the stars."""
    p = piece.problem
    if not priors:
        p = replace(p, priors=StarPriors.none(p.n_stars, p.n_star))
    return expand(p, theta, mixture, piece.stars, observed=observed)[0]


def log_density(piece: ModePiece, theta: Float, mixtures: Float) -> Float:
    """Log densities (n,) as of `log_marginal`."""
    return log_marginal(piece.problem, theta, mixtures, piece.modes)


def slope(piece: ModePiece, theta: Float, mixture: Mixture, observed: bool) -> Expansion:
    """Expansion at theta (D,) as of `expand`."""
    stars = piece.modes.moved(piece.problem, theta)
    return expand(piece.problem, theta, mixture, stars, observed=observed)[0]


# -- results of each piece ------------------------------------------------------------------------


def squares(piece: StarPiece, theta: Float) -> Float:
    """Squared distances (N,) of detections from their stars."""
    return piece.problem.squares(theta, piece.stars)


def _state(piece: StarPiece) -> tuple[Float, ...]:
    p = piece.problem
    return p.X, p.Y, p.offset, p.W, piece.stars


def gathered(problem: Problem, pieces: MappedPieces) -> StarPiece:
    """All stars of a problem as one piece, in the state of its pieces."""
    states = pieces.each(_state)
    X, Y, offset, W, stars = (
        columns[0] if len(columns) == 1 else np.concatenate(columns)
        for columns in zip(*states, strict=True)
    )
    return StarPiece(replace(problem, X=X, Y=Y, offset=offset, W=W), stars)


# -- where they are -------------------------------------------------------------------------------


@contextmanager
def in_pieces(
    problem: Problem, stars: Float, compute: Compute | None = None
) -> Iterator[MappedPieces]:
    """Context with detections and stars (S, q): one piece in this process, or many on a cluster.

    InputError as `ClusterPieces`.
    """
    whole = StarPiece(problem, stars)
    pieces: MappedPieces = _Whole(whole)
    if compute is not None and compute.engine == "dask":
        # dask is imported where it is asked for
        from bayesdist.infer.stars.cluster import ClusterPieces

        pieces = ClusterPieces(_same, whole.split(PIECE), compute)
    try:
        yield pieces
    finally:
        pieces.close()


def each_of(compute: Compute | None, function: Task, sources: Iterable[Any]) -> Iterable[Any]:
    """Results of a function of each source, in their order: one at a time here, or on a cluster.

    InputError as `ClusterPieces`.
    """
    if compute is None or compute.engine != "dask":
        return map(function, sources)
    from bayesdist.infer.stars.cluster import ClusterPieces

    with closing(ClusterPieces(function, sources, compute)) as made:
        return list(made.each(_same))


@contextmanager
def one_cluster(compute: Compute | None) -> Iterator[Compute | None]:
    """Context in which all `in_pieces` of its compute share one cluster, where that is one."""
    if compute is None or compute.engine != "dask":
        yield compute
        return
    from bayesdist.infer.stars import cluster

    with cluster.one_cluster(compute) as shared:
        yield shared


class _Whole(MappedPieces):
    """One piece in this process, whose passes use its threads."""

    def __init__(self, piece: Any) -> None:
        self._piece = piece

    def sum(self, task: Task, *args: Any) -> Any:
        """Result of the task."""
        return task(self._piece, *args)

    def each(self, task: Task, *args: Any) -> tuple[Any]:
        """Result of the task, alone."""
        return (task(self._piece, *args),)

    def map(self, task: Task, *args: Any) -> Self:
        """Piece that the task makes."""
        return type(self)(task(self._piece, *args))

    def close(self) -> None:
        """Nothing is to be released."""


def _same(piece: Any) -> Any:
    """On a worker: the piece as it was sent, to be kept there; or as it was made, to be fetched."""
    return piece
