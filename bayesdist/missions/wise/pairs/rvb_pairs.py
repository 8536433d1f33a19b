"""RvB pairs of one band: matches, colours, selection by colour, and writing as Parquet.

WSDC D-T033, section 3, prefers candidates with similar magnitudes at the shortest and longest
wavelength at which they are detected.  This selects stars, which are blue, and favours bright
sources, since a colour requires detections in two bands.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import Matches
from bayesdist.data.tables.checks import columns_of
from bayesdist.data.writing import Labelled, Part, write_parts
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.utils.arrays import Bool, Float, Int

NO_COLOUR = "no colour"
COLOUR = "colour"


@dataclass(frozen=True, eq=False)
class RvbPairs:
    """RvB pairs of one band."""

    # x, y: detection; u, v: reference star on an undistorted detector; the filter is the band, and
    # the exposure is the frame
    matches: Matches
    # (N,), magnitudes; NaN if fewer than two bands have one.  None if the file has no magnitudes
    colour: Float | None = None

    def __post_init__(self) -> None:
        if self.colour is not None and np.shape(self.colour) != (len(self.matches),):
            raise InputError(
                f"colour has shape {np.shape(self.colour)}, but there are {len(self)} pairs",
                where=", ".join(self.matches.sources),
                do="give one colour per pair",
            )

    def __len__(self) -> int:
        return len(self.matches)

    @property
    def band(self) -> str:
        """Name of the band."""
        return self.matches.filter_names[0]

    def select(self, which: ArrayLike, *, reason: str | None = None) -> RvbPairs:
        """Select some of the pairs; see `Matches.select`."""
        matches = self.matches.select(which, reason=reason)
        which = np.asarray(which)
        return RvbPairs(matches, None if self.colour is None else self.colour[which])

    @staticmethod
    def concatenate(several: Sequence[RvbPairs]) -> RvbPairs:
        """Concatenate several sets of pairs.

        Raises InputError if the sets are of different bands, only some have colours, or they cannot
        be concatenated (see `Matches.concatenate`).
        """
        bands = list(dict.fromkeys(pairs.band for pairs in several))
        if len(bands) > 1:
            raise InputError(
                f"the sets are of bands {', '.join(bands)}", do="give sets of one band"
            )
        matches = Matches.concatenate([pairs.matches for pairs in several])
        colours = [pairs.colour for pairs in several if pairs.colour is not None]
        if colours and len(colours) < len(several):
            raise InputError(
                "only some of the sets have colours",
                where=", ".join(matches.sources),
                do="give all of them the same columns",
            )
        return RvbPairs(matches, np.concatenate(colours) if colours else None)


def colour_of(magnitudes: ArrayLike) -> Float:
    """Magnitude at the shortest wavelength of detection minus that at the longest.

    The bands differ between sources: the colour is W1 - W2 for one source and W1 - W4 for another,
    depending on the bands in which they are detected.

    Parameters
    ----------
    magnitudes : array_like, shape (B, N)
        Magnitudes in B bands by ascending wavelength; NaN if a source is not detected.

    Returns
    -------
    ndarray, shape (N,)
        Colours; NaN if fewer than two bands have a magnitude.
    """
    magnitudes = np.asarray(magnitudes, float)
    detected = np.isfinite(magnitudes)
    first = detected.argmax(axis=0)
    last = len(magnitudes) - 1 - detected[::-1].argmax(axis=0)
    column = np.arange(magnitudes.shape[1])
    colour = magnitudes[first, column] - magnitudes[last, column]
    return np.where(detected.sum(axis=0) >= 2, colour, np.nan)


def bluest_rows(colour: Float, frame: Int, n: int) -> Bool:
    """Boolean mask (N,) that is True for the n bluest rows of each frame; False without colour."""
    order = np.lexsort((colour, frame))  # stable, NaN last within a frame
    first = np.searchsorted(frame[order], frame[order])
    rank = np.empty(len(colour), np.int64)
    rank[order] = np.arange(len(colour)) - first
    return np.asarray((rank < n) & ~np.isnan(colour))


def colours_of(pairs: RvbPairs) -> Float:
    """Colours (N,) of pairs; raises InputError if they have none."""
    if pairs.colour is None:
        raise InputError(
            "has no magnitudes in several bands, and therefore no colours",
            where=", ".join(pairs.matches.sources),
            do="give mag_w1 etc. in the option 'columns', or do not select by colour",
        )
    return pairs.colour


_NUMBERS = ("x", "y", "u", "v", "sigma_u", "sigma_v", "mag", "epoch")


def write_rvb(batches: Iterable[RvbPairs], folder: str | os.PathLike[str]) -> int:
    """Write pairs to a folder of Parquet files, one per batch.

    If the files are read as RvB pairs, all numbers, bands, frames and colours are recovered
    exactly.

    Parameters
    ----------
    batches : iterable of RvbPairs
        Batches of pairs; only one is in memory at a time.
    folder : path-like
        New or empty folder.  A new folder is removed if an error occurs.

    Returns
    -------
    int
        Number of pairs.

    Raises
    ------
    InputError
        If there are no batches, the folder is not empty, or it is not writable.
    """
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and next(folder.iterdir(), None) is None):
        raise InputError("is in use", where=str(folder), do="choose a new folder")
    batches = iter(batches)
    first = list(
        islice(batches, 1)
    )  # most errors occur in the first batch, before the folder is created
    if not first:
        raise InputError("there are no pairs to write", where=str(folder), do="give pairs")
    is_new = not folder.exists()
    made_folder(folder)
    sizes: list[int] = []

    def parts() -> Iterator[Part]:
        for pairs in chain(first, batches):
            yield _columns(pairs), _units(pairs), {}
            sizes.append(len(pairs))

    try:
        write_parts(folder, parts())
    except BaseException:
        if is_new:
            folder.rmdir()
        raise
    return sum(sizes)


def _columns(pairs: RvbPairs) -> dict[str, NDArray[Any] | Labelled]:
    m = pairs.matches
    columns = columns_of(m, _NUMBERS) | columns_of(pairs, ["colour"]) | columns_of(m, ["star"])
    if m.exposure_names != ("1",):  # the pairs have frames
        columns["frame"] = (m.exposure, m.exposure_names)
    columns["band"] = (np.zeros(len(m), np.int64), (pairs.band,))
    return columns


def _units(pairs: RvbPairs) -> dict[str, str]:
    units = dict.fromkeys(("u", "v", "sigma_u", "sigma_v"), pairs.matches.unit)
    return units | {"x": "pix", "y": "pix", "epoch": "yr"}
