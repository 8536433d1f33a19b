"""RvB pairs as input of a run: in memory, on disk, or selected and written to its folder.

Pairs are selected in batches, and rejected pairs are counted by reason.  The selection does not
depend on the batches.  The criteria are applied in this order: range of colours, bluest pairs of
each frame, radial limits.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypedDict

import numpy as np

from bayesdist.app.store.rundir import PAIRS, RunDirectory, part_files
from bayesdist.data import Matches, input_files, open_matches, write_partitioned
from bayesdist.data.batches import BATCH
from bayesdist.data.columns import merged_counts
from bayesdist.data.tables.checks import Place, counted
from bayesdist.data.tables.names import ALIASES
from bayesdist.data.tables.parquet import ParquetPart, describe_part
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.files.tables import read_table
from bayesdist.kinds.matches.init_guesses import column_lines
from bayesdist.kinds.matches.sources import MatchSource, is_large
from bayesdist.missions.wise.pairs.read import (
    IPAC,
    MAGNITUDES,
    ArrayCheck,
    RvbFile,
    band_name,
    chosen_band,
    open_rvb_files,
    rvb_bands,
    stream_rvb,
)
from bayesdist.missions.wise.pairs.rvb_pairs import (
    COLOUR,
    NO_COLOUR,
    RvbPairs,
    bluest_rows,
    colours_of,
)
from bayesdist.missions.wise.pairs.section import RvbBlock, RvbData
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.utils.arrays import Bool, Float, Int

PathLike = str | os.PathLike[str]

OFFSET = "offset beyond the radial limit"
CHI2 = "chi-square beyond the radial limit"
MOST_COLOURS = 100_000_000  # maximum number of pairs for the selection of the bluest (1.6 GB)


def open_rvb(
    path: PathLike | Sequence[PathLike],
    *,
    band: str | None,
    columns: Mapping[str, str] | None,
    unit: str,
    sigma: str | float,
    pixel_origin: int,
    size: tuple[float, float],
    batch_rows: int = BATCH,
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
    return open_matches(
        path,
        columns=named,
        unit=unit,
        sigma=sigma,
        pixel_origin=pixel_origin,
        batch_rows=batch_rows,
    )


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
        if not is_large(path, data.rows_in_memory):
            return load_rvb(path, data, size)
        if data.band is not None:
            _require_array(data.band, size)
        if "pairs" in self.run.facts and part_files(self.run / PAIRS):
            return self._opened(self.run / PAIRS, self.run.facts["pairs"])
        if data.rvb.takes_all:
            opened = open_rvb(path, **options, batch_rows=data.rows_in_memory)
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
        rows = self.data.rows_in_memory
        opened = open_matches(folder, unit=options["unit"], sigma=sigma, batch_rows=rows)
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


# -- template of a configuration ------------------------------------------------------------------


SIGMA = 0.1  # default error of pairs without errors, pixels

_FORMAT = """\
format = "rvb"                  # pairs of WISE and 2MASS, u and v in pixels of the band frame
band = "{band}"                     # {found}
"""

_SELECTION = """\
# [data.rvb]                    # selection of pairs; all by default
{colour}# accept_centre = 1.0           # largest offset of a pair at the array's centre, in pixels
# accept_corner = 3.0           # ... and in its corners, where distortion is largest

"""

_COLOUR = """\
# colour = [-0.5, 0.5]          # magnitude at the shortest minus that at the longest wavelength
# bluest = 100                  # maximum number of pairs per frame; the bluest are selected
"""

_DETECTOR = """\
[detector]
mission = "WISE"
name = "{band}"
size = [{nx:.0f}, {ny:.0f}]
scale_mas = {scale:.0f}
"""


def rvb_template(matches: str | Path) -> tuple[int, dict[str, object]] | None:
    """Number of RvB pairs, and the values for the template of `init`; None for other matches.

    Raises InputError as `stream_rvb` does.
    """
    if not _is_rvb(matches):
        return None
    files = open_rvb_files(matches, None)
    quantities = set(files[0].found)
    if "band" in quantities:
        counts = rvb_bands(matches)
        band = max(counts, key=counts.__getitem__)
        comment = "the file contains " + ", ".join(f"{name} ({n})" for name, n in counts.items())
    else:
        band = _guessed_band(files)
        comment = "GUESSED from the positions: not stated in the file"
    sigma: str | float = "columns" if {"sigma_u", "sigma_v"} <= quantities else SIGMA
    n, has_mag = 0, True
    for pairs in stream_rvb(matches, band=band, sigma=sigma):
        n += len(pairs)
        has_mag = has_mag and pairs.matches.has_mag
    sigma_lines = {
        "columns": '"columns"',
        SIGMA: '"by_magnitude"        # the table has no errors'
        if has_mag
        else f"{SIGMA}                     # GUESSED: the table has no errors",
    }
    coloured = "colour" in quantities or len(quantities.intersection(MAGNITUDES)) > 1
    array = WISE_ARRAYS[band]
    (nx, ny), scale = array.size, 1000 * array.scale
    return n, {
        "format": _FORMAT.format(band=band, found=comment),
        "columns": column_lines(None, None),
        "unit_line": "",
        "sigma": sigma_lines[sigma],
        "detector": _SELECTION.format(colour=_COLOUR if coloured else "")
        + _DETECTOR.format(band=band, nx=nx, ny=ny, scale=scale),
        "reference": f"# reference_pixel = [{array.centre[0]}, {array.centre[1]}]  # the centre\n",
        "frames": "none",
        "grid_y": 33,
        "unit": "pix",
    }


def _is_rvb(matches: str | Path) -> bool:
    """True if the files are RvB pairs: IPAC tables with u and v, or Parquet with WISE bands."""
    files = input_files(matches)
    if all(file.name.lower().endswith(IPAC) for file in files):
        return {"u", "v"} <= {name.lower() for name in read_table(files[0]).colnames}
    if any(file.suffix.lower() != ".parquet" for file in files):
        return False
    part = describe_part(files[0])
    if not {"band", "x", "y", "u", "v"} <= set(part.colnames) or "band" not in part.texts:
        return False
    try:
        return bool(rvb_bands(files[0]))
    except InputError:  # bands of another instrument
        return False


def _guessed_band(files: list[RvbFile]) -> str:
    """W4 if all detections are on its array, otherwise W1 (W2 and W3 have the same array)."""
    reach = 0.0
    for file in files:
        for table, _, place in file.blocks(["x", "y"]):
            for key in "xy":
                reach = max(reach, float(file.column(table, key, place).numbers().max()))
    return "W4" if reach <= WISE_ARRAYS["W4"].size[0] + 1 else "W1"


SOURCE = MatchSource(read=load_rvb, input_of=rvb_input, template=rvb_template)


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
