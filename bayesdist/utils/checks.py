"""Checks of a run, and the limits on diagnostics that they compare with.

Each check is a row of the status table: a value, its limit, the outcome, and the consequence for
users of the numbers.  All warnings, and all reasons for which a verdict on a requirement is left
undecided, come from checks.  Each limit is defined once, with the reason for its value.  Minimum
amounts of data, below which a quantity is not computed at all, are defined in the modules that
compute the quantity.
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


@dataclass(frozen=True)
class Limit:
    """Limit on a diagnostic, and the reason for its value.

    Parameters
    ----------
    value : float
        Number that a diagnostic is compared with.
    sense : str
        'at most' or 'at least': the side of the limit on which the criterion is met.
    reason : str
        Reason for the value, or its unit and meaning, for the documentation.

    Examples
    --------
    >>> PARETO_K.met_by(0.4), PARETO_K.words
    (True, 'at most 0.7')
    """

    value: float
    sense: str
    reason: str

    def met_by(self, value: float) -> bool:
        """True if a value meets the criterion or equals the limit; False for NaN."""
        return value <= self.value if self.sense == "at most" else value >= self.value

    @property
    def words(self) -> str:
        """Sense and value as shown in tables, such as 'at most 0.7'."""
        return f"{self.sense} {self.value:g}"


# -- sampling -------------------------------------------------------------------------------------
PARETO_K = Limit(
    0.7, "at most", "above it importance weights cannot be trusted (Vehtari et al. 2024)"
)
IMPORTANCE_EFFICIENCY = Limit(0.1, "at least", "below it the proposal misses part of the posterior")
MEAN_ERROR = Limit(0.1, "at most", "posterior sd: increases the error of a mean by half a percent")
DRAWS_PER_WALKER = Limit(
    5.0, "at least", "a large number of walkers must not hide that the walkers do not mix"
)

# -- fit and quoted errors ------------------------------------------------------------------------
CHI2_TOO_SMALL = Limit(
    0.8, "at least", "per degree of freedom: quoted errors right within some ten percent"
)
CHI2_TOO_SMALL_CHANCE = Limit(1e-3, "at least", "probability of a chi-square as small by chance")
CHI2_TOO_LARGE = Limit(
    1.5, "at most", "per degree of freedom: quoted errors right within some twenty percent"
)
EXPOSURE_CHI2 = Limit(
    1.5, "at most", "ratio, either way, to the chi-square of all exposures: its errors differ"
)
LEFT_OUT = Limit(
    0.2, "at most", "fraction of the stars: more rejections would shape the solution itself"
)
CONDITION = Limit(1e8, "at most", "half the digits of a double remain")
QUOTED_ERRORS = Limit(
    20.0, "at most", "times the quoted errors: beyond it the total error is almost all jitter"
)
FALSE_MAJORITY = Limit(
    0.5, "at most", "if most matches are false, the others may be chance matches"
)
WIDENED_ERRORS = Limit(
    5.0, "at most", "times the quoted error: beyond it the mixture absorbs false matches as true"
)
MATCH_RADIUS = Limit(
    5.0, "at least", "errors of a star: below it true matches of poorly measured stars are lost"
)
PIXEL_SIZE = Limit(3.0, "at most", "ratio of two pixel scales that can still be a coincidence")
EPOCH_SHIFT = Limit(5.0, "at most", "standard errors: a shift is one of many effects tested")
TREND = Limit(1e-3, "at least", "probability of a trend by chance, over all kinds of deviations")
GAUGE_CONTRADICTION = Limit(
    1e-4, "at least", "probability of the gauge constraints, given the detections"
)

# -- residuals ------------------------------------------------------------------------------------
STRUCTURE = Limit(
    1e-4, "at least", "probability of as much structure by chance, over all tests combined"
)
STRUCTURE_SEEN = Limit(
    0.5,
    "at least",
    "fraction of all patterns that would be detected: if fewer, no finding means little",
)
STRUCTURE_IN_BUDGET = Limit(
    0.5, "at least", "fraction of the structure found in residuals that the budget must include"
)
SCORE_TESTS = Limit(1e-3, "at least", "probability that any test of a run gives a false positive")
UNCOVERED = Limit(0.05, "at most", "fraction of the area: gaps at the edges of a detector")
UNCOVERED_BY_CHANCE = Limit(
    3.0, "at most", "times the mean gap left by the same number of uniformly scattered stars"
)
BEYOND_STARS = Limit(
    0.03,
    "at most",
    "of the longer side: distance of the grid's edge from the outermost stars",
)

# -- held-out stars -------------------------------------------------------------------------------
HELD_OUT = Limit(50, "at least", "stars: fewer do not constrain the errors")
HELD_OUT_UNUSUAL = Limit(0.01, "at least", "probability by chance, over all tests combined")
HELD_OUT_DOUBTFUL = Limit(1e-3, "at least", "probability by chance: below it no verdict is given")
HELD_OUT_RATIO = Limit(
    1.05,
    "at most",
    "times the predicted errors: a smaller excess is not material",
)
HELD_OUT_DISTRIBUTION = Limit(
    0.02, "at most", "of a distribution function: smaller is not material"
)
HELD_OUT_TAILS = Limit(1.5, "at most", "times the stars expected in tails: fewer are not material")

# -- matching -------------------------------------------------------------------------------------
COMPLETENESS = Limit(0.8, "at least", "below it the missing stars are probably a biased selection")
FALSE_MATCHES = Limit(
    0.01, "at most", "the outlier model tolerates more, but more suggest that matching failed"
)

# -- comparisons and verdicts ---------------------------------------------------------------------
DIFFERENCE = Limit(0.01, "at least", "probability by chance: below it a difference is significant")
CONFIDENCE = Limit(0.99, "at least", "level of the Monte-Carlo interval used for verdicts")
EXCEEDS = Limit(
    0.95, "at least", "probability that the limit is exceeded, for a requirement to count as missed"
)
COUNTING_ERROR = Limit(
    0.005, "at most", "Monte-Carlo error of a probability close to the required one, for a verdict"
)

# -- files ----------------------------------------------------------------------------------------
SKY_CLOSURE = Limit(
    1e-3, "at most", "pixels: a header that deviates from its solution by more is wrong"
)
FILE_ERROR = Limit(0.3, "at most", "of the total error: increases it by 4 %")
