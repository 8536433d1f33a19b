"""Cache folder for compiled code, named after a hash of all kernel sources.

To decide whether its cache is valid, numba checks only the file of the compiled function, not the
files of functions that it calls.  After a change in one of those it would use outdated code.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from numba import config

from bayesdist.files.regular import read_bytes

log = logging.getLogger("bayesdist")

_private: list[tempfile.TemporaryDirectory[str]] = []  # removed when the process ends


@contextmanager
def kept_by_content(further: Path | None = None) -> Iterator[None]:
    """Context in which numba functions must be declared to use the cache folder of these sources.

    The folder is next to the sources, or in the user's cache if these are read-only.  If neither is
    writable, a temporary folder of this process is used, and everything is compiled again.
    NUMBA_CACHE_DIR takes precedence.

    Parameters
    ----------
    further : Path, optional
        Folder of compiled functions outside this package, which call functions of it.  They have a
        cache folder next to their own sources, named after those of both.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(_folder(further))
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _folder(further: Path | None) -> Path:
    """First cache folder that is writable."""
    packages = [Path(__file__).parent, *([] if further is None else [further])]
    digest = hashlib.sha256()
    for package in packages:
        for source in sorted(package.glob("*.py")):
            digest.update(read_bytes(source))
    name = digest.hexdigest()[:16]
    for folder in (packages[-1] / "__pycache__", *_user_cache()):
        if _is_writable(folder / name):
            return folder / name
    log.warning(
        "compiled code cannot be cached, so each command compiles it again; set NUMBA_CACHE_DIR to "
        "a writable folder"
    )
    # a folder with a random name, so that no code of other users can be placed in it
    _private.append(tempfile.TemporaryDirectory(prefix="bayesdist-", ignore_cleanup_errors=True))
    return Path(_private[-1].name)


def _user_cache() -> Iterator[Path]:
    """Yield the user's cache folder; nothing if the user has no home directory."""
    with suppress(RuntimeError):
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bayesdist"


def _is_writable(folder: Path) -> bool:
    """True if files can be written to the folder, which is created if necessary."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
