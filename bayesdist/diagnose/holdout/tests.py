"""Tests of held-out stars, from their sums.

All statistics are sums of scores, whose mean is zero where the prediction is right.  They vary with
the stars themselves, and together through what all predictions share: the solution's parameters and
those of the mixture, whose covariances are carried through (the scores are the derivatives).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, erf

from bayesdist.diagnose.holdout.bins import ALL, Partition
from bayesdist.diagnose.holdout.frames import Frame
from bayesdist.diagnose.holdout.grouped import ScaleSums
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.holdout.sums import LEVELS, PIT_BINS, STEP, TAILS, BinSums, HeldSums
from bayesdist.diagnose.significance import clopper_pearson, hotelling_p
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_sf, norm_sf
from bayesdist.utils.limits import HELD_OUT_DISTRIBUTION, HELD_OUT_RATIO, HELD_OUT_TAILS

AXIS = "axis"  # a part: the stars along one axis

INTERVAL = 0.95  # of fractions
MIN_INFORMATION = 0.5  # fraction of a deviation's prior variance that stars take off, to be tested
MIN_STARS = 20  # of a bin that is judged by itself
STARS_PER_PIT_BIN = 20
SINGULAR = 0.05  # of a variance: what is left where frames have taken up nearly all


@dataclass(frozen=True)
class HeldTest:
    """One question that held-out stars were asked."""

    name: str  # 'offset', 'spread', 'distribution', 'tails' or 'deviation'
    part: str  # 'all', 'axis', 'region', 'magnitude', 'epoch', 'exposure' or 'place in exposure'
    where: str  # in words
    index: int  # of the bin in its partition; -1 for all bins together
    n: int  # stars
    # distance from the prediction in the unit of u, v; factor on the predicted errors; largest
    # difference of distribution functions; fraction of stars beyond the limit; deviation of an
    # exposure
    value: float
    expected: float  # 0, 1, 0, the expected fraction, or 0
    p_value: float
    p_corrected: float = 1.0  # for the number of tests (Holm 1979)
    interval: tuple[float, float] = (np.nan, np.nan)  # of a fraction, 95 %; else NaN
    limit: float = np.nan  # of the tails, in sigma; else NaN
    wider: bool = True  # of distributions: True where stars lie farther out than predicted

    @property
    def is_omnibus(self) -> bool:
        """True where all bins are tested at once; `where` and `value` are of the worst."""
        return self.index < 0

    @property
    def is_material(self) -> bool:
        """True where errors would be larger than predicted, if it is no chance."""
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
    """Fraction of held-out stars in the middle of their predictions along an axis."""

    axis: str  # 'u' or 'v'
    level: float  # in sigma of a normal variable
    n: int  # stars
    # value, expected: fraction of them, and the predicted one
    value: float
    expected: float
    interval: tuple[float, float]  # of the fraction, 95 %


def axis_coverage(sums: HeldSums) -> tuple[AxisCoverage, ...]:
    """Coverage along u and v at each level."""
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
    """Tests that there are enough stars for, without correction."""
    out = []
    for partition in partitions:
        found = sums.bins[partition.kind]
        out += _offsets(found, sums, predictive, partition)
        for b, bin_ in enumerate(partition.bins):
            if found.n[b] >= MIN_STARS:
                stars = partition.kind, bin_.words, b, int(found.n[b])
                out.append(_spread(found.scale, b, predictive, stars))
    for a, axis in enumerate(sums.axes):
        out.append(_spread(axis, 0, predictive, (AXIS, f"along {'uv'[a]}", a, sums.n)))
    return [*out, *_distributions(sums, predictive), *_tails(sums, predictive)]


def _offsets(
    found: BinSums, sums: HeldSums, predictive: Predictive, partition: Partition
) -> list[HeldTest]:
    """Tests of the mean offsets from the predictions: each bin, then all together."""
    # a score of the position is odd: on average the mixture's parameters do not move it
    cov = found.place.covariance(predictive, sums.frames, mixture=False) + found.place_cov
    out, good = [], []
    for b, bin_ in enumerate(partition.bins):
        pair = slice(2 * b, 2 * b + 2)
        least = np.linalg.eigvalsh(cov[pair, pair])[0]
        n = found.independent[b]
        if n < MIN_STARS or least < 2 * SINGULAR * np.trace(found.place_2[b]):
            continue
        good.append(b)
        score = found.offset_scores[b]
        t = float(score @ np.linalg.solve(cov[pair, pair], score))
        # their variance is their own, as in Hotelling's test about zero
        p = hotelling_p(t, 2, int(n))
        size = float(np.hypot(*(score / found.weight[b])))
        out.append(HeldTest("offset", partition.kind, bin_.words, b, int(found.n[b]), size, 0.0, p))
    if len(good) > 1:
        rows = np.ravel([[2 * b, 2 * b + 1] for b in good])
        root = np.sqrt(np.diag(cov)[rows])
        values, vectors = np.linalg.eigh(cov[np.ix_(rows, rows)] / np.outer(root, root))
        along = vectors.T @ (found.place.sums[rows] / root)
        known = values > SINGULAR
        t, dof = float((along[known] ** 2 / values[known]).sum()), int(known.sum())
        p = float(chi2_sf(t, dof))
        if sums.shared is not None:
            p = hotelling_p(t, dof, sums.shared.n_stars)
        worst = min(out, key=lambda one: (one.p_value, -one.value))
        out.append(
            HeldTest(
                "offset", partition.kind, worst.where, -1, int(found.n.sum()), worst.value, 0.0, p
            )
        )
    return out


def _spread(
    sums: ScaleSums, k: int, predictive: Predictive, stars: tuple[str, str, int, int]
) -> HeldTest:
    """Test of the scatter of true matches of one group: part, words, index, number of stars."""
    p = sums.p_value(k, predictive.free_cov)
    return HeldTest("spread", *stars, sums.factor(k), 1.0, p)


def _distributions(sums: HeldSums, predictive: Predictive) -> list[HeldTest]:
    """Tests of the predictive probabilities against uniform ones."""
    merge, shared = 1, sums.shared
    n = sums.n if shared is None else shared.n_stars
    while merge < PIT_BINS // 4 and n * merge < STARS_PER_PIT_BIN * PIT_BINS:
        merge = {1: 2, 2: 4, 4: 5}[merge]
    m = PIT_BINS // merge
    # in merged bins, less the mean over all
    merged = np.asarray(np.kron(np.eye(m), np.ones(merge)) - 1 / m, np.float64)
    middle = sums.pit[2].sums @ (np.arange(PIT_BINS) + 0.5)
    wider = bool(middle > sums.n * PIT_BINS / 2)
    out = []
    for k, what in enumerate(("of u", "of v", "of their distances")):
        counts = sums.pit[k].mapped(merged)
        cov = sums.n * (np.eye(m) / m - 1 / m**2)
        if shared is not None:
            cov = shared.pit_covariance(k, merge)
        cov += counts.covariance(predictive, sums.frames, mixture=True)
        rest = counts.sums[:-1]
        t = float(rest @ np.linalg.solve(cov[:-1, :-1], rest))
        p = float(chi2_sf(t, m - 1))
        if shared is not None and shared.stars_repeat:
            p = hotelling_p(t, m - 1, n)
        below = np.cumsum(sums.pit[k].sums) / sums.n
        size = float(np.abs(below - np.arange(1, PIT_BINS + 1) / PIT_BINS).max())
        out.append(HeldTest("distribution", ALL, what, k, sums.n, size, 0.0, p, wider=wider))
    return out


def _tails(sums: HeldSums, predictive: Predictive) -> list[HeldTest]:
    """Tests of the number of stars that lie far out, false matches among them."""
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
        seen = int(sums.beyond[k])
        more = 1.0 if sums.shared is None else sums.shared.overdispersion(limit)
        below = float(weights @ _at_most(seen / more, sums.n / more, share))
        above = float(weights @ _at_least(seen / more, sums.n / more, share))
        interval = clopper_pearson(seen / sums.n, sums.n, INTERVAL)
        p = float(min(1.0, 2 * min(below, above)))
        out.append(
            HeldTest(
                "tails",
                ALL,
                f"beyond {limit:g} sigma",
                k,
                sums.n,
                seen / sums.n,
                middle / sums.n,
                p,
                interval=interval,
                limit=limit,
            )
        )
    return out


def _at_least(k: float, n: float, share: Float) -> Float:
    """Probability of k or more of n, of which neither need be whole."""
    return np.asarray(betainc(k, n - k + 1, share)) if k > 0 else np.ones_like(share)


def _at_most(k: float, n: float, share: Float) -> Float:
    """Probability of k or fewer of n."""
    return np.asarray(1 - betainc(k + 1, n - k, share)) if k < n else np.ones_like(share)


def deviation_tests(predictive: Predictive, frames: Mapping[str, Frame]) -> list[HeldTest]:
    """Tests of each deviation of exposures that were held out whole, by the others' scatter.

    Its scale and shears, and where its chips lie, are fitted to its own stars before these are
    judged: what is wrong with them does not show in residuals.  With b and v the estimate of one
    deviation and its variance by the stars alone, all others being as they scatter,

        b ~ N(0, tau^2 + v + w)

    with draws of tau, and w what the errors of the solution do to b.  The probability of a larger
    one is the mean over the draws.  The `limit` of a test is the scatter.
    """
    known = predictive.deviations
    if known is None:
        return []
    n = predictive.model.n_distortion
    C, out = predictive.cov[:n, :n], []
    for name, frame in frames.items():
        taken = 1 - frame.precision * np.diag(frame.spent)
        by_solution = frame.spent @ frame.shared
        extra = np.einsum("qn,nm,qm->q", by_solution, C, by_solution)
        for kind, tau in zip(known.kinds, known.tau.T, strict=True):
            k = frame.names.index(kind)
            if taken[k] < MIN_INFORMATION:
                continue
            # without what its own prior has said
            b = frame.values[k] / taken[k]
            v = frame.spent[k, k] / taken[k] + extra[k] / taken[k] ** 2
            p = float(np.mean(2 * norm_sf(abs(b) / np.sqrt(tau**2 + v))))
            where = f"the {kind.replace('_', ' ')} of exposure {name}, held out whole"
            scatter = float(np.sqrt(np.mean(tau**2)))
            out.append(
                HeldTest(
                    "deviation", "exposure", where, k, frame.n, float(b), 0.0, p, limit=scatter
                )
            )
    return out
