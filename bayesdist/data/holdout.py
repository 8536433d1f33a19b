"""Matches that are set aside before anything is fitted, to be predicted afterwards.

The choice depends on a star's own code, or on its position on the detector where it has none, and
on a seed: neither on the order of the rows nor on the pieces in which they are read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.data.partitioned import PartitionedMatches
from bayesdist.data.pieces import Piece
from bayesdist.errors import InputError

__all__ = [
    "HELD_OUT",
    "ChosenMatches",
    "SetAside",
    "Split",
    "exposures_drawn",
    "refuse_strangers",
    "split_matches",
]

Bits = NDArray[np.uint64]
Matches = MatchTable | PartitionedMatches

HELD_OUT = "held out"  # reason under which they are counted


@dataclass(frozen=True)
class SetAside:
    """Selection of the matches that are set aside: a fraction of the stars, and whole exposures."""

    fraction: float  # of the stars, in [0, 1)
    exposures: tuple[str, ...] = ()
    seed: int = 1

    def which(self, table: MatchTable) -> NDArray[np.bool_]:
        """Boolean mask (N,) of the matches that are set aside; those of a star go together."""
        if table.star is not None:
            keys = [table.star.view(np.uint64)]
        else:
            # -0.0 and 0.0 are one position
            keys = [(a + 0.0).view(np.uint64) for a in (table.x, table.y)]
        bits = np.full(len(table), _mixed(np.array([self.seed], np.uint64))[0])
        for key in keys:
            bits = _mixed(bits ^ key)
        chosen = (bits >> np.uint64(11)) * 2.0**-53 < self.fraction
        whole = [name in set(self.exposures) for name in table.exposure_names]
        return np.asarray(chosen | np.array(whole, bool)[table.exposure])


@dataclass(frozen=True, eq=False)
class Split:
    """Matches in two parts: to be fitted, and set aside."""

    kept: Matches  # fitted; exposures without stars here are not named
    held: Matches  # set aside, with the names of all exposures


@dataclass(frozen=True, eq=False)
class _ChosenPiece:
    """Rows of a piece that are, or are not, set aside."""

    piece: Piece
    aside: SetAside
    held: bool
    names: tuple[str, ...]
    n: int

    def __len__(self) -> int:
        return self.n

    def read(self) -> MatchTable:
        """The rows."""
        table = self.piece.read()
        rows = table.select(self.aside.which(table) == self.held)
        return _renamed(rows, self.names)


@dataclass(frozen=True, eq=False)
class ChosenMatches(PartitionedMatches):
    """Matches on disk without those that are set aside, or (`held`) these alone."""

    origin: PartitionedMatches | None = None
    aside: SetAside | None = None
    held: bool = False
    counts: tuple[int, ...] = ()  # rows of each piece of the origin

    def pieces(self) -> tuple[Piece, ...]:
        """Pieces of the origin that have any of these rows."""
        assert self.origin is not None and self.aside is not None
        errors = {"errors": self.errors, "factor": self.factor, "added": self.added}
        pieces = replace(self.origin, **errors).pieces()
        return tuple(
            _ChosenPiece(piece, self.aside, self.held, self.exposure_names, n)
            for piece, n in zip(pieces, self.counts, strict=True)
            if n
        )


def exposures_drawn(names: Sequence[str], n: int, seed: int) -> tuple[str, ...]:
    """Names of `n` exposures drawn by a seed, whatever their order; refused where none is left."""
    if n >= len(names):
        raise InputError(
            f"{n} exposures are to be held out, and there are {len(names)}",
            where="holdout.exposures",
            do="ask for fewer",
        )
    drawn = sorted(names, key=lambda name: hashlib.sha256(f"{seed}\n{name}".encode()).digest())
    chosen = set(drawn[:n])
    return tuple(name for name in names if name in chosen)


def split_matches(matches: Matches, aside: SetAside) -> Split:
    """Matches in two parts; those on disk are read once.

    Refused are an unknown exposure, nothing left to fit, and nothing set aside.
    """
    where = ", ".join(matches.sources)
    refuse_strangers(aside.exposures, matches.exposure_names, where)
    if isinstance(matches, MatchTable):
        which = aside.which(matches)
        _refuse_nothing(int(which.sum()), len(which), where)
        kept = matches.select(~which, reason=HELD_OUT)
        return Split(_renamed(kept, kept.exposures), matches.select(which))
    n_held, n_all = [], []
    seen = np.zeros(len(matches.exposure_names), bool)
    for piece in matches.pieces():
        table = piece.read()
        which = aside.which(table)
        seen[table.exposure[~which]] = True
        n_held.append(int(which.sum()))
        n_all.append(len(table))
    total = sum(n_held)
    _refuse_nothing(total, len(matches), where)
    named = tuple(n for n, there in zip(matches.exposure_names, seen, strict=True) if there)
    n_kept = tuple(n - k for n, k in zip(n_all, n_held, strict=True))

    def chosen(held: bool) -> ChosenMatches:
        n = total if held else len(matches) - total
        others = {} if held else {HELD_OUT: total}
        return ChosenMatches(
            replace(
                matches.whole,
                n_rows=n,
                exposure_names=matches.exposure_names if held else named,
            ),
            matches.parts,
            matches.errors,
            {**matches.dropped, **others},
            matches.factor,
            matches.added,
            matches,
            aside,
            held,
            tuple(n_held) if held else n_kept,
        )

    return Split(chosen(False), chosen(True))


def refuse_strangers(asked: Sequence[str], names: Sequence[str], where: str) -> None:
    """Refuse names of exposures to be held out that are not among `names`."""
    for name in asked:
        if name not in names:
            raise InputError(
                f"there is no exposure {name!r} to be held out",
                where=where,
                do=f"name some of {', '.join(names[:5])}, ... in holdout.exposures",
            )


def _refuse_nothing(held: int, n: int, where: str) -> None:
    if 0 < held < n:
        return
    raise InputError(
        "no star is set aside" if held == 0 else "every star is set aside, and none is left to fit",
        where=where,
        do="correct holdout.fraction and holdout.exposures",
    )


def _renamed(table: MatchTable, names: tuple[str, ...]) -> MatchTable:
    """Table whose exposures are numbered by other names, which include all of its own."""
    if names == table.exposure_names:
        return table
    code = {name: k for k, name in enumerate(names)}
    codes = np.array([code.get(name, -1) for name in table.exposure_names], np.int64)
    return table._with(exposure=codes[table.exposure], exposure_names=names)


def _mixed(bits: Bits) -> Bits:
    """Bits that depend on all bits: the finaliser of SplitMix64 (Steele, Lea and Flood 2014)."""
    out = bits + np.uint64(0x9E3779B97F4A7C15)
    out = (out ^ (out >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    out = (out ^ (out >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(out ^ (out >> np.uint64(31)))
