"""Tests of the match radius: residuals that end too abruptly, or elsewhere than it says.

Matching takes no pair beyond its radius.  Where that cuts into the true matches, their residuals
are too small: the errors seem too large, chi-square is too small, and so is the scatter that
everything else is judged by.  Errors that are merely quoted too large shrink all residuals alike;
so the scale of the residuals is taken from themselves, and the question is how many of them should
lie beyond the last ones that there are.

The likelihood of false matches, and of the circle about nominal positions, takes the radius as it
is stated.  Where matches were cut at a smaller one, false matches are missing beyond the last ones
that there are; where they were cut at a larger one, there are matches beyond the stated radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import optimize, special

from bayesdist.diagnose.score.result import Family, Outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.significance import chi_square_of
from bayesdist.infer.kernel import GAUSSIAN
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import EITHER
from bayesdist.utils.limits import SCORE_TESTS

TRUNCATION = Family(
    "truncation",
    "match again with a wider radius",
    "",
    "the residuals do not end abruptly",
    group="matching",
)
RADIUS = Family(
    "match radius",
    "",
    "",
    "the matches end where the stated match radius says",
    group="matching",
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
CLEAR = 4.5  # errors beyond which a match is clearly false, if errors are not larger than quoted
MIN_FALSE = 8
SHARE = 0.9  # of the clearly false ones, that lie within what is called their end
FAR = 1.5  # median of their squared distances beyond those of true ones, over the largest of these:
# that of Student's t with four degrees of freedom is 0.4
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
class _FalseMatches:
    """Matches that are clearly false, by their distances from where they were looked for."""

    square: Float  # (m,) squared distances, ascending
    hidden2: float  # squared distance up to which true ones hide them
    gaussian: bool  # whether the likelihood takes their distances for Gaussian

    @classmethod
    def of(
        cls, distance: Float, residual: Float, sigma: Float, *, gaussian: bool
    ) -> _FalseMatches | None:
        """By distances (N,), sizes of the residuals (N,) and errors along an axis (N,).

        None for fewer than `MIN_FALSE`.
        """
        clear = residual > CLEAR * sigma
        if clear.sum() < MIN_FALSE:
            return None
        square = np.sort(distance[clear]) ** 2
        return cls(square, min(float(np.median((CLEAR * sigma) ** 2)), square[-1] / 2), gaussian)

    @property
    def end2(self) -> float:
        """Squared distance within which `SHARE` of them lie."""
        return float(self.square[int(np.ceil(SHARE * len(self.square))) - 1])

    @property
    def numbers(self) -> tuple[int, int, float]:
        """Numbers in the outer half of the area within the end, and beyond; where that begins."""
        middle2 = (self.hidden2 + self.end2) / 2
        beyond = int((self.square > self.end2).sum())
        return int((self.square > middle2).sum()) - beyond, beyond, middle2

    def expected(self, radius: float) -> float:
        """Number beyond the end if they are even within a radius."""
        outer, _, middle2 = self.numbers
        return outer * (radius**2 - self.end2) / (self.end2 - middle2)

    def p_value(self, radius: float) -> float:
        """Probability of so few beyond the end if they are even within a radius.

        At least that of their distances if these are Gaussian, or a long tail of those of the true
        ones: they become few by themselves.
        """
        if self.end2 > (INSIDE * radius) ** 2 or self.end2 <= self.hidden2:
            return 1.0
        outer, beyond, middle2 = self.numbers
        share = (radius**2 - self.end2) / (radius**2 - middle2)
        even = float(special.bdtr(beyond, outer + beyond, share))
        over = self.square.clip(self.hidden2) - self.hidden2
        if not self.gaussian and np.median(over) > FAR * self.hidden2:
            return even
        # squares of Gaussian distances are exponential, those of other tails longer
        largest = -np.expm1(-over[-1] / max(float(over.mean()), 1e-300))
        return max(even, float(largest ** len(over)))


def _weights(sample: ScoredSample) -> Float:
    """Probabilities (N,) of true matches, those of one star divided by their number.

    They are 0 for residuals that the fit has taken.  Detections that share the error of one
    reference position lie beyond a radius together, or not at all.
    """
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    return np.asarray(sample.inlier * sample.share * (leverage.max(axis=0) < LARGEST_LEVERAGE))


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
    return _ends_inside(sample, radius)


def _ends_inside(sample: ScoredSample, radius: float) -> Outcome:
    """Outcome of a test whose matches may end inside the stated radius."""
    unit, n = sample.model.unit, len(sample)
    residual, sigma = np.hypot(*sample.residual), np.sqrt(sample.variance.max(axis=0))
    # by the median: false matches pass for larger errors if the area of the circle is wrong
    ratio = float(np.median(residual / sigma)) / np.sqrt(2 * np.log(2))
    distance, centre, columns = residual, "the solution", ", and give u_nominal and v_nominal"
    if sample.from_nominal is not None:
        distance, centre, columns = np.hypot(*sample.from_nominal), "nominal positions", ""
    false = _FalseMatches.of(
        distance,
        residual,
        sigma * min(ratio, 1.0),
        gaussian=sample.mixture is not None and sample.mixture.kind == GAUSSIAN,
    )
    cut = _cut_by_circle(sample, distance)
    p_false = 1.0 if false is None else false.p_value(radius)
    p_value = min(1.0, 2 * min(p_false, cut.p_value))
    largest = float(distance.max())
    if false is not None and p_false <= cut.p_value:
        end, expected = np.sqrt(false.end2), false.expected(radius)
        beyond = false.numbers[1]
        kind = "false"
    else:
        end, expected, beyond = cut.radius, cut.expected, cut.beyond
        kind = "true"
    if largest > INSIDE * radius:
        largest = end
    remedy = (
        f"state outliers.match_radius = {_rounded_up(largest)}, or the radius that the matches "
        f"were cut at{columns}"
    )
    present = (
        f"the matches end far inside the stated match radius of {radius:.3g} {unit}: "
        f"{expected:.3g} {kind} ones are expected beyond {end:.3g} {unit} from {centre}, and there "
        f"are {beyond}"
    )
    size = end * np.sqrt(max(expected - beyond, 0.0) / n / 2) if p_value < 1 else 0.0
    return _radius_outcome(replace(RADIUS, present=present, remedy=remedy), sample, p_value, size)


def _cut_by_circle(sample: ScoredSample, distance: Float) -> _Deficit:
    """True matches that are missing beyond the largest distances (N,) from nominal positions."""
    unit = sample.model.unit
    nothing = _Deficit(0.0, 0, float(distance.max()), unit, 0.0)
    if sample.from_nominal is None or sample.match_radius is None:
        return nothing
    offset = np.hypot(*(sample.from_nominal - sample.residual))
    variance = sample.variance.max(axis=0)
    deficits = [nothing]
    for k, end in _ends(distance):
        if end > INSIDE * sample.match_radius:
            continue
        # of round Gaussians about the offsets
        tail = 1.0 - special.chndtr(end**2 / variance, 2, offset**2 / variance)
        total = float(sample.inlier @ tail)
        # the logarithm of a tail goes with that of the variance by some half its square
        relative = np.sqrt(1.0 / max(float(sample.inlier.sum()), 1.0))
        slope = float(sample.inlier @ (tail * (end - offset).clip(0) ** 2 / variance)) / 2
        spread = relative * slope / max(total, 1e-300)
        deficits.append(_Deficit(total, k, end, unit, spread))
    return min(deficits, key=lambda deficit: deficit.p_value)


def _beyond_radius(sample: ScoredSample, radius: float, far: Float, p_value: float) -> Outcome:
    """Outcome of a test that has found matches far beyond the stated radius."""
    unit, n = sample.model.unit, len(sample)
    largest = float(far.max())
    present = (
        f"{len(far)} of {n} residuals are larger than {NEAR:g} times the stated match radius of "
        f"{radius:.3g} {unit}, up to {largest:.3g}"
    )
    remedy = (
        "state as outliers.match_radius the radius that the matches were cut at, some "
        f"{_rounded_up(largest)}, or leave out what lies beyond it; if the matches lie within the "
        "radius of other positions, give these as u_nominal and v_nominal"
    )
    size = float(np.sqrt((far**2).sum() / (2 * n)))
    return _radius_outcome(replace(RADIUS, present=present, remedy=remedy), sample, p_value, size)


def _radius_outcome(family: Family, sample: ScoredSample, p_value: float, size: float) -> Outcome:
    """Outcome whose size is the rms, along an axis, of the matches that are missing or astray."""
    radius, n = float(sample.match_radius or 0.0), len(sample)

    def smallest(level: float) -> float:
        return float(radius * np.sqrt(min(-np.log(level) / n, 1.0) / 2))

    return Outcome(
        family,
        chi_square_of(p_value, 1),
        1,
        None,
        p_value,
        float(size),
        smallest,
        sample.model.unit,
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
