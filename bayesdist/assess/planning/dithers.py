"""Dither patterns compared by the covariance that a self-calibration would have; what they lack.

Nothing is detected and no noise is drawn: only where stars fall, by the density of a field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bayesdist.assess.maps.uncertainty import UncertaintyMap, uncertainty_map
from bayesdist.data.detections import Detections
from bayesdist.errors import InputError
from bayesdist.infer.compare.frame_fields import mean_squares
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal.expected import (
    ExpectedSolution,
    expected_curvature,
    expected_solution,
)
from bayesdist.infer.selfcal.gauge import SAME_ROLL
from bayesdist.infer.selfcal.mode import SelfCalibrationMode, of_first
from bayesdist.infer.selfcal.prior import (
    frame_prior,
    pointing_prior,
    tie,
)
from bayesdist.infer.selfcal.sky_moves import POINTS, functionals, moves
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import outline_pixels
from bayesdist.simulate.dithers import dithered_model, sky_seen, stars_on_detector
from bayesdist.simulate.patterns import DitherPattern
from bayesdist.utils.arrays import Float, Int

KINDS = ("gauge-free", "shape", "absolute")
LEAST_SHARED = 3  # stars that two exposures share at least, if they overlap at all
MOST_STARS = 2_000_000  # of the sky that all patterns see together
MOST_LOOKED_FOR = 5e8  # stars of that sky times exposures of all patterns
SHORT = 0.25  # of the detector's side: the scales above it are not sampled
SKEWS = ("skew_plus", "skew_cross")
MOST = 4  # parameters that are named
MOST_FURTHER = 64  # exposures whose information is computed: a power of 2
MOST_DETECTIONS = 15_000  # of all of these
WAYS = 5  # in which they may be dithered
SMOOTHING = 0.5  # of the scatter of offsets, by which further ones differ from those at hand


@dataclass(frozen=True, eq=False)
class Camera:
    """A detector as it is planned for."""

    chips: tuple[Chip, ...]
    # (chips, 2, K), Legendre coefficients of its distortion, in pixels: how chips lie matters most
    coefficients: Float
    frames: str = "shift_rotation"  # what is free in each exposure

    @property
    def pixels(self) -> float:
        """Number of pixels."""
        return float(sum(np.prod(chip.size) for chip in self.chips))

    @cached_property
    def side(self) -> float:
        """The smaller side of what all chips cover, pixels."""
        one = np.zeros((1, 2)), np.zeros(1)
        model, theta = dithered_model(self.chips, self.coefficients, *one)
        points = np.concatenate(
            [model.predict(theta, *outline_pixels(c.size), chip=c.number) for c in self.chips]
        )
        return float(np.ptp(points, axis=0).min())


@dataclass(frozen=True)
class PlannedStars:
    """A field of stars, and how well they are detected."""

    per_detector: float  # detections of one exposure, on average
    sigma: float  # error of a detection on one axis, pixels
    false: float = 0.0  # fraction of the detections that are false: they say nothing
    least: int = 2  # fewest detections of a star that is used
    seed: int = 1


@dataclass(frozen=True)
class PriorInformation:
    """Knowledge beside the detections; None for what is not known."""

    offset_sigma: float | None = None  # error of a commanded offset on one axis, pixels
    roll_sigma: float | None = None  # of a commanded roll, radians
    exposure_scale_sigma: float | None = None  # scatter of the exposures' scales
    scale_sigma: float | None = None  # relative error of the size of a pixel

    def prior(self, model: DistortionModel, theta: Float, pattern: DitherPattern) -> Prior:
        """All of it, at a truth."""
        out, n = Prior.none(theta), len(pattern)
        if self.offset_sigma is not None:
            # rolls are about the middle of all chips: a pixel elsewhere moves with the roll
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
    """Errors that a pattern would leave."""

    pattern: DitherPattern
    camera: Camera
    solution: ExpectedSolution
    # of each chip, by kind: 'gauge-free'   without whatever the detections of this pattern leave
    # free; 'shape'        without shift, rotation and scale of the sky: the same for all patterns;
    # 'absolute'     without the zero point alone. None where nothing bounds the errors
    maps: dict[str, tuple[UncertaintyMap, ...] | None]

    def per_axis(self, kind: str) -> Float:
        """Errors per axis (1 sigma) at all points of the grid, pixels; infinite if unbounded."""
        maps = self.maps[kind]
        if maps is None:
            return np.array([np.inf])
        return np.concatenate([m.per_axis.ravel() for m in maps])

    def rms(self, kind: str) -> float:
        """Root mean square of these."""
        return float(np.sqrt(np.mean(self.per_axis(kind) ** 2)))

    def largest(self, kind: str) -> float:
        """The largest of these."""
        return float(self.per_axis(kind).max())

    @property
    def n_free(self) -> int:
        """Directions that detections leave free."""
        return self.solution.gauge.null.shape[1]

    @property
    def rank(self) -> tuple[bool, float, int, float]:
        """By which patterns are sorted: shape, where it is bounded, then what is free."""
        shape = self.rms("shape")
        return (not np.isfinite(shape), shape, self.n_free, self.rms("gauge-free"))

    @cached_property
    def by_degree(self) -> dict[int, float]:
        """Gauge-free rms over detector and axes of the polynomials of each degree, pixels."""
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
        """True if some star is seen on two chips."""
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
    """Outcomes of several patterns on one sky, the best one first.

    InputError for a pattern whose exposures do not overlap, and for too many stars.
    """
    truths = [
        dithered_model(camera.chips, camera.coefficients, p.offsets, p.rolls, frames=camera.frames)
        for p in patterns
    ]
    sky = _sky([sky_seen(*truth) for truth in truths], stars, camera)
    exposures = sum(len(pattern.offsets) for pattern in patterns)
    if len(sky) * exposures > MOST_LOOKED_FOR:
        raise InputError(
            f"{len(sky)} stars are to be looked for in {exposures} exposures",
            where="pattern",
            do=f"give fewer exposures or stars ({MOST_LOOKED_FOR:.0g} pairs of them at most)",
        )
    found = [
        _planned(pattern, camera, *truth, sky, stars, known)
        for pattern, truth in zip(patterns, truths, strict=True)
    ]
    return tuple(sorted(found, key=lambda one: one.rank))


def _sky(corners: Sequence[tuple[Float, Float]], stars: PlannedStars, camera: Camera) -> Float:
    """Positions (S, 2) over the rectangle that all patterns together see."""
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
    # a false detection says nothing, as if it were not there
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
    seen = replace(solution, cov=solution.up_to(directions))
    return tuple(uncertainty_map(seen, chip=chip.number) for chip in solution.model.chips)


def _require_overlap(pattern: DitherPattern, exposure: Int, star: Int) -> None:
    """Refuse exposures that no stars tie to the others."""
    E = len(pattern)
    seen = coo_array(
        (np.ones(len(star)), (exposure, star)), shape=(E, int(star.max(initial=0)) + 1)
    ).tocsr()
    shared = (seen @ seen.T).tocoo()
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
    """Sentences on offsets and rolls that a pattern lacks, and what that costs.

    The result is empty for a pattern of large offsets in both directions and with rolls.
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
        what = "is free" if no_rolls else "rests on the rolls alone"
        out.append(f"offsets lie along one line: what changes only across it {what}")
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
    what = "no rolls but half turns" if np.ptp(found.pattern.rolls) > SAME_ROLL else "no rolls"
    if not np.isfinite(sigma):
        return f"{what}: a linear skew of the distortion cannot be told from one of the sky"
    return (
        f"{what}: linear skew rests on the commanded offsets, "
        f"sigma {sigma:.2g} ({sigma * skews[0].edge_pix:.2g} pix at the edge)"
    )


