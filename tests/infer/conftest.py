"""Fixtures of the tests of inference."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bayesdist.infer import kernel

# files whose tasks go to workers
ON_WORKERS = ("tests.infer.stars.test_cluster", "tests.infer.selfcal.test_cluster")


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Small data on a busy machine: waiting for a second thread costs more than it gives."""
    before = kernel.get_threads()
    kernel.set_threads(1)
    yield
    kernel.set_threads(before)


@pytest.fixture(scope="module")
def forked_workers() -> Iterator[None]:
    """Workers of Dask start in no time."""
    from tests.infer.workers import forked  # dask, which other tests do not need

    with forked(*ON_WORKERS):
        yield
