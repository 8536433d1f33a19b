"""Chunks into which the stars are cut, and the threads that share them.

Threads are Python's.  numba's own compile each pass several times over, and do not survive a fork.
Even to ask numba for their number starts them, and fixes how the process starts others.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from itertools import pairwise
from typing import Any

import numba as nb
import numpy as np

from bayesdist.infer.kernel.lanes import FAST, INNER, copy
from bayesdist.infer.kernel.vectors import whole_vectors
from bayesdist.utils.arrays import Float, Int

# how a pass is compiled: without a check for division by zero, which would exclude vectors
PASS: dict[str, Any] = {
    "cache": True,
    "no_cfunc_wrapper": True,
    "nogil": True,
    "fastmath": FAST,
    "error_model": "numpy",
}

BLOCK = 256  # stars whose scratch arrays stay in the first-level cache
THREADS_PAY = 200_000  # evaluations of a star below which one thread is faster
_threads: ContextVar[int] = ContextVar("threads", default=nb.config.NUMBA_NUM_THREADS)
PARTS = 4  # of the work, for each thread: some are done sooner than others


def pieces_of(starts: Int, size: int) -> Int:
    """Pieces (n, 3) of (group, first star, end), none larger than `size` or across two groups.

    `starts` (G + 1,) are the first stars of the groups.
    """
    first = [np.arange(a, b, size) for a, b in pairwise(starts)]
    group = np.repeat(np.arange(len(first)), [len(f) for f in first])
    begin = np.concatenate([*first, np.zeros(0, np.int64)]).astype(np.int64)
    end = np.minimum(begin + size, np.asarray(starts)[group + 1])
    return np.column_stack([group, begin, end]).astype(np.int64)


def aligned(*shape: int) -> Float:
    """Zeros that begin where a vector does not cross lines of the cache."""
    size = math.prod(shape)
    room = np.zeros(size + 8)
    first = -(room.ctypes.data // 8) % 8
    return room[first : first + size].reshape(shape)


def scratch(n: int) -> Float:
    """Zeros (n, BLOCK), aligned."""
    return aligned(n, BLOCK)


def star_room() -> tuple[Float, Float]:
    """Room for the stars of a block, and for a model of them."""
    return scratch(6), scratch(2)


@nb.njit(**INNER)
def put_ones(rows, n):
    """Write ones to rows of `scratch` behind the first n stars."""
    whole_vectors()
    for k in range(len(rows)):
        for s in range(n, BLOCK):
            rows[k, s] = 1.0


@nb.njit(**INNER)
def lay_out(columns, first, end, rows):
    """Copy X, Y, u, v, var_u, var_v of some stars to rows of `scratch`, and ones behind them."""
    whole_vectors()
    n = end - first
    copy(columns[0], first, n, rows, 0)
    copy(columns[1], first, n, rows, 1)
    copy(columns[2], first, n, rows, 2)
    copy(columns[3], first, n, rows, 3)
    copy(columns[4], first, n, rows, 4)
    copy(columns[5], first, n, rows, 5)
    put_ones(rows, n)


def share_out(
    loop: Callable[..., None],
    n: int,
    *arguments: Any,
    room: Callable[[], tuple[Float, ...]] = tuple,
) -> None:
    """Run loop(first, end, *arguments) over range(n), in parts if there are several threads.

    Each part has its own `room`, arrays to write to, which come before the other arguments.
    """
    threads = min(get_threads(), n)
    if threads < 2:
        loop(0, n, *room(), *arguments)
        return
    edges = [n * part // (PARTS * threads) for part in range(PARTS * threads + 1)]
    pool = _pool(get_threads())
    parts = [pool.submit(loop, a, e, *room(), *arguments) for a, e in pairwise(edges)]
    for done in parts:
        done.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that wait for passes: to start them takes longer than a pass over few stars."""
    return ThreadPoolExecutor(threads)


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive it


def in_turn(function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
    """Results of a function that is called as by `map`, on all threads at a time."""
    threads = get_threads()
    if threads < 2:
        yield from map(function, *arguments)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, *arguments)


def at_once(function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
    """Results as of `in_turn`, all together."""
    return list(in_turn(function, *arguments))


@contextmanager
def threads_for(evaluations: float) -> Iterator[None]:
    """Context with one thread where more would wait for each other longer than they work."""
    token = _threads.set(get_threads() if evaluations > THREADS_PAY else 1)
    try:
        yield
    finally:
        _threads.reset(token)


def get_threads() -> int:
    """Number of threads that a pass may use: at first NUMBA_NUM_THREADS, or the processors."""
    return _threads.get()


def set_threads(n: int) -> None:
    """Use at most `n` threads from now on, in passes that the calling thread starts."""
    _threads.set(max(1, min(n, nb.config.NUMBA_NUM_THREADS, os.cpu_count() or 1)))
