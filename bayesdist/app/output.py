"""Files that a command or a stage writes."""

from __future__ import annotations

from pathlib import Path

from astropy.table import Table

from bayesdist.errors import InputError
from bayesdist.files import atomic_path

__all__ = ["refuse_existing", "write_table"]


def refuse_existing(path: Path, force: bool) -> None:
    """Refuse a file that is there already, unless it may be replaced.

    Raises
    ------
    InputError
    """
    if path.exists() and not force:
        raise InputError("this file exists", where=str(path), do="replace it by --force")


def write_table(table: Table, path: Path) -> None:
    """Write a table as ECSV, whole or not at all."""
    with atomic_path(path) as temporary:
        table.write(temporary, format="ascii.ecsv")
