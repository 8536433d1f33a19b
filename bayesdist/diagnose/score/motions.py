"""Test for stars that move in ways that are not known: do a star's residuals go with time?

Of each star the square of the slope's score is compared with those of its single detections, after
position and slope, so that nothing is assumed of the size of the errors.  With the slope b_s of
star s, its information S_s beside the star's position, the scores p_i of detections for the slope,
given back what position and slope have taken (HC2), and the covariance C_s of the errors that the
catalogue states for the motion,

    D_s = [b_s^T S_s b_s - sum_i p_i^T S_s^-1 p_i - tr(S_s C_s)] / 2

is zero on the mean of stars that move as they are said to.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from bayesdist.diagnose.clusters import sums_over
from bayesdist.diagnose.score.result import Family, Outcome, noncentrality, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import t_sf

MOTIONS = Family(
    "motions",
    "give the catalogue proper motions, or larger errors of those that it has, or leave out the "
    "stars that move",
    "stars move between the dates of the exposures in ways that the catalogue does not have",
    "no motions of the stars are left in the residuals",
    explained_by="exposures",
)
MIN_DETECTIONS = 4  # of a star: of fewer nothing is left
MIN_STARS = 100
SHORTEST = 0.1  # years in which motions are looked for
MAX_TAKEN = 0.95  # of one detection, by position and slope
FARTHEST = 5.0  # errors of a true match along an axis
MOVING = 1e-6  # of the determinant of the slope's information, that the position leaves


@dataclass(frozen=True, eq=False)
class StarResiduals:
    """Gradients and curvatures of detections by the positions of their stars."""

    star: Int  # (N,)
    epoch: Float  # (N,)
    gradient: Float  # (N, 2) of the log-likelihood by the star's position
    curvature: Float  # (N, 2, 2) minus the second derivatives
    precision: Float  # (2, 2) or (stars, 2, 2) or () of what is known of the positions beforehand
    stated: Float | None = None  # (stars, 2) errors of the motions that the catalogue has


def motion_test(sample: ScoredSample) -> Outcome | None:
    """Test of matched stars for motions that the catalogue does not have.

    None without dates, and where too few stars are seen at several of them.
    """
    if sample.epoch is None or np.ptp(sample.epoch) < SHORTEST:
        return None
    score, curvature = _of_true_matches(sample)
    uu, uv, vv = curvature
    stated = None
    if sample.motion_sigma is not None:
        stated = np.zeros((int(sample.star.max()) + 1, 2))
        stated[sample.star] = sample.motion_sigma.T
    residuals = StarResiduals(
        sample.star,
        sample.epoch,
        score.T,
        np.moveaxis(np.array([[uu, uv], [uv, vv]]), 2, 0),
        np.zeros(()),
        stated,
    )
    return motion_outcome(residuals, sample.model.unit, MOTIONS)


def _of_true_matches(sample: ScoredSample) -> tuple[Float, Float]:
    """Scores (2, N) and curvatures (3, N), 0 where a detection is far off.

    A mixture takes stars that move for false matches of small scatter, whose scores say nothing of
    where they are.  Errors that are independent from detection to detection are no motion, however
    large they are, so that all detections within `FARTHEST` errors count as true.
    """
    if sample.mixture is None:
        return sample.whole_score, sample.curvature
    near = (sample.residual**2 < FARTHEST**2 * sample.variance).all(axis=0) & sample.used
    score = near * sample.residual / sample.variance / np.sqrt(1.0 - sample.leverage)
    u, v = near / sample.variance
    return score, np.stack([u, np.zeros_like(u), v])


def motion_outcome(data: StarResiduals, unit: str, family: Family) -> Outcome | None:
    """Test of residuals of stars.

    None for too few stars.
    """
    star, g, H = data.star, data.gradient, data.curvature
    S = int(star.max()) + 1
    good = (H[:, 0, 0] > 0) & (H[:, 1, 1] > 0)

    g, H = g * good[:, None], H * good[:, None, None]
    members = sums_over(star, good.astype(float), S)
    A = sums_over(star, H, S) + data.precision
    many = np.flatnonzero(members >= MIN_DETECTIONS)
    mean = sums_over(star, good * data.epoch, S) / np.maximum(members, 1)
    t = data.epoch - mean[star]
    cross, square = (sums_over(star, t[:, None, None] ** k * H, S)[many] for k in (1, 2))
    if len(many):
        back = np.linalg.solve(A[many], cross)
        left = square - np.swapaxes(cross, 1, 2) @ back
        moving = np.linalg.det(left) > MOVING * np.linalg.det(square)
        many, back, left = many[moving], back[moving], left[moving]
    if len(many) < MIN_STARS:
        return None
    of = np.full(S, -1)
    of[many] = np.arange(len(many))
    rows = np.flatnonzero(good & (of[star] >= 0))
    of, t, g, H = of[star[rows]], t[rows], g[rows], H[rows]
    # the slope's derivative beside the position, of each detection
    T = t[:, None, None] * np.eye(2) - back[of]
    slope = sums_over(of, np.einsum("nba,nb->na", T, g), len(many))
    whole = sums_over(of, g, len(many))
    inside, outside = np.linalg.inv(left), np.linalg.inv(A[many])
    step = np.einsum("nab,nb->na", inside, slope)
    place = np.einsum("nab,nb->na", outside, whole)
    follows = np.einsum("nab,nbc,ndc->nad", T, inside[of], T) + outside[of]
    taken = np.einsum("nab,nba->n", H, follows) / 2
    moved = np.einsum("nab,nb->na", T, step[of]) + place[of]
    psi = np.einsum("nba,nb->na", T, g - np.einsum("nab,nb->na", H, moved))
    each = np.einsum("na,nab,nb->n", psi, inside[of], psi) / (1 - np.minimum(taken, MAX_TAKEN))
    difference = (np.einsum("na,na->n", slope, step) - np.bincount(of, each)) / 2
    if data.stated is not None:
        difference -= np.einsum("naa,na->n", left, data.stated[many] ** 2) / 2
    # motions of mean square m^2, both axes together, add m^2 tr(S_s) / 4 to each
    unit_square = 4 / float(np.trace(left, axis1=1, axis2=2).sum())
    statistic, p = _above_zero(difference)
    noise = float(each.sum()) / (2 * len(many)), float(np.var(difference)), len(many)
    return outcome(
        family,
        max(statistic, 0.0) ** 2,
        1,
        None,
        p,
        # of a motion in a year, rms over the stars and both axes together
        square=float(unit_square * difference.sum()),
        noise=0.0,
        unit=f"{unit}/yr",
        smallest=partial(_smallest, unit_square, *noise),
    )


def _above_zero(values: Float) -> tuple[float, float]:
    """Student's t of the mean, with what a skew distribution does to it, and its probability.

    Squares are skew: then t is too small where it is large, and too large where it is small
    (Johnson 1978, Journal of the American Statistical Association 73, 536).
    """
    n, mean, s = len(values), float(values.mean()), float(values.std(ddof=1))
    skew = float(((values - mean) ** 3).mean())
    t = (mean + skew / (6 * s**2 * n) + skew * mean**2 / (3 * s**4)) * np.sqrt(n) / s
    return t, float(t_sf(t, n - 1))


def _smallest(unit_square: float, own: float, variance: float, n: int, level: float) -> float:
    """Rms of motions that all of n stars have, in a year.

    They add a multiple of an exponential number to each D_s, whose mean is found with the scatter
    that it makes itself.
    """
    k = noncentrality(2 * level, 1) / n
    if k >= 1:
        return float("inf")
    mean = (k * own + np.sqrt((k * own) ** 2 + (1 - k) * k * variance)) / (1 - k)
    return float(np.sqrt(unit_square * n * mean))
