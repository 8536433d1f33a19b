"""RvB pairs of one band: the matches, their colours, and the selection by colour.

WSDC D-T033, section 3, prefers candidates whose magnitudes differ little from the shortest to the
longest wavelength at which they are seen: stars are blue, and a colour needs two bands, which
favours the bright.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError

__all__ = ["RvbPairs", "bluest_rows", "colour_of", "colours_of"]

Float = NDArray[np.float64]

NO_COLOUR = "no colour"
COLOUR = "colour"


@dataclass(frozen=True, eq=False)
class RvbPairs:
    """Pairs of one band."""

    # x, y the detection, u, v the reference star as a detector without distortion would see it; the
    # band is the filter, the frame the exposure
    matches: Matches
    # (N,), magnitudes; NaN where fewer than two bands have one.  None where the file has no
    # magnitudes
    colour: Float | None = None

    def __post_init__(self) -> None:
        if self.colour is not None and np.shape(self.colour) != (len(self.matches),):
            raise InputError(
                f"colour has shape {np.shape(self.colour)}, but there are {len(self)} pairs",
                where=", ".join(self.matches.sources),
                do="give one colour for each pair",
            )

    def __len__(self) -> int:
        return len(self.matches)

    @property
    def band(self) -> str:
        """Name of the band."""
        return self.matches.filter_names[0]

    def select(self, which: ArrayLike, *, reason: str | None = None) -> RvbPairs:
        """Some of the pairs, as `Matches.select`."""
        matches = self.matches.select(which, reason=reason)
        which = np.asarray(which)
        return RvbPairs(matches, None if self.colour is None else self.colour[which])

    @staticmethod
    def concatenate(several: Sequence[RvbPairs]) -> RvbPairs:
        """All pairs of several sets, in their order.

        InputError for sets of different bands, sets of which only some have colours, and as
        `Matches.concatenate`.
        """
        bands = list(dict.fromkeys(one.band for one in several))
        if len(bands) > 1:
            raise InputError(
                f"the sets are of bands {', '.join(bands)}", do="join those of one band"
            )
        matches = Matches.concatenate([one.matches for one in several])
        colours = [one.colour for one in several if one.colour is not None]
        if colours and len(colours) < len(several):
            raise InputError(
                "only some of the sets have colours",
                where=", ".join(matches.sources),
                do="give all of them the same columns",
            )
        return RvbPairs(matches, np.concatenate(colours) if colours else None)


def colour_of(magnitudes: ArrayLike) -> Float:
    """Magnitude of the shortest wavelength detected minus that of the longest.

    `magnitudes`: (B, N), by rising wavelength; NaN where a source is not detected. Returns (N,),
    NaN where fewer than two bands have a magnitude.  Colours of sources that are detected in
    different bands are different colours: W1 - W2 of one stands beside W1 - W4 of another.
    """
    magnitudes = np.asarray(magnitudes, float)
    detected = np.isfinite(magnitudes)
    first = detected.argmax(axis=0)
    last = len(magnitudes) - 1 - detected[::-1].argmax(axis=0)
    column = np.arange(magnitudes.shape[1])
    colour = magnitudes[first, column] - magnitudes[last, column]
    return np.where(detected.sum(axis=0) >= 2, colour, np.nan)


def bluest_rows(colour: Float, frame: NDArray[np.int64], n: int) -> NDArray[np.bool_]:
    """Boolean mask (N,) of the n rows of smallest colour of each frame; never one without."""
    order = np.lexsort((colour, frame))  # stable, NaN last within a frame
    first = np.searchsorted(frame[order], frame[order])
    rank = np.empty(len(colour), np.int64)
    rank[order] = np.arange(len(colour)) - first
    return np.asarray((rank < n) & ~np.isnan(colour))


def colours_of(pairs: RvbPairs) -> Float:
    """Colours (N,) of pairs that must have them."""
    if pairs.colour is None:
        raise InputError(
            "has no magnitudes in several bands, hence no colours",
            where=", ".join(pairs.matches.sources),
            do="name mag_w1 and others in the option 'columns', or do not select by colour",
        )
    return pairs.colour
