"""A file that a command is to write."""

from __future__ import annotations

from pathlib import Path

from bayesdist.errors import InputError

__all__ = ["refuse_existing"]


def refuse_existing(path: Path, force: bool) -> None:
    """Refuse a file that is there already, unless it may be replaced.

    Raises
    ------
    InputError
    """
    if path.exists() and not force:
        raise InputError("this file exists", where=str(path), do="replace it by --force")
