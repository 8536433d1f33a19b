"""Workers on this machine that somebody else has started, as a user's cluster is."""

from __future__ import annotations

import logging

from distributed import LocalCluster

__all__ = ["local_workers"]


def local_workers(n: int) -> LocalCluster:
    """Cluster of n processes of one thread each, to be closed."""
    return LocalCluster(
        n_workers=n,
        threads_per_worker=1,
        memory_limit=0,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
