"""Fixtures of the tests of diagnoses."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bayesdist.infer import kernel


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Small data on a busy machine: waiting for a second thread costs more than it gives."""
    before = kernel.get_threads()
    kernel.set_threads(1)
    yield
    kernel.set_threads(before)
