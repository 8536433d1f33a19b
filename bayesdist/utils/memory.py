"""Memory limit of a single object, and the release of unused memory."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from contextlib import suppress

from bayesdist.errors import MemoryLimitError


def memory_limit() -> int:
    """Maximum size of one object in bytes: half the physical memory or address space limit."""
    try:
        physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # not available on all systems
        return sys.maxsize
    try:
        import resource

        allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    except ImportError:
        return physical // 2
    return (physical if allowed == resource.RLIM_INFINITY else min(physical, allowed)) // 2


def require_memory(n_bytes: float, what: str, *, where: str = "", do: str) -> None:
    """Raise an error if a computation needs more memory than `memory_limit`.

    Parameters
    ----------
    n_bytes : float
        Lower bound of the required memory.
    what : str
        Object for the message, such as "the grid of 100000 x 100000 positions".
    where, do : str
        See `BayesdistError`.

    Raises
    ------
    MemoryLimitError
        If `n_bytes` exceeds the limit.
    """
    limit = memory_limit()
    if n_bytes > limit:
        raise MemoryLimitError(
            f"{what} would take {size_text(n_bytes)} of memory, but at most {size_text(limit)} are "
            "available",
            where=where,
            do=do,
        )


def release_memory() -> None:
    """Return unused memory to the operating system (glibc only; otherwise do nothing).

    glibc keeps freed memory for later use, and freed arrays of a few MB leave gaps between the
    remaining ones: after large files have been read, this is a fifth of all memory.
    """
    with suppress(AttributeError, OSError, TypeError):  # other systems have no such function
        ctypes.CDLL(None).malloc_trim(0)


def size_text(n_bytes: float) -> str:
    """Number of bytes as text with a decimal unit, such as '74 GB'."""
    units = ("bytes", "kB", "MB", "GB", "TB")
    power = min(len(units) - 1, int(math.log10(max(n_bytes, 1.0))) // 3)
    return f"{n_bytes / 1000**power:.3g} {units[power]}"
