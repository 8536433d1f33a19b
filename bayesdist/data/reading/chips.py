"""Chips that a table knows by name: each gets a number."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.tables.column import EncodedColumn, SourceColumn
from bayesdist.errors import InputError

__all__ = ["numbered", "numbered_chips", "text_labels"]

Int = NDArray[np.int64]


def text_labels(column: SourceColumn) -> tuple[str, ...]:
    """Names of the chips in a column; none where they are numbers."""
    values = column.values
    plain = values.labels if isinstance(values, EncodedColumn) else np.asarray(values)
    if plain.dtype.kind not in "SUO":
        return ()
    names = column.labels()[1]
    return () if all(re.fullmatch(r"[+-]?\d+", name) for name in names) else names


def numbered(names: Iterable[str]) -> dict[str, int]:
    """Numbers from 1 for names in their order, digits by their value: S2 before S10."""

    def key(name: str) -> list[tuple[int, int, str]]:
        parts = re.findall(r"\d+|\D+", name)
        return [(0, int(one), "") if one.isdigit() else (1, 0, one) for one in parts]

    return {name: k for k, name in enumerate(sorted(set(names), key=key), 1)}


def numbered_chips(
    column: SourceColumn, chips: Mapping[str, int] | None
) -> tuple[Int, tuple[int, ...], tuple[str, ...]]:
    """Codes (N,) of the chips, their numbers in rising order, and their names where they have such.

    `chips` gives the number of each name; by default from 1 in the order of the names.  Numbers
    that are not whole and names without a number are refused.
    """
    names = text_labels(column)
    if not names:
        numbers, codes = np.unique(column.integers(), return_inverse=True)
        return codes, tuple(numbers.tolist()), ()
    number_of = numbered(names) if chips is None else chips
    if not number_of:
        raise InputError(
            f"holds names of chips ({names[0]!r}), and tables on disk need their numbers first",
            where=column.where,
            do="give [[chip]] blocks of these names, or write numbers",
        )
    own, labels = column.labels()
    for name in labels:
        if name not in number_of:
            raise InputError(
                f"chip {name!r} is none of {', '.join(number_of)}",
                where=column.where,
                do="add a [[chip]] block of this name, or leave these rows out",
            )
    every = np.array([number_of[name] for name in labels], np.int64)
    numbers, codes = np.unique(every[own], return_inverse=True)
    name_of = {number_of[name]: name for name in labels}
    return codes, tuple(numbers.tolist()), tuple(name_of[number] for number in numbers.tolist())
