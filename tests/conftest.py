"""What all tests share."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from bayesdist.infer import kernel
from bayesdist.plugin import SELECTION
from tests import ALONE
from tests.reduced import FULL

# files whose tasks go to workers
ON_WORKERS = ("tests.infer.stars.test_cluster", "tests.kinds.selfcal.infer.test_cluster")

if not ALONE:
    kernel.set_threads(1)

# how long an example takes says nothing of the code on a machine that has other things to do
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


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
    return FULL


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


@pytest.fixture(autouse=True)
def captured_log() -> None:
    """The package's log reaches `caplog`, also after a command line that an earlier test ran."""
    logging.getLogger("bayesdist").propagate = True


@pytest.fixture(scope="session", autouse=True)
def unsynced(full) -> Iterator[None]:
    """Files need not reach the disk, for which a run waits a hundred times; unless run in full."""
    with pytest.MonkeyPatch.context() as patch:
        if not full:
            patch.setattr("bayesdist.files.atomic.os.fsync", lambda number: None)
        yield


# A run compiles the kernels that most tests need, and the files beside it none: a machine that has
# none of them yet compiles once, not in each process.  What takes long is not left for the end.
FIRST = (
    "tests/app/test_run.py",
    *("tests/data/", "tests/model/", "tests/missions/wise/", "tests/report/"),
    *("tests/campaign/", "tests/app/campaign/", "tests/test_new_instrument.py"),
    *("tests/test_docs.py", "tests/test_examples.py", "tests/real/"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The order of FIRST, then that of the folders; tests that need plugins are skipped without."""
    if os.environ.get(SELECTION) == "":
        hidden = pytest.mark.skip(reason=f"{SELECTION} hides kinds, formats and missions")
        for item in items:
            if item.get_closest_marker("plugins"):
                item.add_marker(hidden)

    def place(item: pytest.Item) -> int:
        return next((k for k, name in enumerate(FIRST) if item.nodeid.startswith(name)), len(FIRST))

    items.sort(key=place)


def pytest_collection_finish() -> None:
    """Modules and tests stay: the garbage collector need not look at them again and again."""
    gc.collect()
    gc.freeze()


# folders whose files look at the same thing, which is long in the making
TOGETHER = ("tests/campaign/", "tests/report/", "tests/kinds/selfcal/runs/", "tests/app/campaign/")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """One process for all files of a folder of TOGETHER: what they share is made once."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            own = super()._split_scope(nodeid)
            return next((folder for folder in TOGETHER if own.startswith(folder)), own)

    return Scheduling(config, log) if config.getvalue("dist") == "loadfile" else None
