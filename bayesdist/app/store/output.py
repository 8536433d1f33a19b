"""Atomic writing of output files and folders, which never overwrite other files."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from astropy.table import Table

from bayesdist.app.store import versions, write_json
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.infer import Posterior


def refuse_existing(path: Path, force: bool) -> None:
    """Refuse a file that exists, unless it may be replaced."""
    if path.exists() and not force:
        raise InputError("this file exists", where=str(path), do="replace it with --force")


def write_table(table: Table, path: Path) -> None:
    """Write a table as ECSV, atomically."""
    with atomic_path(path) as temporary:
        table.write(temporary, format="ascii.ecsv")


def provenance_notes(posterior: Posterior, gauge: str) -> dict[str, bool | str]:
    """Metadata on the convergence and the gauge, for the header of a file."""
    return {
        "converged": posterior.convergence.converged,
        **({"gauge": gauge} if gauge else {}),
    }


SCHEMA = 1  # of records of commands


@contextmanager
def record_folder(path: Path, name: str, command: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Create a folder and a record to be filled, which is written when the block succeeds."""
    with atomic_directory(path) as folder:
        record: dict[str, Any] = {"schema": SCHEMA, "command": command, "versions": versions()}
        yield folder, record
        write_json(folder / name, record)


@contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Create a folder that appears under its name if the block succeeds, and is removed otherwise.

    `path` must not exist or be empty.  Yields the temporary folder to write to.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(
            "the folder holds other files" if path.is_dir() else "is a file, not a folder",
            where=str(path),
            do="choose a new folder: existing files are never overwritten",
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    except OSError as error:
        raise InputError(
            f"the folder cannot be made ({error.strerror})",
            where=str(path),
            do="choose one that you may write to",
        ) from error
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)  # temporary folders are readable only by their owner
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
