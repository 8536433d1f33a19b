"""One list of checks, and what is read from it."""

from __future__ import annotations

from bayesdist.utils.checks import EITHER, LARGER, Check, doubts_of, level_of, warnings_of, worst

NOTE = Check("Errors", "Stated", sentence="no error is stated", doubt=LARGER)
WARN = Check("Fit", "Size", level="warn", sentence="residuals are large")
GOOD = Check("Fit", "Condition", 12.0, "at most 1e8", level_of(True))
BAD = Check("Sampling", "Converged", "NO", "yes", level_of(False), "it is not", EITHER)
ALL = (NOTE, WARN, GOOD, BAD)


def test_warnings_are_sentences_of_what_warns_or_fails():
    assert warnings_of(ALL) == ("Residuals are large", "It is not")


def test_doubts_may_be_silent():
    assert doubts_of(ALL) == (NOTE, BAD)


def test_the_worst_level_counts():
    assert worst(ALL) == "fail" and worst((NOTE, WARN, GOOD)) == "warn"
    assert worst((NOTE, GOOD)) == "pass" and worst(()) == "pass"
