"""Tests for what a model may lack: targeted, each with its size and its power."""

from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.diagnose.score.tests import score_tests

__all__ = ["ScoreTest", "score_tests"]
