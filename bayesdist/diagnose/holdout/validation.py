"""Hold-out validation: tests of stars that were set aside before the fit against its predictions.

All statistics are sums of scores, which have zero mean if the prediction is correct.  They vary
with the single stars, and jointly through everything that all predictions share: the parameters of
the solution and of the mixture.  The covariances of these are propagated using the scores, which
are the derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betainc, erf

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.bins import ALL, Bin, Partition, partitions_of
from bayesdist.diagnose.holdout.predictive import Frame, Predictive, frames_for
from bayesdist.diagnose.holdout.sums import (
    LEVELS,
    PIT_BINS,
    STEP,
    TAILS,
    BinSums,
    HeldSums,
    ScaleSums,
    held_sums,
)
from bayesdist.diagnose.statistics import clopper_pearson, holm, hotelling_p
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import (
    HELD_OUT,
    HELD_OUT_DISTRIBUTION,
    HELD_OUT_DOUBTFUL,
    HELD_OUT_RATIO,
    HELD_OUT_TAILS,
    HELD_OUT_UNUSUAL,
)
from bayesdist.utils.distributions import chi2_sf, norm_sf
from bayesdist.utils.text import p_words

SAMPLE = 200_000  # stars that determine the edges of bins
# of importance: names of tests, the most informative first
ORDER = ("offset", "deviation", "spread", "tails", "distribution")
AXIS = "axis"  # part of the data: the stars, along one axis
INTERVAL = 0.95  # confidence level of the intervals of fractions
# a deviation is tested if its stars remove at least this fraction of its prior variance
MIN_INFORMATION = 0.5
MIN_STARS = 20  # minimum of a bin that is tested separately
STARS_PER_PIT_BIN = 20
SINGULAR = 0.05  # fraction of a variance below which frames have absorbed nearly all of it


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


@dataclass(frozen=True)
class HeldTest:
    """Result of one test of the held-out stars."""

    name: str  # 'offset', 'spread', 'distribution', 'tails' or 'deviation'
    part: str  # 'all', 'axis', 'region', 'magnitude', 'epoch', 'exposure' or 'place in exposure'
    where: str  # where the stars are, in words
    index: int  # of the bin in its partition; -1 for all bins together
    n: int  # number of stars
    # depends on the name: distance from the prediction in the unit of u and v; factor on the
    # predicted errors; largest difference of the distribution functions; fraction of stars beyond
    # the limit; deviation of an exposure
    value: float
    expected: float  # expectation of `value`: 0, 1, 0, the predicted fraction, or 0
    p_value: float
    p_corrected: float = 1.0  # corrected for the number of tests (Holm 1979)
    # 95 % confidence interval of a fraction, otherwise NaN
    interval: tuple[float, float] = (np.nan, np.nan)
    limit: float = np.nan  # of the tails, in sigma; prior scatter of a deviation; otherwise NaN
    wider: bool = True  # of distributions: True if the stars lie farther out than predicted

    @property
    def is_omnibus(self) -> bool:
        """True if all bins are tested together; `where` and `value` are those of the worst bin."""
        return self.index < 0

    @property
    def is_material(self) -> bool:
        """True if a significant result means that errors are larger than predicted."""
        if self.name == "spread":
            return not HELD_OUT_RATIO.met_by(self.value)
        if self.name == "distribution":
            return self.wider and not HELD_OUT_DISTRIBUTION.met_by(self.value)
        return (
            self.name in ("offset", "deviation")
            or self.value > HELD_OUT_TAILS.value * self.expected
        )


@dataclass(frozen=True)
class AxisCoverage:
    """Fraction of held-out stars in the central part of their prediction, on one axis."""

    axis: str  # 'u' or 'v'
    level: float  # in sigma of a normal distribution
    n: int  # number of stars
    # value, expected: observed and predicted fraction
    value: float
    expected: float
    interval: tuple[float, float]  # 95 % confidence interval of the fraction


def axis_coverage(sums: HeldSums) -> tuple[AxisCoverage, ...]:
    """Coverage along u and v at each level of `LEVELS`."""
    return tuple(
        AxisCoverage(
            axis,
            level,
            sums.n,
            float(sums.within[a, k]) / sums.n,
            float(erf(level / np.sqrt(2))),
            clopper_pearson(float(sums.within[a, k]) / sums.n, sums.n, INTERVAL),
        )
        for a, axis in enumerate("uv")
        for k, level in enumerate(LEVELS)
    )


def all_tests(
    sums: HeldSums, predictive: Predictive, partitions: Sequence[Partition]
) -> list[HeldTest]:
    """All tests for which there are enough stars, without correction for their number."""
    out = []
    for partition in partitions:
        bin_sums = sums.bins[partition.kind]
        out += _offsets(bin_sums, sums, predictive, partition)
        for b, bin_ in enumerate(partition.bins):
            if bin_sums.n[b] >= MIN_STARS:
                stars = partition.kind, bin_.words, b, int(bin_sums.n[b])
                out.append(_spread(bin_sums.scale, b, predictive, stars))
    for a, axis in enumerate(sums.axes):
        out.append(_spread(axis, 0, predictive, (AXIS, f"along {'uv'[a]}", a, sums.n)))
    return [*out, *_distributions(sums, predictive), *_tails(sums, predictive)]


def _offsets(
    found: BinSums, sums: HeldSums, predictive: Predictive, partition: Partition
) -> list[HeldTest]:
    """Tests of the mean offsets from the predictions: per bin, then for all bins together."""
    # scores of the position are odd functions: on average the mixture's parameters do not change
    # them
    cov = found.place.covariance(predictive, sums.frames, mixture=False) + found.place_cov
    out, good = [], []
    for b, bin_ in enumerate(partition.bins):
        pair = slice(2 * b, 2 * b + 2)
        smallest = np.linalg.eigvalsh(cov[pair, pair])[0]
        n = found.independent[b]
        if n < MIN_STARS or smallest < 2 * SINGULAR * np.trace(found.place_2[b]):
            continue
        good.append(b)
        score = found.offset_scores[b]
        t = float(score @ np.linalg.solve(cov[pair, pair], score))
        # the variance is estimated from the same scores, as in Hotelling's test about zero
        p = hotelling_p(t, 2, int(n))
        size = float(np.hypot(*(score / found.weight[b])))
        out.append(HeldTest("offset", partition.kind, bin_.words, b, int(found.n[b]), size, 0.0, p))
    if len(good) > 1:
        rows = np.ravel([[2 * b, 2 * b + 1] for b in good])
        root = np.sqrt(np.diag(cov)[rows])
        values, vectors = np.linalg.eigh(cov[np.ix_(rows, rows)] / np.outer(root, root))
        along = vectors.T @ (found.place.sums[rows] / root)
        determined = values > SINGULAR
        t, dof = float((along[determined] ** 2 / values[determined]).sum()), int(determined.sum())
        p = float(chi2_sf(t, dof))
        if sums.shared is not None:
            p = hotelling_p(t, dof, sums.shared.n_stars)
        worst = min(out, key=lambda test: (test.p_value, -test.value))
        out.append(
            HeldTest(
                "offset", partition.kind, worst.where, -1, int(found.n.sum()), worst.value, 0.0, p
            )
        )
    return out


def _spread(
    sums: ScaleSums, k: int, predictive: Predictive, stars: tuple[str, str, int, int]
) -> HeldTest:
    """Test of the scatter of the true matches of one group.

    `stars` contains the part, its description, index and number of stars.
    """
    p = sums.p_value(k, predictive.free_cov)
    return HeldTest("spread", *stars, sums.factor(k), 1.0, p)


def _distributions(sums: HeldSums, predictive: Predictive) -> list[HeldTest]:
    """Tests of the predictive probabilities, which should be uniform."""
    merge, shared = 1, sums.shared
    n = sums.n if shared is None else shared.n_stars
    while merge < PIT_BINS // 4 and n * merge < STARS_PER_PIT_BIN * PIT_BINS:
        merge = {1: 2, 2: 4, 4: 5}[merge]
    m = PIT_BINS // merge
    # counts in merged bins, minus the mean over all bins
    merged = np.asarray(np.kron(np.eye(m), np.ones(merge)) - 1 / m, np.float64)
    middle = sums.pit[2].sums @ (np.arange(PIT_BINS) + 0.5)
    wider = bool(middle > sums.n * PIT_BINS / 2)
    out = []
    for k, description in enumerate(("of u", "of v", "of their distances")):
        counts = sums.pit[k].mapped(merged)
        cov = sums.n * (np.eye(m) / m - 1 / m**2)
        if shared is not None:
            cov = shared.pit_covariance(k, merge)
        cov += counts.covariance(predictive, sums.frames, mixture=True)
        deviations = counts.sums[:-1]
        t = float(deviations @ np.linalg.solve(cov[:-1, :-1], deviations))
        p = float(chi2_sf(t, m - 1))
        if shared is not None and shared.stars_repeat:
            p = hotelling_p(t, m - 1, n)
        below = np.cumsum(sums.pit[k].sums) / sums.n
        size = float(np.abs(below - np.arange(1, PIT_BINS + 1) / PIT_BINS).max())
        out.append(HeldTest("distribution", ALL, description, k, sums.n, size, 0.0, p, wider=wider))
    return out


def _tails(sums: HeldSums, predictive: Predictive) -> list[HeldTest]:
    """Tests of the number of stars that lie far out, including false matches."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    weights = weights / weights.sum()
    sd = np.sqrt(np.diag(predictive.free_cov))
    out = []
    for k, limit in enumerate(TAILS):
        middle = max(sums.expected[k, 0], 1e-300)
        low, high = np.maximum(sums.expected[k, 1:].reshape(-1, 2).T, 1e-300)
        slope = np.divide(np.log(high / low), 2 * STEP * sd, out=np.zeros_like(sd), where=sd > 0)
        spread = np.sqrt(max(slope @ predictive.free_cov @ slope, 0.0))
        share = np.minimum(middle * np.exp(spread * nodes) / sums.n, 1.0)
        observed = int(sums.beyond[k])
        overdispersion = 1.0 if sums.shared is None else sums.shared.overdispersion(limit)
        below = float(weights @ _at_most(observed / overdispersion, sums.n / overdispersion, share))
        above = float(
            weights @ _at_least(observed / overdispersion, sums.n / overdispersion, share)
        )
        interval = clopper_pearson(observed / sums.n, sums.n, INTERVAL)
        p = float(min(1.0, 2 * min(below, above)))
        out.append(
            HeldTest(
                "tails",
                ALL,
                f"beyond {limit:g} sigma",
                k,
                sums.n,
                observed / sums.n,
                middle / sums.n,
                p,
                interval=interval,
                limit=limit,
            )
        )
    return out


