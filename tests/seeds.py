"""A function of many seeds, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from itertools import starmap
from multiprocessing import get_context
from typing import Any

from threadpoolctl import threadpool_limits

from bayesdist.infer import kernel


def over(function: Callable[..., Any], jobs: Iterable[tuple[Any, ...]], *, lot: int = 1) -> list:
    """Results for each of these arguments, in their order; a process takes so many at a time.

    Where the tests themselves run in several processes these have the cores already, and more
    processes would only import and compile everything once more: then it is done here.
    """
    jobs = list(jobs)
    if "PYTEST_XDIST_WORKER" in os.environ:
        return _here(function, jobs)
    workers = min(os.cpu_count() or 1, len(jobs))
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_one_thread) as pool:
        return list(pool.map(function, *zip(*jobs, strict=True), chunksize=lot))


def _here(function: Callable[..., Any], jobs: list[tuple[Any, ...]]) -> list:
    threads = kernel.get_threads()
    kernel.set_threads(1)
    try:
        with threadpool_limits(1):
            return list(starmap(function, jobs))
    finally:
        kernel.set_threads(threads)


def _one_thread() -> None:
    kernel.set_threads(1)
    threadpool_limits(1)
