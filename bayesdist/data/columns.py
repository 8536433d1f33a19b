"""Columns and labels of matches as plain arrays in one unit, with checks and concatenation.

Labels are the names of codes, the unit, counts and notes.  When tables are concatenated, codes are
renumbered, counts are added, and columns are checked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.covariances import LARGEST_RHO
from bayesdist.data.repeated import first_duplicate
from bayesdist.data.tables.checks import (
    COMPLETED,
    absent,
    check_values,
    columns_of,
    counted,
    one_length,
    refuse_half,
)
from bayesdist.data.tables.column import check_unit, conversion, unit_of, without_unit
from bayesdist.data.tables.names import ASSUMED
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.text import refuse_control_characters

LABELS_OF_CODES = {
    "exposure": "exposure_names",
    "chip": "chip_numbers",
    "filter": "filter_names",
}
DEFAULT_LABELS: dict[str, Any] = {"exposure": "1", "chip": 1, "filter": ""}
POSITIONS = ("x", "y", "u", "v")
SIGMAS = ("sigma_u", "sigma_v")
_NOMINAL = ("u_nominal", "v_nominal")
_MOTIONS = ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v")
CORRELATION = "rho_uv"
OPTIONAL = (CORRELATION, "epoch", "mag", "colour", *_NOMINAL, *_MOTIONS)
_INTEGERS = ("row", "source", "star", ASSUMED, *LABELS_OF_CODES)
_NUMBERS = (*POSITIONS, *SIGMAS, *OPTIONAL)
COLUMNS = (*_NUMBERS, *_INTEGERS)
Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Labels:
    """Attributes shared by all batches of matches; the fields are those of `Matches`."""

    unit: str
    exposure_names: tuple[str, ...]
    chip_numbers: tuple[int, ...]
    filter_names: tuple[str, ...]
    sources: tuple[str, ...]
    n_rows: int
    tangent_point: tuple[float, float] | None = None
    chip_names: tuple[str, ...] = ()
    rejected: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    match_radius: float | None = None

    def arguments(self) -> dict[str, Any]:
        """Arguments of `Matches` by name."""
        return {label_field.name: getattr(self, label_field.name) for label_field in fields(self)}

    def of_batch(self, n: int) -> Labels:
        """Labels of a batch of n rows, without the counts of rejected rows."""
        return replace(self, n_rows=n, rejected={})

    def codes(self, key: str, block: Mapping[str, Any], *, source: str) -> Int:
        """Convert the codes of a block of rows to codes (n,) among the labels of all files.

        `key` is 'exposure', 'chip' or 'filter'.  Raises InputError for a label that did not exist
        when the files were scanned.
        """
        code_by_label = self._numbers[key]
        labels = block[LABELS_OF_CODES[key]]
        try:
            code_of_label = np.array([code_by_label[label] for label in labels], np.int64)
        except KeyError:
            raise InputError(
                "has changed since it was opened", where=source, do="start again"
            ) from None
        return recoded(key, block, code_of_label)

    @cached_property
    def _numbers(self) -> dict[str, dict[Any, int]]:
        """Code of each label, by the kind of label."""
        return {
            key: {label: k for k, label in enumerate(getattr(self, names))}
            for key, names in LABELS_OF_CODES.items()
        }


def recoded(key: str, block: Mapping[str, Any], code_of_label: Int) -> Int:
    """New codes (N,) of the rows of a block.

    `key` is 'exposure', 'chip' or 'filter'; `code_of_label` has the new code of each label of the
    block.
    """
    codes = block.get(key)
    if codes is None:
        codes = np.zeros(len(block["x"]), np.int64)
    return code_of_label[codes]


def merged_counts(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Sums of counts by key."""
    total: dict[str, int] = {}
    for count_by_key in counts:
        for key, number in count_by_key.items():
            total[key] = total.get(key, 0) + number
    return total


_LABELS = tuple(label_field.name for label_field in fields(Labels))


