"""Workers on this machine that somebody else has started, as a user's cluster is."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver

import dask
from distributed import LocalCluster
from distributed.utils import get_mp_context

__all__ = ["forked", "local_workers"]


@contextmanager
def forked(*modules: str) -> Iterator[None]:
    """Context in which workers are forks of one process that has imported these modules.

    Each by itself would import them anew, for seconds.
    """
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        get_mp_context().set_forkserver_preload(["distributed.worker", *modules])
        forkserver.ensure_running()
        yield


def local_workers(n: int) -> LocalCluster:
    """Cluster of n processes of one thread each, to be closed."""
    return LocalCluster(
        n_workers=n,
        threads_per_worker=1,
        memory_limit=0,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
