"""Sums over stars, by group or in total; sums over different chunks of the data can be added."""

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
    """Base class of dataclasses with sums over stars, the results of tasks for `Shards.sum`.

    Fields are numbers, arrays, other `Sums`, None, or tuples and mappings of these.  If a subclass
    has a field `groups`, the fields named in `BY_GROUP` and `OF_GROUP` have one row per group, and
    adding two objects merges their groups.
    """

    BY_GROUP: ClassVar[tuple[str, ...]] = ()  # fields that are summed by group
    OF_GROUP: ClassVar[tuple[str, ...]] = ()  # properties of a group, which must agree
    SAME: ClassVar[tuple[str, ...]] = ()  # properties of all sums, which must agree

    def __add__(self, other: Self) -> Self:
        """Sum over the stars of both; raises ValueError if `SAME` or `OF_GROUP` fields differ."""
        out: dict[str, Any] = {}
        rows: Rows = ()
        mine: Any = self  # dataclasses that may have groups
        theirs: Any = other
        if getattr(mine, "groups", None) is not None:
            out["groups"], rows = _merged(mine.groups, theirs.groups)
        for name in (item.name for item in fields(mine) if item.name not in out):
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
    """Merged groups, and the rows in them of the groups of `a` and of `b`."""
    if a.same(b):
        return a, (np.arange(len(a)), np.arange(len(a)))
    groups, *rows = merge_groups(a, b)
    return groups, tuple(rows)


def _scattered(a: NDArray[Any], b: NDArray[Any], rows: Rows, n: int) -> NDArray[Any]:
    """Sum (n, ...) of arrays, with the rows of `a` and `b` added at the indices `rows`."""
    out = np.zeros((n, *a.shape[1:]), a.dtype)
    out[rows[0]] += a
    out[rows[1]] += b
    return out


def _placed(a: NDArray[Any], b: NDArray[Any], rows: Rows, n: int, name: str) -> NDArray[Any]:
    """Array (n, ...) with the rows of both at the indices `rows`; common rows must be equal."""
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
        return tuple(_added(first, second) for first, second in zip(a, b, strict=True))
    if isinstance(a, Mapping):
        return {key: _added(first, b[key]) for key, first in a.items()}
    return a + b