@dataclass(frozen=True, eq=False, repr=False)
class MatchColumns:
    """Columns and labels of matches with defaults and checks; `Matches` documents them."""

    x: Float
    y: Float
    u: Float
    v: Float
    sigma_u: Float | None = None
    sigma_v: Float | None = None
    unit: str = "pix"
    epoch: Float | None = None
    mag: Float | None = None
    colour: Float | None = None
    exposure: Int = COMPLETED
    exposure_names: tuple[str, ...] = ("1",)
    chip: Int = COMPLETED
    chip_numbers: tuple[int, ...] = (1,)
    filter: Int = COMPLETED
    filter_names: tuple[str, ...] = ("",)
    star: Int | None = None
    row: Int = COMPLETED
    source: Int = COMPLETED
    sources: tuple[str, ...] = ("table",)
    n_rows: int = COMPLETED
    rejected: Mapping[str, int] = field(default_factory=dict)
    tangent_point: tuple[float, float] | None = None
    u_nominal: Float | None = None
    v_nominal: Float | None = None
    pm_u: Float | None = None
    pm_v: Float | None = None
    sigma_pm_u: Float | None = None
    sigma_pm_v: Float | None = None
    chip_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    match_radius: float | None = None
    rho_uv: Float | None = None
    assumed_motion: Int | None = None

    def _complete(self) -> None:
        """Fill in the defaults, convert every array to its type, and check the values."""
        location = ", ".join(self.sources)
        columns, n, rejected = _completed(self._columns, unit=self.unit, where=location)
        self.__dict__.update(columns)
        counts = merged_counts([self.rejected, rejected]) if rejected else dict(self.rejected)
        object.__setattr__(self, "n_rows", n if self.n_rows is None else int(self.n_rows))
        object.__setattr__(self, "rejected", counts)
        names = {**LABELS_OF_CODES, "source": "sources"}
        _check(
            columns,
            {name: getattr(self, labels) for name, labels in names.items()},
            unit=self.unit,
            where=location,
            place=self.place,
        )

    @property
    def _columns(self) -> dict[str, Any]:
        """Columns that are not None."""
        return columns_of(self, COLUMNS)

    @property
    def labels(self) -> Labels:
        """Names, unit, counts and notes."""
        return Labels(**{name: getattr(self, name) for name in _LABELS})

    @property
    def chip_number(self) -> Int:
        """Chip number of each star (N,)."""
        return np.asarray(self.chip_numbers, np.int64)[self.chip]

    @property
    def motion_is_assumed(self) -> Bool:
        """Boolean mask (N,) of the stars whose motion is assumed instead of measured."""
        if self.assumed_motion is None:
            return np.zeros(len(self.x), bool)
        return np.asarray(self.assumed_motion != 0)

    def grouped(self, by: str) -> tuple[tuple[str, ...], Int]:
        """Labels of groups of stars, and the code of each star's group.

        Parameters
        ----------
        by : str
            'chip', 'exposure' or 'filter'; empty for a single group of all stars with an empty
            label.

        Returns
        -------
        labels : tuple of str
            Labels of the groups.
        codes : ndarray of int, shape (N,)
            Index of each star's group in `labels`.
        """
        if not by:
            return ("",), np.zeros(len(self.x), np.int64)
        return tuple(map(str, getattr(self, LABELS_OF_CODES[by]))), getattr(self, by)

    def place(self, row: int, column: str = "") -> str:
        """Location of a star for a message: file, row (counted from 1) and column."""
        head = f"{self.sources[self.source[row]]}, row {self.row[row] + 1}"
        return f"{head}, column {column!r}" if column else head


