"""Division of the stars into chunks, and the threads that process them.

Python threads are used instead of those of numba.  The latter require several compilations of each
pass and do not survive a fork.  Merely asking numba for their number would start them and fix the
start method of further processes.
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

from bayesdist.infer.kernel.lanes import FAST, INNER, WIDTH, copy, load, put
from bayesdist.infer.kernel.numeric import evaluate, whole_vectors
from bayesdist.utils.arrays import Float, Int

# options of compiled passes; a check for division by zero would prevent vectorisation
PASS: dict[str, Any] = {
    "cache": True,
    "no_cfunc_wrapper": True,
    "nogil": True,
    "fastmath": FAST,
    "error_model": "numpy",
}

BLOCK = 256  # stars per block, so that the scratch arrays fit the first-level cache
THREADS_PAY = 200_000  # with fewer evaluations (stars times draws), one thread is faster
_threads: ContextVar[int] = ContextVar("threads", default=nb.config.NUMBA_NUM_THREADS)
PARTS = 4  # tasks per thread, to balance the load


def pieces_of(starts: Int, size: int) -> Int:
    """Divide the stars into pieces of at most `size` stars, each within one group.

    Parameters
    ----------
    starts : ndarray of int, shape (G + 1,)
        Index of the first star of each group, and the total number.
    size : int
        Maximum number of stars per piece.

    Returns
    -------
    ndarray of int, shape (n, 3)
        Group, first star, and end of each piece.
    """
    first = [np.arange(a, b, size) for a, b in pairwise(starts)]
    group = np.repeat(np.arange(len(first)), [len(f) for f in first])
    begin = np.concatenate([*first, np.zeros(0, np.int64)]).astype(np.int64)
    end = np.minimum(begin + size, np.asarray(starts)[group + 1])
    return np.column_stack([group, begin, end]).astype(np.int64)


def aligned(*shape: int) -> Float:
    """Array of zeros, of the given shape, that is aligned to the cache lines."""
    size = math.prod(shape)
    room = np.zeros(size + 8)
    first = -(room.ctypes.data // 8) % 8
    return room[first : first + size].reshape(shape)


def scratch(n: int) -> Float:
    """Aligned zeros (n, BLOCK): n scratch rows for the stars of a block."""
    return aligned(n, BLOCK)


def star_room() -> tuple[Float, Float]:
    """Scratch rows for the columns of a block of stars (8), and for the model positions (2)."""
    return scratch(8), scratch(2)


@nb.njit(**INNER)
def put_ones(rows, n):
    """Fill the rows of a scratch array with ones after the first n stars."""
    whole_vectors()
    for k in range(len(rows)):
        for s in range(n, BLOCK):
            rows[k, s] = 1.0


@nb.njit(**INNER)
def lay_out(columns, first, end, rows):
    """Copy the columns of the stars first..end to scratch rows, followed by ones.

    The columns are X, Y, u, v, var_u, var_v and, unless they are empty, the cosine and sine of the
    angle from u to the first principal axis of a star's errors.  u, v and the variances are then
    along the principal axes.
    """
    whole_vectors()
    n = end - first
    copy(columns[0], first, n, rows, 0)
    copy(columns[1], first, n, rows, 1)
    copy(columns[2], first, n, rows, 2)
    copy(columns[3], first, n, rows, 3)
    copy(columns[4], first, n, rows, 4)
    copy(columns[5], first, n, rows, 5)
    if len(columns[6]):
        copy(columns[6], first, n, rows, 6)
        copy(columns[7], first, n, rows, 7)
    put_ones(rows, n)


@nb.njit(**INNER)
def modelled(columns, coef, order, stars, n, model):
    """Write the positions of n stars by coefficients (2, K), along the axes of `lay_out`."""
    whole_vectors()
    evaluate(coef, order, stars, n, model)
    if len(columns[6]):
        for s in range(0, n, WIDTH):
            c, d = load(stars, 6, s), load(stars, 7, s)
            u, v = load(model, 0, s), load(model, 1, s)
            put(model, 0, s, c * u + d * v)
            put(model, 1, s, c * v - d * u)


@nb.njit(**INNER)
def off_axes(columns, stars, n, weighted, vectors):
    """Turn weights of n stars from the principal axes of their errors to u and v.

    The first three rows of `weighted` are matrices uu, uv, vv; pairs of rows from the third on, as
    many as `vectors`, are vectors.
    """
    whole_vectors()
    if len(columns[6]):
        for s in range(0, n, WIDTH):
            c, d = load(stars, 6, s), load(stars, 7, s)
            cc, cd, dd = c * c, c * d, d * d
            uu, uv, vv = load(weighted, 0, s), load(weighted, 1, s), load(weighted, 2, s)
            put(weighted, 0, s, cc * uu - 2.0 * cd * uv + dd * vv)
            put(weighted, 1, s, cd * (uu - vv) + (cc - dd) * uv)
            put(weighted, 2, s, dd * uu + 2.0 * cd * uv + cc * vv)
            for k in range(3, 3 + 2 * vectors, 2):
                u, v = load(weighted, k, s), load(weighted, k + 1, s)
                put(weighted, k, s, c * u - d * v)
                put(weighted, k + 1, s, d * u + c * v)


def share_out(
    loop: Callable[..., None],
    n: int,
    *arguments: Any,
    room: Callable[[], tuple[Float, ...]] = tuple,
) -> None:
    """Run loop(first, end, *arguments) over range(n), in parallel if there are several threads.

    Each task calls `room` for its scratch arrays, which are passed before the other arguments.
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
    """Thread pool, kept alive because starting threads takes longer than a pass over few stars."""
    return ThreadPoolExecutor(threads)


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive it


def in_turn(function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
    """Like `map`, but runs the calls in parallel threads; results are in the order of the input."""
    threads = get_threads()
    if threads < 2:
        yield from map(function, *arguments)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, *arguments)


def at_once(function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
    """Like `in_turn`, but returns a list."""
    return list(in_turn(function, *arguments))


@contextmanager
def threads_for(evaluations: float) -> Iterator[None]:
    """Context that uses a single thread if there are too few evaluations for several."""
    token = _threads.set(get_threads() if evaluations > THREADS_PAY else 1)
    try:
        yield
    finally:
        _threads.reset(token)


def get_threads() -> int:
    """Maximum number of threads of a pass.

    The default is that of NUMBA_NUM_THREADS, or the number of processors.

    Returns
    -------
    int
    """
    return _threads.get()


def set_threads(n: int) -> None:
    """Set the maximum number of threads for passes started by the calling thread.

    Parameters
    ----------
    n : int
        Maximum number of threads, limited to the number of processors and NUMBA_NUM_THREADS.
    """
    _threads.set(max(1, min(n, nb.config.NUMBA_NUM_THREADS, os.cpu_count() or 1)))
