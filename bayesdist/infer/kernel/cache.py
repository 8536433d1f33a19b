"""Cache folder of compiled code, by the content of all sources of the kernel.

numba looks at the file of the function that it compiles, not at those of the functions that this
one calls; after a change in one of them it would use the old code.
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
def kept_by_content() -> Iterator[None]:
    """Context in which declared functions use a cache folder by the content of the sources.

    It lies beside the sources, in the user's cache where these are read-only, or else is a folder
    of this process alone, which compiles everything anew.  NUMBA_CACHE_DIR comes before them all.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(_folder())
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _folder() -> Path:
    """The first folder that may be written into."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(here.glob("*.py")):
        digest.update(read_bytes(source))
    name = digest.hexdigest()[:16]
    for folder in (here / "__pycache__", *_user_cache()):
        if _is_writable(folder / name):
            return folder / name
    log.warning(
        "compiled code cannot be kept: each command compiles it anew; set NUMBA_CACHE_DIR to a "
        "folder of your own that can be written into"
    )
    # code of others must not be found there: no folder that has a known name
    _private.append(tempfile.TemporaryDirectory(prefix="bayesdist-", ignore_cleanup_errors=True))
    return Path(_private[-1].name)


def _user_cache() -> Iterator[Path]:
    """Folder of what a user's programs may lose; none for a user without a home."""
    with suppress(RuntimeError):
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bayesdist"


def _is_writable(folder: Path) -> bool:
    """Boolean: a folder is there, made if need be, and takes files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