class _Column:
    """Descriptor of a column of matches; raises InputError if the stars are on disk."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, matches: MatchColumns | None, owner: type) -> Any:
        if matches is None:
            return self
        try:
            return matches.__dict__[self._name]
        except KeyError:
            raise InputError(
                f"the stars are on disk, so their column {self._name!r} is not in memory",
                where=", ".join(matches.sources),
                do="go through batches(), or take sample(n) or load()",
            ) from None

    def __set__(self, matches: MatchColumns, values: Any) -> None:
        matches.__dict__[self._name] = values


for _name in COLUMNS:
    setattr(MatchColumns, _name, _Column(_name))


def column_unit(name: str, unit: str) -> str | None:
    """Unit of a column if u and v are in `unit`; None for integer columns."""
    if name not in _NUMBERS:
        return None
    if name in _MOTIONS:
        return f"{unit} / yr"
    units = {"x": "pix", "y": "pix", "epoch": "yr", "mag": "mag", "colour": "mag"}
    return units.get(name, unit)


def _completed(
    given: Mapping[str, Any], *, unit: str, where: str
) -> tuple[dict[str, NDArray[Any]], int, dict[str, int]]:
    """Columns with their defaults, the number of rows given, and counts of rejected rows.

    Quantities are converted to numbers in `unit`. Rows with a masked value are left out and counted
    by reason.
    """
    columns = _without_units(given, unit, where)
    n = np.size(columns["x"])
    columns, rejected = _without_masked(columns, n)
    n_valid = np.size(columns["x"])
    if n_valid == 0:
        raise InputError("holds no rows", where=where, do="give a table with matched stars")
    absent_codes = {"source", *LABELS_OF_CODES} - columns.keys()
    columns = columns | {name: np.zeros(n_valid, np.int64) for name in absent_codes}
    if "row" not in columns:
        columns = columns | {"row": np.arange(n_valid)}
    ordered = {name: columns[name] for name in COLUMNS if name in columns}
    return one_length(ordered, integers=_INTEGERS, where=where), n, rejected


def _without_units(given: Mapping[str, Any], unit: str, where: str) -> dict[str, Any]:
    """Columns with quantities replaced by numbers in `unit`."""
    out = dict(given)
    for name in _NUMBERS:
        stated_unit = unit_of(out.get(name), where=f"column {name!r}")
        to = column_unit(name, unit)
        if stated_unit is not None and to is not None:
            factor = conversion(stated_unit, to, where=f"{where}, column {name!r}")
            out[name] = factor * without_unit(out[name])
    return out


def _without_masked(columns: dict[str, Any], n: int) -> tuple[dict[str, Any], dict[str, int]]:
    """Columns without the rows that have a masked value, and counts of these rows by reason."""
    masked = [name for name in COLUMNS if hasattr(columns.get(name), "mask")]
    if not masked or {np.shape(values) for values in columns.values()} != {(n,)}:
        return columns, {}  # unequal lengths are reported by `one_length`
    gone = {name: absent(columns[name], not_finite=False) for name in masked}
    reasons = [(f"no value in column {name!r}", rows) for name, rows in gone.items()]
    stay, rejected = counted(reasons, n)
    if not rejected:
        return columns, {}
    columns = {"row": np.arange(n)} | columns
    plain = {name: np.asarray(getattr(a, "unmasked", a)) for name, a in columns.items()}
    return {name: values[stay] for name, values in plain.items()}, rejected


def _check(
    columns: Columns,
    labels: Mapping[str, Sequence[Any]],
    *,
    unit: str,
    where: str,
    place: Callable[[int, str], str],
) -> None:
    """Raise InputError for an unknown unit, half a pair, codes without labels, or bad values."""
    check_unit(unit, where=where)
    refuse_half(SIGMAS, columns, where=where, what="errors")
    if CORRELATION in columns:
        beyond = ~(np.abs(columns[CORRELATION]) <= LARGEST_RHO)
        if beyond.any() or SIGMAS[0] not in columns:
            raise InputError(
                f"correlations of errors must lie between -{LARGEST_RHO} and {LARGEST_RHO}"
                if beyond.any()
                else "correlations of errors are given without the errors",
                where=place(int(np.argmax(beyond)), CORRELATION),
                do="correct them, or leave the column out",
            )
    refuse_half(_NOMINAL, columns, where=where, what="nominal positions")
    for name, names in labels.items():
        if name != "source":  # file names may contain any character
            refuse_control_characters((n for n in names if isinstance(n, str)), where)
        if columns[name].min() < 0 or columns[name].max() >= len(names):
            label = {**LABELS_OF_CODES, "source": "sources"}[name]
            raise InputError(
                f"codes in {name!r} are not indices of {label!r}",
                where=where,
                do="give a label for each code",
            )
    star = columns.get("star")
    if star is not None and star.min() < 0:
        bad = int(np.argmax(star < 0))
        raise InputError(
            f"value is {star[bad]}, but must not be negative",
            where=place(bad, "star"),
            do="number the reference stars from 0",
        )
    numbers = {name: columns[name] for name in _NUMBERS if name in columns}
    check_values(numbers, place=lambda row: place(row, ""), positive=SIGMAS)


def refuse_repeated(columns: Columns, *, place: Callable[[int], str]) -> None:
    """Raise InputError if the same measurement of a star occurs twice.

    `place` returns the location of a row, given its index, for the message.
    """
    names = (*POSITIONS, *LABELS_OF_CODES, "epoch")
    pair = first_duplicate([columns[name] for name in names if name in columns])
    if pair is not None:
        first, second = pair
        raise InputError(
            f"repeats {place(first)}: the same x, y, u, v, exposure and chip",
            where=place(second),
            do="keep each row once",
        )


def joined_arguments(tables: Sequence[MatchColumns]) -> dict[str, Any]:
    """Arguments of `Matches` for the rows of several tables in their order.

    Raises InputError if units or tangent points differ, or if only some tables have an optional
    column.
    """
    first = tables[0]
    for table in tables[1:]:
        for name, label in (("unit", "unit"), ("tangent_point", "tangent point")):
            if getattr(table, name) != getattr(first, name):
                raise InputError(
                    f"{label} is {getattr(table, name)}, but {getattr(first, name)} in "
                    f"{', '.join(first.sources)}",
                    where=", ".join(table.sources),
                    do="bring all files to one",
                )
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(t, name) for t in tables]) for name in (*POSITIONS, "row")
    }
    for name in (*SIGMAS, *OPTIONAL):
        joined[name] = merged_optional(
            name, [getattr(t, name) for t in tables], [", ".join(t.sources) for t in tables]
        )
    stars = [t.star for t in tables if t.star is not None]
    joined["star"] = np.concatenate(stars) if len(stars) == len(tables) else None
    if any(t.assumed_motion is not None for t in tables):
        joined[ASSUMED] = np.concatenate([t.motion_is_assumed for t in tables]).astype(np.int64)
    for name, labels in {**LABELS_OF_CODES, "source": "sources"}.items():
        joined[name], joined[labels] = merged_codes(
            [getattr(t, name) for t in tables],
            [getattr(t, labels) for t in tables],
            ordered=name == "chip",
        )
    name_of = {
        number: name
        for t in tables
        for number, name in zip(t.chip_numbers, t.chip_names, strict=False)
    }
    chips = joined["chip_numbers"]
    if len(name_of) == len(chips):
        joined["chip_names"] = tuple(name_of[number] for number in chips)
    joined |= {
        "notes": tuple(dict.fromkeys(note for t in tables for note in t.notes)),
        "unit": first.unit,
        "tangent_point": first.tangent_point,
        "match_radius": common_radius(
            [t.match_radius for t in tables], [", ".join(t.sources) for t in tables]
        ),
        "n_rows": sum(t.n_rows for t in tables),
        "rejected": merged_counts([t.rejected for t in tables]),
    }
    return joined


def joined_columns(parts: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Columns that all parts have, concatenated in their order."""
    names = [name for name in parts[0] if all(name in part for part in parts)]
    if len(parts) == 1:
        return dict(parts[0])
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def merged_codes(
    codes: Sequence[Int], labels: Sequence[tuple[Any, ...]], *, ordered: bool = False
) -> tuple[Int, tuple[Any, ...]]:
    """Concatenate codes with different labels; return the new codes (N,) and the labels.

    There is one array of codes and one tuple of labels per table.  The returned labels are in the
    order of their first appearance, or sorted if `ordered`.
    """
    all_labels: list[Any] = list(
        dict.fromkeys(label for part_labels in labels for label in part_labels)
    )
    if ordered:
        all_labels.sort()
    number = {label: k for k, label in enumerate(all_labels)}
    renumbered = [
        np.array([number[label] for label in part_labels], np.int64)[code]
        for code, part_labels in zip(codes, labels, strict=True)
    ]
    return np.concatenate(renumbered), tuple(all_labels)


