"""Hold-out validation: stars that were set aside before the fit, compared with its predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.bins import Bin, partitions_of
from bayesdist.diagnose.holdout.frames import frames_for
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.holdout.sums import held_sums
from bayesdist.diagnose.holdout.tests import (
    AxisCoverage,
    HeldTest,
    all_tests,
    axis_coverage,
    deviation_tests,
)
from bayesdist.diagnose.significance import holm
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import HELD_OUT, HELD_OUT_DOUBTFUL, HELD_OUT_UNUSUAL
from bayesdist.utils.numbers import p_words

SAMPLE = 200_000  # stars that determine the edges of bins
# of importance: names of tests, the most informative first
ORDER = ("offset", "deviation", "spread", "tails", "distribution")


@dataclass(frozen=True, eq=False)
class HoldoutValidation:
    """Results of the comparison of held-out stars with the predictions of a solution."""

    unit: str  # of u and v
    n: int  # number of predicted stars
    n_left_out: int  # number of stars of exposures with too few stars for a frame
    exposures: tuple[str, ...]  # names of the exposures that were held out entirely
    tests: tuple[HeldTest, ...]  # most significant first
    # (3, bins) counts of the predictive probabilities: of u, of v given u, of the distance
    pit: Float
    regions: tuple[Bin, ...]
    region_n: Float  # (B,) number of stars
    # (B,) factor on the predicted errors in each region; NaN for too few stars
    region_scale: Float
    # (B, 2) mean offset from the prediction, in units of its predicted error
    region_offset: Float
    coverage: tuple[AxisCoverage, ...] = ()  # along each axis

    @property
    def coverage_words(self) -> str:
        """Fractions within one sigma along both axes, as a clause."""
        inner = [result for result in self.coverage if result.level == 1.0]
        return " and ".join(f"{result.value:.3f} along {result.axis}" for result in inner) + (
            f" of held-out stars lie within 1 sigma of their prediction, {inner[0].expected:.3f} "
            "are predicted"
        )

    @property
    def p_value(self) -> float:
        """Probability of so large a disagreement by chance, corrected for the number of tests."""
        return self.tests[0].p_corrected

    @property
    def level(self) -> str:
        """'pass', 'warn' or 'fail'."""
        if self.doubtful:
            return "fail"
        return "warn" if not HELD_OUT_UNUSUAL.met_by(self.p_value) else "pass"

    @property
    def doubtful(self) -> bool:
        """True if errors are significantly larger than the solution states."""
        return self._telling(HELD_OUT_DOUBTFUL.value) is not None

    @property
    def verdict(self) -> str:
        """Verdict as one clause."""
        test = self._telling(HELD_OUT_DOUBTFUL.value)
        if test is None and not HELD_OUT_UNUSUAL.met_by(self.p_value):
            test = self.tests[0]
        if test is None:
            return f"held-out stars agree with the prediction (p = {self.p_value:.2g})"
        return f"{self._words(test)} ({p_words(test.p_corrected)})"

    def _telling(self, level: float) -> HeldTest | None:
        """Most important significant test, or None.

        Only tests that imply larger errors than stated are considered.
        """
        significant = [t for t in self.tests if t.p_corrected < level and t.is_material]
        places = [t for t in significant if t.name in ("offset", "spread", "deviation")]
        return min(places or significant, key=_rank, default=None)

    def _words(self, test: HeldTest) -> str:
        place = f"{test.where}," if "held out whole" in test.where else test.where
        if test.name == "offset":
            return (
                f"{place} held-out stars lie {test.value:.2g} {self.unit} from where they are "
                "predicted"
            )
        if test.name == "spread":
            return (
                f"{place} the residuals of held-out stars are {test.value:.2g} times as large "
                "as predicted"
            )
        if test.name == "deviation":
            return (
                f"{place} deviates by {test.value:.2g} from the other exposures, which scatter"
                f" by {test.limit:.2g}"
            )
        if test.name == "tails":
            return (
                f"{test.value * test.n:.0f} of {test.n} held-out stars lie {test.where}, and "
                f"{test.expected * test.n:.2g} are predicted"
            )
        return f"the residuals {test.where} of held-out stars are not distributed as predicted"


def _rank(test: HeldTest) -> tuple[float, int, float, bool]:
    """Sort key of tests; ties occur because p-values underflow together.

    For an exposure with a unique date, the exposure precedes the date.
    """
    size = -abs(test.value - test.expected)
    return test.p_value, ORDER.index(test.name), size, test.part == "epoch"


def holdout_validation(
    predictive: Predictive, held: Matches, *, whole: Sequence[str] = ()
) -> HoldoutValidation:
    """Compare held-out stars with the prediction of a solution that was fitted without them.

    `whole` are the names of exposures that were held out entirely.  Raises InputError if there are
    too few stars, and if the prediction of a campaign lacks the deviations of its exposures.
    """
    sources = ", ".join(held.sources)
    if predictive.model.gauge != "first" and predictive.deviations is None:
        raise InputError(
            "the posterior of a campaign does not say how exposures scatter",
            where=sources,
            do="give a Predictive with deviations",
        )
    partitions = partitions_of(predictive.model, held, held.sample(SAMPLE), whole)
    frames = frames_for(predictive, held, held.exposure_names)
    sums = held_sums(predictive, held, partitions, frames)
    if not HELD_OUT.met_by(sums.n):
        raise InputError(
            f"{sums.n} held-out stars say too little of the solution",
            where=sources,
            do=f"hold out at least {HELD_OUT.value}: raise holdout.fraction",
        )
    tests = [*all_tests(sums, predictive, partitions), *deviation_tests(predictive, frames)]
    corrected = holm(np.array([t.p_value for t in tests]))
    tests = [replace(t, p_corrected=float(p)) for t, p in zip(tests, corrected, strict=True)]
    regions = next(p for p in partitions if p.kind == "region")
    region_sums = sums.bins["region"]
    has_stars = region_sums.n >= 1
    error = np.sqrt(np.einsum("bii->bi", region_sums.place_2))
    return HoldoutValidation(
        unit=predictive.model.unit,
        n=sums.n,
        n_left_out=sums.n_left_out,
        exposures=tuple(whole),
        tests=tuple(sorted(tests, key=_rank)),
        pit=np.stack([counts.sums for counts in sums.pit]),
        regions=regions.bins,
        region_n=region_sums.n,
        region_scale=np.array(
            [
                region_sums.scale.factor(b) if is_filled else np.nan
                for b, is_filled in enumerate(has_stars)
            ]
        ),
        region_offset=np.divide(
            region_sums.offset_scores, error, out=np.full_like(error, np.nan), where=error > 0
        ),
        coverage=axis_coverage(sums),
    )
