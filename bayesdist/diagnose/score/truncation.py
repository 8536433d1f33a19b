"""Test for matches that are missing at large radii: residuals that end too abruptly.

Matching takes no pair beyond its radius.  Where that cuts into the true matches, their residuals
are too small: the errors seem too large, chi-square is too small, and so is the scatter that
everything else is judged by.  Errors that are merely quoted too large shrink all residuals alike;
so the scale of the residuals is taken from themselves, and the question is how many of them should
lie beyond the last ones that there are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import optimize, special

from bayesdist.diagnose.score.result import Family, Outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.significance import chi_square_of
from bayesdist.utils.arrays import Float, Int

TRUNCATION = Family(
    "truncation", "match again with a wider radius", "", "the residuals do not end abruptly"
)
MIN_STARS = 50
LARGEST_LEVERAGE = 0.5
MAX_FRACTION_BEYOND = 0.25  # of the expected number: with more, nothing ends at the match radius
STARS_PER_PART = 150  # with errors alike, from which their scatter is measured
MAX_PARTS = 12
MIN_EXPECTED = 0.5  # expected matches whose absence says nothing
BEYOND = (0, 3)  # stars that may lie beyond a radius: the edge need not be sharp
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
