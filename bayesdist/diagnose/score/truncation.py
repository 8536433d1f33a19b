"""Tests of the match radius: residuals that end too abruptly, or elsewhere than it says.

Matching takes no pair beyond its radius.  Where that cuts into the true matches, their residuals
are too small: the errors seem too large, chi-square is too small, and so is the scatter that
everything else is judged by.  Errors that are merely quoted too large shrink all residuals alike;
so the scale of the residuals is taken from themselves, and the question is how many of them should
lie beyond the last ones that there are.

The likelihood of false matches, and of the circle about nominal positions, takes the radius as it is
stated.  Where matches were cut at a smaller one, the likelihood expects some beyond the last ones
that there are; where they were not cut at it, there are matches beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import optimize, special

from bayesdist.diagnose.score.result import Family, Outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.significance import chi_square_of
from bayesdist.infer.kernel import GAUSSIAN, UNIFORM
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import EITHER
from bayesdist.utils.limits import SCORE_TESTS

TRUNCATION = Family(
    "truncation",
    "match again with a wider radius",
    "",
    "the residuals do not end abruptly",
    group="matching",
    cause="the match radius",
)
RADIUS = Family(
    "match radius",
    "",
    "",
    "the matches end where the stated match radius says",
    group="matching",
    cause="the match radius",
    doubt=EITHER,
)
MIN_STARS = 50
LARGEST_LEVERAGE = 0.5
MAX_FRACTION_BEYOND = 0.25  # of the expected number: with more, nothing ends at the match radius
STARS_PER_PART = 150  # with errors alike, from which their scatter is measured
MAX_PARTS = 12
MIN_EXPECTED = 0.5  # expected matches whose absence says nothing
MOST_TESTS = 100  # score tests of a run, at most
BEYOND = (0, 3)  # stars that may lie beyond a radius: the edge need not be sharp
INSIDE = 0.9  # of the stated radius: matches that end nearer to it are not said to end elsewhere
# Without nominal positions, of which residuals are measured from others: how far beyond the stated
# radius they may lie, in radii, and which fraction of the false ones.
NEAR = 1.25
STRAY = 0.01
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
ANGLES = (np.arange(8) + 0.5) * np.pi / 16  # of a quarter of the circle


@dataclass(frozen=True, eq=False)
class _Deficit:
    """True matches expected beyond a radius, and detections that are there."""

    expected: float
    beyond: int
    radius: float
    unit: str
    # standard deviation of the logarithm of `expected`, as the scale is not known exactly
    spread: float

    @property
    def p_value(self) -> float:
        """Probability of so few, over what the scale may be."""
        if self.expected < MIN_EXPECTED or self.beyond > MAX_FRACTION_BEYOND * self.expected:
            return 1.0
        at = self.expected * np.exp(self.spread * NODES)
        chance = special.gammaincc(self.beyond + 1, at)
        return float(WEIGHTS @ chance / WEIGHTS.sum())


@dataclass(frozen=True, eq=False)
class _Radii:
    """Residuals in units of their own scatter."""

    inlier: Float  # (N,) probability of being a true match
    # (2, N) squared residuals over their quoted variance, by which they scatter as a whole
    square: Float
    relative: float  # relative error of that factor
    radius2: Float  # (N,) squared residuals of both axes, in the unit of u and v
    part: Int  # (N,) stars of about equal quoted errors
    # (2, P) of the residuals along each axis, in each part, given back what the fit has taken
    variance: Float
    left: Float  # (2, P) as the fit has left it
    relative_of: Float  # (P,) its relative error

    @classmethod
    def of(cls, sample: ScoredSample, inlier: Float) -> _Radii:
        """Residuals of a sample, its true matches by their probabilities (N,)."""
        n = inlier.sum()
        # given back what the fit has taken of them
        square = sample.residual**2 / (1.0 - sample.leverage)
        part = _alike(sample.variance.sum(axis=0), inlier)
        count = np.bincount(part, inlier)
        # not by the quoted errors of single stars: where they are wrong, those with large ones
        # would be expected far out
        variance, left = (
            np.stack([np.bincount(part, inlier * one) / count for one in both])
            for both in (square, sample.residual**2)
        )
        excess = square.sum(axis=0) / variance.sum(axis=0)[part] - 1.0
        square = square / sample.variance
        t = square.mean(axis=0)
        scale = float(inlier @ t / n)
        return cls(
            inlier=inlier,
            square=square / scale,
            relative=float(np.sqrt(inlier @ (t / scale - 1.0) ** 2) / n),
            radius2=(sample.residual**2).sum(axis=0),
            part=part,
            variance=variance,
            left=left,
            relative_of=np.sqrt(np.bincount(part, inlier * excess**2)) / count,
        )

    def lost(self, end: Float) -> float:
        """Rms scatter along an axis that was cut off; `end` (P,) as of `_lost`."""
        count = np.bincount(self.part, self.inlier)
        # where nothing is cut the largest of so many lies there
        free = _lost(np.log(count.sum()))
        excess = np.array([max(_lost(one) ** 2 - free**2, 0.0) for one in end])
        return float(np.sqrt(np.average(self.variance.mean(axis=0) * excess, weights=count)))


@dataclass(frozen=True, eq=False)
class _Distances:
    """Distances of the matches from where they were looked for, and those that are expected."""

    distance: Float  # (N,) from the nominal position, or from the model's where there is none
    offset: Float  # (N,) of the model's position from there; 0 without nominal positions
    variance: Float  # (N,) of a true match along an axis, the larger one
    radius: float  # as is stated
    fraction: float  # of false matches
    wide: float | None  # variance of false matches; None where they are even within the circle

    @classmethod
    def of(cls, sample: ScoredSample, radius: float) -> _Distances | None:
        """Distances of a sample; None where its likelihood has no false matches."""
        constants = sample.mixture
        if constants is None or constants.kind not in (GAUSSIAN, UNIFORM):
            return None
        seen, offset = sample.residual, np.zeros(len(sample))
        if sample.from_nominal is not None:
            seen = sample.from_nominal
            offset = np.hypot(*(seen - sample.residual))
        fraction, wide = (float(np.ravel(c)[0]) for c in (np.exp(constants.log_f), constants.out))
        return cls(
            np.hypot(*seen),
            offset,
            sample.variance.max(axis=0),
            radius,
            fraction,
            wide if constants.kind == GAUSSIAN else None,
        )

    def expected(self, radius: float) -> tuple[float, float]:
        """Numbers of true and of false matches between a radius and the stated one."""
        n = len(self.distance)
        true = (1.0 - self.fraction) * _between(radius, self.radius, self.offset, self.variance)
        if self.wide is None:
            share = np.full(n, 1.0 - (radius / self.radius) ** 2)
        else:
            share = _between(radius, self.radius, self.offset, np.full(n, self.wide))
        return float(true.sum()), float(self.fraction * share.sum())


def _between(low: float, high: float, offset: Float, variance: Float) -> Float:
    """Probability (N,) that round Gaussians about offsets, within a radius, are beyond a smaller one.

    Offsets and variances are (N,).
    """
    inner, outer = (
        special.chndtr(radius**2 / variance, 2, offset**2 / variance) for radius in (low, high)
    )
    return np.asarray(np.where(outer > 0, 1.0 - inner / np.maximum(outer, 1e-300), 0.0))


def _weights(sample: ScoredSample) -> Float:
    """Probabilities (N,) of true matches, without those whose residuals the fit has taken."""
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    return np.asarray(sample.inlier * (leverage.max(axis=0) < LARGEST_LEVERAGE))


def _alike(variance: Float, inlier: Float) -> Int:
    """Parts (N,) with stars of about equal errors."""
    n = int(np.clip(inlier.sum() // STARS_PER_PART, 1, MAX_PARTS))
    edges = np.unique(np.quantile(variance, np.linspace(0, 1, n + 1)[1:-1]))
    part = np.searchsorted(edges, variance, side="right")
    count = np.bincount(part, inlier, minlength=len(edges) + 1)
    # what equal errors leave with few stars goes to its neighbour
    large = np.flatnonzero(count >= STARS_PER_PART / 2)
    if not len(large):
        return np.zeros(len(variance), np.int64)
    return np.clip(np.searchsorted(large, np.arange(len(count))), 0, len(large) - 1)[part]


def truncation_test(sample: ScoredSample, match_radius: float | None) -> Outcome | None:
    """Test for true matches missing beyond some radius.

    `match_radius` is in the unit of u and v. None for less than `MIN_STARS` true matches.
    """
    inlier = _weights(sample)
    n = float(inlier.sum())
    if n < MIN_STARS:
        return None
    radii = _Radii.of(sample, inlier)
    found = [
        *_in_sigmas(radii),
        *_along_an_axis(radii),
        *_in_units(radii, sample.model.unit, match_radius),
    ]
    worst = min(found, key=lambda one: (one.p_value, -one.expected))
    both = radii.variance.sum(axis=0)
    end = np.full(len(both), worst.radius**2 / 2)
    if worst.unit == sample.model.unit:
        end = worst.radius**2 / both
    sigma = float(np.sqrt(np.median(both[radii.part]) / 2))
    chi2 = sample.residual**2 / (sample.variance * (1.0 - sample.leverage))
    p_value = min(1.0, len(found) * worst.p_value)
    present = (
        f"the residuals end too abruptly: {worst.expected:.3g} true matches are expected beyond "
        f"{worst.radius:.3g} {worst.unit}, and there are {worst.beyond}, so that the matching has "
        f"cut the scatter, and chi-square ({float(inlier @ chi2.mean(axis=0)) / n:.2g} of each "
        "degree of freedom) says nothing of the quoted errors"
    )
    return Outcome(
        replace(TRUNCATION, present=present),
        chi_square_of(p_value, 1),
        1,
        None,
        p_value,
        radii.lost(end),
        partial(_smallest, sigma, n, len(found)),
        sample.model.unit,
    )


def radius_test(sample: ScoredSample) -> Outcome | None:
    """Test whether the matches end at the match radius that is stated.

    None without such a radius, and for less than `MIN_STARS` matches.
    """
    radius = sample.match_radius
    if radius is None or len(sample) < MIN_STARS:
        return None
    if sample.from_nominal is None:
        beyond = np.hypot(*sample.residual)
        far = beyond[beyond > NEAR * radius]
        false = float((1.0 - sample.inlier).sum())
        p_value = float(special.gammainc(len(far), STRAY * false + 0.5)) if len(far) else 1.0
        if p_value < SCORE_TESTS.value / MOST_TESTS:
            return _beyond_radius(sample, radius, far, p_value)
    distances = _Distances.of(sample, radius)
    if distances is None:
        return None
    deficits = []
    for k, end in _ends(distances.distance):
        true, false = distances.expected(min(end, radius))
        spread = false / max(true + false, 1e-300) / np.sqrt(max(false, 1.0))
        deficits.append(_Deficit(true + false, k, end, sample.model.unit, float(spread)))
    worst = min(deficits, key=lambda deficit: (deficit.p_value, -deficit.expected))
    p_value = min(1.0, len(deficits) * worst.p_value)
    if worst.radius > INSIDE * radius:
        p_value = 1.0
    return _ends_inside(sample, radius, worst, p_value)


def _ends_inside(
    sample: ScoredSample, radius: float, deficit: _Deficit, p_value: float
) -> Outcome:
    """Outcome of a test whose matches end at a radius that may be smaller than the stated one."""
    unit, n = sample.model.unit, len(sample)
    centre, columns = "nominal positions", ""
    if sample.from_nominal is None:
        centre, columns = "the solution", ", and give the columns u_nominal and v_nominal"
    remedy = (
        f"state outliers.match_radius = {_rounded_up(deficit.radius)}, or the radius that the "
        f"matches were cut at{columns}"
    )
    present = (
        f"the matches end {deficit.radius:.3g} {unit} from {centre}, far inside the stated match "
        f"radius of {radius:.3g}: {deficit.expected:.3g} matches are expected beyond, most of them "
        f"false, and there are {deficit.beyond}"
    )

    def smallest(level: float) -> float:
        needed = -np.log(level / len(BEYOND))
        return float(deficit.radius * np.sqrt(min(needed / n, 1.0) / 2))

    # of the matches that are missing, if they lie just beyond the others
    size = deficit.radius * np.sqrt(deficit.expected / n / 2)
    return Outcome(
        replace(RADIUS, present=present, remedy=remedy),
        chi_square_of(p_value, 1),
        1,
        None,
        p_value,
        float(size),
        smallest,
        unit,
    )


def _beyond_radius(
    sample: ScoredSample, radius: float, far: Float, p_value: float
) -> Outcome:
    """Outcome of a test that has found matches far beyond the stated radius."""
    unit, n = sample.model.unit, len(sample)
    largest = float(far.max())
    present = (
        f"{len(far)} of {n} residuals are larger than {NEAR:g} times the stated match radius of "
        f"{radius:.3g} {unit}, up to {largest:.3g}"
    )
    remedy = (
        "state as outliers.match_radius the radius that the matches were cut at, some "
        f"{_rounded_up(largest)}, or leave out what lies beyond it"
    )
    size = float(np.sqrt((far**2).sum() / (2 * n)))
    return Outcome(
        replace(RADIUS, present=present, remedy=remedy),
        chi_square_of(p_value, 1),
        1,
        None,
        p_value,
        size,
        lambda level: size,
        unit,
    )


def _rounded_up(radius: float) -> str:
    """Three digits of a radius, not below it."""
    step = 10.0 ** (np.floor(np.log10(radius)) - 2)
    return f"{np.ceil(radius / step) * step:.3g}"


def _in_sigmas(radii: _Radii) -> list[_Deficit]:
    """Deficits by the radius in units of the errors: half its square is exponential."""
    n = float(radii.inlier.sum())
    return [
        _Deficit(n * np.exp(-end), k, np.sqrt(2 * end), "sigma", radii.relative * end)
        for k, end in _ends(radii.square.mean(axis=0))
    ]


def _along_an_axis(radii: _Radii) -> list[_Deficit]:
    """Deficits by the larger of both axes, as a match in a square leaves them."""
    out = []
    for k, end in _ends(radii.square.max(axis=0)):
        tail = float(special.erfc(np.sqrt(end / 2)))
        expected = float(radii.inlier.sum()) * (2 * tail - tail**2)
        spread = radii.relative * end / 2
        out.append(_Deficit(expected, k, np.sqrt(end), "sigma along an axis", spread))
    return out


def _in_units(radii: _Radii, unit: str, match_radius: float | None) -> list[_Deficit]:
    """Deficits by the radius itself, whatever the errors of each star are."""
    ends = _ends(radii.radius2)
    if match_radius is not None:
        outside = int((radii.radius2 > match_radius**2).sum())
        ends.append((outside, match_radius**2))
    out = []
    for k, end in ends:
        expected = np.bincount(radii.part, radii.inlier) * _tail(radii.left, end)
        # by how much the logarithm goes with that of the variance
        slope = end / radii.left.sum(axis=0)
        spread = np.sqrt(((expected * slope * radii.relative_of) ** 2).sum())
        total = float(expected.sum())
        out.append(_Deficit(total, k, np.sqrt(end), unit, float(spread) / max(total, 1e-300)))
    return out


def _ends(values: Float) -> list[tuple[int, float]]:
    """Numbers of `BEYOND`, each with the limit beyond which so many values lie."""
    return [(k, float(np.partition(values, -k - 1)[-k - 1])) for k in BEYOND]


def _tail(variance: Float, radius2: float) -> Float:
    """Probability (P,) of a residual beyond a radius, by the variances (2, P) along both axes."""
    u, v = variance
    out = np.zeros(len(u))
    for angle in ANGLES:
        inverse = np.cos(angle) ** 2 / u + np.sin(angle) ** 2 / v
        out += np.exp(-radius2 / 2 * inverse) / inverse
    return out / (len(ANGLES) * np.sqrt(u * v))


def _lost(end: float) -> float:
    """Scatter along an axis that was cut off, in units of what is left.

    `end` is half the square of the radius in units of the scatter that is left.
    """
    # mean of an exponential of scale s cut at `end`: s - end / (exp(end / s) - 1) = 1
    if end <= 2.0:  # as flat a distribution as there is
        return 1.0

    def mean(s: float) -> float:
        return s - end / np.expm1(min(end / s, 700.0)) - 1.0

    s = optimize.brentq(mean, 1.0, 50.0) if mean(50.0) > 0 else 50.0
    return float(np.sqrt(max(s - 1.0, 0.0)))


def _smallest(sigma: float, n: float, several: int, level: float) -> float:
    """Scatter that is lost where just so many stars are as have to be missed."""
    expected = -np.log(level / several)
    if expected >= n:
        return sigma
    end = np.log(n / expected)
    return float(sigma * np.sqrt(end / np.expm1(end)))
