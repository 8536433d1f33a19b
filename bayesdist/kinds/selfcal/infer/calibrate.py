"""Self-calibration: group detections into stars and solve, in turn, until the groups are stable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.errors import NotSettledError
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.stars.shards import Compute
from bayesdist.kinds.selfcal.grouping import Friends, friends_of_friends
from bayesdist.kinds.selfcal.infer.elimination import (
    Mixture,
    StarPiece,
    each_of,
    eliminated_rows,
    in_pieces,
    memberships,
)
from bayesdist.kinds.selfcal.infer.gauge import Decision, Gauge
from bayesdist.kinds.selfcal.infer.mode import (
    PriorAt,
    SelfCalibrationMode,
    gauge_of,
    solve_in_gauge,
)
from bayesdist.kinds.selfcal.infer.problem import (
    Problem,
    StarPriors,
    TangentPlane,
    places_of,
    prepare,
)
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

MAX_ITERATIONS = 12
SHRINK = 0.5  # smallest factor on the linking length from one iteration to the next
REACH = 12.0  # the linking length is at least this many errors
MAX_CHANGED = 1e-3  # convergence: largest fraction of the detections that change their star,
MIN_CHANGED = 4  # or this number (two at the edge of the linking length, and their successors)
ALIKE = 0.02  # relative change of the number of detections that leaves the errors about the same
GUESS = 0.02  # pixels: assumed error before it is measured, if none is quoted
MIN_IN_BIN = 200  # detections per magnitude bin
MAX_BINS = 20
# largest fraction of a residual's variance that the star's parameters are assumed to absorb
MOST_TAKEN = 0.99
References = Callable[[Problem, Float], StarPriors]


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """Result of a self-calibration.

    Parameters
    ----------
    mode : SelfCalibrationMode
        The solution.
    gauge : Gauge
        Properties that the detections do not determine, and their constraints.
    friends : Friends
        Last grouping; its `star` refers to the input detections.
    detections : Detections
        Detections with star codes and errors, on a common tangent plane if requested.
    iterations : int
        Number of iterations.
    """

    mode: SelfCalibrationMode
    gauge: Gauge
    friends: Friends
    detections: Detections
    iterations: int


@dataclass(frozen=True, eq=False)
class _Iteration:
    """Results of an iteration that the next one uses as starting values."""

    n_detections: int  # number of detections that belong to stars
    mixture: Mixture
    decision: Decision | None

    @classmethod
    def of(cls, mode: SelfCalibrationMode) -> _Iteration:
        """Extract the starting values from a mode."""
        return cls(len(mode.problem), mode.mixture, mode.decision)

    def is_near(self, problem: Problem) -> bool:
        """True if errors and free directions are good starting values for the next problem.

        This requires nearly the same detections, since new ones may be far from their predicted
        positions.  Stars with proper motions start at rest and need large initial errors.
        """
        similar = abs(len(problem) / self.n_detections - 1.0) < ALIKE
        return similar and problem.n_star == 2


def self_calibrate(
    model: DistortionModel,
    detections: Detections,
    theta: Float,
    *,
    prior_at: PriorAt | None = None,
    match_radius: float,
    start_radius: float | None = None,
    min_detections: int = 2,
    motion: str = "none",
    parallax_factors: Float | None = None,
    dilation: Float | None = None,
    jitter: float | None = None,
    references: References | None = None,
    plane: TangentPlane | None = None,
    max_iterations: int = MAX_ITERATIONS,
    log: Callable[[str], None] = lambda text: None,
    compute: Compute | None = None,
) -> SelfCalibration:
    """Calibrate a detector from detections alone.

    Parameters
    ----------
    model : DistortionModel
        Model of the distortion and the exposure frames, with D parameters.
    detections : Detections
        Detections in E exposures. If they have no errors, the errors are measured, by magnitude if
        magnitudes are given.
    theta : ndarray, shape (D,)
        Starting parameters, accurate enough that the detections of a star are closer than
        `start_radius` to each other on the sky.
    prior_at : callable, optional
        Function that returns a `Prior` from other information than the detections, linearised at
        given parameters (D,).
    match_radius : float
        Linking length of the last iteration in pixels, which is also the largest distance of a
        false detection from a star.
    start_radius : float, optional
        Linking length of the first iteration in pixels; `match_radius` by default.
    min_detections : int
        Minimum number of detections of a star.
    motion : str
        Parameters of the stars in addition to positions: 'none', 'proper_motion', or 'parallax'
        (which includes proper motion).
    parallax_factors : ndarray, shape (E, 2), optional
        Parallax factors of the exposures along u and v; required for 'parallax'.
    dilation : ndarray, shape (E,), optional
        Known scale of the sky in each exposure, such as velocity aberration.
    jitter : float, optional
        Additional error of the detections in pixels; fitted by default.
    references : callable, optional
        Function of a `Problem` and parameters (D,) that returns `StarPriors`, such as
        `ReferenceStars`.
    plane : TangentPlane, optional
        Common plane to which the tangent planes of the exposures are mapped. By default the sky is
        treated as flat.
    max_iterations : int
        Maximum number of iterations.
    log : callable, optional
        Called with a message after each iteration.
    compute : Compute, optional
        Computing engine; this process by default.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    InputError
        If no star has enough detections, or dates or parallax factors are missing.
    DegenerateError
        If the detections do not determine the parameters.
    NotSettledError
        If the groups of detections or the solution do not converge.
    """
    theta = np.array(theta, float)
    prior_at = prior_at or Prior.none
    measured = detections.sigma is None
    sigma = np.full(len(detections), GUESS) if detections.sigma is None else detections.sigma
    detections = replace(detections, sigma=sigma)
    radius = max(start_radius or match_radius, match_radius)
    pixel = model.pixel_size(theta)
    max_changed = max(MAX_CHANGED * len(detections), MIN_CHANGED)
    last = False
    before: _Iteration | None = None
    solved: tuple[Friends, SelfCalibrationMode] | None = None
    each = partial(each_of, compute)
    for turn in range(max_iterations + 1):
        flat = detections if plane is None else plane.onto_it(model, detections, theta)
        friends = friends_of_friends(
            places_of(model, flat, theta, dilation), flat.exposure, radius * pixel, each=each
        )
        # References and priors are linearised at the start of a solution, which is not accurate in
        # the first iteration: at least two are needed.
        if solved is not None and turn > 1 and last and _changed(solved[0], friends) <= max_changed:
            friends, mode = solved
            if measured:  # with the errors of the last iteration
                problem = replace(mode.problem, var=sigma[mode.problem.rows] ** 2)
                mode = solve_in_gauge(
                    problem,
                    theta,
                    prior_at,
                    stars=mode.stars,
                    jitter=jitter,
                    mixture=mode.mixture,
                    decision=mode.decision,
                    compute=compute,
                )
            gauge = gauge_of(mode.problem, mode.theta, prior_at(mode.theta), mode)
            grouped = replace(flat, star=friends.star)
            return SelfCalibration(mode, gauge, friends, grouped, turn)
        if turn == max_iterations:
            break
        if solved is not None:
            before = _Iteration.of(solved[1])
            solved = None  # release memory: do not keep two problems
        grouped = replace(flat, star=friends.star)
        problem = prepare(
            model,
            grouped,
            theta,
            match_radius=radius,
            min_detections=min_detections,
            motion=motion,
            parallax_factors=parallax_factors,
            dilation=dilation,
        )
        if references is not None:
            problem = replace(problem, priors=references(problem, theta))
        near = before if before is not None and before.is_near(problem) else None
        mode = solve_in_gauge(
            problem,
            theta,
            prior_at,
            mixture=None if near is None else near.mixture,
            decision=None if near is None else near.decision,
            jitter=jitter,
            compute=compute,
        )
        theta = mode.theta
        log(
            f"iteration {turn + 1}: linking length {radius:.3g} pix, {friends.n_stars} stars, "
            f"{len(problem)} detections, error {mode.error:.3g} pix"
        )
        last = radius <= match_radius
        if measured:
            sigma = _errors_of(detections, mode)
            detections = replace(detections, sigma=sigma)
        scatter, solved = mode.error, (friends, mode)
        radius = max(match_radius, min(radius, max(SHRINK * radius, REACH * scatter)))
        del flat, grouped, problem, mode  # release memory: do not keep two problems
    if last:
        raise NotSettledError(
            f"stars and solution still change after {max_iterations} iterations",
            where="self-calibration",
            do="give a better start (selfcal.initial_distortion), another match radius or a lower "
            "order",
        )
    raise NotSettledError(
        f"after {max_iterations} iterations the detections still require a linking length of "
        f"{radius:.3g} pix, since they scatter by {scatter:.3g} pix",
        where="self-calibration",
        do="give a higher order, a better start (selfcal.initial_distortion) or a larger match "
        "radius",
    )


def _errors_of(detections: Detections, mode: SelfCalibrationMode) -> Float:
    """Errors (N,) in pixels as a function of magnitude, or a common one without magnitudes."""
    problem = mode.problem
    mag = np.zeros(len(detections)) if detections.mag is None else detections.mag
    middles, sigma = scatter_by_magnitude(
        problem, mode.theta, mode.mixture, mode.stars, mag[problem.rows]
    )
    return np.exp(np.interp(mag, middles, np.log(sigma)))


def _changed(before: Friends, after: Friends) -> int:
    """Number of detections with a different predecessor in their star than before.

    Star codes cannot be compared, because they change when a star appears or disappears.
    """
    return int(np.sum(_previous(before.star) != _previous(after.star)))


def _previous(star: Int) -> Int:
    """Index of the previous detection (N,) of the same star, or -1."""
    order = np.argsort(star, kind="stable")
    same_star = (star[order[1:]] == star[order[:-1]]) & (star[order[1:]] >= 0)
    out = np.full(len(star), -1)
    out[order[1:]] = np.where(same_star, order[:-1], -1)
    return out


def scatter_by_magnitude(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float, mag: Float
) -> tuple[Float, Float]:
    """Errors of the detections in bins of magnitude, from their distances to the stars.

    Returns the median magnitude (bins,) of each bin and the error per axis (bins,) in pixels.  The
    scatter is corrected for the degrees of freedom that the stars' positions absorb.  `stars` (S,
    q) are the modes of the stars, and `mag` (N,) is in the order of the problem.
    """
    w = memberships(problem, theta, mixture, stars)
    precision = w / (problem.var + mixture.jitter**2)
    total = np.bincount(problem.star, precision, minlength=problem.n_stars)[problem.star]
    # a star absorbs q / 2 degrees of freedom per axis, distributed according to the weights
    remaining = 1.0 - np.minimum(
        precision / np.maximum(total, 1e-300) * problem.n_star / 2, MOST_TAKEN
    )
    square = problem.squares(theta, stars)
    n_bins = int(np.clip(len(mag) // MIN_IN_BIN, 1, MAX_BINS))
    # equal magnitudes (as in lists without magnitudes) give fewer bins
    edges = np.unique(np.quantile(mag, np.linspace(0, 1, n_bins + 1)))
    n_bins = max(len(edges) - 1, 1)
    bin_of = np.clip(np.searchsorted(edges, mag, side="right") - 1, 0, n_bins - 1)
    number = np.bincount(bin_of, w * remaining, n_bins)
    variance = np.bincount(bin_of, w * square, n_bins) / (2 * np.maximum(number, 1e-9))
    middles = np.array([np.median(mag[bin_of == k]) for k in range(n_bins)])
    return middles, np.sqrt(variance)


# -- catalogue of the stars of a self-calibration, with the covariances of their parameters --------


@dataclass(frozen=True, eq=False)
class StarCatalogue:
    """Parameters of S stars in the coordinate system of the solution."""

    values: Float  # (S, q): position at `epoch`, then proper motion per year, then parallax
    cov: Float  # (S, q, q): covariance including the errors of distortion and frames
    own: Float  # (S, q, q): covariance for exactly known distortion and frames
    n: Int  # number (S,) of detections
    n_members: Float  # expected number (S,) of true detections
    epoch: float  # date of the positions in decimal years
    unit: str  # unit of u, v

    def __len__(self) -> int:
        return len(self.values)


def star_catalogue(
    solution: SelfCalibrationMode, cov: Float | None = None, *, compute: Compute | None = None
) -> StarCatalogue:
    """Make a catalogue of the stars at their modes, with covariances (Laplace approximation).

    The covariance of a star is the sum of that for a known distortion, from the star's detections,
    and that caused by the error of the distortion: A^-1 + A^-1 B Sigma B^T A^-1.

    Parameters
    ----------
    solution : SelfCalibrationMode
    cov : ndarray, shape (D, D), optional
        Covariance Sigma of the parameters of the model; that of the solution by default.
    compute : Compute, optional
        Computing engine; this process by default.

    Returns
    -------
    StarCatalogue
    """
    problem = solution.problem
    root = np.zeros((len(solution.theta), len(solution.free)))
    if cov is None:
        root[solution.free] = np.linalg.inv(np.linalg.cholesky(solution.precision)).T
    else:
        scale = np.sqrt(np.diag(cov)[solution.free])
        inner = cov[np.ix_(solution.free, solution.free)] / np.outer(scale, scale)
        root[solution.free] = scale[:, None] * np.linalg.cholesky(inner)
    with in_pieces(problem, solution.stars, compute) as pieces:
        parts = list(pieces.each(_covariances, solution.theta, solution.mixture, root))
    total, star_cov, members = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    # a star without true detections may be anywhere in the match circle
    widest = problem.least_root**-2
    lost = (members < 0.5) & (np.trace(star_cov[:, :2, :2], axis1=1, axis2=2) > 2 * widest)
    for matrices in (star_cov, total):
        matrices[lost, :2] = matrices[lost, :, :2] = 0.0
        matrices[lost, :2, :2] = widest * np.eye(2)
    return StarCatalogue(
        solution.stars,
        total,
        star_cov,
        problem.counts,
        members,
        problem.epoch0,
        problem.model.unit,
    )


def _covariances(
    piece: StarPiece, theta: Float, mixture: Mixture, root: Float
) -> tuple[Float, Float, Float]:
    """Total covariances, covariances for a known distortion (S, q, q each), and members (S,).

    `root` (D, F) is a matrix square root of the covariance of the parameters.
    """
    p, stars = piece.problem, piece.stars
    S, q = p.n_stars, p.n_star
    total, star_cov = np.empty((S, q, q)), np.empty((S, q, q))
    for selection, rows, factors in eliminated_rows(p, theta, mixture, stars):
        back = np.linalg.inv(np.tril(factors))  # L^-1
        star_cov[selection] = np.swapaxes(back, 1, 2) @ back
        # A^-1 B = L^-T (L^-1 B)
        spread = np.swapaxes(back, 1, 2) @ (rows @ root)
        total[selection] = star_cov[selection] + spread @ np.swapaxes(spread, 1, 2)
    w = memberships(p, theta, mixture, stars)
    return total, star_cov, np.asarray(np.bincount(p.star, w, minlength=S), float)
