"""Tests and cases that only the full suites have (BAYESDIST_FULL=1)."""

from __future__ import annotations

import os
from typing import Any

import pytest

__all__ = ["FULL", "case_in_full", "only_in_full"]

FULL = os.environ.get("BAYESDIST_FULL", "") not in ("", "0")


def only_in_full(instead: str) -> pytest.MarkDecorator:
    """Mark of a test that is skipped in the reduced form; `instead` says what shows as much."""
    return pytest.mark.skipif(not FULL, reason=f"{instead}: set BAYESDIST_FULL=1")


def case_in_full(*values: Any, instead: str, id: str | None = None) -> Any:
    """Arguments of a parametrised test that the reduced form leaves out."""
    return pytest.param(*values, marks=[pytest.mark.slow, only_in_full(instead)], id=id)
