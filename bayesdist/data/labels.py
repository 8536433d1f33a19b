"""Several tables become one: codes renumbered, counts added, optional columns in agreement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError

__all__ = ["merged_codes", "merged_counts", "merged_optional"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


def merged_codes(
    codes: Sequence[Int], labels: Sequence[tuple[Any, ...]], *, ordered: bool = False
) -> tuple[Int, tuple[Any, ...]]:
    """One numbering for codes with labels of their own: the joined codes, and the labels.

    Labels stand in the order of their first appearance, or sorted.
    """
    every: list[Any] = list(dict.fromkeys(label for own in labels for label in own))
    if ordered:
        every.sort()
    number = {label: k for k, label in enumerate(every)}
    renumbered = [
        np.array([number[label] for label in own], np.int64)[code]
        for code, own in zip(codes, labels, strict=True)
    ]
    return np.concatenate(renumbered), tuple(every)


def merged_counts(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Sums by key."""
    total: dict[str, int] = {}
    for one in counts:
        for key, number in one.items():
            total[key] = total.get(key, 0) + number
    return total


def merged_optional(
    name: str, arrays: Sequence[Float | None], sources: Sequence[str]
) -> Float | None:
    """Joined column that all tables have; None where none has it; refused where only some have."""
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
