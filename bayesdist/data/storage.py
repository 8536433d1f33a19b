"""Matches in Parquet files, read from disk batch by batch.

`open_matches` leaves the rows on disk. A scan with one block in memory at a time collects what must
be known about all rows: the names of exposures, chips and filters, and the tangent point. It also
checks that no row is invalid or repeated. A `StoredFile` describes how one file is read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from astropy.table import Column
from numpy.typing import NDArray

from bayesdist.data.batches import BATCH, even_edges
from bayesdist.data.columns import (
    COLUMNS,
    CORRELATION,
    DEFAULT_LABELS,
    LABELS_OF_CODES,
    POSITIONS,
    SIGMAS,
    Labels,
    common_radius,
    recoded,
)
from bayesdist.data.formats import exposure_names, input_files
from bayesdist.data.matches import Matches
from bayesdist.data.output import header_arguments
from bayesdist.data.reading.centroids import ellipse_columns
from bayesdist.data.reading.columns import (
    are_moved,
    columns_read,
    match_columns,
    nominal_columns,
    plane_unit,
    position_unit,
)
from bayesdist.data.reading.motions import (
    NEEDED,
    MotionPrior,
    MovingStars,
    doubtful_solutions,
    unnamed_columns,
    warn_of_zeros,
)
from bayesdist.data.reading.options import ReadArguments, ReadOptions, refuse_missing_errors
from bayesdist.data.repeated import buckets_for, first_repetition
from bayesdist.data.sky import MOTIONS, sky_columns, states_correlations
from bayesdist.data.tables.checks import refuse_half
from bayesdist.data.tables.column import Quantities, SourceColumn
from bayesdist.data.tables.names import ASSUMED
from bayesdist.data.tables.parquet import ParquetPart, RowBlock, describe_part
from bayesdist.data.tangent import direction_of, direction_sum
from bayesdist.errors import FormatError, InputError
from bayesdist.utils.arrays import Float

PathLike = str | os.PathLike[str]
Segment = tuple[int, int, int]  # file, first row, and row after the last
BLOCK = 2**16  # rows read together
STARS_OF_PRIOR = 200_000  # from which a prior of motions is made
NO_COVARIANCE = (
    "error ellipses are not converted in tables on disk, so that errors of x and y are taken as "
    "uncorrelated"
)


@dataclass(frozen=True, eq=False)
class StoredRows:
    """Consecutive rows of Parquet files."""

    labels: Labels
    files: tuple[StoredFile, ...]  # files of the rows
    # for each file: its code, the first row, and the row after the last
    segments: tuple[Segment, ...]

    def __len__(self) -> int:
        return sum(stop - start for _, start, stop in self.segments)

    def load(self) -> Matches:
        """Read the rows, with codes and sources that refer to the labels.

        Raises InputError if a file is damaged, missing, or has changed since it was opened.
        """
        columns: dict[str, NDArray[Any]] = {}
        names, end = set(COLUMNS), 0
        for block in self._blocks():
            first, end = end, end + len(block["x"])
            names &= block.keys()
            for name in names:
                if first == 0:
                    columns[name] = np.empty(len(self), block[name].dtype)
                columns[name][first:end] = block[name]
        labels = self.labels.of_batch(len(self)).arguments()
        return Matches.of_distinct_rows(**{name: columns[name] for name in names}, **labels)

    def _blocks(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Columns of the rows, block by block."""
        for file, (code, start, stop) in zip(self.files, self.segments, strict=True):
            row = start
            for block in file.blocks(start=start, stop=stop, size=BLOCK):
                out = {name: block[name] for name in COLUMNS if name in block}
                for key in LABELS_OF_CODES:
                    out[key] = self.labels.codes(key, block, source=file.source)
                out["row"] = np.arange(row, row + len(out["x"]))
                out["source"] = np.full(len(out["x"]), code)
                row += len(out["x"])
                yield out


