"""Columns of a table by quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from bayesdist.data.tables.column import Place, SourceColumn, row_number
from bayesdist.data.tables.names import known_unit

__all__ = ["Columns", "Quantities"]


class Columns(Protocol):
    """Named columns of one length, as an astropy Table has them."""

    @property
    def colnames(self) -> Sequence[str]:
        """Names."""

    def __len__(self) -> int:
        """Rows."""

    def __getitem__(self, name: str) -> Any:
        """Values as `SourceColumn` takes them."""


@dataclass(frozen=True, eq=False)
class Quantities:
    """Columns of a table by quantity."""

    table: Columns
    found: Mapping[str, str]  # column of each quantity
    source: str  # file, for errors
    place: Place = row_number  # name of a row, by its index
    names: Sequence[str] = ()  # all columns of the file: they tell which catalogue it is

    def __contains__(self, key: str) -> bool:
        return key in self.found

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, key: str) -> SourceColumn:
        name = self.found[key]
        unit = known_unit(name, self.names or self.table.colnames)
        return SourceColumn(self.table[name], self.source, name, self.place, unit)
