"""A folder that appears with all its files, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bayesdist.errors import InputError

__all__ = ["atomic_directory"]


@contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """A folder that takes its name when the block succeeds, and else is removed.

    Parameters
    ----------
    path : pathlib.Path
        New, or empty.

    Yields
    ------
    pathlib.Path
        Where to write.

    Raises
    ------
    InputError
        For a folder that holds something, or that cannot be made.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(
            "the folder holds other files" if path.is_dir() else "is a file, not a folder",
            where=str(path),
            do="choose a new folder: what is there is never overwritten",
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
        temporary.chmod(0o777 & ~mask)  # a temporary folder is its owner's alone
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
