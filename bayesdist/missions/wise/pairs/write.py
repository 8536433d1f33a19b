"""RvB pairs to Parquet, as they are read again."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.data.storage.write import Part, write_parts
from bayesdist.errors import InputError
from bayesdist.files import made_folder
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs

__all__ = ["write_rvb"]

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
            yield _columns(pairs), _units(pairs)
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
    columns: dict[str, Any] = {
        name: getattr(m, name) for name in _NUMBERS if getattr(m, name) is not None
    }
    if pairs.colour is not None:
        columns["colour"] = pairs.colour
    if m.star is not None:
        columns["star"] = m.star
    if m.exposure_names != ("1",):  # there is a column of frames
        columns["frame"] = (m.exposure, m.exposure_names)
    columns["band"] = (np.zeros(len(m), np.int64), (pairs.band,))
    return columns


def _units(pairs: RvbPairs) -> dict[str, str]:
    units = dict.fromkeys(("u", "v", "sigma_u", "sigma_v"), pairs.matches.unit)
    return units | {"x": "pix", "y": "pix", "epoch": "yr"}
