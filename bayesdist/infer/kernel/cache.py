"""Cache folder of compiled code, by the content of all sources of the kernel.

numba looks at the file of the function that it compiles, not at those of the functions that this
one calls; after a change in one of them it would use the old code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba import config

from bayesdist.reading.regular import read_bytes

__all__ = ["kept_by_content"]


@contextmanager
def kept_by_content() -> Iterator[None]:
    """Context in which declared functions use a cache folder by the content of the sources.

    Where that cannot be made, or the user has set NUMBA_CACHE_DIR, numba's own choice is used.
    """
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(here.glob("*.py")):
        digest.update(read_bytes(source))
    folder, before = here / "__pycache__" / digest.hexdigest()[:16], config.CACHE_DIR
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        yield
        return
    config.CACHE_DIR = before or str(folder)
    try:
        yield
    finally:
        config.CACHE_DIR = before
