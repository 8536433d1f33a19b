"""Selection of RvB pairs in batches; rejected pairs are counted by reason.

The selection does not depend on the batches.  The criteria are applied in this order: range of
colours, bluest pairs of each frame, radial limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from bayesdist.data.columns import merged_counts
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
MOST_COLOURS = 100_000_000  # maximum number of pairs for the selection of the bluest (1.6 GB)


@dataclass
class SelectedPairs:
    """Iterable over the selected pairs, which can be used once."""

    # function that returns the pairs of one band in batches; it is called twice if the bluest of
    # each frame are selected, since this requires the colours of all pairs
    batches: Callable[[], Iterable[RvbPairs]]
    selection: RvbBlock
    size: tuple[float, float]  # columns and rows of the array
    n_rows: int = 0  # number of pairs that have been read
    rejected: dict[str, int] = field(default_factory=dict)  # number of rejected pairs by reason

    def __iter__(self) -> Iterator[RvbPairs]:
        """Yield batches of selected pairs, without empty batches.

        Raises InputError if required colours are missing, u and v are not in pixels although
        offsets are limited, or no pair is selected.
        """
        bluest = self._bluest()
        sources: dict[str, None] = {}
        for pairs in self.batches():
            sources |= dict.fromkeys(pairs.matches.sources)
            rules = self._rules(pairs, bluest).items()
            selected, counts = counted([(reason, ~good) for reason, good in rules], len(pairs))
            self.rejected |= merged_counts([self.rejected, counts])
            self.n_rows += len(pairs)
            if selected.any():
                yield pairs if selected.all() else pairs.select(selected)
        if self.n_rows == sum(self.rejected.values()):
            why = ", ".join(f"{reason} ({n})" for reason, n in self.rejected.items())
            raise InputError(
                f"none of the {self.n_rows} pairs are selected: {why}",
                where=", ".join(sources),
                do="widen the limits of the selection",
            )

    def table(self) -> Matches:
        """Selected pairs in memory, with the counts of rejected pairs.

        Raises InputError as the iteration and `Matches.concatenate` do.
        """
        matches = Matches.concatenate([pairs.matches for pairs in self])
        return matches.with_counts(self.n_rows, self.rejected)

    def _rules(self, pairs: RvbPairs, bluest: Bool | None) -> Mapping[str, Bool]:
        """Boolean masks of the pairs that meet each criterion, by the reason for rejection."""
        rules: dict[str, Bool] = {}
        if self.selection.by_colour:
            right = self._right_colour(pairs)
            if bluest is not None:
                right = right & bluest[self.n_rows : self.n_rows + len(pairs)]
            rules = {NO_COLOUR: ~np.isnan(colours_of(pairs)), COLOUR: right}
        offset, chi2, matches = self.selection.offset, self.selection.chi2, pairs.matches
        sources = ", ".join(matches.sources)
        if matches.unit != "pix" and (offset is not None or chi2 is not None):
            raise InputError(
                f"u, v are in {matches.unit}, but limits on offsets are in pixels",
                where=sources,
                do="convert u, v to pixels of the array",
            )
        du, dv = matches.u - matches.x, matches.v - matches.y
        if offset is not None:
            rules[OFFSET] = np.hypot(du, dv) <= offset.at(matches.x, matches.y, self.size)
        if chi2 is not None:
            if matches.sigma_u is None or matches.sigma_v is None:
                raise InputError(
                    "a limit on chi-square needs errors",
                    where=sources,
                    do="give columns sigma_u and sigma_v, or limit only the offset",
                )
            value = (du / matches.sigma_u) ** 2 + (dv / matches.sigma_v) ** 2
            rules[CHI2] = value <= chi2.at(matches.x, matches.y, self.size)
        return rules

    def _right_colour(self, pairs: RvbPairs) -> Bool:
        """Boolean mask (N,) that is True for pairs with a colour within the limits."""
        colour = colours_of(pairs)
        low, high = self.selection.colour or (-np.inf, np.inf)
        return np.asarray((colour >= low) & (colour <= high))

    def _bluest(self) -> Bool | None:
        """Boolean mask of the bluest pairs of each frame over all batches; None if not selected."""
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
                    f"the bluest of each frame are selected from at most {MOST_COLOURS} pairs",
                    where=", ".join(pairs.matches.sources),
                    do="select by a range of colours instead",
                )
        if set(codes) == {"1"}:
            raise InputError(
                "has no column of frames, which the selection of the bluest of each frame needs",
                where=", ".join(pairs.matches.sources),
                do="give it as 'exposure' in the option 'columns'",
            )
        return bluest_rows(np.concatenate(colours), np.concatenate(frames), self.selection.bluest)
