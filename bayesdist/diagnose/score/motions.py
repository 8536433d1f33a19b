"""Tests for motions that are not fitted: of the stars, and of the chips.

**Proper motions.**  Do the residuals of a star change with time?  For each star, the squared score
of the slope is compared with the squared scores of its single detections, after position and slope
have been fitted.  Nothing is therefore assumed about the size of the errors.  Let b_s be the slope
of star s, S_s its information with the star's position projected out, p_i the scores of the
detections for the slope, corrected for the leverage of position and slope (HC2), and C_s the
covariance that the catalogue states for the motion.  Then

    D_s = [b_s^T S_s b_s - sum_i p_i^T S_s^-1 p_i - tr(S_s C_s)] / 2

has zero mean if the stars move as the catalogue states.

**The gap between chips.**  Do the chips move relative to each other with time, in a way that is not
fitted?  For every exposure, the shift of each chip relative to the first chip, and its rotation
about its own reference pixel, are fitted together with terms common to all chips: shift, rotation,
scale and shears.  Scale and shears act about each chip's reference pixel, like the drifting terms
of a model, so that they do not change the gap; those of a frame that all chips share act about the
origin of the frame.  A linear trend is fitted to these values,

    d_e = d_0 + rate (t_e - t_0) + noise        F = rate^2 / var(rate)

for exposure e at the date t_e.  The noise is the scatter of whole visits about the trend, so that
chips which move to and fro do not count as drifting.  Errors of catalogue stars, which follow a
chip through all exposures if the roll angles are similar, are added to var(rate).  The largest F is
tested, and its p-value is corrected for the number of trends (Sidak 1967).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.diagnose.score.projection import Projection
from bayesdist.diagnose.score.result import (
    Family,
    Outcome,
    noncentrality,
    outcome,
    smallest_pattern,
)
from bayesdist.diagnose.score.sample import DetectionBlock, ScoredSample
from bayesdist.diagnose.statistics import squares_over, sums_over
from bayesdist.model.frames import DEVIATIONS, LINEAR_MATRICES, RIGID, frame_names
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import f_sf, t_sf

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
MIN_MOTION_SPAN = 0.1  # years; shortest time span in which motions are tested
MAX_TAKEN = 0.95  # largest leverage of one detection by position and slope
FARTHEST = 5.0  # largest residual of a true match, in errors per axis
# smallest fraction of the determinant of the slope's information that remains after the position
MOVING = 1e-6
GAP = Family("gap", "", "", "no drift of the gap between the chips is left in the residuals")
MIN_FREE = 3  # number of visits beyond the parameters of the line
MIN_STARS_PER_CHIP = 12  # per exposure and chip: six linear terms on both axes, and as many again
MIN_DRIFT_SPAN = 0.1  # years; shortest time span in which a drift is tested
VISIT = 1 / 365.25  # years; exposures closer than this form a visit and may deviate together
_WAYS = ("along x", "along y", "in rotation")


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
    if sample.epoch is None or np.ptp(sample.epoch) < MIN_MOTION_SPAN:
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
    free = np.sqrt(1.0 - sample.leverage)
    if sample.covariance is None:
        u, v = near / sample.variance
        return near * sample.residual / sample.variance / free, np.stack([u, np.zeros_like(u), v])
    uu, vv = sample.variance
    uv = sample.covariance
    inverse = near * np.stack([vv, -uv, uu]) / (uu * vv - uv**2)
    u, v = sample.residual
    score = np.stack([inverse[0] * u + inverse[1] * v, inverse[1] * u + inverse[2] * v])
    return score / free, inverse


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
        smallest=partial(_smallest_motion, unit_square, *noise),
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


def _smallest_motion(
    unit_square: float, own: float, variance: float, n: int, level: float
) -> float:
    """Detectable rms of the motions, per year, if all n stars have one.

    Motions add a multiple of an exponential variable to each D_s.  Their mean must be detected
    against a scatter to which they contribute.
    """
    k = noncentrality(2 * level, 1) / n
    if k >= 1:
        return float("inf")
    mean = (k * own + np.sqrt((k * own) ** 2 + (1 - k) * k * variance)) / (1 - k)
    return float(np.sqrt(unit_square * n * mean))


@dataclass(frozen=True, eq=False)
class _Exposure:
    """Positions of the chips of one exposure relative to the first chip."""

    epoch: float
    chips: tuple[int, ...]  # codes of all chips but the first
    # (len(chips), 3) shifts along the axes of the polynomials, and rotation times half the side of
    # the chip, in the unit of u and v
    value: Float
    variance: Float  # (len(chips), 3)
    star: Int  # (n,) stars of the detections
    by_star: Float  # (n, len(chips), 3) contribution of each detection to `value`


@dataclass(frozen=True)
class _Line:
    """Drift of one chip in one of the `_WAYS`, in the unit of u and v per year."""

    chip: int
    way: int
    rate: float
    variance: float
    free: int

    @property
    def statistic(self) -> float:
        """F statistic with 1 and `free` degrees of freedom."""
        return self.rate**2 / self.variance

    @property
    def p_value(self) -> float:
        """Probability of a larger statistic, for this trend alone."""
        return float(f_sf(self.statistic, 1, self.free))


def gap_test(projection: Projection) -> Outcome | None:
    """Test for chips that drift relative to each other.

    Returns None for a single chip, without dates, and with too few visits for a trend.
    """
    sample = projection.sample
    model = sample.model
    if len(model.chips) == 1 or sample.epoch is None or np.ptp(sample.epoch) < MIN_DRIFT_SPAN:
        return None
    exposures = list(_exposures(projection, sample.epoch))
    lines = [
        line
        for chip in range(1, len(model.chips))
        for way in range(len(_WAYS))
        if not _drifts(projection, chip, way) and (line := _line(projection, exposures, chip, way))
    ]
    if not lines:
        return None
    best = min(lines, key=lambda trend: trend.p_value)
    name = model.chips[best.chip].name
    terms = "['u', 0, 0] and ['v', 0, 0]" if best.way < 2 else "['u', 0, 1] and ['v', 1, 0]"
    return outcome(
        replace(
            GAP,
            remedy=f"add {terms} to model.tdd.terms",
            present=f"chip {name} drifts {_WAYS[best.way]} against chip {model.chips[0].name}, and "
            "the gap between them is taken to be constant",
        ),
        best.statistic,
        1,
        float(best.free),
        float(-np.expm1(len(lines) * np.log1p(-best.p_value))),
        square=best.rate**2,
        noise=best.variance,
        unit=f"{model.unit}/yr",
        smallest=partial(_smallest_drift, lines),
    )


def _smallest_drift(lines: list[_Line], level: float) -> float:
    """Rate that would be detected for every chip and direction."""
    line_level = -np.expm1(np.log1p(-level) / len(lines))
    return max(smallest_pattern(float(np.sqrt(a.variance)), 1, a.free, line_level) for a in lines)


def _drifts(projection: Projection, chip: int, way: int) -> bool:
    """True if the model contains this drift as a rate without a prior."""
    model = projection.sample.model
    if model.time is None or way == 2:
        return False
    term = ("uv"[way], 0, 0)
    if term not in model.time.terms:
        return False
    first = model.tdd_slice(model.chips[chip].number).start
    first += model.time.terms.index(term) * model.time.n_values
    return bool(projection.precision[first, first] == 0)


def visit_codes(epoch: Float) -> Int:
    """Visit number of each exposure, in the order of the dates `epoch` (years)."""
    order = np.argsort(epoch, kind="stable")
    out = np.empty(len(epoch), np.int64)
    out[order] = np.cumsum(np.append(0, np.diff(epoch[order]) > VISIT))
    return out


def _line(projection: Projection, exposures: list[_Exposure], chip: int, way: int) -> _Line | None:
    """Drift of one chip in one direction; None if there are too few visits."""
    with_chip = [exposure for exposure in exposures if chip in exposure.chips]
    if not with_chip:
        return None
    epoch = np.array([exposure.epoch for exposure in with_chip])
    at = [(exposure.chips.index(chip), way) for exposure in with_chip]
    value, variances = (
        np.array([getattr(exposure, name)[k] for exposure, k in zip(with_chip, at, strict=True)])
        for name in ("value", "variance")
    )
    # weighted means of the exposures of each visit
    code = visit_codes(epoch)
    total = np.asarray(np.bincount(code, 1 / variances), float)
    part = 1 / variances / total[code]
    t, d = (np.asarray(np.bincount(code, part * z), float) for z in (epoch, value))
    time = projection.sample.model.time
    segment = np.searchsorted(() if time is None else time.breaks, t, side="right")
    design = (segment[:, None] == np.unique(segment)).astype(float)
    design = np.column_stack([design, t - t.mean()])
    free = len(t) - np.linalg.matrix_rank(design)
    if free < MIN_FREE or np.linalg.matrix_rank(design[:, :-1]) == np.linalg.matrix_rank(design):
        return None
    weight = _weights(design, d, 1 / total)
    root = np.sqrt(weight)[:, None]
    # derivative of the rate with respect to the values
    gain = np.linalg.pinv(root * design)[-1] * root[:, 0]
    residual = d - design @ (np.linalg.pinv(root * design) @ (root[:, 0] * d))
    scale = float(weight @ residual**2) / free
    variance = scale * float(gain**2 @ (1 / weight))
    pull = gain[code] * part
    variance += _of_stars(with_chip, at, pull)
    return _Line(chip, way, float(gain @ d), variance, int(free))


def _weights(design: Float, values: Float, own: Float) -> Float:
    """Inverse variances of visits, including a common scatter estimated by moments.

    The estimator is that of DerSimonian and Laird (1986).  `own` are the variances of the visits
    without that scatter.
    """
    w = 1 / own
    root = np.sqrt(w)[:, None]
    hat = root * design @ np.linalg.pinv(root * design)
    residual = values - design @ (np.linalg.pinv(root * design) @ (root[:, 0] * values))
    free = len(values) - np.trace(hat)
    c = float(w.sum() - np.diag(hat) @ w)
    scatter = max(0.0, (float(w @ residual**2) - free) / c)
    return 1 / (own + scatter)


def _of_stars(some: list[_Exposure], at: list[tuple[int, int]], pull: Float) -> float:
    """Variance of a rate from errors that the detections of a star share.

    Only the excess over independent errors is returned.
    """
    star = np.concatenate([exposure.star for exposure in some])
    psi = np.concatenate(
        [
            p * exposure.by_star[:, k, way]
            for p, exposure, (k, way) in zip(pull, some, at, strict=True)
        ]
    )
    return max(float(squares_over(star, psi)[0] - (psi**2).sum()), 0.0)


def _exposures(projection: Projection, epoch: Float) -> Iterator[_Exposure]:
    """Iterate over the exposures with enough stars on the first chip and on another chip."""
    for blocks in projection.sample.blocks_by("exposure"):
        if exposure := _exposure(projection, epoch, blocks):
            yield exposure


def _exposure(
    projection: Projection, epoch: Float, blocks: list[DetectionBlock]
) -> _Exposure | None:
    sample = projection.sample
    number: dict[int, int] = {}
    for block in blocks:
        n = int(sample.used[block.rows].sum())
        number[block.chip] = number.get(block.chip, 0) + n
    enough = sorted(chip for chip, n in number.items() if n >= MIN_STARS_PER_CHIP)
    if len(enough) < 2 or enough[0] != 0:
        return None
    chips = enough[1:]
    blocks = [block for block in blocks if block.chip in enough]
    rows = [np.arange(block.rows.start, block.rows.stop) for block in blocks]
    F = np.concatenate([_columns(projection, block, chips) for block in blocks], axis=1)
    at = np.concatenate(rows)
    uu, uv, vv = sample.curvature[:, at]
    HF = np.stack(
        [uu[:, None] * F[0] + uv[:, None] * F[1], uv[:, None] * F[0] + vv[:, None] * F[1]]
    )
    A = F[0].T @ HF[0] + F[1].T @ HF[1]
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    A = A / np.outer(scale, scale)
    if not (np.diag(A) > 0).all() or np.linalg.eigvalsh(A).min() < 1e-8:
        return None
    inverse = np.linalg.inv(A) / np.outer(scale, scale)
    g, tail = sample.score[:, at], slice(-3 * len(chips), None)
    step = inverse @ (F[0].T @ g[0] + F[1].T @ g[1])
    value = step[tail].reshape(len(chips), 3)
    value = value + _fitted(projection, blocks[0].frame_exposure, chips)
    # scores after the fit to the exposure, for the errors that detections of a star share
    psi = sum(F[axis] * (g[axis] - HF[axis] @ step)[:, None] for axis in (0, 1))
    by_star = (psi @ inverse[:, tail]).reshape(len(at), len(chips), 3)
    return _Exposure(
        float(epoch[at[0]]),
        tuple(chips),
        value,
        np.diag(inverse)[tail].reshape(len(chips), 3) * projection.score_ratio,
        sample.star[at],
        by_star,
    )


def _half(projection: Projection, chip: int) -> float:
    """Half the longest side of a chip, in the unit of u and v."""
    model = projection.sample.model
    return model.pixel_size(projection.theta) * max(model.chips[chip].size) / 2


def _columns(projection: Projection, block: DetectionBlock, chips: list[int]) -> Float:
    """Derivatives (2, n, unknowns) of the positions of a block.

    They are with respect to the unknowns of the block's exposure.
    """
    model = projection.sample.model
    polynomials = projection.functions.polynomials(block.rows)
    at_centre = block.effective @ model.basis(model.chips[block.chip].number).monomial_matrix[0]
    about = (block.effective @ polynomials).T - at_centre
    n = len(about)
    shared = () if model.chip_deviations else frame_names(model.frames)
    origin = np.zeros(2) + model.origin
    columns = [np.tile(axis_unit, (n, 1)) for axis_unit in np.eye(2)]
    columns.append((about + at_centre - origin) @ LINEAR_MATRICES["rotation"].T)
    for name in DEVIATIONS:
        at = about + at_centre - origin if name in shared else about
        columns.append(at @ LINEAR_MATRICES[name].T)
    for chip in chips:
        on_chip = float(chip == block.chip)
        columns += [np.tile(on_chip * block.frame[:, axis], (n, 1)) for axis in (0, 1)]
        columns.append(on_chip / _half(projection, chip) * about @ LINEAR_MATRICES["rotation"].T)
    return np.moveaxis(np.stack(columns), (0, 1, 2), (2, 1, 0))


def _fitted(projection: Projection, exposure: int, chips: list[int]) -> Float:
    """Shifts and rotation (chips, 3) of the chips in the model of an exposure."""
    model, out = projection.sample.model, np.zeros((len(chips), 3))
    if not model.chip_deviations:
        return out
    names = {name: k for k, name in enumerate(model.names)}
    for row, chip in enumerate(chips):
        for way, kind in enumerate(RIGID):
            at = names.get(f"{model.exposures[exposure]}.{model.chips[chip].name}.{kind}")
            if at is not None:
                out[row, way] = projection.theta[at]
        out[row, 2] *= _half(projection, chip)
    return out
