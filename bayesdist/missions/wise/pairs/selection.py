"""Selection of RvB pairs, batch by batch; those that it drops are counted by reason.

In memory or streamed, the same pairs pass: by the range of colours, then the bluest of each frame,
then the radial limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from bayesdist.data.columns.labels import merged_counts
from bayesdist.data.matches import Matches
from bayesdist.data.tables.checks import counted
from bayesdist.errors import InputError
from bayesdist.missions.wise.pairs.rvb_pairs import (
    COLOUR,
    NO_COLOUR,
    RvbPairs,
    bluest_rows,
    colours_of,
)
from bayesdist.missions.wise.pairs.section import RvbBlock
from bayesdist.utils.arrays import Bool, Float, Int

OFFSET = "offset beyond the radial limit"
CHI2 = "chi-square beyond the radial limit"
MOST_COLOURS = 100_000_000  # rows whose colours are compared with each other, 1.6 GB of them


@dataclass
class SelectedPairs:
    """The pairs that a selection takes, to be gone through once."""

    # gives the pairs of one band batch by batch: once more where the bluest of each frame are asked
    # for, which takes the colours of all
    batches: Callable[[], Iterable[RvbPairs]]
    selection: RvbBlock
    size: tuple[float, float]  # columns and rows of the array
    n_rows: int = 0  # pairs so far
    # those of them that were dropped, by reason
    rejected: dict[str, int] = field(default_factory=dict)

    def __iter__(self) -> Iterator[RvbPairs]:
        """Batches of which something is left.

        InputError without colours where they are needed, for u, v in another unit where offsets are
        judged, and when no pair at all is left.
        """
        bluest = self._bluest()
        sources: dict[str, None] = {}
        for pairs in self.batches():
            sources |= dict.fromkeys(pairs.matches.sources)
            rules = self._rules(pairs, bluest).items()
            left, counts = counted([(reason, ~good) for reason, good in rules], len(pairs))
            self.rejected |= merged_counts([self.rejected, counts])
            self.n_rows += len(pairs)
            if left.any():
                yield pairs if left.all() else pairs.select(left)
        if self.n_rows == sum(self.rejected.values()):
            why = ", ".join(f"{reason} ({n})" for reason, n in self.rejected.items())
            raise InputError(
                f"no pair of {self.n_rows} is left by the selection: {why}",
                where=", ".join(sources),
                do="widen its limits",
            )

    def table(self) -> Matches:
        """All of them in memory, with the counts.

        InputError as going through them, and as `Matches.concatenate`.
        """
        found = Matches.concatenate([pairs.matches for pairs in self])
        return found.with_counts(self.n_rows, self.rejected)

    def _rules(self, pairs: RvbPairs, bluest: Bool | None) -> Mapping[str, Bool]:
        """Boolean masks of the pairs that pass, by the reason to drop the others."""
        rules: dict[str, Bool] = {}
        if self.selection.by_colour:
            right = self._right_colour(pairs)
            if bluest is not None:
                right = right & bluest[self.n_rows : self.n_rows + len(pairs)]
            rules = {NO_COLOUR: ~np.isnan(colours_of(pairs)), COLOUR: right}
        offset, chi2, matches = self.selection.offset, self.selection.chi2, pairs.matches
        where = ", ".join(matches.sources)
        if matches.unit != "pix" and (offset is not None or chi2 is not None):
            raise InputError(
                f"u, v are in {matches.unit}, and offsets are judged in pixels",
                where=where,
                do="bring u, v to pixels of the array",
            )
        du, dv = matches.u - matches.x, matches.v - matches.y
        if offset is not None:
            rules[OFFSET] = np.hypot(du, dv) <= offset.at(matches.x, matches.y, self.size)
        if chi2 is not None:
            if matches.sigma_u is None or matches.sigma_v is None:
                raise InputError(
                    "a limit on chi-square needs errors",
                    where=where,
                    do="map sigma_u and sigma_v, or limit the offset alone",
                )
            value = (du / matches.sigma_u) ** 2 + (dv / matches.sigma_v) ** 2
            rules[CHI2] = value <= chi2.at(matches.x, matches.y, self.size)
        return rules

    def _right_colour(self, pairs: RvbPairs) -> Bool:
        """Boolean mask (N,) of the pairs with a colour within the limits."""
        colour = colours_of(pairs)
        low, high = self.selection.colour or (-np.inf, np.inf)
        return np.asarray((colour >= low) & (colour <= high))

    def _bluest(self) -> Bool | None:
        """Boolean mask of the rows among the bluest of their frames; None without that rule."""
        if self.selection.bluest is None:
            return None
        colours: list[Float] = []
        frames: list[Int] = []
        codes: dict[str, int] = {}
        for pairs in self.batches():
            colour = np.where(self._right_colour(pairs), colours_of(pairs), np.nan)
            names = pairs.matches.exposure_names
            code = np.array([codes.setdefault(name, len(codes)) for name in names])
            colours.append(colour)
            frames.append(code[pairs.matches.exposure])
            if sum(map(len, colours)) > MOST_COLOURS:
                raise InputError(
                    f"the bluest of each frame are asked for among more than {MOST_COLOURS} pairs",
                    where=", ".join(pairs.matches.sources),
                    do="select by a range of colours instead",
                )
        if set(codes) == {"1"}:
            raise InputError(
                "has no column of frames, of each of which the bluest are asked for",
                where=", ".join(pairs.matches.sources),
                do="name it as 'exposure' in the option 'columns'",
            )
        return bluest_rows(np.concatenate(colours), np.concatenate(frames), self.selection.bluest)
