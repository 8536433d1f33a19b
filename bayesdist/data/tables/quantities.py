"""The columns of a table by what they are."""

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
        """What `SourceColumn` takes."""


@dataclass(frozen=True, eq=False)
class Quantities:
    """Columns of a table by what they are.

    Parameters
    ----------
    table : Columns
    found : mapping of str to str
        Column of each quantity.
    source : str
        File, for errors.
    place : callable, optional
        Name of a row, by its index.
    names : sequence of str, optional
        All columns of the file, where the table has but some: they say which catalogue it is.
    """

    table: Columns
    found: Mapping[str, str]
    source: str
    place: Place = row_number
    names: Sequence[str] = ()

    def __contains__(self, key: str) -> bool:
        return key in self.found

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, key: str) -> SourceColumn:
        name = self.found[key]
        unit = known_unit(name, self.names or self.table.colnames)
        return SourceColumn(self.table[name], self.source, name, self.place, unit)
