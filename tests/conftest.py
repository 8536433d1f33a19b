"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real data, which are no part of the project."""
    folder = os.environ.get("BAYESDIST_DATA")
    if not folder:
        pytest.skip("BAYESDIST_DATA is not set: it names the folder of real data")
    if not Path(folder).is_dir():
        pytest.fail(f"BAYESDIST_DATA is {folder!r}, which is no folder")
    return Path(folder).resolve()


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in each run."""
    return np.random.default_rng(20150206)


@pytest.fixture(scope="session")
def full() -> bool:
    """Whether the statistical suites run at full size (BAYESDIST_FULL=1) or reduced."""
    return os.environ.get("BAYESDIST_FULL", "") not in ("", "0")