def open_matches(
    path: PathLike | Sequence[PathLike],
    *,
    batch_rows: int = BATCH,
    **options: Unpack[ReadArguments],
) -> Matches:
    """Open matched star positions without reading them into memory.

    Parameters
    ----------
    path : path-like or sequence of path-like
        Parquet: a file, a list of files, a pattern, or a folder of parts of one table.
    batch_rows : int
        Largest number of rows in a batch, one of which is in memory at a time.
    **options
        Fields of `ReadOptions` by name; rows with missing values or values that are not finite are
        an error.

    Returns
    -------
    Matches
        Matches on disk; the batches are equal to `read_matches` of their rows.

    Raises
    ------
    InputError
        If a file or an option is invalid, or the files have different quantities; the message says
        what to change. Some of the files may be empty.

    Examples
    --------
    >>> from bayesdist.data import write_partitioned
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> paths = write_partitioned([matches], "stars")
    >>> stars = bd.open_matches("stars")  # stays on disk
    >>> sum(len(batch) for batch in stars.batches())
    500
    """
    reading = ReadOptions(**options)
    if reading.not_finite == "reject":
        raise InputError(
            "rows of tables on disk cannot be left out while reading",
            where="data.not_finite",
            do="write the table without them",
        )
    if reading.plate_scale is not None:
        raise InputError(
            "tables on disk cannot be converted to another unit",
            where="data.plate_scale",
            do="write u, v and their errors in arcsec",
        )
    files = input_files(path)
    for file in files:
        if file.suffix.lower() != ".parquet":
            raise FormatError(
                "is not a Parquet file, and other files are read into memory",
                where=str(file),
                do="use read_matches",
            )
    in_parts = isinstance(path, str | os.PathLike) and Path(path).is_dir()
    names: Sequence[str | None] = [None] * len(files)
    if not in_parts and len(files) > 1:
        names = exposure_names(files)
    stored = [
        stored_file(describe_part(file), reading, exposure_name=name)
        for file, name in zip(files, names, strict=True)
    ]
    _refuse_differences(stored)
    first = stored[0]
    sigma = reading.sigma
    refuse_missing_errors(sigma, _has_errors(first), "mag" in first.found, where=first.source)
    if first.on_sky and reading.tangent_point is None:
        point = tangent_point_of(stored)
        stored = [
            replace(part, options=replace(part.options, tangent_point=point)) for part in stored
        ]
    if all(part.moves for part in stored):
        stored = _with_motion_prior(stored, reading.motion_prior)
    labels = scan(stored)
    readers = _readers(labels, stored, batch_rows)
    matches = Matches.from_readers(readers, labels, _columns_of(stored[0]))
    return matches if isinstance(sigma, str) else matches.with_errors(sigma)


def _readers(labels: Labels, files: Sequence[StoredFile], batch_rows: int) -> list[StoredRows]:
    """Consecutive rows of all files.

    Row groups and files are combined up to `batch_rows`; larger row groups are split evenly.
    """
    out: list[list[Segment]] = [[]]
    size = 0
    for code, file in enumerate(files):
        for start, stop in _spans(file.part.group_rows, batch_rows):
            if size + stop - start > batch_rows:
                out.append([])
                size = 0
            size += stop - start
            last = out[-1][-1] if out[-1] else None
            if last is not None and last[0] == code:
                out[-1][-1] = (code, last[1], stop)
            else:
                out[-1].append((code, start, stop))
    return [
        StoredRows(labels, tuple(files[code] for code, *_ in segments), tuple(segments))
        for segments in out
    ]


def _spans(group_rows: Sequence[int], batch_rows: int) -> list[tuple[int, int]]:
    """First row and row after the last of each row group; large groups are split evenly."""
    out = []
    first = 0
    for rows in group_rows:
        edges = [first + edge for edge in even_edges(rows, batch_rows)]
        out += list(pairwise(edges))
        first += rows
    return out


def _columns_of(file: StoredFile) -> set[str]:
    """Columns of matches that a file provides."""
    available = set(file.found) & set(COLUMNS) | {*POSITIONS, *LABELS_OF_CODES, "row", "source"}
    if file.options.epoch is not None:
        available.add("epoch")
    if file.motion_prior is not None:
        available.add(ASSUMED)
    if _has_errors(file):
        available |= set(SIGMAS)
    correlated = "sigma_ra" in file.found and states_correlations(file.found)
    if "sigma_x" in file.found or correlated:
        available.add(CORRELATION)
    for on_sky, on_plane in (("pm_ra", "pm"), ("sigma_pm_ra", "sigma_pm")):
        if on_sky in file.found:
            available |= {f"{on_plane}_u", f"{on_plane}_v"}
    return available


