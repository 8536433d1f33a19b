"""Memory that this machine has, what would need more of it, and what is free again."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from contextlib import suppress

from bayesdist.errors import MemoryLimitError


def memory_limit() -> int:
    """Bytes that one object may take: half the memory of the machine, or of what it allows us."""
    try:
        found = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # systems that do not tell
        return sys.maxsize
    try:
        import resource

        allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    except ImportError:
        return found // 2
    return (found if allowed == resource.RLIM_INFINITY else min(found, allowed)) // 2


def require_memory(n_bytes: float, what: str, *, where: str = "", do: str) -> None:
    """Refuse a computation before it takes more memory than it may.

    `n_bytes`: that it needs, at least. `what`: as in "the grid of 100000 x 100000 positions".
    `where`, `do`: as of `BayesdistError`.
    """
    most = memory_limit()
    if n_bytes > most:
        raise MemoryLimitError(
            f"{what} would take {size_text(n_bytes)} of memory, and at most {size_text(most)} are "
            "to be had here",
            where=where,
            do=do,
        )


def release_memory() -> None:
    """Give memory that is free back to the system, where the C library keeps it for later (glibc).

    Arrays of a few MB leave gaps between those that stay: a fifth of all memory after large files.
    """
    with suppress(AttributeError, OSError, TypeError):  # other systems have no such function
        ctypes.CDLL(None).malloc_trim(0)


def size_text(n_bytes: float) -> str:
    """A number of bytes in words, as '74 GB'."""
    units = ("bytes", "kB", "MB", "GB", "TB")
    power = min(len(units) - 1, int(math.log10(max(n_bytes, 1.0))) // 3)
    return f"{n_bytes / 1000**power:.3g} {units[power]}"