def nearly_free(found: PlannedPattern) -> str:
    """Combinations that are nearly free, by the parameters that lead them; empty for none."""
    weakest = found.solution.gauge.weakest
    if not len(weakest):
        return ""
    names = found.solution.model.names
    led = dict.fromkeys(names[int(k)] for _, k in weakest)
    more = f" and {len(led) - MOST} more" if len(led) > MOST else ""
    return (
        f"nearly free: combinations led by {', '.join(list(led)[:MOST])}{more}, up to "
        f"{weakest[:, 0].max():.2g} pix at the edge"
    )


@dataclass(frozen=True, eq=False)
class FurtherDithers:
    """Information of further exposures about the parameters of a self-calibration.

    It is more than the number of exposures times that of one of those at hand: stars that were seen
    before lie where they lie, others are seen for a second time, and pointings that lie farther
    apart tell what small offsets leave nearly free.  By stars that are better known the frames of
    the exposures at hand are, too.  So it is computed, for further exposures with
    offsets and rolls as those at hand have, over a field of stars that is as dense.
    """

    mode: SelfCalibrationMode
    offsets: Float  # (E + MOST_FURTHER, 2) of all exposures, in the unit of u and v
    rolls: Float  # (E + MOST_FURTHER,) in radians
    seed: int

    def information(self, n: int) -> Float:
        """Information (D, D) of n further exposures; beyond `MOST_FURTHER` it is linear in n."""
        number, values = self._known
        above = min(max(int(np.searchsorted(number, n)), 1), len(number) - 1)
        low, high = number[above - 1], number[above]
        return values[above - 1] + (n - low) / (high - low) * (values[above] - values[above - 1])

    @cached_property
    def _known(self) -> tuple[Int, list[Float]]:
        """Numbers of further exposures, 0 and powers of 2, and their information."""
        mode, E = self.mode, len(self.mode.problem.model.exposures)
        number = np.concatenate([[0], 2 ** np.arange(MOST_FURTHER.bit_length())])
        model, theta, sky = self._field
        seen = stars_on_detector(model, theta, sky)
        expected = [self._expected(seen, E + int(n)) for n in number]
        # of as many detections as there are, with their errors
        D = mode.problem.model.n_params
        scale = np.trace(of_first(mode.expansion.curvature, mode.free, D)) / np.trace(expected[0])
        return number, [scale * (one - expected[0]) for one in expected]

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

    def _expected(self, seen: tuple[Float, Float, Int, Int, Int], n: int) -> Float:
        """Information (D, D) of the first n exposures by the stars that they have seen."""
        whole, theta, _ = self._field
        model = replace(whole, exposures=whole.exposures[:n])
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
        curvature = expected_curvature(model, theta[: model.n_params], detections)
        # the gauge holds what it holds at present
        D = self.mode.problem.model.n_params
        return of_first(curvature, np.append(self.mode.free, np.arange(D, model.n_params)), D)


