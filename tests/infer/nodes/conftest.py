"""Fixtures of the tests of look-up tables."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(autouse=True)
def one_blas_thread() -> Iterator[None]:
    """Small matrices on a busy machine: waiting for a second thread costs more than it gives."""
    with threadpool_limits(1, user_api="blas"):
        yield
