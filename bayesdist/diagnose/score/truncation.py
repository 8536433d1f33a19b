"""Tests of the match radius: do the residuals end too abruptly, or elsewhere than at that radius?

Matching accepts no pair beyond its radius. If the radius cuts into the true matches, their
residuals are too small: the quoted errors seem too large, chi-square is too small, and so is the
scatter that all other results are compared with. Quoted errors that are merely too large shrink all
residuals by the same factor. The scale of the residuals is therefore estimated from the residuals
themselves, and the test compares the number of true matches expected beyond the outermost ones with
the number observed there.

The likelihoods of false matches and of the match circle about nominal positions use the stated
radius. If the matches were cut at a smaller radius, false matches are missing beyond the outermost
ones; if they were cut at a larger radius, there are matches beyond the stated radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import optimize, special

from bayesdist.diagnose.score.result import Family, Outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.statistics import chi_square_of
from bayesdist.infer.kernel import GAUSSIAN
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import EITHER, SCORE_TESTS

TRUNCATION = Family(
    "truncation",
    "match again with a wider radius, or write more decimals if the scatter is that of rounding",
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
# of the expected number: with more, the residuals do not end at the radius
MAX_FRACTION_BEYOND = 0.25
STARS_PER_PART = 150  # of similar quoted errors, from which the scatter of a part is measured
MAX_PARTS = 12
MIN_EXPECTED = 0.5  # with fewer expected matches, their absence is not significant
MOST_TESTS = 100  # upper limit to the number of score tests of a run
BEYOND = (0, 3)  # numbers of stars that may be beyond a radius: the edge need not be sharp
INSIDE = 0.9  # of the stated radius: beyond this, matches count as ending there
# errors beyond which most matches are false, if errors are not larger than quoted: of the true ones
# 0.2 %, and their tail only conceals an end
CLEAR = 3.5
MIN_FALSE = 8
SHARE = 0.9  # fraction of the clearly false matches that defines their outer end
# Limit to the median excess of their squared residuals over the largest squared residual of true
# matches, in units of the latter. For Student's t with four degrees of freedom it is 0.5.
FAR = 1.5
# Without nominal positions, residuals refer to the solution instead. NEAR: how far beyond the
# stated radius they may extend, in radii. STRAY: fraction of the false matches that may do so.
NEAR = 1.25
STRAY = 0.01
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
ANGLES = (np.arange(8) + 0.5) * np.pi / 16  # in the first quadrant


@dataclass(frozen=True, eq=False)
class _Deficit:
    """Number of true matches expected beyond a radius, and number of detections observed there."""

    expected: float
    beyond: int
    radius: float
    unit: str
    # standard deviation of log(expected), due to the uncertainty of the scale
    spread: float

    @property
    def p_value(self) -> float:
        """Probability of at most `beyond` matches, averaged over the uncertainty of the scale."""
        if self.expected < MIN_EXPECTED or self.beyond > MAX_FRACTION_BEYOND * self.expected:
            return 1.0
        at = self.expected * np.exp(self.spread * NODES)
        chance = special.gammaincc(self.beyond + 1, at)
        return float(WEIGHTS @ chance / WEIGHTS.sum())


@dataclass(frozen=True, eq=False)
class _Radii:
    """Residuals in units of their measured scatter."""

    inlier: Float  # (N,) probability of being a true match
    # (2, N) squared residuals over quoted variances, divided by their overall mean
    square: Float
    relative: float  # relative standard error of that mean
    radius2: Float  # (N,) squared residuals of both axes, in the unit of u and v
    part: Int  # (N,) codes of parts of the stars with similar quoted errors
    # (2, P) variance of the residuals per axis and part, corrected for the leverage
    variance: Float
    left: Float  # (2, P) variance of the residuals without that correction
    relative_of: Float  # (P,) relative standard error of the variance of each part

    @classmethod
    def of(cls, sample: ScoredSample, inlier: Float) -> _Radii:
        """Build from a sample and the probabilities (N,) that its detections are true matches."""
        n = inlier.sum()
        # corrected for the leverage of each detection
        square = sample.residual**2 / (1.0 - sample.leverage)
        part = _alike(sample.variance.sum(axis=0), inlier)
        count = np.bincount(part, inlier)
        # Measured scatter is used because quoted errors of single stars may be wrong: stars with
        # large quoted errors would be expected far out.
        variance, left = (
            np.stack([np.bincount(part, inlier * axis_square) / count for axis_square in squares])
            for squares in (square, sample.residual**2)
        )
        excess = square.sum(axis=0) / variance.sum(axis=0)[part] - 1.0
        square = sample.whitened**2 / (1.0 - sample.leverage)
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
        """Rms scatter per axis that was cut off.

        `end` (P,) is half the squared radius, as in `_lost`.
        """
        count = np.bincount(self.part, self.inlier)
        # without truncation the largest of this many values is expected here
        free = _lost(np.log(count.sum()))
        excess = np.array([max(_lost(half_square) ** 2 - free**2, 0.0) for half_square in end])
        return float(np.sqrt(np.average(self.variance.mean(axis=0) * excess, weights=count)))


@dataclass(frozen=True, eq=False)
class _FalseMatches:
    """Distances of clearly false matches from the positions at which they were searched."""

    square: Float  # (m,) squared distances, ascending
    residual2: Float  # (m,) squared residuals, ascending
    hidden2: float  # squared distance within which true matches outnumber them
    gaussian: bool  # True if the likelihood assumes a Gaussian distribution of their distances

    @classmethod
    def of(
        cls, distance: Float, residual: Float, sigma: Float, *, gaussian: bool
    ) -> _FalseMatches | None:
        """Select them from distances (N,), residual sizes (N,) and errors per axis (N,).

        Returns None if fewer than `MIN_FALSE` matches are clearly false.
        """
        clear = residual > CLEAR * sigma
        if clear.sum() < MIN_FALSE:
            return None
        square, residual2 = (np.sort(size[clear]) ** 2 for size in (distance, residual))
        hidden2 = min(float(np.median((CLEAR * sigma) ** 2)), square[-1] / 2)
        return cls(square, residual2, hidden2, gaussian)

    @property
    def end2(self) -> float:
        """Squared distance within which a fraction `SHARE` of them is found."""
        return float(self.square[int(np.ceil(SHARE * len(self.square))) - 1])

    @property
    def numbers(self) -> tuple[int, int, float]:
        """Counts in the outer half of the area within the end and beyond the end, and a radius.

        The radius, squared, is that at which the outer half begins.
        """
        middle2 = (self.hidden2 + self.end2) / 2
        beyond = int((self.square > self.end2).sum())
        return int((self.square > middle2).sum()) - beyond, beyond, middle2

    def expected(self, radius: float) -> float:
        """Number expected beyond the end if they are uniformly distributed within `radius`."""
        outer, _, middle2 = self.numbers
        return outer * (radius**2 - self.end2) / (self.end2 - middle2)

    def p_value(self, radius: float) -> float:
        """Probability of the observed number beyond the end for a uniform density within `radius`.

        If the distances are Gaussian, or a long tail of those of true matches, their number also
        falls off without a cut; then the larger of both probabilities is returned.  Tails of true
        matches are those of normal distributions of various widths, whose squared residuals are
        mixtures of exponentials.  They are compared with the lightest of these tails, a single
        exponential, by the largest distance and by the total time on test, which a mixture can
        only make smaller (Barlow and Proschan 1975, Statistical Theory of Reliability and Life
        Testing, chapter 3).
        """
        if self.end2 > (INSIDE * radius) ** 2 or self.end2 <= self.hidden2:
            return 1.0
        outer, beyond, middle2 = self.numbers
        share = (radius**2 - self.end2) / (radius**2 - middle2)
        even = float(special.bdtr(beyond, outer + beyond, share))
        over = self.residual2.clip(self.hidden2) - self.hidden2
        if not self.gaussian and np.median(over) > FAR * self.hidden2:
            return even
        return max(even, _level_then_steep(self.residual2[1:] - self.residual2[0]))


def _level_then_steep(values: Float) -> float:
    """Probability that ascending values (m,) are exponential, against an even density that ends.

    Each partial sum of the spacings, multiplied by the number of values above them, is uniformly
    distributed relative to the total if the values are exponential.  The sum of these is compared
    with its normal approximation, whose tail is wider than the exact one.
    """
    n = len(values)
    spacings = np.diff(values, prepend=0.0) * np.arange(n, 0, -1)
    partial_sums = np.cumsum(spacings)
    if partial_sums[-1] <= 0:
        return 1.0
    above = float(partial_sums[:-1].sum() / partial_sums[-1]) - (n - 1) / 2
    return float(special.ndtr(-above / np.sqrt((n - 1) / 12)))


def _weights(sample: ScoredSample) -> Float:
    """Probabilities (N,) of true matches, divided by the number of detections of the same star.

    They are zero for residuals with a large leverage. Detections that share the error of one
    reference position lie beyond a radius together or not at all, so that a star counts once.
    """
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    return np.asarray(sample.inlier * sample.share * (leverage.max(axis=0) < LARGEST_LEVERAGE))


def _alike(variance: Float, inlier: Float) -> Int:
    """Codes (N,) of parts that contain stars of similar quoted errors."""
    n = int(np.clip(inlier.sum() // STARS_PER_PART, 1, MAX_PARTS))
    edges = np.unique(np.quantile(variance, np.linspace(0, 1, n + 1)[1:-1]))
    part = np.searchsorted(edges, variance, side="right")
    count = np.bincount(part, inlier, minlength=len(edges) + 1)
    # parts with too few stars, left by equal errors, are merged with their neighbours
    large = np.flatnonzero(count >= STARS_PER_PART / 2)
    if not len(large):
        return np.zeros(len(variance), np.int64)
    return np.clip(np.searchsorted(large, np.arange(len(count))), 0, len(large) - 1)[part]


def truncation_test(sample: ScoredSample, match_radius: float | None) -> Outcome | None:
    """Test for true matches that are missing beyond some radius.

    `match_radius` is in the unit of u and v. Returns None if there are fewer than `MIN_STARS` true
    matches.
    """
    inlier = _weights(sample)
    n = float(inlier.sum())
    if n < MIN_STARS:
        return None
    radii = _Radii.of(sample, inlier)
    deficits = [
        *_in_sigmas(radii),
        *_along_an_axis(radii),
        *_in_units(radii, sample.model.unit, match_radius),
    ]
    worst = min(deficits, key=lambda deficit: (deficit.p_value, -deficit.expected))
    total_variance = radii.variance.sum(axis=0)
    end = np.full(len(total_variance), worst.radius**2 / 2)
    if worst.unit == sample.model.unit:
        end = worst.radius**2 / total_variance
    sigma = float(np.sqrt(np.median(total_variance[radii.part]) / 2))
    chi2 = sample.whitened**2 / (1.0 - sample.leverage)
    p_value = min(1.0, len(deficits) * worst.p_value)
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
        partial(_smallest, sigma, n, len(deficits)),
        sample.model.unit,
    )


def radius_test(sample: ScoredSample) -> Outcome | None:
    """Test whether the matches end at the stated match radius.

    Returns None without a stated radius and for fewer than `MIN_STARS` matches.
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
    """Outcome of the test for matches that end inside the stated radius."""
    unit, n = sample.model.unit, len(sample)
    residual, sigma = np.hypot(*sample.residual), np.sqrt(sample.variance.max(axis=0))
    # the median, because false matches count as large errors if the circle's area is wrong
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
    """True matches missing beyond the largest distances (N,) from the nominal positions."""
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
        # of round Gaussians centred on the offsets
        tail = 1.0 - special.chndtr(end**2 / variance, 2, offset**2 / variance)
        total = float(sample.inlier @ tail)
        # derivative of the log of the tail with respect to the log of the variance: half the square
        relative = np.sqrt(1.0 / max(float(sample.inlier.sum()), 1.0))
        slope = float(sample.inlier @ (tail * (end - offset).clip(0) ** 2 / variance)) / 2
        spread = relative * slope / max(total, 1e-300)
        deficits.append(_Deficit(total, k, end, unit, spread))
    return min(deficits, key=lambda deficit: deficit.p_value)