def further_dithers(mode: SelfCalibrationMode, seed: int) -> list[FurtherDithers]:
    """Several ways in which further exposures of a self-calibration may be dithered.

    Offsets are those at hand at random, smoothed without a change of their variance, and rolls are
    those at hand in turn.  The list is empty for fewer than three exposures, for stars that move or
    are known beforehand, and for distortions that depend on time.
    """
    problem = mode.problem
    model, E = problem.model, len(problem.model.exposures)
    if E < 3 or model.time is not None or problem.n_star > 2 or problem.priors.informed.any():
        return []
    frames = np.zeros((E, 3))
    for e in range(1, E):
        of_exposure = mode.theta[model.frame_slice(e)]
        known = dict(zip(model.free_frame_names(e), of_exposure, strict=True))
        frames[e] = [known.get(name, 0.0) for name in ("shift_u", "shift_v", "rotation")]
    offsets, rolls = frames[:, :2], frames[:, 2]
    middle, scatter = offsets.mean(axis=0), np.cov(offsets.T)
    # rolls alone, or dithers along a line, have no scatter in some direction
    root = np.linalg.cholesky(scatter + 1e-9 * (np.trace(scatter) + 1e-300) * np.eye(2))
    rng, out = np.random.default_rng([seed, 6]), []
    for k in range(WAYS):
        more = np.sqrt(E / (E - 1)) * (offsets[rng.integers(E, size=MOST_FURTHER)] - middle)
        more += SMOOTHING * rng.standard_normal((MOST_FURTHER, 2)) @ root.T
        more = middle + more / np.sqrt(1 + SMOOTHING**2)
        turned = np.resize(rng.permutation(rolls), MOST_FURTHER)
        every = np.concatenate([offsets, more]), np.concatenate([rolls, turned])
        out.append(FurtherDithers(mode, *every, seed + k))
    return out
