"""Parquet files of matches: how each file is read, and the labels found by scanning all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from astropy.table import Column
from numpy.typing import NDArray

from bayesdist.data.columns.joining import common_radius
from bayesdist.data.columns.labels import DEFAULT_LABELS, LABELS_OF_CODES, Labels, recoded
from bayesdist.data.columns.output import header_arguments
from bayesdist.data.reading.columns import (
    columns_read,
    match_columns,
    nominal_columns,
    plane_unit,
    position_unit,
)
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.sky.positions import sky_columns
from bayesdist.data.sky.tangent import direction_of, direction_sum
from bayesdist.data.tables.checks import refuse_half
from bayesdist.data.tables.column import Quantities, SourceColumn
from bayesdist.data.tables.parquet import ParquetPart, RowBlock
from bayesdist.data.tables.repeated import buckets_for, first_repetition
from bayesdist.errors import InputError

BLOCK = 2**16  # rows read together


@dataclass(frozen=True, eq=False)
class StoredFile:
    """Parquet file of matches, and how to read it."""

    part: ParquetPart
    found: Mapping[str, str]  # column of each quantity
    unit: str  # unit of u and v
    exposure_name: str | None  # name of the single exposure, if there is no column of exposures
    options: ReadOptions  # with pixel origin, and with the tangent point once it is known
    notes: tuple[str, ...] = ()  # clauses on the file

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
        """Arguments of Matches for rows `start` to `stop`, at most `size` rows at a time.

        As from `match_columns`, with codes that refer to labels of the block. InputError for an
        invalid row names its row group.
        """
        column_names = self.found
        encoded = {column_names[key] for key in LABELS_OF_CODES if key in column_names}
        encoded |= {column_names["epoch"]} & self.part.texts if "epoch" in column_names else set()
        columns = list(dict.fromkeys(column_names.values()))
        # chip names get their numbers once all names are known
        options = replace(self.options, unit=self.unit, chips=self.options.chips or {})
        for block in self.part.blocks(columns, encoded=encoded, start=start, stop=stop, size=size):
            out = match_columns(self._quantities(block, column_names), options)
            for key, labels in LABELS_OF_CODES.items():
                if key not in column_names:
                    exposure_label = self.exposure_name if key == "exposure" else None
                    out[labels] = (
                        DEFAULT_LABELS[key] if exposure_label is None else exposure_label,
                    )
            yield out

    def direction(self) -> tuple[int, int, int]:
        """Sum of the direction vectors of all reference positions."""
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
    """Layout of a file from the names and units of its columns; InputError if one is missing."""
    source = part.name
    column_names, options, notes = columns_read(part.colnames, {}, options, source=source)
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


def tangent_point_of(parts: Sequence[StoredFile]) -> tuple[float, float]:
    """Mean direction of all reference positions."""
    total = np.zeros(3, object)
    for part in parts:
        total += part.direction()
    x, y, z = total.tolist()
    return direction_of((x, y, z))


@dataclass(eq=False)
class _Scan:
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
    """Labels common to all parts, from a scan of all rows; InputError for invalid or repeated rows.

    The parts must have the same quantities and unit, and a tangent point if they need one.
    """
    n_rows = sum(part.part.n_rows for part in parts)
    if n_rows == 0:
        remainder = f" and {len(parts) - 1} more" if len(parts) > 1 else ""
        raise InputError(
            "holds no rows", where=parts[0].source + remainder, do="give a table with matched stars"
        )
    rows = _Scan(parts)
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