def _refuse_differences(parts: Sequence[StoredFile]) -> None:
    """Raise InputError for parts that do not form one table."""
    first = parts[0]
    for part in parts[1:]:
        for lacking, having in ((part, first), (first, part)):
            missing = [key for key in having.found if key not in lacking.found]
            if missing:
                raise InputError(
                    f"has no column for {missing[0]!r}, but {having.source} has "
                    f"{having.found[missing[0]]!r}",
                    where=lacking.source,
                    do="give all parts the same columns",
                )
        if part.unit != first.unit:
            raise InputError(
                f"unit is {part.unit}, but {first.unit} in {first.source}",
                where=part.source,
                do="bring all files to one",
            )


def _has_errors(file: StoredFile) -> bool:
    """True if a file has errors of the matches, the reference positions or the centroids."""
    return bool({"sigma_u", "sigma_ra", "sigma_x"} & set(file.found))


@dataclass(frozen=True, eq=False)
class StoredFile:
    """Parquet file of matches, and how to read it."""

    part: ParquetPart
    found: Mapping[str, str]  # column of each quantity
    unit: str  # unit of u and v
    exposure_name: str | None  # name of the single exposure, if there is no column of exposures
    options: ReadOptions  # with pixel origin, and with the tangent point once it is known
    notes: tuple[str, ...] = ()  # clauses on the file
    motion_prior: MotionPrior | None = None  # of stars without a motion

    @property
    def moves(self) -> bool:
        """True if positions are moved to the epochs of the exposures, with errors of motions."""
        has_errors = self.found.keys() >= NEEDED
        return has_errors and are_moved(self.options, self.found, self.source)

    @property
    def source(self) -> str:
        """Name of the file."""
        return self.part.name

    @property
    def on_sky(self) -> bool:
        """True if the reference positions are ra and dec."""
        return "ra" in self.found

    def blocks(
        self,
        *,
        start: int = 0,
        stop: int | None = None,
        size: int,
    ) -> Iterator[dict[str, Any]]:
        """Arguments of `Matches` for rows `start` to `stop`, at most `size` rows at a time.

        They are those of `match_columns`, with codes that refer to labels of the block.  The
        InputError for an invalid row names its row group.
        """
        column_names = self.found
        encoded = {column_names[key] for key in LABELS_OF_CODES if key in column_names}
        encoded |= {column_names["epoch"]} & self.part.texts if "epoch" in column_names else set()
        columns = list(dict.fromkeys(column_names.values()))
        if self.motion_prior is not None:
            columns += [name for name in self._of_motions() if name not in columns]
        # chip names get their numbers once all names are known
        options = replace(self.options, unit=self.unit, chips=self.options.chips or {})
        for block in self.part.blocks(columns, encoded=encoded, start=start, stop=stop, size=size):
            quantities = self._quantities(block, column_names)
            assumed = np.zeros(len(quantities), bool)
            if self.motion_prior is not None:
                quantities, assumed = self.motion_prior.filled(quantities)
            out = match_columns(quantities, options)
            if self.motion_prior is not None:
                out[ASSUMED] = (assumed | (out.get(ASSUMED, 0) != 0)).astype(np.int64)
            for key, labels in LABELS_OF_CODES.items():
                if key not in column_names:
                    exposure_label = self.exposure_name if key == "exposure" else None
                    out[labels] = (
                        DEFAULT_LABELS[key] if exposure_label is None else exposure_label,
                    )
            yield out

    def _of_motions(self) -> list[str]:
        """Columns with motions and parallaxes, and those that their prior depends on."""
        keys = (*MOTIONS, "parallax", "sigma_parallax", "mag")
        names = [self.found[key] for key in keys if key in self.found]
        return list(dict.fromkeys([*names, *unnamed_columns(self.part.colnames)]))

    def moving_stars(self) -> Iterator[tuple[int, MovingStars]]:
        """First row, and motions of the stars, block by block."""
        for block in self.part.blocks(self._of_motions(), size=BLOCK):
            stars = MovingStars.of(self._quantities(block, self.found), None)
            if stars is not None:
                yield block.first, stars

    def direction(self) -> tuple[int, int, int]:
        """Sum of the unit vectors of all reference positions, in the form of `direction_sum`."""
        total = np.zeros(3, object)
        columns = [self.found["ra"], self.found["dec"]]
        for block in self.part.blocks(columns, size=BLOCK):
            total += direction_sum(*sky_columns(self._quantities(block, self.found)))
        x, y, z = total.tolist()
        return x, y, z

    def _quantities(self, block: RowBlock, found: Mapping[str, str]) -> Quantities:
        place = self.part.place(block.first)
        return Quantities(block, found, self.source, place, self.part.colnames)


