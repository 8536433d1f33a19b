"""Compare dither patterns by the covariance that a self-calibration would have.

No detections are simulated and no noise is drawn: the density of the field determines where stars
fall on the detector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bayesdist.assess.maps import UncertaintyMap, uncertainty_map
from bayesdist.data.detections import Detections
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer.gauge import POINTS, SAME_ROLL, functionals, moves
from bayesdist.kinds.selfcal.infer.mode import (
    ExpectedSolution,
    SelfCalibrationMode,
    expected_curvature,
    expected_solution,
    of_first,
)
from bayesdist.kinds.selfcal.infer.prior import (
    frame_prior,
    pointing_prior,
    tie,
)
from bayesdist.kinds.selfcal.patterns.exposures import (
    DitherPattern,
    dithered_model,
    sky_seen,
    stars_on_detector,
)
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.alignment import mean_squares
from bayesdist.model.frames import FRAME_KINDS
from bayesdist.model.grid import outline_pixels
from bayesdist.utils.arrays import Float, Int

KINDS = ("gauge-free", "shape", "absolute")
LEAST_SHARED = 3  # least number of common stars of two exposures that overlap
MOST_STARS = 2_000_000  # stars in the part of the sky covered by all patterns
MOST_LOOKED_FOR = 5e8  # these stars times the exposures of all patterns
SHORT = 0.25  # of the detector's side: shorter offsets do not constrain large scales
SKEWS = ("skew_plus", "skew_cross")
MOST = 4  # largest number of parameters that are named
MOST_FURTHER = 64  # exposures for which information is computed: a power of 2
MOST_DETECTIONS = 15_000  # in all of these exposures
WAYS = 5  # number of dither patterns for these exposures
SMOOTHING = 0.5  # of the scatter of offsets: smoothing of new offsets relative to existing ones


@dataclass(frozen=True, eq=False)
class Camera:
    """A detector for which exposures are planned."""

    chips: tuple[Chip, ...]
    # (chips, 2, K), Legendre coefficients of the distortion in pixels, mainly to place the chips
    coefficients: Float
    frames: str = "shift_rotation"  # free parameters of each exposure

    @property
    def pixels(self) -> float:
        """Number of pixels."""
        return float(sum(np.prod(chip.size) for chip in self.chips))

    @cached_property
    def side(self) -> float:
        """The smaller side of the area covered by all chips, in pixels."""
        pose = np.zeros((1, 2)), np.zeros(1)
        model, theta = dithered_model(self.chips, self.coefficients, *pose)
        points = np.concatenate(
            [model.predict(theta, *outline_pixels(c.size), chip=c.number) for c in self.chips]
        )
        return float(np.ptp(points, axis=0).min())


@dataclass(frozen=True)
class PlannedStars:
    """A field of stars, and the quality of its detections."""

    per_detector: float  # mean number of detections in one exposure
    sigma: float  # error of a detection per axis, pixels
    false: float = 0.0  # fraction of false detections, which carry no information
    least: int = 2  # least number of detections of a star that is used
    seed: int = 1


@dataclass(frozen=True)
class PriorInformation:
    """Prior knowledge in addition to the detections; None for unknown quantities."""

    offset_sigma: float | None = None  # error of a commanded offset per axis, pixels
    roll_sigma: float | None = None  # error of a commanded roll, radians
    exposure_scale_sigma: float | None = None  # standard deviation of the exposures' scales
    scale_sigma: float | None = None  # relative error of the pixel scale

    def prior(self, model: DistortionModel, theta: Float, pattern: DitherPattern) -> Prior:
        """Prior (D parameters) that combines all of this knowledge.

        It is linearised at the true parameters `theta` (D,), for the offsets and rolls of
        `pattern`.
        """
        out, n = Prior.none(theta), len(pattern)
        if self.offset_sigma is not None:
            # rolls are about the centre of all chips, so pixels elsewhere move with the roll
            middles = [(c.number, (c.size[0] + 1) / 2, (c.size[1] + 1) / 2) for c in model.chips]
            sigma = np.full(n, self.offset_sigma)
            out = out + pointing_prior(model, theta, pattern.offsets, sigma, pixels=middles)
        if self.roll_sigma is not None:
            rolls = pattern.rolls
            out = out + frame_prior(model, theta, "rotation", rolls, self.roll_sigma)
        if self.exposure_scale_sigma is not None:
            scatter = self.exposure_scale_sigma
            out = out + frame_prior(model, theta, "scale", np.zeros(n), scatter)
        if self.scale_sigma is not None:
            out = out + tie(theta, functionals(model, theta)["scale"], 0.0, self.scale_sigma)
        return out


@dataclass(frozen=True, eq=False)
class PlannedPattern:
    """Errors that a dither pattern would leave."""

    pattern: DitherPattern
    camera: Camera
    solution: ExpectedSolution
    # map of each chip, by kind. 'gauge-free': without directions that the detections of this
    # pattern leave free; 'shape': without shift, rotation and scale on the sky, the same for all
    # patterns; 'absolute': without the zero point only. None if the errors are unbounded
    maps: dict[str, tuple[UncertaintyMap, ...] | None]

    def per_axis(self, kind: str) -> Float:
        """Standard deviations per axis at all grid points of all chips in pixels, shape (N,).

        `kind` is 'gauge-free', 'shape' or 'absolute'.  The result is [inf] if the errors are
        unbounded.
        """
        maps = self.maps[kind]
        if maps is None:
            return np.array([np.inf])
        return np.concatenate([m.per_axis.ravel() for m in maps])

    def rms(self, kind: str) -> float:
        """Rms of the standard deviations per axis over the grid, in pixels; see `per_axis`."""
        return float(np.sqrt(np.mean(self.per_axis(kind) ** 2)))

    def largest(self, kind: str) -> float:
        """Largest standard deviation per axis on the grid, in pixels; see `per_axis`."""
        return float(self.per_axis(kind).max())

    @property
    def n_free(self) -> int:
        """Number of directions that the detections leave free."""
        return self.solution.gauge.null.shape[1]

    @property
    def rank(self) -> tuple[bool, float, int, float]:
        """Sort key of patterns: rms of the shape if bounded, then the number of free directions."""
        shape = self.rms("shape")
        return (not np.isfinite(shape), shape, self.n_free, self.rms("gauge-free"))

    @cached_property
    def by_degree(self) -> dict[int, float]:
        """Gauge-free rms over the detector and both axes, by polynomial degree, pixels."""
        solution = self.solution
        model, gauge = solution.model, solution.gauge
        square = mean_squares(model) * np.diag(solution.up_to(gauge.null))[: model.n_polynomial]
        degree = np.sum(model.basis().terms, axis=1)
        of_term = square.reshape(-1, len(degree)).sum(axis=0)
        return {
            int(k): float(np.sqrt(of_term[degree == k].sum() / 2))
            for k in range(1, model.order + 1)
        }

    @cached_property
    def chips_share_stars(self) -> bool:
        """True if at least one star is detected on two chips."""
        p = self.solution.problem
        chip = p.groups.chip[p.groups.index]
        low, high = (f.reduceat(chip, p.starts[:-1]) for f in (np.minimum, np.maximum))
        return bool((low != high).any())


def compare_patterns(
    patterns: Sequence[DitherPattern],
    camera: Camera,
    stars: PlannedStars,
    known: PriorInformation,
) -> tuple[PlannedPattern, ...]:
    """Compare dither patterns on the same sky; the best one comes first.

    `known` is the prior information on offsets, rolls and scales.

    Raises InputError if the exposures of a pattern do not overlap, or if there are too many stars.
    """
    truths = [
        dithered_model(camera.chips, camera.coefficients, p.offsets, p.rolls, frames=camera.frames)
        for p in patterns
    ]
    sky = _sky([sky_seen(*truth) for truth in truths], stars, camera)
    exposures = sum(len(pattern.offsets) for pattern in patterns)
    if len(sky) * exposures > MOST_LOOKED_FOR:
        raise InputError(
            f"{len(sky)} stars are to be searched for in {exposures} exposures",
            where="pattern",
            do=f"give fewer exposures or stars ({MOST_LOOKED_FOR:.0g} pairs of them at most)",
        )
    plans = [
        _planned(pattern, camera, *truth, sky, stars, known)
        for pattern, truth in zip(patterns, truths, strict=True)
    ]
    return tuple(sorted(plans, key=lambda plan: plan.rank))


def _sky(corners: Sequence[tuple[Float, Float]], stars: PlannedStars, camera: Camera) -> Float:
    """Random positions (S, 2) in the rectangle covered by all patterns."""
    low = np.min([c[0] for c in corners], axis=0)
    high = np.max([c[1] for c in corners], axis=0)
    mean = stars.per_detector * float(np.prod(high - low)) / camera.pixels
    if mean > MOST_STARS:
        raise InputError(
            f"the patterns together see {mean:.3g} stars",
            where="stars.per_detector",
            do=f"give fewer stars or smaller offsets ({MOST_STARS:.0g} stars at most)",
        )
    rng = np.random.default_rng(stars.seed)
    return np.asarray(low + rng.uniform(size=(rng.poisson(mean), 2)) * (high - low))


def _planned(
    pattern: DitherPattern,
    camera: Camera,
    model: DistortionModel,
    truth: Float,
    sky: Float,
    stars: PlannedStars,
    known: PriorInformation,
) -> PlannedPattern:
    x, y, exposure, chip, star = stars_on_detector(model, truth, sky)
    # false detections carry no information and are omitted
    true = np.random.default_rng([stars.seed, 1]).uniform(size=len(x)) >= stars.false
    x, y = x[true], y[true]
    exposure, chip, star = exposure[true], chip[true], star[true]
    _require_overlap(pattern, exposure, star)
    sigma = np.full(len(x), stars.sigma)
    detections = Detections(
        x, y, exposure, model.exposures, chip, sigma=sigma, star=star, source=pattern.name
    )
    prior = known.prior(model, truth, pattern)
    solution = expected_solution(model, truth, detections, prior, min_detections=stars.least)
    move = moves(model, truth)
    without = {
        "gauge-free": solution.gauge.null,
        "shape": _columns(move, *POINTS, "rotation", "scale"),
        "absolute": _columns(move, *POINTS),
    }
    maps = {kind: _maps(solution, directions) for kind, directions in without.items()}
    return PlannedPattern(pattern, camera, solution, maps)


def _columns(move: dict[str, Float], *names: str) -> Float:
    return np.stack([move[name] for name in names], axis=1)


def _maps(solution: ExpectedSolution, directions: Float) -> tuple[UncertaintyMap, ...] | None:
    if not solution.bounded_by(directions):
        return None
    reduced = replace(solution, cov=solution.up_to(directions))
    return tuple(uncertainty_map(reduced, chip=chip.number) for chip in solution.model.chips)


def _require_overlap(pattern: DitherPattern, exposure: Int, star: Int) -> None:
    """Raise InputError if exposures form groups without common stars."""
    E = len(pattern)
    detected = coo_array(
        (np.ones(len(star)), (exposure, star)), shape=(E, int(star.max(initial=0)) + 1)
    ).tocsr()
    shared = (detected @ detected.T).tocoo()
    tied = shared.data >= LEAST_SHARED
    graph = coo_array((tied[tied], (shared.row[tied], shared.col[tied])), shape=(E, E))
    n, group = connected_components(graph, directed=False)
    if n == 1:
        return
    groups = [np.flatnonzero(group == g) + 1 for g in range(n)]
    listed = " | ".join(_numbers(g) for g in groups)
    raise InputError(
        f"its exposures fall into {n} groups that share no stars: {listed} (numbers of exposures)",
        where=f"pattern {pattern.name!r}",
        do="take smaller offsets, or exposures between them",
    )


def _numbers(values: Int, most: int = 6) -> str:
    text = ", ".join(str(v) for v in values[:most])
    return text if len(values) <= most else f"{text}, ... ({len(values)} in all)"


def lacking(found: PlannedPattern) -> tuple[str, ...]:
    """Sentences on offsets and rolls that a pattern lacks, and the consequences.

    The result is empty for a pattern with rolls and with large offsets in both directions.
    """
    pattern, gauge = found.pattern, found.solution.gauge
    no_rolls = gauge.spread < SAME_ROLL
    out = []
    if no_rolls:
        out.append(_without_rolls(found))
    if pattern.reach == 0:
        out.append(
            "no offsets: the polynomials are free"
            if no_rolls
            else "no offsets: what a roll brings back onto itself, as radial distortion, is free"
        )
    elif pattern.along_one_line:
        consequence = "is free" if no_rolls else "rests on the rolls alone"
        out.append(f"offsets lie along one line: what changes only across it {consequence}")
    if 0 < pattern.reach < SHORT * found.camera.side:
        worst = max(found.by_degree, key=found.by_degree.__getitem__)
        out.append(
            f"no large offsets: two pointings are {pattern.reach:.3g} pix apart at most, "
            f"{pattern.reach / found.camera.side:.2g} of the detector; terms of degree {worst} are "
            f"known to {found.by_degree[worst]:.2g} pix"
        )
    if len(found.camera.chips) > 1 and not found.chips_share_stars:
        out.append("no star is seen on two chips: how the chips lie to each other is not tied")
    return tuple(out)


def _without_rolls(found: PlannedPattern) -> str:
    skews = [d for d in found.solution.gauge.directions if d.name in SKEWS]
    sigma = max(d.sigma_fixed for d in skews)
    missing = "no rolls but half turns" if np.ptp(found.pattern.rolls) > SAME_ROLL else "no rolls"
    if not np.isfinite(sigma):
        return f"{missing}: a linear skew of the distortion cannot be told from one of the sky"
    return (
        f"{missing}: linear skew rests on the commanded offsets, "
        f"sigma {sigma:.2g} ({sigma * skews[0].edge_pix:.2g} pix at the edge)"
    )


def nearly_free(found: PlannedPattern) -> str:
    """Sentence on nearly free combinations of parameters; empty if there are none.

    The combinations are described by their leading parameters.
    """
    weakest = found.solution.gauge.weakest
    if not len(weakest):
        return ""
    names = found.solution.model.names
    led = dict.fromkeys(names[int(k)] for _, k in weakest)
    remainder = f" and {len(led) - MOST} more" if len(led) > MOST else ""
    return (
        f"nearly free: combinations led by {', '.join(list(led)[:MOST])}{remainder}, up to "
        f"{weakest[:, 0].max():.2g} pix at the edge"
    )


@dataclass(frozen=True, eq=False)
class FurtherDithers:
    """Fisher information of further exposures on the parameters of a self-calibration.

    It is more than the number of exposures times the information of an existing one. Positions of
    known stars are already constrained, other stars get a second detection, and larger offsets
    constrain combinations that small offsets leave nearly free. Better star positions also improve
    the frames of the existing exposures. The information is therefore computed for a field of the
    same density, with offsets and rolls like those of the existing exposures.
    """

    mode: SelfCalibrationMode
    offsets: Float  # (E + MOST_FURTHER, 2), offsets of all exposures, in the unit of u and v
    rolls: Float  # (E + MOST_FURTHER,) in radians
    seed: int

    def information(self, n: int) -> Float:
        """Information (D, D) of n further exposures; linear in n beyond `MOST_FURTHER`."""
        number, values = self._known.number, self._known.information
        above = min(max(int(np.searchsorted(number, n)), 1), len(number) - 1)
        low, high = number[above - 1], number[above]
        return values[above - 1] + (n - low) / (high - low) * (values[above] - values[above - 1])

    def deviations(self, n: int) -> float:
        """Effect of the exposures' deviations on the polynomials with n further exposures.

        The effect is an rms over the detector, for the same scatter of scale and shears, relative
        to that at present. It is interpolated as a power of the number of exposures between the
        numbers for which it is computed, and decreases with the square root of that number beyond
        `MOST_FURTHER`.
        """
        E = len(self.mode.problem.model.exposures)
        total = E + self._known.number
        inside = min(E + n, int(total[-1]))
        effect = np.exp(np.interp(np.log(inside), np.log(total), np.log(self._known.deviations)))
        return float(effect * np.sqrt(inside / (E + n)))

    @cached_property
    def _known(self) -> _Further:
        """Information and effects for 0 and powers of 2 of further exposures."""
        mode, E = self.mode, len(self.mode.problem.model.exposures)
        number = np.concatenate([[0], 2 ** np.arange(MOST_FURTHER.bit_length())])
        model, theta, sky = self._field
        star_detections = stars_on_detector(model, theta, sky)
        expected = [self._expected(star_detections, E + int(n)) for n in number]
        information = [
            of_first(*curvature, mode.problem.model.n_params) for curvature, _ in expected
        ]
        effects = np.array([effect for _, effect in expected])
        # scaled to the actual number of detections and their errors
        D = mode.problem.model.n_params
        present = of_first(mode.expansion.curvature, mode.free, D)
        scale = np.trace(present) / np.trace(information[0])
        further = [scale * (values - information[0]) for values in information]
        return _Further(number, further, effects / effects[0])

    @cached_property
    def _field(self) -> tuple[DistortionModel, Float, Float]:
        """Model and parameters of all exposures, and positions (S, 2) of stars."""
        mode, problem = self.mode, self.mode.problem
        n = len(self.offsets)
        model = replace(problem.model, exposures=tuple(f"e{k:04d}" for k in range(n)))
        theta = np.zeros(model.n_params)
        theta[: model.n_global] = mode.theta[: model.n_global]
        for e in range(1, n):
            values = dict(zip(("shift_u", "shift_v"), self.offsets[e], strict=True))
            values["rotation"] = self.rolls[e]
            names = model.free_frame_names(e)
            theta[model.frame_slice(e)] = [values.get(name, 0.0) for name in names]
        low, high = sky_seen(model, theta)
        per_exposure = min(len(problem) / len(problem.model.exposures), MOST_DETECTIONS / n)
        area = sum(float(np.prod(chip.size)) for chip in model.chips) * problem.pixel**2
        rng = np.random.default_rng([self.seed, 7])
        count = int(per_exposure * np.prod(high - low) / area)
        return model, theta, low + rng.uniform(size=(count, 2)) * (high - low)

    def _expected(
        self, seen: tuple[Float, Float, Int, Int, Int], n: int
    ) -> tuple[tuple[Float, Int], float]:
        """Curvature and free parameters of the first n exposures, and the effect of deviations.

        `seen` are the stars detected in all exposures. The effect is the rms over the detector that
        deviations of unit scatter have on the polynomials.
        """
        full_model, theta, _ = self._field
        model = replace(full_model, exposures=full_model.exposures[:n])
        x, y, exposure, chip, star = seen
        rows = exposure < n
        detections = Detections(
            x[rows],
            y[rows],
            exposure[rows],
            model.exposures,
            chip[rows],
            sigma=np.full(np.count_nonzero(rows), self.mode.error),
            star=star[rows],
        )
        # deviations of exposures are parameters of a more general frame, which are not fitted
        general = replace(model, frames=FRAME_KINDS[-1])
        fitted = np.concatenate(
            [np.arange(model.n_global), *(_places(general, model, e) for e in range(1, n))]
        )
        general_theta = np.zeros(general.n_params)
        general_theta[fitted] = theta[: model.n_params]
        every = expected_curvature(general, general_theta, detections)
        curvature = every[np.ix_(fitted, fitted)]
        # the gauge constrains the same directions as at present
        D = self.mode.problem.model.n_params
        free = np.append(self.mode.free, np.arange(D, model.n_params))
        deviating = np.setdiff1d(np.arange(general.n_params), fitted)
        response = np.zeros((model.n_params, len(deviating)))
        precision = curvature[np.ix_(free, free)]
        scale = 1.0 / np.sqrt(np.diag(precision))
        pull = scale[:, None] * every[np.ix_(fitted[free], deviating)]
        scaled_precision = precision * np.outer(scale, scale)
        response[free] = scale[:, None] * np.linalg.solve(scaled_precision, pull)
        of_polynomials = (response[: model.n_polynomial] ** 2).sum(axis=1)
        # the first exposure, whose frame is fixed, deviates like the others
        square = mean_squares(model) @ of_polynomials * n / (n - 1)
        return (curvature, free), float(np.sqrt(square))


@dataclass(frozen=True, eq=False)
class _Further:
    """Information and effect of deviations for some numbers of further exposures."""

    number: Int  # (m,) ascending, from 0
    information: list[Float]  # (D, D) of the further exposures
    deviations: Float  # (m,) effect of the deviations of all exposures, relative to the present one


def _places(general: DistortionModel, model: DistortionModel, exposure: int) -> Int:
    """Indices in the parameters of `general` of the frame that `model` fits to an exposure."""
    block, names = general.frame_slice(exposure), general.free_frame_names(exposure)
    return np.array([block.start + names.index(k) for k in model.free_frame_names(exposure)], int)


def further_dithers(mode: SelfCalibrationMode, seed: int) -> list[FurtherDithers]:
    """Possible dither patterns of further exposures of a self-calibration.

    Offsets are drawn from the existing ones and smoothed without changing their variance; rolls are
    the existing ones in random order, with random numbers from `seed`. The list is empty if there
    are fewer than three exposures, stars move or have prior positions, or the distortion depends on
    time.
    """
    problem = mode.problem
    model, E = problem.model, len(problem.model.exposures)
    if E < 3 or model.time is not None or problem.n_star > 2 or problem.priors.informed.any():
        return []
    frames = np.zeros((E, 3))
    for e in range(1, E):
        of_exposure = mode.theta[model.frame_slice(e)]
        frame = dict(zip(model.free_frame_names(e), of_exposure, strict=True))
        frames[e] = [frame.get(name, 0.0) for name in ("shift_u", "shift_v", "rotation")]
    offsets, rolls = frames[:, :2], frames[:, 2]
    middle, scatter = offsets.mean(axis=0), np.cov(offsets.T)
    # rolls only, or dithers along a line, have no scatter in some direction
    root = np.linalg.cholesky(scatter + 1e-9 * (np.trace(scatter) + 1e-300) * np.eye(2))
    rng, out = np.random.default_rng([seed, 6]), []
    for k in range(WAYS):
        further = np.sqrt(E / (E - 1)) * (offsets[rng.integers(E, size=MOST_FURTHER)] - middle)
        further += SMOOTHING * rng.standard_normal((MOST_FURTHER, 2)) @ root.T
        further = middle + further / np.sqrt(1 + SMOOTHING**2)
        turned = np.resize(rng.permutation(rolls), MOST_FURTHER)
        extended = np.concatenate([offsets, further]), np.concatenate([rolls, turned])
        out.append(FurtherDithers(mode, *extended, seed + k))
    return out