def _beyond_radius(sample: ScoredSample, radius: float, far: Float, p_value: float) -> Outcome:
    """Outcome of the test if matches far beyond the stated radius were found."""
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
    """Outcome with the rms per axis of the missing or stray matches as its size."""
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
    """Radius rounded up to three significant digits."""
    step = 10.0 ** (np.floor(np.log10(radius)) - 2)
    return f"{np.ceil(radius / step) * step:.3g}"


def _in_sigmas(radii: _Radii) -> list[_Deficit]:
    """Deficits in the radius in units of the errors.

    Half the square of this radius is exponentially distributed.
    """
    n = float(radii.inlier.sum())
    return [
        _Deficit(n * np.exp(-end), k, np.sqrt(2 * end), "sigma", radii.relative * end)
        for k, end in _ends(radii.square.mean(axis=0))
    ]


def _along_an_axis(radii: _Radii) -> list[_Deficit]:
    """Deficits in the larger coordinate of both axes, as matching within a square cuts it."""
    out = []
    for k, end in _ends(radii.square.max(axis=0)):
        tail = float(special.erfc(np.sqrt(end / 2)))
        expected = float(radii.inlier.sum()) * (2 * tail - tail**2)
        spread = radii.relative * end / 2
        out.append(_Deficit(expected, k, np.sqrt(end), "sigma along an axis", spread))
    return out