def stored_file(
    part: ParquetPart,
    options: ReadOptions,
    *,
    exposure_name: str | None,
) -> StoredFile:
    """Describe a stored file by the names and units of its columns.

    Raises InputError if a needed column is missing.  `exposure_name` is the name of the single
    exposure, if the file has no column of exposures.
    """
    source = part.name
    column_names, options, notes = columns_read(part.colnames, {}, options, source=source)
    are_moved(options, column_names, source)  # refuses options that would have no effect
    ellipse = ellipse_columns(part.colnames)
    named = options.columns or {}
    if "sigma_x" in column_names and "rho_xy" not in column_names and ellipse is not None:
        notes = (*notes, *(() if named.get("rho_xy") == "" else (NO_COVARIANCE,)))
    used = options.read_sigma and not {"sigma_u", "sigma_x"} & column_names.keys()
    if used and ellipse is not None and named.get("sigma_x") != "":
        raise InputError(
            f"error ellipses ({', '.join(ellipse[0])}) are not converted in tables on disk",
            where=source,
            do=f"write the variances as {', '.join(ellipse[1])}, or set data.sigma to a number",
        )
    if named.get("flux"):
        raise InputError(
            f"column {named['flux']!r} is named for 'flux', which is not read in tables on disk",
            where=f"{source}, columns",
            do="leave 'flux' out, and write magnitudes into the table if they are needed",
        )
    column_names.pop("flux", None)  # magnitudes would require the fluxes of all rows to be positive
    refuse_half(("sigma_u", "sigma_v"), column_names, where=source, what="errors")
    nominal_columns(column_names, source=source, tangent_point=options.tangent_point)
    if "ra" in column_names:
        plane_unit_ = plane_unit(options.unit, source=source)
    else:
        u, v = (
            SourceColumn(
                Column([], unit=part.units.get(column_names[key])), source, column_names[key]
            )
            for key in ("u", "v")
        )
        plane_unit_ = position_unit((u, v), options.unit)
    return StoredFile(part, column_names, plane_unit_, exposure_name, options, notes)


