"""Matches that are set aside before anything is fitted, to be predicted afterwards.

The choice depends on a star's own code, or on its position on the detector where it has none, and
on a seed: neither on the order of the rows nor on the batches in which they are read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool
from bayesdist.utils.streams import mixed

Bits = NDArray[np.uint64]

HELD_OUT = "held out"  # reason under which they are counted


@dataclass(frozen=True)
class HoldoutSpec:
    """Selection of the matches that are set aside: a fraction of the stars, and whole exposures."""

    fraction: float  # of the stars, in [0, 1)
    exposures: tuple[str, ...] = ()
    seed: int = 1

    def which(self, table: Matches) -> Bool:
        """Boolean mask (N,) of the matches that are set aside; those of a star go together."""
        if table.star is not None:
            keys = [table.star.view(np.uint64)]
        else:
            # -0.0 and 0.0 are one position
            keys = [(a + 0.0).view(np.uint64) for a in (table.x, table.y)]
        bits = np.full(len(table), mixed(np.array([self.seed], np.uint64))[0])
        for key in keys:
            bits = mixed(bits ^ key)
        chosen = (bits >> np.uint64(11)) * 2.0**-53 < self.fraction
        whole = [name in set(self.exposures) for name in table.exposure_names]
        return np.asarray(chosen | np.array(whole, bool)[table.exposure])


@dataclass(frozen=True, eq=False)
class Split:
    """Matches in two parts: to be fitted, and set aside."""

    kept: Matches  # fitted; exposures without stars here are not named
    held: Matches  # set aside, with the names of all exposures


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


def split_matches(matches: Matches, aside: HoldoutSpec) -> Split:
    """Matches in two parts; those on disk are read once.

    Refused are an unknown exposure, nothing left to fit, and nothing set aside.
    """
    where = ", ".join(matches.sources)
    refuse_strangers(aside.exposures, matches.exposure_names, where)
    masks = []
    seen = np.zeros(len(matches.exposure_names), bool)
    for batch in matches.batches():
        rows = aside.which(batch)
        seen[batch.exposure[~rows]] = True
        masks.append(rows)
    which = np.concatenate(masks)
    _refuse_nothing(int(which.sum()), len(which), where)
    names = tuple(n for n, there in zip(matches.exposure_names, seen, strict=True) if there)
    kept = matches.select(~which, reason=HELD_OUT).with_exposure_names(names)
    return Split(kept, matches.select(which))


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
