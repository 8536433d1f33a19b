"""RvB pairs that stay where they are: Parquet of one band that reads as a table of matches."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial

from bayesdist.data.matches import Matches
from bayesdist.data.storage.on_disk import open_matches
from bayesdist.data.tables.column import Place
from bayesdist.data.tables.names import ALIASES
from bayesdist.data.tables.parquet import ParquetPart
from bayesdist.missions.wise.pairs.array_check import ArrayCheck
from bayesdist.missions.wise.pairs.files import MAGNITUDES, RvbFile, open_rvb_files
from bayesdist.missions.wise.pairs.read import chosen_band

__all__ = ["open_rvb"]

PathLike = str | os.PathLike[str]


def open_rvb(
    path: PathLike | Sequence[PathLike],
    *,
    band: str | None,
    columns: Mapping[str, str] | None,
    unit: str,
    sigma: str | float,
    pixel_origin: int,
    size: tuple[float, float],
) -> Matches | None:
    """RvB pairs of one band, left on disk.

    `path`, `band`, `columns`, `unit`, `sigma`, `pixel_origin`, `size`: as `stream_rvb`. Returns the
    pairs that `stream_rvb` gives.  None where the files are no Parquet, hold other bands beside
    this one, or have to be converted: dates in MJD, magnitudes by band. InputError as `stream_rvb`
    and `open_matches`.
    """
    files = open_rvb_files(path, columns)
    band = chosen_band(files, band)
    if not _fit(files) or not all(_only(file, band) for file in files):
        return None
    check = ArrayCheck(band, size)
    for file in files:
        for table, _, place in file.blocks(["x", "y", "u", "v"]):
            x, y, u, v = (file.column(table, key, place).numbers() for key in "xyuv")
            check.see(
                x + 1 - pixel_origin,
                y + 1 - pixel_origin,
                partial(_row_name, file, place),
                reference=(u, v) if unit == "pix" else None,
            )
    check.end(", ".join(file.source for file in files))
    found = files[0].found
    named = {key: found.get(key, "") for key in ALIASES}
    # frames and bands may share their names with other quantities of a table of matches
    named |= {"ra": "", "dec": "", "chip": "", "colour": "", "filter": found.get("band", "")}
    return open_matches(path, columns=named, unit=unit, sigma=sigma, pixel_origin=pixel_origin)


def _row_name(file: RvbFile, place: Place, k: int) -> str:
    return f"{file.source}, {place(k)}"


def _fit(files: Sequence[RvbFile]) -> bool:
    """True if the files read as one table of matches."""
    found = files[0].found
    return (
        all(isinstance(file.contents, ParquetPart) and file.found == found for file in files)
        and not ("mjd" in found and "epoch" not in found)
        and not ("mag" not in found and any(key in found for key in MAGNITUDES))
    )


def _only(file: RvbFile, band: str) -> bool:
    """True if a file holds no other band."""
    if "band" not in file.found:
        return True
    return all(file.bands(table, place)[1] == (band,) for table, _, place in file.blocks(["band"]))