def _at_least(k: float, n: float, share: Float) -> Float:
    """Probability of at least k successes out of n; neither needs to be an integer."""
    return np.asarray(betainc(k, n - k + 1, share)) if k > 0 else np.ones_like(share)


def _at_most(k: float, n: float, share: Float) -> Float:
    """Probability of at most k successes out of n."""
    return np.asarray(1 - betainc(k + 1, n - k, share)) if k < n else np.ones_like(share)


def deviation_tests(predictive: Predictive, frames: Mapping[str, Frame]) -> list[HeldTest]:
    """Compare deviations of exposures that were held out entirely with the scatter of the others.

    Scale, shears and chip positions of such an exposure are fitted to its stars before the stars
    are tested, so that errors of these do not show in the residuals.  If b and v are the estimate
    of one deviation and its variance from the stars alone, with all other deviations following
    their scatter,

        b ~ N(0, tau^2 + v + w)

    where tau are draws of the scatter and w is the contribution of the solution's errors to b.  The
    p-value is averaged over the draws.  The `limit` of a test is the scatter.
    """
    deviations = predictive.deviations
    if deviations is None:
        return []
    n = predictive.model.n_distortion
    C, out = predictive.cov[:n, :n], []
    for name, frame in frames.items():
        weight = 1 - frame.precision * np.diag(frame.spent)
        by_solution = frame.spent @ frame.shared
        extra = np.einsum("qn,nm,qm->q", by_solution, C, by_solution)
        for kind, tau in zip(deviations.kinds, deviations.tau.T, strict=True):
            k = frame.names.index(kind)
            if weight[k] < MIN_INFORMATION:
                continue
            # remove the effect of the prior on the estimate
            b = frame.values[k] / weight[k]
            v = frame.spent[k, k] / weight[k] + extra[k] / weight[k] ** 2
            p = float(np.mean(2 * norm_sf(abs(b) / np.sqrt(tau**2 + v))))
            description = f"the {kind.replace('_', ' ')} of exposure {name}, held out whole"
            scatter = float(np.sqrt(np.mean(tau**2)))
            out.append(
                HeldTest(
                    "deviation",
                    "exposure",
                    description,
                    k,
                    frame.n,
                    float(b),
                    0.0,
                    p,
                    limit=scatter,
                )
            )
    return out
