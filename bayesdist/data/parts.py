"""Parquet files of matches as parts of one whole: their content, and their common attributes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy.table import Column
from numpy.typing import NDArray

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
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.parquet import ParquetPart, RowBlock
from bayesdist.data.tables.quantities import Quantities
from bayesdist.data.tables.repeated import buckets_for, first_repetition
from bayesdist.errors import InputError

__all__ = ["MatchPart", "Whole", "match_part", "scan", "tangent_point_of"]

Int = NDArray[np.int64]

_BLOCK = 2**18  # rows scanned together
_LABELS = {"exposure": "exposure_names", "chip": "chip_numbers", "filter": "filter_names"}
_DEFAULTS: dict[str, Any] = {"exposure": "1", "chip": 1, "filter": ""}


@dataclass(frozen=True, eq=False)
class MatchPart:
    """Parquet file of matches, and how it is read."""

    part: ParquetPart
    found: Mapping[str, str]  # column of each quantity
    unit: str  # of u and v
    exposure_name: str | None  # of the one exposure, where there is no column
    options: ReadOptions  # with pixel origin, and tangent point once known
    notes: tuple[str, ...] = ()  # findings on the file, as clauses

    @property
    def source(self) -> str:
        """Name of the file."""
        return str(self.part.path)

    @property
    def on_sky(self) -> bool:
        """True where the reference positions are ra and dec."""
        return "ra" in self.found

    def blocks(
        self,
        *,
        start: int = 0,
        stop: int | None = None,
        size: int,
        without: Sequence[str] = (),
    ) -> Iterator[dict[str, Any]]:
        """Arguments of MatchTable for rows `start` to `stop`, at most `size` rows at a time.

        As `match_columns`, without the quantities of `without`, with codes into labels of the
        block's own.  InputError names the row group of a wrong row.
        """
        found = {key: name for key, name in self.found.items() if key not in without}
        encoded = {found[key] for key in _LABELS if key in found}
        encoded |= {found["epoch"]} & self.part.texts if "epoch" in found else set()
        columns = list(dict.fromkeys(found.values()))
        # names of chips get numbers once all are known
        options = replace(self.options, unit=self.unit, chips=self.options.chips or {})
        for block in self.part.blocks(columns, encoded=encoded, start=start, stop=stop, size=size):
            out = match_columns(self._quantities(block, found), options)
            for key, labels in _LABELS.items():
                if key not in found:
                    own = self.exposure_name if key == "exposure" else None
                    out[labels] = (_DEFAULTS[key] if own is None else own,)
            yield out

    def direction(self) -> tuple[int, int, int]:
        """Sum of the directions of all its reference positions."""
        total = np.zeros(3, object)
        columns = [self.found["ra"], self.found["dec"]]
        for block in self.part.blocks(columns, size=_BLOCK):
            total += direction_sum(*sky_columns(self._quantities(block, self.found)))
        x, y, z = total.tolist()
        return x, y, z

    def _quantities(self, block: RowBlock, found: Mapping[str, str]) -> Quantities:
        place = self.part.place(block.first)
        return Quantities(block, found, self.source, place, self.part.colnames)


def match_part(
    part: ParquetPart,
    options: ReadOptions,
    *,
    exposure_name: str | None,
) -> MatchPart:
    """Layout of a file, by the names and units of its columns alone; missing ones are refused."""
    source = str(part.path)
    found, options, notes = columns_read(part.colnames, {}, options, source=source)
    found.pop("flux", None)  # magnitudes of all rows or of none: that takes all of them
    refuse_half(("sigma_u", "sigma_v"), found, where=source, what="errors")
    nominal_columns(found, source=source, tangent_point=options.tangent_point)
    if "ra" in found:
        own = plane_unit(options.unit, source=source)
    else:
        u, v = (
            SourceColumn(Column([], unit=part.units.get(found[key])), source, found[key])
            for key in ("u", "v")
        )
        own = position_unit((u, v), options.unit)
    return MatchPart(part, found, own, exposure_name, options, notes)


@dataclass(frozen=True, eq=False)
class Whole:
    """Names, unit and tangent point common to all parts."""

    unit: str
    exposure_names: tuple[str, ...]
    chip_numbers: tuple[int, ...]
    filter_names: tuple[str, ...]
    sources: tuple[str, ...]
    n_rows: int
    tangent_point: tuple[float, float] | None

    def codes(self, key: str, block: Mapping[str, Any], *, source: str) -> Int:
        """Codes of a block's exposures, chips or filters among those of the whole.

        InputError for a label that was not there when the parts were scanned.
        """
        known = self._numbers[key]
        try:
            code_of_label = np.array([known[label] for label in block[_LABELS[key]]], np.int64)
        except KeyError:
            raise InputError(
                "has changed since it was opened", where=source, do="start again"
            ) from None
        return _recoded(key, block, code_of_label)

    @cached_property
    def _numbers(self) -> dict[str, dict[Any, int]]:
        """Code of each label."""
        return {
            key: {label: k for k, label in enumerate(getattr(self, names))}
            for key, names in _LABELS.items()
        }


def _recoded(key: str, block: Mapping[str, Any], code_of_label: Int) -> Int:
    codes = block.get(key)
    if codes is None:
        codes = np.zeros(len(block["x"]), np.int64)
    return code_of_label[codes]


def tangent_point_of(parts: Sequence[MatchPart]) -> tuple[float, float]:
    """Mean direction of all reference positions."""
    total = np.zeros(3, object)
    for one in parts:
        total += one.direction()
    x, y, z = total.tolist()
    return direction_of((x, y, z))


@dataclass(eq=False)
class _Scan:
    """Parts batch by batch, as `first_repetition` takes them.

    All columns are read, so that any wrong row is found, and labels are numbered as they appear.
    """

    parts: Sequence[MatchPart]
    numbers: dict[str, dict[Any, int]] = field(default_factory=lambda: {k: {} for k in _LABELS})

    def __call__(self) -> Iterator[list[NDArray[Any]]]:
        for one in self.parts:
            for block in one.blocks(size=_BLOCK):
                keys = [block[name] for name in ("x", "y", "u", "v")]
                for key, known in self.numbers.items():
                    code_of_label = np.array(
                        [known.setdefault(label, len(known)) for label in block[_LABELS[key]]]
                    )
                    if key in block or one.exposure_name is not None:
                        keys.append(_recoded(key, block, code_of_label))
                if "epoch" in block:
                    keys.append(block["epoch"])
                yield keys


def scan(parts: Sequence[MatchPart]) -> Whole:
    """Names common to all parts, from a scan of all rows; any wrong or repeated row is refused.

    The parts have the same quantities and unit, and a tangent point if they need one.
    """
    n_rows = sum(one.part.n_rows for one in parts)
    if n_rows == 0:
        more = f" and {len(parts) - 1} more" if len(parts) > 1 else ""
        raise InputError(
            "holds no rows", where=parts[0].source + more, do="give a table with matched stars"
        )
    rows = _Scan(parts)
    pair = first_repetition(rows, buckets_for(n_rows))
    if pair is not None:
        first, second = (_named(parts, row) for row in pair)
        raise InputError(
            f"repeats {first}: the same x, y, u, v, exposure and chip",
            where=second,
            do="drop one of them",
        )
    return Whole(
        unit=parts[0].unit,
        exposure_names=tuple(rows.numbers["exposure"]),
        chip_numbers=tuple(sorted(rows.numbers["chip"])),
        filter_names=tuple(rows.numbers["filter"]),
        sources=tuple(one.source for one in parts),
        n_rows=n_rows,
        tangent_point=parts[0].options.tangent_point,
    )


def _named(parts: Sequence[MatchPart], row: int) -> str:
    """File, row group and row of a row counted over all parts."""
    for one in parts:
        if row < one.part.n_rows:
            break
        row -= one.part.n_rows
    return f"{one.source}, {one.part.place(0)(row)}"
