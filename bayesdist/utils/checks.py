"""Checks of a run: value, limit, outcome, and the consequence for users of the numbers.

Each check is a row of the status table.  All warnings, and all reasons for which a verdict on a
requirement is left undecided, come from checks.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LEVELS = ("note", "pass", "warn", "fail")  # from the least to the worst
LARGER, EITHER = "larger", "either"

# order of the groups in the status table
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
    """Comparison of one diagnostic with its limit: a row of the status table."""

    group: str  # subject, one of `GROUPS` or a subject of another package
    name: str  # quantity that was checked, with its unit
    value: float | str = ""  # its value; empty if the sentence contains it
    limit: str = ""  # the limit in words; empty if there is none
    level: str = "note"  # 'pass', 'warn' or 'fail'; 'note' if there is no limit
    # consequence for users of the numbers, as a clause; empty if there is none
    sentence: str = ""
    # effect on the verdicts about requirements.  `LARGER`: the true errors can only be larger than
    # stated, so that no requirement counts as met, but a missed one remains missed.  `EITHER`: the
    # true errors may be larger or smaller, so that all requirements are undecided.  Empty: none.
    doubt: str = ""

    @property
    def text(self) -> str:
        """The sentence with its first letter capitalized."""
        return self.sentence[:1].upper() + self.sentence[1:]


def in_order(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Checks sorted by group; the order within each group is preserved."""
    places = {group: place for place, group in enumerate(GROUPS)}
    return tuple(sorted(checks, key=lambda check: places.get(check.group, len(GROUPS))))


def level_of(good: bool, bad: str = "fail") -> str:
    """'pass' if `good` (the criterion is met), otherwise the level `bad`."""
    return "pass" if good else bad


def worst(checks: Iterable[Check]) -> str:
    """Most severe level of the checks; 'pass' if there are none."""
    return max((check.level for check in checks), key=LEVELS.index, default="pass")


def warnings_of(checks: Iterable[Check]) -> tuple[str, ...]:
    """Sentences of the checks with level 'warn' or 'fail'."""
    return tuple(
        check.text for check in checks if check.sentence and check.level in ("warn", "fail")
    )


def doubts_of(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Checks that affect the verdicts about requirements (those with a `doubt`)."""
    return tuple(check for check in checks if check.doubt)
