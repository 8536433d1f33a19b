"""RvB pairs as input of a run: in memory, on disk, or selected and written to its folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypedDict

from bayesdist.app.kinds.matches.sources import MatchSource, is_large
from bayesdist.app.store.rundir import PAIRS, RunDirectory, part_files
from bayesdist.data import Matches, open_matches, write_partitioned
from bayesdist.data.tables.checks import Place
from bayesdist.data.tables.names import ALIASES
from bayesdist.data.tables.parquet import ParquetPart
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.missions.wise.pairs.files import (
    MAGNITUDES,
    ArrayCheck,
    RvbFile,
    band_name,
    open_rvb_files,
)
from bayesdist.missions.wise.pairs.read import chosen_band, stream_rvb
from bayesdist.missions.wise.pairs.section import RvbData
from bayesdist.missions.wise.pairs.selection import SelectedPairs
from bayesdist.missions.wise.pairs.template import rvb_template
from bayesdist.missions.wise.published import WISE_ARRAYS

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
    """Open the RvB pairs of one band without reading them into memory; see `stream_rvb`.

    Returns None if the files are not Parquet, contain other bands, or must be converted because of
    dates in MJD or magnitudes by band.
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
    column_of = files[0].found
    named = {key: column_of.get(key, "") for key in ALIASES}
    # exclude quantities that could be mistaken for columns of frames and bands
    named |= {"ra": "", "dec": "", "chip": "", "colour": "", "filter": column_of.get("band", "")}
    return open_matches(path, columns=named, unit=unit, sigma=sigma, pixel_origin=pixel_origin)


def _row_name(file: RvbFile, place: Place, k: int) -> str:
    return f"{file.source}, {place(k)}"


def _fit(files: Sequence[RvbFile]) -> bool:
    """True if the files can be read as one table of matches."""
    column_of = files[0].found
    return (
        all(isinstance(file.contents, ParquetPart) and file.found == column_of for file in files)
        and not ("mjd" in column_of and "epoch" not in column_of)
        and not ("mag" not in column_of and any(key in column_of for key in MAGNITUDES))
    )


def _only(file: RvbFile, band: str) -> bool:
    """True if a file contains no other band."""
    if "band" not in file.found:
        return True
    return all(file.bands(table, place)[1] == (band,) for table, _, place in file.blocks(["band"]))


@dataclass
class RvbInput:
    """RvB pairs of a configuration.

    Pairs that are too large for memory and must be selected or converted are written once, as a
    table of matches.  They are first written next to the folder of the run, and moved into it when
    it may be changed.  The record of the run states that they are there.
    """

    run: RunDirectory
    data: RvbData
    size: tuple[float, float]  # columns and rows of the detector
    _scratch: TemporaryDirectory[str] | None = None
    _counts: Mapping[str, Any] | None = None

    def load(self) -> Matches:
        """Read or open the selected pairs."""
        data, size = self.data, self.size
        path = self.run.config.named_files(self.run.base)
        options = _options(data, size)
        if not is_large(path):
            return load_rvb(path, data, size)
        if data.band is not None:
            _require_array(data.band, size)
        if "pairs" in self.run.facts and part_files(self.run / PAIRS):
            return self._opened(self.run / PAIRS, self.run.facts["pairs"])
        if data.rvb.takes_all:
            opened = open_rvb(path, **options)
            if opened is not None:
                for band in opened.filter_names:
                    _require_array(band or data.band, size)
                return opened
        return self._written(SelectedPairs(lambda: stream_rvb(path, **options), data.rvb, size))

    def _written(self, selected: SelectedPairs) -> Matches:
        """Write the pairs as a table of matches, in the folder of the run if possible."""
        self.close()
        place = self.run.path.resolve().parent
        while not place.is_dir():
            place = place.parent
        try:
            self._scratch = TemporaryDirectory(
                prefix=".bayesdist-", dir=place, ignore_cleanup_errors=True
            )
        except OSError as error:
            raise InputError(
                f"the selected pairs cannot be written next to the run ({error.strerror})",
                where=str(place),
                do="choose a writable folder",
            ) from error
        folder = Path(self._scratch.name) / PAIRS

        def tables() -> Iterator[Matches]:
            for pairs in selected:
                _require_array(pairs.band, self.size)
                yield pairs.matches

        write_partitioned(tables(), folder)
        self._counts = {"n_rows": selected.n_rows, "rejected": selected.rejected}
        if not self.run.is_planned:
            self.move_into_run()
            return self._opened(self.run / PAIRS, self.run.facts["pairs"])
        return self._opened(folder, self._counts)

    def _opened(self, folder: Path, counts: Mapping[str, Any]) -> Matches:
        options = _options(self.data, self.size)
        # errors given as a number were written to the columns
        sigma = options["sigma"] if options["sigma"] == "by_magnitude" else "columns"
        opened = open_matches(folder, unit=options["unit"], sigma=sigma)
        rejected = counts["rejected"]
        return opened.with_counts(len(opened) + sum(rejected.values()), rejected)

    def move_into_run(self) -> bool:
        """Move the pairs to the folder of the run; True if they must be opened again."""
        if self._scratch is None or self._counts is None:
            return False
        target = made_folder(self.run / PAIRS)
        for stale in part_files(target):
            stale.unlink()
        try:
            (Path(self._scratch.name) / PAIRS).replace(target)
        except OSError as error:
            raise InputError(
                f"the selected pairs cannot be moved there ({error.strerror})",
                where=str(target),
                do="remove this folder, or choose another for the run",
            ) from error
        self.run.note(pairs=self._counts)
        self.close()
        return True

    def close(self) -> None:
        """Remove temporary files that were not moved."""
        if self._scratch is not None:
            self._scratch.cleanup()
        self._scratch = self._counts = None


def load_rvb(
    path: str | Path | Sequence[str | Path], data: RvbData, size: tuple[float, float]
) -> Matches:
    """Read and select the RvB pairs of a configuration into memory."""
    if data.band is not None:
        _require_array(data.band, size)
    batches = list(stream_rvb(path, **_options(data, size)))
    _require_array(batches[0].band, size)
    return SelectedPairs(lambda: batches, data.rvb, size).table()


class _Options(TypedDict):
    """Options of `stream_rvb` and `open_rvb`."""

    band: str | None
    columns: Mapping[str, str] | None
    unit: str
    sigma: str | float
    pixel_origin: int
    size: tuple[float, float]


def _options(data: RvbData, size: tuple[float, float]) -> _Options:
    """Options of `stream_rvb` and `open_rvb`."""
    return {
        "band": data.band,
        "columns": data.columns,
        "unit": data.unit or "pix",
        "sigma": data.sigma,
        "pixel_origin": 1 if data.pixel_origin is None else data.pixel_origin,
        "size": size,
    }


def _require_array(label: str | None, size: tuple[float, float]) -> None:
    """Raise InputError unless the detector has the size of the band's array."""
    band = band_name(label)
    if tuple(size) != WISE_ARRAYS[band].size:
        columns, rows = WISE_ARRAYS[band].size
        raise InputError(
            f"the array of {band} has {columns:g} x {rows:g} pixels, but the detector "
            f"{size[0]:g} x {size[1]:g}",
            where="detector.size",
            do="give the size of the band's array, or another band",
        )


def rvb_input(run: RunDirectory) -> RvbInput:
    """Input of a run with a configuration for RvB pairs."""
    config: Any = run.config
    return RvbInput(run, config.data, config.detector.size)


SOURCE = MatchSource(read=load_rvb, input_of=rvb_input, template=rvb_template)
