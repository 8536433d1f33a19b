"""Test for unmodelled proper motions: do the residuals of a star change with time?

For each star, the squared score of the slope is compared with the squared scores of its single
detections, after position and slope have been fitted.  Nothing is therefore assumed about the size
of the errors.  Let b_s be the slope of star s, S_s its information with the star's position
projected out, p_i the scores of the detections for the slope, corrected for the leverage of
position and slope (HC2), and C_s the covariance that the catalogue states for the motion.  Then

    D_s = [b_s^T S_s b_s - sum_i p_i^T S_s^-1 p_i - tr(S_s C_s)] / 2

has zero mean if the stars move as the catalogue states.
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
MIN_DETECTIONS = 4  # per star; fewer leave no residual
MIN_STARS = 100
SHORTEST = 0.1  # years; shortest time span in which motions are tested
MAX_TAKEN = 0.95  # largest leverage of one detection by position and slope
FARTHEST = 5.0  # largest residual of a true match, in errors per axis
# smallest fraction of the determinant of the slope's information that remains after the position
MOVING = 1e-6


@dataclass(frozen=True, eq=False)
class StarResiduals:
    """Gradients and curvatures of detections with respect to the positions of their stars."""

    star: Int  # (N,)
    epoch: Float  # (N,)
    gradient: Float  # (N, 2) of the log-likelihood with respect to the star's position
    curvature: Float  # (N, 2, 2) minus the second derivatives
    precision: Float  # (2, 2) or (stars, 2, 2) or () prior precision of the positions
    stated: Float | None = None  # (stars, 2) standard errors of the catalogue's proper motions


def motion_test(sample: ScoredSample) -> Outcome | None:
    """Test matched stars for motions that the catalogue lacks.

    Returns None without dates, and if too few stars are observed at several dates.
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
    """Scores (2, N) and curvatures (3, N), with zeros for detections that are far off.

    A mixture model may classify moving stars as false matches of small scatter; their scores then
    do not reflect their positions.  Errors that are independent between detections do not look like
    motion even if they are large.  All detections within `FARTHEST` errors therefore count as true.
    """
    if sample.mixture is None:
        return sample.whole_score, sample.curvature
    near = (sample.residual**2 < FARTHEST**2 * sample.variance).all(axis=0) & sample.used
    score = near * sample.residual / sample.variance / np.sqrt(1.0 - sample.leverage)
    u, v = near / sample.variance
    return score, np.stack([u, np.zeros_like(u), v])


def motion_outcome(data: StarResiduals, unit: str, family: Family) -> Outcome | None:
    """Test the residuals of stars for motions; None if there are too few stars."""
    star, g, H = data.star, data.gradient, data.curvature
    S = int(star.max()) + 1
    good = (H[:, 0, 0] > 0) & (H[:, 1, 1] > 0)

    g, H = g * good[:, None], H * good[:, None, None]
    members = sums_over(star, good.astype(float), S)
    A = sums_over(star, H, S) + data.precision
    tested = np.flatnonzero(members >= MIN_DETECTIONS)
    mean = sums_over(star, good * data.epoch, S) / np.maximum(members, 1)
    t = data.epoch - mean[star]
    cross, square = (sums_over(star, t[:, None, None] ** k * H, S)[tested] for k in (1, 2))
    if len(tested):
        back = np.linalg.solve(A[tested], cross)
        slope_information = square - np.swapaxes(cross, 1, 2) @ back
        moving = np.linalg.det(slope_information) > MOVING * np.linalg.det(square)
        tested, back, slope_information = tested[moving], back[moving], slope_information[moving]
    if len(tested) < MIN_STARS:
        return None
    of = np.full(S, -1)
    of[tested] = np.arange(len(tested))
    rows = np.flatnonzero(good & (of[star] >= 0))
    of, t, g, H = of[star[rows]], t[rows], g[rows], H[rows]
    # derivative with respect to the slope, with the position projected out, for each detection
    T = t[:, None, None] * np.eye(2) - back[of]
    slope = sums_over(of, np.einsum("nba,nb->na", T, g), len(tested))
    position_score = sums_over(of, g, len(tested))
    inside, outside = np.linalg.inv(slope_information), np.linalg.inv(A[tested])
    step = np.einsum("nab,nb->na", inside, slope)
    place = np.einsum("nab,nb->na", outside, position_score)
    follows = np.einsum("nab,nbc,ndc->nad", T, inside[of], T) + outside[of]
    leverage = np.einsum("nab,nba->n", H, follows) / 2
    moved = np.einsum("nab,nb->na", T, step[of]) + place[of]
    psi = np.einsum("nba,nb->na", T, g - np.einsum("nab,nb->na", H, moved))
    each = np.einsum("na,nab,nb->n", psi, inside[of], psi) / (1 - np.minimum(leverage, MAX_TAKEN))
    difference = (np.einsum("na,na->n", slope, step) - np.bincount(of, each)) / 2
    if data.stated is not None:
        difference -= np.einsum("naa,na->n", slope_information, data.stated[tested] ** 2) / 2
    # motions with mean square m^2, both axes together, add m^2 tr(S_s) / 4 to each D_s
    unit_square = 4 / float(np.trace(slope_information, axis1=1, axis2=2).sum())
    statistic, p = _above_zero(difference)
    noise = float(each.sum()) / (2 * len(tested)), float(np.var(difference)), len(tested)
    return outcome(
        family,
        max(statistic, 0.0) ** 2,
        1,
        None,
        p,
        # of the motion per year: rms over the stars, both axes together
        square=float(unit_square * difference.sum()),
        noise=0.0,
        unit=f"{unit}/yr",
        smallest=partial(_smallest, unit_square, *noise),
    )


def _above_zero(values: Float) -> tuple[float, float]:
    """Student's t of the mean, corrected for skewness, and its one-sided p-value.

    Squares have a skewed distribution, so that the plain t is too small if it is large, and too
    large if it is small (Johnson 1978, Journal of the American Statistical Association 73, 536).
    """
    n, mean, s = len(values), float(values.mean()), float(values.std(ddof=1))
    skew = float(((values - mean) ** 3).mean())
    t = (mean + skew / (6 * s**2 * n) + skew * mean**2 / (3 * s**4)) * np.sqrt(n) / s
    return t, float(t_sf(t, n - 1))


def _smallest(unit_square: float, own: float, variance: float, n: int, level: float) -> float:
    """Detectable rms of the motions, per year, if all n stars have one.

    Motions add a multiple of an exponential variable to each D_s.  Their mean must be detected
    against a scatter to which they contribute.
    """
    k = noncentrality(2 * level, 1) / n
    if k >= 1:
        return float("inf")
    mean = (k * own + np.sqrt((k * own) ** 2 + (1 - k) * k * variance)) / (1 - k)
    return float(np.sqrt(unit_square * n * mean))
