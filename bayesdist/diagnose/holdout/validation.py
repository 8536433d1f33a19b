"""Held-out truth: stars that were set aside before the fit, against what it predicts of them."""

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

SAMPLE = 200_000  # stars that say where bins end
ORDER = ("offset", "deviation", "spread", "tails", "distribution")  # of what tells most


@dataclass(frozen=True, eq=False)
class HoldoutValidation:
    """Results of held-out stars against a solution."""

    unit: str  # of u and v
    n: int  # stars that were predicted
    n_left_out: int  # of exposures with too few stars for a frame of their own
    exposures: tuple[str, ...]  # held out whole
    tests: tuple[HeldTest, ...]  # the most telling first
    # (3, bins) counts of the predictive probabilities: of u, of v given u, of the distance
    pit: Float
    regions: tuple[Bin, ...]
    region_n: Float  # (B,)
    # (B,) factor on the predicted errors in each region; NaN where there are too few stars
    region_scale: Float
    # (B, 2) mean offset from the prediction, in units of its own predicted error
    region_offset: Float
    coverage: tuple[AxisCoverage, ...] = ()  # along each axis

    @property
    def coverage_words(self) -> str:
        """Fractions within one sigma along both axes, as a clause."""
        found = [one for one in self.coverage if one.level == 1.0]
        return " and ".join(f"{one.value:.3f} along {one.axis}" for one in found) + (
            f" of held-out stars lie within 1 sigma of their prediction, {found[0].expected:.3f} "
            "are predicted"
        )

    @property
    def p_value(self) -> float:
        """Probability of so much disagreement by chance, over all tests together."""
        return self.tests[0].p_corrected

    @property
    def level(self) -> str:
        """'pass', 'warn' or 'fail'."""
        if self.doubtful:
            return "fail"
        return "warn" if not HELD_OUT_UNUSUAL.met_by(self.p_value) else "pass"

    @property
    def doubtful(self) -> bool:
        """True where errors are larger than the solution states, beyond chance."""
        return self._telling(HELD_OUT_DOUBTFUL.value) is not None

    @property
    def verdict(self) -> str:
        """One clause."""
        found = self._telling(HELD_OUT_DOUBTFUL.value)
        if found is None and not HELD_OUT_UNUSUAL.met_by(self.p_value):
            found = self.tests[0]
        if found is None:
            return f"held-out stars agree with the prediction (p = {self.p_value:.2g})"
        return f"{self._words(found)} ({p_words(found.p_corrected)})"

    def _telling(self, level: float) -> HeldTest | None:
        """The test that tells most of those that matter."""
        found = [t for t in self.tests if t.p_corrected < level and t.is_material]
        places = [t for t in found if t.name in ("offset", "spread", "deviation")]
        return min(places or found, key=_rank, default=None)

    def _words(self, test: HeldTest) -> str:
        where = f"{test.where}," if "held out whole" in test.where else test.where
        if test.name == "offset":
            return (
                f"{where} held-out stars lie {test.value:.2g} {self.unit} from where they are "
                "predicted"
            )
        if test.name == "spread":
            return (
                f"{where} the residuals of held-out stars are {test.value:.2g} times as large "
                "as predicted"
            )
        if test.name == "deviation":
            return (
                f"{where} deviates by {test.value:.2g} from the other exposures, which scatter"
                f" by {test.limit:.2g}"
            )
        if test.name == "tails":
            return (
                f"{test.value * test.n:.0f} of {test.n} held-out stars lie {test.where}, and "
                f"{test.expected * test.n:.2g} are predicted"
            )
        return f"the residuals {test.where} of held-out stars are not distributed as predicted"


def _rank(test: HeldTest) -> tuple[float, int, float, bool]:
    """Key by which tests are sorted: tails of distributions underflow together.

    Of an exposure that is alone at its date the exposure is named.
    """
    size = -abs(test.value - test.expected)
    return test.p_value, ORDER.index(test.name), size, test.part == "epoch"


def holdout_validation(
    predictive: Predictive, held: Matches, *, whole: Sequence[str] = ()
) -> HoldoutValidation:
    """Results of stars that a solution has not seen, against its prediction.

    Of the exposures `whole` all stars were held out. Raises InputError for too few stars, and for a
    campaign's prediction without deviations of its exposures.
    """
    where = ", ".join(held.sources)
    if predictive.model.gauge != "first" and predictive.deviations is None:
        raise InputError(
            "the posterior of a campaign does not say how exposures scatter",
            where=where,
            do="give a Predictive with deviations",
        )
    partitions = partitions_of(predictive.model, held, held.sample(SAMPLE), whole)
    frames = frames_for(predictive, held, held.exposure_names)
    sums = held_sums(predictive, held, partitions, frames)
    if not HELD_OUT.met_by(sums.n):
        raise InputError(
            f"{sums.n} held-out stars say too little of the solution",
            where=where,
            do=f"hold out at least {HELD_OUT.value}: raise holdout.fraction",
        )
    tests = [*all_tests(sums, predictive, partitions), *deviation_tests(predictive, frames)]
    corrected = holm(np.array([t.p_value for t in tests]))
    tests = [replace(t, p_corrected=float(p)) for t, p in zip(tests, corrected, strict=True)]
    regions = next(p for p in partitions if p.kind == "region")
    found = sums.bins["region"]
    seen = found.n >= 1
    error = np.sqrt(np.einsum("bii->bi", found.place_2))
    return HoldoutValidation(
        unit=predictive.model.unit,
        n=sums.n,
        n_left_out=sums.n_left_out,
        exposures=tuple(whole),
        tests=tuple(sorted(tests, key=_rank)),
        pit=np.stack([counts.sums for counts in sums.pit]),
        regions=regions.bins,
        region_n=found.n,
        region_scale=np.array(
            [found.scale.factor(b) if some else np.nan for b, some in enumerate(seen)]
        ),
        region_offset=np.divide(
            found.offset_scores, error, out=np.full_like(error, np.nan), where=error > 0
        ),
        coverage=axis_coverage(sums),
    )
