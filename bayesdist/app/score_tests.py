"""Score tests of a run, as rows of summary.json."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bayesdist.app.rundir import RunDirectory
from bayesdist.diagnose import ScoreTest

__all__ = ["keep_score_tests", "kept_score_tests"]

log = logging.getLogger("bayesdist")


def keep_score_tests(run: RunDirectory, tests: Sequence[ScoreTest]) -> None:
    """Write the tests for the stages that follow, and log what they found."""
    run.summarise(score_tests=[_row(test) for test in tests])
    for test in tests:
        if test.significant:
            log.info("assess: %s: %s", test.finding, test.remedy)


def kept_score_tests(run: RunDirectory) -> tuple[ScoreTest, ...]:
    """Tests that an earlier stage wrote; none where there are none."""
    return tuple(
        ScoreTest(**{k: np.inf if v is None and k == "smallest" else v for k, v in row.items()})
        for row in run.summary.get("score_tests") or ()
    )


def _row(test: ScoreTest) -> dict[str, Any]:
    row = asdict(test)
    # JSON has no infinity: what no effect can show has no smallest size
    return row | {"smallest": test.smallest if np.isfinite(test.smallest) else None}
