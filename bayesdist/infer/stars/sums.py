"""Sums over stars, by group or for all: those of two chunks of the data add up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from bayesdist.model import Groups, merge_groups
from bayesdist.utils.arrays import Int

Rows = tuple[Int, ...]


class Sums:
    """Base of dataclasses of sums over stars, as tasks for `Shards.sum` return them.

    Fields are numbers, arrays, further sums, None, or tuples and mappings of these.  A field
    `groups` makes those named in `BY_GROUP` and `OF_GROUP` have a row for each group; the sum then
    has the groups of both.
    """

    BY_GROUP: ClassVar[tuple[str, ...]] = ()  # sums
    OF_GROUP: ClassVar[tuple[str, ...]] = ()  # what the sums of a group refer to
    SAME: ClassVar[tuple[str, ...]] = ()  # what all sums refer to

    def __add__(self, other: Self) -> Self:
        """Sum over the stars of both; ValueError for sums that refer to different things."""
        out: dict[str, Any] = {}
        rows: Rows = ()
        mine: Any = self  # dataclasses, which may have groups
        theirs: Any = other
        if getattr(mine, "groups", None) is not None:
            out["groups"], rows = _merged(mine.groups, theirs.groups)
        for name in (one.name for one in fields(mine) if one.name not in out):
            a, b = getattr(self, name), getattr(other, name)
            if name in self.SAME:
                if np.any(a != b):
                    raise ValueError(f"sums with different {name} do not add")
                out[name] = a
            elif name in self.BY_GROUP:
                out[name] = _scattered(a, b, rows, len(out["groups"]))
            elif name in self.OF_GROUP:
                out[name] = _placed(a, b, rows, len(out["groups"]), name)
            else:
                out[name] = _added(a, b)
        return type(self)(**out)


def _merged(a: Groups, b: Groups) -> tuple[Groups, Rows]:
    """Groups of either, and the rows in them of each."""
    if a.same(b):
        return a, (np.arange(len(a)), np.arange(len(a)))
    groups, *rows = merge_groups(a, b)
    return groups, tuple(rows)


def _scattered(a: NDArray[Any], b: NDArray[Any], rows: Rows, n: int) -> NDArray[Any]:
    """Sum (n, ...) of arrays whose rows have these places in it."""
    out = np.zeros((n, *a.shape[1:]), a.dtype)
    out[rows[0]] += a
    out[rows[1]] += b
    return out


def _placed(a: NDArray[Any], b: NDArray[Any], rows: Rows, n: int, name: str) -> NDArray[Any]:
    """Array (n, ...) with the rows of both, which are equal where both have one."""
    out = np.empty((n, *a.shape[1:]), a.dtype)
    out[rows[0]] = a
    out[rows[1]] = b
    if not np.array_equal(out[rows[0]], a):
        raise ValueError(f"sums with different {name} do not add")
    return out


def _added(a: Any, b: Any) -> Any:
    if a is None:
        return b
    if isinstance(a, tuple):
        return tuple(_added(one, two) for one, two in zip(a, b, strict=True))
    if isinstance(a, Mapping):
        return {key: _added(one, b[key]) for key, one in a.items()}
    return a + b