def _with_motion_prior(files: Sequence[StoredFile], sigma_mas_yr: float | None) -> list[StoredFile]:
    """Files with a common prior on the motions of stars without a measured one.

    It is made from about `STARS_OF_PRIOR` stars at equal distances, or from all if they are fewer.
    There is none if all motions are measured, or too few.
    """
    step = max(1, sum(file.part.n_rows for file in files) // STARS_OF_PRIOR)
    samples = list[dict[str, Float]]()
    magnitudes: list[list[Float]] = [[] for _ in files]  # of stars without a motion
    missing, zero, doubtful = (np.zeros(len(files), int) for _ in range(3))
    for k, file in enumerate(files):
        for first, stars in file.moving_stars():
            stars.refuse_missing_errors()
            samples.append(stars.measured(slice(-first % step, None, step)))
            missing[k] += np.count_nonzero(stars.missing)
            magnitudes[k].append(stars.magnitude[stars.missing][::step])
            zero[k], doubtful[k] = zero[k] + stars.n_zero, doubtful[k] + stars.n_doubtful
    prior = None
    if samples and missing.any():
        prior = MotionPrior.of(samples, sigma_mas_yr, unit=None, source=files[0].source)
    out = []
    for k, file in enumerate(files):
        n, notes = file.part.n_rows, [*file.notes]
        notes += doubtful_solutions(int(doubtful[k]), file.part.n_rows)
        if prior is not None and missing[k]:
            notes.append(prior.note(np.concatenate(magnitudes[k]), int(missing[k]), n))
            names = [file.found[key] for key in MOTIONS[:2]]
            warn_of_zeros(names, int(zero[k]), n, file.source)
        out.append(replace(file, motion_prior=prior, notes=tuple(notes)))
    return out


def tangent_point_of(parts: Sequence[StoredFile]) -> tuple[float, float]:
    """Tangent point: mean direction (RA, Dec), in degrees, of all reference positions."""
    total = np.zeros(3, object)
    for part in parts:
        total += part.direction()
    x, y, z = total.tolist()
    return direction_of((x, y, z))


@dataclass(eq=False)
class _LabelScan:
    """Iterates over all parts batch by batch, as `first_repetition` requires.

    All columns are read, so that any invalid row is found, and labels are numbered as they appear.
    """

    parts: Sequence[StoredFile]
    numbers: dict[str, dict[Any, int]] = field(
        default_factory=lambda: {k: {} for k in LABELS_OF_CODES}
    )

    def __call__(self) -> Iterator[list[NDArray[Any]]]:
        for part in self.parts:
            for block in part.blocks(size=BLOCK):
                keys = [block[name] for name in ("x", "y", "u", "v")]
                for key, code_by_label in self.numbers.items():
                    code_of_label = np.array(
                        [
                            code_by_label.setdefault(label, len(code_by_label))
                            for label in block[LABELS_OF_CODES[key]]
                        ]
                    )
                    if key in block or part.exposure_name is not None:
                        keys.append(recoded(key, block, code_of_label))
                if "epoch" in block:
                    keys.append(block["epoch"])
                yield keys


def scan(parts: Sequence[StoredFile]) -> Labels:
    """Labels common to all parts, from a scan of all rows.

    Raises InputError if a row is invalid or repeated.  The parts must have the same quantities and
    unit, and a tangent point if they need one.
    """
    n_rows = sum(part.part.n_rows for part in parts)
    if n_rows == 0:
        remainder = f" and {len(parts) - 1} more" if len(parts) > 1 else ""
        raise InputError(
            "holds no rows", where=parts[0].source + remainder, do="give a table with matched stars"
        )
    rows = _LabelScan(parts)
    pair = first_repetition(rows, buckets_for(n_rows))
    if pair is not None:
        first, second = (_named(parts, row) for row in pair)
        raise InputError(
            f"repeats {first}: the same x, y, u, v, exposure and chip",
            where=second,
            do="keep each row once",
        )
    return Labels(
        unit=parts[0].unit,
        exposure_names=tuple(rows.numbers["exposure"]),
        chip_numbers=tuple(sorted(rows.numbers["chip"])),
        filter_names=tuple(rows.numbers["filter"]),
        sources=tuple(part.source for part in parts),
        n_rows=n_rows,
        **_geometry(parts),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _geometry(parts: Sequence[StoredFile]) -> dict[str, Any]:
    """Tangent point and match radius of all parts, as arguments of `Labels`.

    InputError if parts state different values.
    """
    first = parts[0]
    if first.on_sky:
        return {"tangent_point": first.options.tangent_point}
    stated = [header_arguments(part.part.header, part.unit, source=part.source) for part in parts]
    points = [header.get("tangent_point") for header in stated]
    for point, part in zip(points, parts, strict=True):
        if point != points[0]:
            raise InputError(
                f"tangent point is {point}, but {points[0]} in {first.source}",
                where=part.source,
                do="bring all parts to one",
            )
    radii = [header.get("match_radius") for header in stated]
    return {
        "tangent_point": points[0],
        "match_radius": common_radius(radii, [part.source for part in parts]),
    }


def _named(parts: Sequence[StoredFile], row: int) -> str:
    """File, row group and row of a row number counted over all parts."""
    for part in parts:
        if row < part.part.n_rows:
            break
        row -= part.part.n_rows
    return f"{part.source}, {part.part.place(0)(row)}"
