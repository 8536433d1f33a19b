"""RvB pairs of a run: in memory, left on disk where they are, or selected into the run's folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bayesdist.app.config import Data
from bayesdist.app.config.rvb import RvbBlock
from bayesdist.app.matches import is_large
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.star_files import PAIRS, part_files
from bayesdist.data import Matches, open_matches, write_partitioned
from bayesdist.data.rvb.files import ARRAY_SIZE, band_name
from bayesdist.data.rvb.on_disk import open_rvb
from bayesdist.data.rvb.read import stream_rvb
from bayesdist.data.rvb.select import RvbSelection, SelectedPairs
from bayesdist.errors import InputError
from bayesdist.files import made_folder

__all__ = ["RvbInput", "load_rvb"]


@dataclass
class RvbInput:
    """The RvB pairs that a configuration names.

    What is too large for memory and has to be selected or converted is written once, as a table of
    matches: beside the run's folder as long as nothing may be written into it, then moved there
    whole.  The record of the run says that it is there.

    Parameters
    ----------
    run : RunDirectory
    """

    run: RunDirectory
    _scratch: TemporaryDirectory[str] | None = None
    _counts: Mapping[str, Any] | None = None

    def load(self) -> Matches:
        """The selected pairs.

        Raises
        ------
        InputError
            For all that is wrong with files and selection, and a detector that is not the band's.
        """
        config, path = self.run.config, self.run.matches
        data, options = config.data, self._options
        assert data is not None and config.detector.size is not None
        if not is_large(path):
            return load_rvb(path, data, config.detector.size)
        if data.band is not None:
            _refuse_other_array(band_name(data.band), config.detector.size)
        if "pairs" in self.run.record and part_files(self.run / PAIRS):
            return self._opened(self.run / PAIRS, self.run.record["pairs"])
        if _selection(data).takes_all:
            opened = open_rvb(path, **options)
            if opened is not None:
                for band in opened.filter_names:
                    _refuse_other_array(band_name(band or data.band), options["size"])
                return opened
        selected = SelectedPairs(
            lambda: stream_rvb(path, **options), _selection(data), options["size"]
        )
        return self._written(selected)

    @property
    def _options(self) -> dict[str, Any]:
        """Of `stream_rvb`."""
        config = self.run.config
        assert config.data is not None and config.detector.size is not None
        return _options(config.data, config.detector.size)

    def _written(self, selected: SelectedPairs) -> Matches:
        """The pairs as a table of matches, in the run's folder if it may be."""
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
                f"the selected pairs cannot be written beside the run ({error.strerror})",
                where=str(place),
                do="choose a folder that you may write to",
            ) from error
        folder = Path(self._scratch.name) / PAIRS
        size = self._options["size"]

        def tables() -> Iterator[Matches]:
            for pairs in selected:
                _refuse_other_array(pairs.band, size)
                yield pairs.matches

        write_partitioned(tables(), folder)
        self._counts = {"n_rows": selected.n_rows, "rejected": selected.rejected}
        if not self.run.is_planned:
            self.settle()
            return self._opened(self.run / PAIRS, self.run.record["pairs"])
        return self._opened(folder, self._counts)

    def _opened(self, folder: Path, counts: Mapping[str, Any]) -> Matches:
        options = self._options
        # a number has been written into the columns
        sigma = options["sigma"] if options["sigma"] == "by_magnitude" else "columns"
        opened = open_matches(folder, unit=options["unit"], sigma=sigma)
        rejected = counts["rejected"]
        return opened.with_counts(len(opened) + sum(rejected.values()), rejected)

    def settle(self) -> bool:
        """Move what was written into the folder of the run, which has begun.

        Returns
        -------
        bool
            Whether there was anything: it has to be opened anew.

        Raises
        ------
        InputError
            When the system refuses.
        """
        if self._scratch is None or self._counts is None:
            return False
        target = made_folder(self.run / PAIRS)
        for stale in part_files(target):
            stale.unlink()
        try:
            os.replace(Path(self._scratch.name) / PAIRS, target)
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
        """Remove what was not moved."""
        if self._scratch is not None:
            self._scratch.cleanup()
        self._scratch = self._counts = None


def load_rvb(
    path: str | Path | Sequence[str | Path], data: Data, size: tuple[float, float]
) -> Matches:
    """RvB pairs in memory, as a configuration reads and selects them.

    Parameters
    ----------
    path : path or sequence of path
    data : Data
        With the format 'rvb'.
    size : tuple of float
        Columns and rows of the detector.

    Returns
    -------
    Matches

    Raises
    ------
    InputError
        For all that is wrong with files and selection, and a detector that is not the band's.
    """
    if data.band is not None:
        _refuse_other_array(band_name(data.band), size)
    pieces = list(stream_rvb(path, **_options(data, size)))
    _refuse_other_array(pieces[0].band, size)
    return SelectedPairs(lambda: pieces, _selection(data), size).table()


def _selection(data: Data) -> RvbSelection:
    return (data.rvb or RvbBlock()).selection()


def _options(data: Data, size: tuple[float, float]) -> dict[str, Any]:
    return {
        "band": data.band,
        "columns": data.columns,
        "unit": data.unit or "pix",
        "sigma": data.sigma,
        "pixel_origin": 1 if data.pixel_origin is None else data.pixel_origin,
        "size": size,
    }


def _refuse_other_array(band: str, size: tuple[float, float]) -> None:
    if tuple(size) != ARRAY_SIZE[band]:
        columns, rows = ARRAY_SIZE[band]
        raise InputError(
            f"the array of {band} has {columns:g} x {rows:g} pixels, but the detector "
            f"{size[0]:g} x {size[1]:g}",
            where="detector.size",
            do="give the size of the band's array, or choose the band that it belongs to",
        )
