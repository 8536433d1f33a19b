"""RvB pairs of one band: the matches, their colours, the selection by colour, and as Parquet.

WSDC D-T033, section 3, prefers candidates whose magnitudes differ little from the shortest to the
longest wavelength at which they are seen: stars are blue, and a colour needs two bands, which
favours the bright.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.data.storage.write import Part, write_parts
from bayesdist.data.tables.checks import columns_of
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.utils.arrays import Bool, Float, Int

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


def bluest_rows(colour: Float, frame: Int, n: int) -> Bool:
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


_NUMBERS = ("x", "y", "u", "v", "sigma_u", "sigma_v", "mag", "epoch")


def write_rvb(batches: Iterable[RvbPairs], folder: str | os.PathLike[str]) -> int:
    """Write pairs as a folder of Parquet files, one for each batch.

    Reading them as RvB pairs gives the same numbers bit for bit, with bands, frames and colours.

    `batches`: only one need be in memory at a time. `folder`: a new one.  When a batch cannot be
    had or written, the folder is removed. Returns pairs written. InputError for no batches, a
    folder that holds something, and when the system refuses to write.
    """
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and next(folder.iterdir(), None) is None):
        raise InputError("is in use", where=str(folder), do="choose a new folder")
    batches = iter(batches)
    first = list(islice(batches, 1))  # what is wrong is mostly wrong in the first
    if not first:
        raise InputError("there are no pairs to write", where=str(folder), do="give some")
    made = not folder.exists()
    made_folder(folder)
    sizes: list[int] = []

    def parts() -> Iterator[Part]:
        for pairs in chain(first, batches):
            yield _columns(pairs), _units(pairs), {}
            sizes.append(len(pairs))

    try:
        write_parts(folder, parts())
    except BaseException:
        if made:
            folder.rmdir()
        raise
    return sum(sizes)


def _columns(pairs: RvbPairs) -> dict[str, Any]:
    m = pairs.matches
    columns = columns_of(m, _NUMBERS) | columns_of(pairs, ["colour"]) | columns_of(m, ["star"])
    if m.exposure_names != ("1",):  # there is a column of frames
        columns["frame"] = (m.exposure, m.exposure_names)
    columns["band"] = (np.zeros(len(m), np.int64), (pairs.band,))
    return columns


def _units(pairs: RvbPairs) -> dict[str, str]:
    units = dict.fromkeys(("u", "v", "sigma_u", "sigma_v"), pairs.matches.unit)
    return units | {"x": "pix", "y": "pix", "epoch": "yr"}
