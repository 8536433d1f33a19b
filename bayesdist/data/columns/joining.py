"""Concatenation of tables of matches: codes are renumbered, counts added, and columns checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.columns.checked import OPTIONAL, POSITIONS, SIGMAS, MatchColumns
from bayesdist.data.columns.labels import LABELS_OF_CODES, merged_counts
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int


def joined_arguments(tables: Sequence[MatchColumns]) -> dict[str, Any]:
    """Arguments of `Matches` for the rows of several tables in their order.

    InputError if units or tangent points differ, or if only some tables have an optional column.
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
    """Concatenate codes with different labels: returns the new codes and the labels.

    Labels are in the order of their first appearance, or sorted if `ordered`.
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
    """Match radius of all tables; None if any has none. InputError if they differ."""
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
    """Concatenated column; None if no table has it. InputError if only some have it."""
    present = [a for a in arrays if a is not None]
    if not present:
        return None
    if len(present) < len(arrays):
        lacking = next(s for a, s in zip(arrays, sources, strict=True) if a is None)
        having = next(s for a, s in zip(arrays, sources, strict=True) if a is not None)
        raise InputError(
            f"has no {name!r}, but {having} has",
            where=lacking,
            do="give the column in all files or in none",
        )
    return np.concatenate(present)