def _in_units(radii: _Radii, unit: str, match_radius: float | None) -> list[_Deficit]:
    """Deficits in the radius in the unit of u and v, independent of the errors of single stars."""
    ends = _ends(radii.radius2)
    if match_radius is not None:
        outside = int((radii.radius2 > match_radius**2).sum())
        ends.append((outside, match_radius**2))
    out = []
    for k, end in ends:
        expected = np.bincount(radii.part, radii.inlier) * _tail(radii.left, end)
        # derivative of the log of the expected number with respect to the log of the variance
        slope = end / radii.left.sum(axis=0)
        spread = np.sqrt(((expected * slope * radii.relative_of) ** 2).sum())
        total = float(expected.sum())
        out.append(_Deficit(total, k, np.sqrt(end), unit, float(spread) / max(total, 1e-300)))
    return out


def _ends(values: Float) -> list[tuple[int, float]]:
    """Pairs (k, limit) for each k of `BEYOND`: exactly k values exceed the limit."""
    return [(k, float(np.partition(values, -k - 1)[-k - 1])) for k in BEYOND]


def _tail(variance: Float, radius2: float) -> Float:
    """Probability (P,) of a residual beyond a radius for the variances (2, P) along both axes."""
    u, v = variance
    out = np.zeros(len(u))
    for angle in ANGLES:
        inverse = np.cos(angle) ** 2 / u + np.sin(angle) ** 2 / v
        out += np.exp(-radius2 / 2 * inverse) / inverse
    return out / (len(ANGLES) * np.sqrt(u * v))


def _lost(end: float) -> float:
    """Scatter per axis that was cut off, in units of the remaining scatter.

    `end` is half the squared radius in units of the remaining scatter.
    """
    # mean of an exponential of scale s that is truncated at `end`: s - end / (exp(end / s) - 1) = 1
    if end <= 2.0:  # the flattest distribution possible
        return 1.0

    def mean(s: float) -> float:
        return s - end / np.expm1(min(end / s, 700.0)) - 1.0

    s = optimize.brentq(mean, 1.0, 50.0) if mean(50.0) > 0 else 50.0
    return float(np.sqrt(max(s - 1.0, 0.0)))


def _smallest(sigma: float, n: float, several: int, level: float) -> float:
    """Lost scatter at which the expected number of missing stars is just significant."""
    expected = -np.log(level / several)
    if expected >= n:
        return sigma
    end = np.log(n / expected)
    return float(sigma * np.sqrt(end / np.expm1(end)))
