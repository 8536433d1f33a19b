"""Checks: what was found, against what limit, and what it means for whoever uses the numbers.

Each is a row of the status table: nothing warns, and nothing keeps a verdict open, that has none.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LEVELS = ("note", "pass", "warn", "fail")  # from the least to the worst
LARGER, EITHER = "larger", "either"

# in which order a reader meets them
GROUPS = (
    "Held-out truth",
    "Sampling",
    "Campaign",
    "Gauge",
    "Score tests",
    "Fit",
    "Matching",
    "Errors",
    "Assumptions",
    "Periods",
    "Requirements",
    "Validity",
    "Products",
)


@dataclass(frozen=True)
class Check:
    """One criterion."""

    group: str  # what it concerns: one of `GROUPS`
    name: str  # what was checked, with its unit
    value: float | str = ""  # what was found; empty where the sentence says it
    limit: str = ""  # what is asked, in words; empty where nothing is
    level: str = "note"  # 'pass', 'warn', 'fail', or 'note' where nothing is asked
    # what a reader of the numbers has to know, as a clause; empty where that is nothing
    sentence: str = ""
    # what the sentence does to verdicts: `LARGER` where errors can only be larger for it, so that
    # nothing is met, and what is missed is missed all the same; `EITHER` where errors may be
    # smaller too, so that nothing is decided; empty where verdicts stand
    doubt: str = ""

    @property
    def text(self) -> str:
        """The sentence with a capital."""
        return self.sentence[:1].upper() + self.sentence[1:]


def in_order(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Checks by their groups, in each as they come."""
    return tuple(sorted(checks, key=lambda one: GROUPS.index(one.group)))


def level_of(good: bool, bad: str = "fail") -> str:
    """'pass' for what is good, else another level."""
    return "pass" if good else bad


def worst(checks: Iterable[Check]) -> str:
    """The worst level of some checks; 'pass' where nothing is wrong."""
    return max((one.level for one in checks), key=LEVELS.index, default="pass")


def warnings_of(checks: Iterable[Check]) -> tuple[str, ...]:
    """Sentences of the checks that warn or fail."""
    return tuple(one.text for one in checks if one.sentence and one.level in ("warn", "fail"))


def doubts_of(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Checks that keep verdicts from being given."""
    return tuple(one for one in checks if one.doubt)
