"""Targeted tests for effects that a model may lack, with the size and the power of each test."""

from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.diagnose.score.tests import score_tests

__all__ = ["ScoreTest", "score_tests"]
