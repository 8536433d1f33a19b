"""Matches that stay on disk: Parquet files, streamed in pieces.

A scan in the memory of one block finds what must be known of all rows: the names of exposures,
chips and filters, the tangent point, and that no row is wrong or repeated.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.added_errors import AddedErrors
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.data.matches import MatchTable
from bayesdist.data.parts import MatchPart, Whole, match_part, scan, tangent_point_of
from bayesdist.data.pieces import PIECE, Piece, even_edges, every_kth
from bayesdist.data.reading.formats import exposure_names, input_files
from bayesdist.data.reading.options import ReadOptions, refuse_missing_errors
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import FormatError, InputError

__all__ = ["PartPiece", "PartitionedMatches", "open_matches"]

Float = NDArray[np.float64]
PathLike = str | os.PathLike[str]
Errors = MagnitudeErrors | tuple[float, float]
Segment = tuple[int, int, int]  # part, first row, row after the last

_ARRAYS = (
    *("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch", "mag", "colour", "star"),
    *("u_nominal", "v_nominal", "pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"),
)


@dataclass(frozen=True, eq=False)
class PartPiece:
    """Consecutive rows of partitioned matches."""

    whole: Whole
    parts: tuple[MatchPart, ...]  # files of the rows
    segments: tuple[Segment, ...]  # for each file its code, the first row, the row after the last
    errors: Errors | None = None  # in place of those in the files
    factor: float = 1.0  # on all errors
    added: tuple[AddedErrors, ...] = ()  # in quadrature, after the factor

    def __len__(self) -> int:
        return sum(stop - start for _, start, stop in self.segments)

    def read(self) -> MatchTable:
        """Rows, with codes and sources by the names of the whole.

        InputError when a file is damaged, gone, or not what it was when it was opened.
        """
        read = [self._segment(*both) for both in zip(self.parts, self.segments, strict=True)]
        arrays = {name: [one[name] for one in read] for name in read[0]}
        joined = {
            name: several[0] if len(several) == 1 else np.concatenate(several)
            for name, several in arrays.items()
        }
        table = MatchTable.of_distinct_rows(**joined, **_shared(self.whole, len(self)))
        for one in self.added:
            table = table.with_added_errors(one)
        return table

    def _segment(self, part: MatchPart, segment: Segment) -> dict[str, Any]:
        """Arrays of the rows in one file."""
        code, start, stop = segment
        without = ("sigma_u", "sigma_v", "sigma_ra", "sigma_dec") if self.errors is not None else ()
        (block,) = part.blocks(start=start, stop=stop, size=stop - start, without=without)
        out = {name: block[name] for name in _ARRAYS if name in block}
        for key in ("exposure", "chip", "filter"):
            out[key] = self.whole.codes(key, block, source=part.source)
        out["row"] = np.arange(start, stop)
        out["source"] = np.full(stop - start, code)
        if isinstance(self.errors, MagnitudeErrors):
            out["sigma_u"], out["sigma_v"] = self.errors.at(block["mag"])
        elif self.errors is not None:
            for name, value in zip(("sigma_u", "sigma_v"), self.errors, strict=True):
                out[name] = np.full(stop - start, value)
        if self.factor != 1.0:
            for name in ("sigma_u", "sigma_v"):
                out[name] = self.factor * out[name]
        return out


def _shared(whole: Whole, n_rows: int) -> dict[str, Any]:
    """Attributes that a table of some rows takes from the whole."""
    names = ("unit", "exposure_names", "chip_numbers", "filter_names", "sources", "tangent_point")
    return {name: getattr(whole, name) for name in names} | {"n_rows": n_rows}


@dataclass(frozen=True, eq=False)
class PartitionedMatches:
    """Matched stars on disk, as `open_matches` finds them.

    It offers all of a MatchTable but the columns, which are read piece by piece.

    Parameters
    ----------
    whole : Whole
    parts : tuple of MatchPart
    errors : MagnitudeErrors or tuple of float, optional
        Errors in place of those in the files.
    dropped : mapping of str to int
        Rows that were left out when the files were made, by reason.
    factor : float
        On all errors.
    added : tuple of AddedErrors
        In quadrature, after the factor.

    Attributes
    ----------
    unit : str
    exposure_names, filter_names : tuple of str
    chip_numbers : tuple of int
    sources : tuple of str
        Files.
    n_rows : int
        Of the files, and those that were left out.
    rejected : dict of str to int
        As `dropped`.
    tangent_point : tuple of float or None
    has_epoch, has_mag, has_sigma, has_nominal : bool
    """

    whole: Whole
    parts: tuple[MatchPart, ...]
    errors: Errors | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)
    factor: float = 1.0
    added: tuple[AddedErrors, ...] = ()

    def __len__(self) -> int:
        return self.whole.n_rows

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.whole.unit

    @property
    def exposure_names(self) -> tuple[str, ...]:
        """Exposures, in the order of their first appearance."""
        return self.whole.exposure_names

    @property
    def exposures(self) -> tuple[str, ...]:
        """Names of the exposures that have stars: all."""
        return self.whole.exposure_names

    @property
    def chip_numbers(self) -> tuple[int, ...]:
        """Chips, sorted."""
        return self.whole.chip_numbers

    @property
    def filter_names(self) -> tuple[str, ...]:
        """Filters, in the order of their first appearance."""
        return self.whole.filter_names

    @property
    def sources(self) -> tuple[str, ...]:
        """Files."""
        return self.whole.sources

    @property
    def n_rows(self) -> int:
        """Rows of all files, and those that were left out."""
        return self.whole.n_rows + sum(self.dropped.values())

    @property
    def rejected(self) -> dict[str, int]:
        """Rows left out, by reason."""
        return dict(self.dropped)

    @property
    def tangent_point(self) -> tuple[float, float] | None:
        """RA and Dec in degrees of the plane that u, v lie on, where they come from the sky."""
        return self.whole.tangent_point

    @property
    def notes(self) -> tuple[str, ...]:
        """Clauses on properties of the files."""
        return tuple(dict.fromkeys(note for part in self.parts for note in part.notes))

    @property
    def has_epoch(self) -> bool:
        """True where the stars have epochs."""
        return "epoch" in self.parts[0].found or self.parts[0].options.epoch is not None

    @property
    def has_mag(self) -> bool:
        """True where the stars have magnitudes."""
        return "mag" in self.parts[0].found

    @property
    def has_sigma(self) -> bool:
        """True where the stars have errors."""
        return self.errors is not None or _has_errors(self.parts[0])

    @property
    def has_nominal(self) -> bool:
        """True where the stars have nominal positions."""
        return "u_nominal" in self.parts[0].found

    def pieces(self) -> tuple[Piece, ...]:
        """Rows in consecutive pieces.

        Row groups, and files, are joined up to `PIECE` rows; larger ones are split evenly.

        Returns
        -------
        tuple of Piece
        """
        out: list[list[Segment]] = [[]]
        size = 0
        for code, part in enumerate(self.parts):
            for start, stop in _spans(part.part.group_rows):
                if size + stop - start > PIECE:
                    out.append([])
                    size = 0
                size += stop - start
                last = out[-1][-1] if out[-1] else None
                if last is not None and last[0] == code:
                    out[-1][-1] = (code, last[1], stop)
                else:
                    out[-1].append((code, start, stop))
        return tuple(
            PartPiece(
                self.whole,
                tuple(self.parts[code] for code, *_ in segments),
                tuple(segments),
                self.errors,
                self.factor,
                self.added,
            )
            for segments in out
        )

    def sample(self, n: int) -> MatchTable:
        """Every k-th row, in memory.

        Parameters
        ----------
        n : int
            Largest number of rows of the sample; k is as small as this allows.

        Returns
        -------
        MatchTable
            In the order of the rows; all of them where there are no more than `n`.

        Raises
        ------
        InputError
            For less than one row, and as `PartPiece.read`.
        """
        k = every_kth(len(self), n)
        kept: list[dict[str, Any]] = []
        start = 0
        for piece in self.pieces():
            which = slice(-start % k, None, k)
            start += len(piece)
            if len(range(len(piece))[which]):
                table = piece.read()
                # copies: a view would keep the whole piece
                columns = _columns(table).items()
                kept.append({name: values[which].copy() for name, values in columns})
        joined = {name: np.concatenate([one[name] for one in kept]) for name in kept[0]}
        counts = {"rejected": self.rejected}
        return MatchTable.of_distinct_rows(**joined, **counts, **_shared(self.whole, self.n_rows))

    def with_errors_by_magnitude(self, errors: MagnitudeErrors) -> PartitionedMatches:
        """These stars with errors by magnitude.

        Parameters
        ----------
        errors : MagnitudeErrors

        Returns
        -------
        PartitionedMatches

        Raises
        ------
        InputError
            Without magnitudes.
        """
        refuse_missing_errors("by_magnitude", False, self.has_mag, where=self.sources[0])
        return replace(self, errors=errors, factor=1.0, added=())

    def with_errors_times(self, factor: float) -> PartitionedMatches:
        """These stars with all errors multiplied by a factor.

        Parameters
        ----------
        factor : float

        Returns
        -------
        PartitionedMatches
        """
        added = tuple(one.times(factor) for one in self.added)
        return replace(self, factor=factor * self.factor, added=added)

    def with_added_errors(self, added: AddedErrors) -> PartitionedMatches:
        """These stars with errors added in quadrature.

        Parameters
        ----------
        added : AddedErrors

        Returns
        -------
        PartitionedMatches
        """
        return replace(self, added=(*self.added, added))

    def with_sigma(self, sigma_u: float, sigma_v: float) -> PartitionedMatches:
        """These stars with other errors.

        Parameters
        ----------
        sigma_u, sigma_v : float
            In `unit`.

        Returns
        -------
        PartitionedMatches

        Raises
        ------
        InputError
            For errors that are not positive.
        """
        for name, sigma in (("sigma_u", sigma_u), ("sigma_v", sigma_v)):
            if not (np.isfinite(sigma) and sigma > 0):
                raise InputError(
                    f"{name} is {sigma:g}, and must be finite and positive", do="give another"
                )
        return replace(self, errors=(float(sigma_u), float(sigma_v)), factor=1.0, added=())


def _has_errors(part: MatchPart) -> bool:
    """True where a file has errors of the matches, or of the reference positions."""
    return bool({"sigma_u", "sigma_ra"} & set(part.found))


def _columns(table: MatchTable) -> dict[str, NDArray[Any]]:
    """Arrays of a table that it has."""
    names = (*_ARRAYS, "exposure", "chip", "filter", "row", "source")
    return {name: getattr(table, name) for name in names if getattr(table, name) is not None}


def _spans(group_rows: Sequence[int]) -> list[tuple[int, int]]:
    """First row and row after the last of each row group, large ones split evenly."""
    out = []
    first = 0
    for rows in group_rows:
        edges = [first + edge for edge in even_edges(rows, PIECE)]
        out += list(pairwise(edges))
        first += rows
    return out


def open_matches(path: PathLike | Sequence[PathLike], **options: Any) -> PartitionedMatches:
    """Matched star positions that stay on disk.

    Parameters
    ----------
    path : path-like or sequence of path-like
        Parquet: a file, a list of files, a pattern, or a folder of parts of one table.
    **options
        As `ReadOptions`; a row with a missing value, or one that is not finite, is refused.

    Returns
    -------
    PartitionedMatches
        Its pieces are equal to `read_matches` of these rows.

    Raises
    ------
    InputError
        For all that is wrong with a file or an option, in one sentence.  All files must have the
        same quantities; one of them may be empty.
    """
    given = ReadOptions(**options)
    if given.not_finite == "reject":
        raise InputError(
            "rows of tables on disk cannot be left out in reading",
            where="data.not_finite",
            do="write the table without them",
        )
    files = input_files(path)
    for file in files:
        if file.suffix.lower() != ".parquet":
            raise FormatError(
                "is no Parquet file, and others are read into memory",
                where=str(file),
                do="use read_matches",
            )
    in_parts = isinstance(path, str | os.PathLike) and Path(path).is_dir()
    names: Sequence[str | None] = [None] * len(files)
    if not in_parts and len(files) > 1:
        names = exposure_names(files)
    parts = tuple(
        match_part(describe_part(file), given, exposure_name=name)
        for file, name in zip(files, names, strict=True)
    )
    _refuse_differences(parts)
    first = parts[0]
    sigma = given.sigma
    refuse_missing_errors(sigma, _has_errors(first), "mag" in first.found, where=first.source)
    if first.on_sky and given.tangent_point is None:
        point = tangent_point_of(parts)
        parts = tuple(
            replace(one, options=replace(one.options, tangent_point=point)) for one in parts
        )
    errors = None if isinstance(sigma, str) else (float(sigma), float(sigma))
    return PartitionedMatches(scan(parts), parts, errors)


def _refuse_differences(parts: Sequence[MatchPart]) -> None:
    """Refuse parts that do not make one table."""
    first = parts[0]
    for other in parts[1:]:
        for lacking, having in ((other, first), (first, other)):
            missing = [key for key in having.found if key not in lacking.found]
            if missing:
                raise InputError(
                    f"has no column for {missing[0]!r}, but {having.source} has "
                    f"{having.found[missing[0]]!r}",
                    where=lacking.source,
                    do="give all parts the same columns",
                )
        if other.unit != first.unit:
            raise InputError(
                f"unit is {other.unit}, but {first.unit} in {first.source}",
                where=other.source,
                do="bring all files to one",
            )
