"""Matches that are held out of the fit in order to be predicted afterwards.

The selection depends on a seed and on the star code, or on the detector position if there are no
codes. It does not depend on the order of the rows or on the batches in which they are read.
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

HELD_OUT = "held out"  # reason under which held-out rows are counted


@dataclass(frozen=True)
class HoldoutSpec:
    """Selection of the matches to hold out: a fraction of the stars, and entire exposures."""

    fraction: float  # fraction of the stars, in [0, 1)
    exposures: tuple[str, ...] = ()
    seed: int = 1

    def which(self, table: Matches) -> Bool:
        """Boolean mask (N,) of the matches to hold out; all matches of a star are treated alike."""
        if table.star is not None:
            keys = [table.star.view(np.uint64)]
        else:
            # adding 0.0 makes -0.0 and 0.0 the same position
            keys = [(a + 0.0).view(np.uint64) for a in (table.x, table.y)]
        bits = np.full(len(table), mixed(np.array([self.seed], np.uint64))[0])
        for key in keys:
            bits = mixed(bits ^ key)
        chosen = (bits >> np.uint64(11)) * 2.0**-53 < self.fraction
        is_held_exposure = [name in set(self.exposures) for name in table.exposure_names]
        return np.asarray(chosen | np.array(is_held_exposure, bool)[table.exposure])


@dataclass(frozen=True, eq=False)
class Split:
    """Matches split into those to fit and those that are held out."""

    kept: Matches  # matches to fit; exposures without such matches are not listed
    held: Matches  # held-out matches, with the names of all exposures


def exposures_drawn(names: Sequence[str], n: int, seed: int) -> tuple[str, ...]:
    """Names of `n` exposures drawn with a seed; InputError unless fewer than all are drawn."""
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
    """Split matches into two parts; matches on disk are read once.

    InputError for an unknown exposure, or if either part would be empty.
    """
    location = ", ".join(matches.sources)
    refuse_strangers(aside.exposures, matches.exposure_names, location)
    masks = []
    has_fitted = np.zeros(len(matches.exposure_names), bool)
    for batch in matches.batches():
        rows = aside.which(batch)
        has_fitted[batch.exposure[~rows]] = True
        masks.append(rows)
    held = np.concatenate(masks)
    _refuse_nothing(int(held.sum()), len(held), location)
    names = tuple(
        n for n, is_fitted in zip(matches.exposure_names, has_fitted, strict=True) if is_fitted
    )
    fitted = matches.select(~held, reason=HELD_OUT).with_exposure_names(names)
    return Split(fitted, matches.select(held))


def refuse_strangers(asked: Sequence[str], names: Sequence[str], where: str) -> None:
    """Raise InputError for names of held-out exposures that are not among `names`."""
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
