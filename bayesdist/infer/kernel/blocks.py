"""Chunks into which the stars are cut, and the threads that share them.

Threads are Python's.  numba's own compile each pass several times over, and do not survive a fork.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numba as nb
import numpy as np
from numba.extending import overload

from bayesdist.infer.kernel.lanes import FAST
from bayesdist.utils.arrays import Int

# how a pass is compiled: without a check for division by zero, which would exclude vectors
PASS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": FAST, "error_model": "numpy"}

BLOCK = 256  # stars whose scratch arrays stay in the first-level cache
THREADS_PAY = 200_000  # evaluations of a star below which one thread is faster
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


def scratch(n):
    """Empty rows (n, BLOCK) that begin where a vector does not cross lines of the cache."""
    room = np.empty(n * BLOCK + 8)
    first = -(room.ctypes.data // 8) % 8
    return room[first : first + n * BLOCK].reshape(n, BLOCK)


@overload(scratch)
def _scratch(n):
    """`scratch` for any n; numba would compile it anew for each literal number of rows."""
    return scratch


@nb.njit(cache=True)
def _copy(column, row):
    n = len(column)
    for s in range(n):
        row[s] = column[s]
    for s in range(n, BLOCK):
        row[s] = 1.0


@nb.njit(cache=True)
def lay_out(columns, first, end, rows):
    """Copy X, Y, u, v, var_u, var_v of some stars to rows of `scratch`, and ones behind them."""
    X, Y, u, v, var_u, var_v = columns[:6]
    _copy(X[first:end], rows[0])
    _copy(Y[first:end], rows[1])
    _copy(u[first:end], rows[2])
    _copy(v[first:end], rows[3])
    _copy(var_u[first:end], rows[4])
    _copy(var_v[first:end], rows[5])


def share_out(loop: Callable[..., None], n: int, *arguments: Any) -> None:
    """Run loop(first, end, *arguments) over range(n), in parts if there are several threads."""
    threads = min(nb.get_num_threads(), n)
    if threads < 2:
        loop(0, n, *arguments)
        return
    edges = [n * part // (PARTS * threads) for part in range(PARTS * threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(loop, a, e, *arguments) for a, e in pairwise(edges)]:
            done.result()


def in_turn(function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
    """Results of a function that is called as by `map`, on all threads at a time."""
    threads = nb.get_num_threads()
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
    threads = nb.get_num_threads()
    nb.set_num_threads(threads if evaluations > THREADS_PAY else 1)
    try:
        yield
    finally:
        nb.set_num_threads(threads)


def set_threads(n: int) -> None:
    """Use at most `n` threads in this process from now on."""
    nb.set_num_threads(max(1, min(n, nb.config.NUMBA_NUM_THREADS, os.cpu_count() or 1)))
