"""Limits that decide something: each stands here once, with the reason for its value.

A limit on a size of the data below which a quantity is not computed at all is none of these; it
stands where it is computed.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """A number that decides, and why it is that number.

    Parameters
    ----------
    value : float
    sense : str
        'at most' or 'at least': on which side of it all is well.
    reason : str

    Examples
    --------
    >>> PARETO_K.met_by(0.4), PARETO_K.words
    (True, 'at most 0.7')
    """

    value: float
    sense: str
    reason: str

    def met_by(self, value: float) -> bool:
        """Whether a value is on the good side, or on the limit itself; never for NaN."""
        return value <= self.value if self.sense == "at most" else value >= self.value

    @property
    def words(self) -> str:
        """The limit as tables show it."""
        return f"{self.sense} {self.value:g}"


# -- sampling -------------------------------------------------------------------------------------

PARETO_K = Limit(
    0.7, "at most", "above it importance weights cannot be trusted (Vehtari et al. 2024)"
)
IMPORTANCE_EFFICIENCY = Limit(0.1, "at least", "below it the proposal has missed what it proposes")
MEAN_ERROR = Limit(0.1, "at most", "of a posterior sd: adds half a percent to the error of a mean")
DRAWS_PER_WALKER = Limit(
    5.0, "at least", "many walkers must not make up for walkers that do not mix"
)

# -- fit and quoted errors ------------------------------------------------------------------------

CHI2_TOO_SMALL = Limit(
    0.8, "at least", "per degree of freedom: quoted errors right within some ten percent"
)
CHI2_TOO_SMALL_CHANCE = Limit(1e-3, "at least", "probability of so small a chi-square by chance")
CHI2_TOO_LARGE = Limit(
    1.5, "at most", "per degree of freedom: quoted errors right within some twenty percent"
)
EXPOSURE_CHI2 = Limit(
    1.5, "at most", "times the chi-square of all exposures, or less by it: errors of one differ"
)
LEFT_OUT = Limit(
    0.2, "at most", "of the stars: rejection that takes more has shaped what it was to protect"
)
CONDITION = Limit(1e8, "at most", "leaves half the digits of a double")
QUOTED_ERRORS = Limit(
    20.0, "at most", "times the quoted errors, beyond which jitter would be nearly all there is"
)
FALSE_MAJORITY = Limit(0.5, "at most", "with more false than true matches these may be by chance")
WIDENED_ERRORS = Limit(
    5.0, "at most", "times the quoted error: a mixture that widens true matches to hold false ones"
)
MATCH_RADIUS = Limit(
    5.0, "at least", "errors of a star, within which true matches are lost about poor positions"
)
PIXEL_SIZE = Limit(3.0, "at most", "factor by which two kinds of pixels differ")
EPOCH_SHIFT = Limit(5.0, "at most", "standard errors: a shift is one of many things looked for")
TREND = Limit(
    1e-3, "at least", "probability of a trend of deviations by chance, over all of their kinds"
)
GAUGE_CONTRADICTION = Limit(
    1e-4, "at least", "probability of what is known of the gauge, given the detections"
)

# -- residuals ------------------------------------------------------------------------------------

STRUCTURE = Limit(
    1e-4, "at least", "probability of as much structure by chance, over all tests together"
)
STRUCTURE_SEEN = Limit(
    0.5, "at least", "of all patterns, below which that none is found says little"
)
STRUCTURE_IN_BUDGET = Limit(
    0.5, "at least", "of the structure that is found in residuals, for the budget to hold it"
)
SCORE_TESTS = Limit(
    1e-3, "at least", "probability that any test of a run finds something where nothing is"
)
UNCOVERED = Limit(0.05, "at most", "of the area: what may be missing at the edges of a detector")
UNCOVERED_BY_CHANCE = Limit(
    3.0, "at most", "times the gap that as many evenly scattered stars leave on average"
)
BEYOND_STARS = Limit(
    0.03, "at most", "of the longer side: a grid reaches this far beyond the outermost stars"
)

# -- held-out stars -------------------------------------------------------------------------------

HELD_OUT = Limit(50, "at least", "stars, without which nothing can be said")
HELD_OUT_UNUSUAL = Limit(0.01, "at least", "probability by chance, over all tests together")
HELD_OUT_DOUBTFUL = Limit(1e-3, "at least", "probability by chance that no verdict stands against")
HELD_OUT_RATIO = Limit(
    1.05, "at most", "of predicted errors: less is not material, however significant"
)
HELD_OUT_DISTRIBUTION = Limit(0.02, "at most", "of a distribution function: less is not material")
HELD_OUT_TAILS = Limit(1.5, "at most", "times the stars expected in tails: less is not material")

# -- matching -------------------------------------------------------------------------------------

COMPLETENESS = Limit(
    0.8, "at least", "below it stars are missed for a reason that selects among them"
)
FALSE_MATCHES = Limit(
    0.01, "at most", "the outlier model takes more, but so many say that matching went wrong"
)

# -- comparisons and verdicts ---------------------------------------------------------------------

DIFFERENCE = Limit(0.01, "at least", "probability by chance under which a difference is called one")
CONFIDENCE = Limit(0.99, "at least", "of the Monte-Carlo interval that a verdict rests on")
EXCEEDS = Limit(
    0.95, "at least", "probability that a limit is exceeded, for a requirement to be called missed"
)
COUNTING_ERROR = Limit(
    0.005, "at most", "of a probability near the one asked for, for its estimate to decide"
)

# -- files ----------------------------------------------------------------------------------------

SKY_CLOSURE = Limit(
    1e-3, "at most", "of a pixel: a header that misses its solution by more is wrong"
)
FILE_ERROR = Limit(0.3, "at most", "of the total error: it makes that 4 % larger")
