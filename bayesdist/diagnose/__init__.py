"""Tests for what a model may lack: targeted, each with its size and its power."""

from bayesdist.diagnose.result import ScoreTest
from bayesdist.diagnose.tests import score_tests

__all__ = ["ScoreTest", "score_tests"]