def common_radius(radii: Sequence[float | None], sources: Sequence[str]) -> float | None:
    """Match radius common to all tables; None if a table has none.

    Raises InputError if the radii differ; `sources` are the names of the tables for the message.
    """
    stated = {radius for radius in radii if radius is not None}
    if len(stated) == 0 or None in radii:
        return None
    if len(stated) > 1:
        raise InputError(
            f"match radii differ: {', '.join(f'{radius:g}' for radius in sorted(stated))}",
            where=", ".join(sources),
            do="match all tables with one radius",
        )
    return stated.pop()


def merged_optional(
    name: str, arrays: Sequence[Float | None], sources: Sequence[str]
) -> Float | None:
    """Concatenate a column (N,) of several tables; None if no table has it.

    `arrays` has an array, or None, for each table, and `sources` the names of the tables.  Raises
    InputError if only some tables have the column.
    """
    present = [a for a in arrays if a is not None]
    if not present:
        return None
    if len(present) < len(arrays):
        lacking = next(s for a, s in zip(arrays, sources, strict=True) if a is None)
        having = next(s for a, s in zip(arrays, sources, strict=True) if a is not None)
        raise InputError(
            f"has no {name!r}, but {having} does",
            where=lacking,
            do="give the column in all files or in none",
        )
    return np.concatenate(present)
