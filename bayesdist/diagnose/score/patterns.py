"""Tests for patterns of the detector: jumps, repeating patterns, and rings.

**Jumps** are residuals that differ between both sides of a column or row of the detector.  The
boundaries of amplifiers, stitched masks, strips of the field from another epoch or list, and plates
of a catalogue are lines.  A polynomial bends to follow such a step, and a smooth field rounds it
off; neither includes the remaining residuals, which extend over much of the detector.  At each of
`EDGES` columns and rows of a chip, the score of a step is tested using its sandwich covariance.
The step is orthogonal to polynomials along its axis up to `HIGHER` orders above the model's.  The
p-value of the most significant edge is multiplied by the number of edges (Bonferroni).

**Patterns that repeat** over the detector are peaks in the spectrum of the scores.

**Rings** have a centre inside or outside the detector, such as the tree rings of thick silicon.
The spacing of the rings decreases as the inverse of the radius, so that their phase is quadratic in
the position x, ``kappa |x - c|^2`` with the centre c.  Multiplied by ``exp(-i kappa |x|^2)``, the
rings become plane waves with the frequency 2 kappa c: one Fourier transform per kappa examines all
centres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.fft import fft2
from scipy.special import i0e, i1e

from bayesdist.diagnose.score.result import (
    LOOK_UP_TABLE,
    Family,
    Outcome,
    outcome,
    smallest_pattern,
)
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.statistics import chi_square_of, hotelling_p, sums_over
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Complex, Float, Int

JUMPS = Family(
    "jumps",
    "fit the parts on both sides separately, correct the offset between them, or "
    f"{LOOK_UP_TABLE}; a higher order does not help",
    "",
    "the residuals do not jump at any column or row",
)
EDGES = 31  # number of columns, and also of rows, that are tested on each chip
HIGHER = 2  # orders above the model's to which the steps are orthogonal
MIN_STARS_ON_A_SIDE = 60
LARGEST_LEVERAGE = 0.5
REPEATING = Family(
    "repeating pattern",
    f"correct the positions for it, or {LOOK_UP_TABLE} with nodes closer than half the period",
    "",
    "no pattern repeats over the detector",
)
PATTERN_BINS = (
    256  # along each side of a chip: periods down to about 1/100 of the side are detected
)
PADDED = 2  # oversampling of the frequencies, so that no wave falls between them
# multiple of the polynomial's highest frequency below which the polynomial absorbs waves
SLOWEST = 1.5
MIN_STARS = 100
WALK_CANDIDATES = 16  # longest walks that are recomputed if steps depend on the wave
RINGS = Family(
    "rings",
    f"correct the positions for rings of the silicon, or {LOOK_UP_TABLE} with nodes closer than "
    "half the distance of the rings; a higher order does not help",
    "",
    "the residuals do not form rings",
)
RING_BINS = 128  # along each side of a chip
# Curvature of the phase, in radians per square of the longer half side. Rings with a smaller
# curvature are wider than the detector; those with a larger one are closer than 45 pixels in a
# corner of 2048 x 2048 pixels if the centre is in the middle. Halfway between neighbouring values
# the phase error is 0.5 rad rms.
CURVATURES = np.arange(8.0, 52.0, 2.5)
FARTHEST = 3.0  # largest distance of the centre from the middle of the chip, in longer half sides
LEAST_LOG = -1e4  # smallest log probability, to avoid underflow
RING_CANDIDATES = 4  # largest sums that are recomputed if the detections of one star form one step


@dataclass(frozen=True, eq=False)
class _Jump:
    """Step at one column or row."""

    p_value: float
    chip: int  # index into the model's chips
    axis: int  # 0 for a column (an edge at constant x), 1 for a row
    pixel: float  # position of the edge, in FITS pixels
    step: Float  # (2,) along the detector's directions of u and v, in the unit of u and v
    variance: Float  # (2,) variance of `step`


def jump_test(sample: ScoredSample) -> Outcome | None:
    """Test for jumps; None if no column or row has enough stars on both sides."""
    jumps = list(_jumps(sample))
    if not jumps:
        return None
    worst = min(jumps, key=lambda jump: jump.p_value)
    p_value = min(1.0, worst.p_value * len(jumps))
    chips = sample.model.chips
    place = f"{'column' if worst.axis == 0 else 'row'} {worst.pixel:.0f}"
    if len(chips) > 1:
        place += f" of {chips[worst.chip].name}"
    present = (
        f"the residuals jump near {place} by {np.hypot(*worst.step):.2g} {sample.model.unit}, "
        "as where amplifiers, stitched parts, or strips of another epoch or list meet"
    )
    noise = float(worst.variance.sum()) / 4
    return outcome(
        replace(JUMPS, present=present),
        chi_square_of(p_value, 2),
        2,
        None,
        p_value,
        # half a step on each side
        square=float((worst.step**2).sum()) / 4,
        noise=noise,
        unit=sample.model.unit,
        smallest=lambda level: smallest_pattern(np.sqrt(noise), 2, None, level / len(jumps)),
    )


def _jumps(sample: ScoredSample) -> Iterator[_Jump]:
    """Iterate over the steps at all columns and rows with enough stars on both sides."""
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    usable = sample.used & (leverage.max(axis=0) < LARGEST_LEVERAGE)
    for code, chip in enumerate(sample.model.chips):
        rows = np.flatnonzero(usable & (sample.chip == code))
        if len(rows) < 2 * MIN_STARS_ON_A_SIDE:
            continue
        star = np.unique(sample.star[rows], return_inverse=True)[1]
        gradient, curvature = (values[rows] for values in sample.on_detector)
        curvature = curvature.mean(axis=1)
        order = sample.model.order + HIGHER
        for axis, scaled in enumerate((sample.X[rows], sample.Y[rows])):
            smooth = legendre.legvander(scaled, order).T
            inverse = np.linalg.inv((smooth * curvature) @ smooth.T)
            for edge in np.linspace(-1.0, 1.0, EDGES + 2)[1:-1]:
                beyond = scaled > edge
                n = np.count_nonzero(beyond)
                if min(n, len(rows) - n) < MIN_STARS_ON_A_SIDE:
                    continue
                step = beyond - ((beyond * curvature) @ smooth.T) @ inverse @ smooth
                result = _jump(step, gradient, curvature, star)
                if result is not None:
                    pixel = 0.5 + (edge + 1) / 2 * chip.size[axis]
                    yield _Jump(result[0], code, axis, pixel, *result[1:])


def _jump(
    step: Float, gradient: Float, curvature: Float, star: Int
) -> tuple[float, Float, Float] | None:
    """P-value of a step (n,), its size (2,) along both axes, and the variances (2,) of the size.

    `gradient` (n, 2) and `curvature` (n,) are those of the log-likelihood.  Returns None if the
    data do not constrain the step.
    """
    by_star = sums_over(star, step[:, None] * gradient)
    total, covariance = by_star.sum(axis=0), by_star.T @ by_star
    information = float(curvature @ step**2)
    if information <= 0 or np.linalg.det(covariance) <= 0:
        return None
    statistic = float(total @ np.linalg.solve(covariance, total))
    p_value = hotelling_p(statistic, 2, len(by_star))
    return p_value, total / information, np.diag(covariance) / information**2


def pattern_test(sample: ScoredSample) -> Outcome | None:
    """Test for a wave of any period and direction on a chip.

    For each frequency k and the scores g of one axis, the length of sum g exp(i k x) is, without a
    wave, that of a random walk of steps |g| in random directions, for any errors of single stars.
    Detections of one star share the error of its reference position and form one step |sum g exp(i
    k x)|.  The p-value of the longest walk is corrected for the number of frequencies:  at relevant
    lengths, neighbours among the oversampled frequencies hardly ever exceed it together.  Returns
    None if there are fewer than `MIN_STARS` stars.
    """
    if len(np.unique(sample.star)) < MIN_STARS:
        return None
    model = sample.model
    allowed = _pattern_frequencies(model.order)
    log_tail, power, trials, at = 0.0, 0.0, 0, (0, 0, 0, 0)
    longer = 1.0  # mean square of the steps divided by that of independent detections
    for chip, walks in _walks(sample).items():
        for axis in (0, 1):
            if not walks.scores[axis].any():
                continue
            lengths = np.abs(np.fft.rfft2(walks.binned[axis], (PADDED * PATTERN_BINS,) * 2))
            lengths[~allowed] = 0.0
            trials += int(allowed.sum())
            for j, i in walks.candidates(lengths):
                steps = walks.steps(axis, i, j)
                tail = log_tail_of_walk(steps, float(lengths[j, i]))
                if tail < log_tail:
                    log_tail, at = tail, (i, j, chip, axis)
                    power = float(lengths[j, i] ** 2 / (steps**2).sum())
                    longer = float((steps**2).sum() / (walks.scores[axis] ** 2).sum())
    p_value = float(-np.expm1(trials * np.log1p(-np.exp(log_tail)))) if power > 0 else 1.0
    column, row, chip, axis = at
    size = model.chips[chip].size
    signed = row if row <= PADDED * PATTERN_BINS // 2 else row - PADDED * PATTERN_BINS
    period = PADDED / max(np.hypot(column / size[0], signed / size[1]), 1e-12)
    h = float(np.mean(sample.curvature[[0, 2]]))
    n = len(sample) / len(model.chips)
    unit = np.sqrt(2 / (n * h))  # rms of a wave with unit power, on one axis

    def smallest(level: float) -> float:
        needed = np.log(trials / level)
        # a noncentral exponential exceeds the limit with probability 0.9
        return float(unit * np.sqrt(longer) * (np.sqrt(needed) + 1.0))

    present = (
        f"the residuals along {'uv'[axis]} repeat over the detector with a period of {period:.0f} "
        "pixels"
    )
    return outcome(
        replace(REPEATING, present=present),
        2 * power,
        2,
        None,
        p_value,
        square=float(unit**2 * longer * power),
        noise=float(unit**2 * longer),
        unit=model.unit,
        smallest=smallest,
    )


def _pattern_frequencies(order: int) -> Bool:
    """Boolean mask of the frequencies of `rfft2` that the polynomial does not absorb."""
    n = PADDED * PATTERN_BINS
    j, i = np.fft.fftfreq(n, 1 / n)[:, None], np.arange(n // 2 + 1)[None]
    waves = np.hypot(i, j) / PADDED  # number of waves over the chip
    return (waves > SLOWEST * (order + 1) / 2) & (waves < PATTERN_BINS / 2.5)


@dataclass(frozen=True, eq=False)
class _Walks:
    """Scores on one chip; their sums with the phases of a wave are random walks in the plane."""

    cell: Int  # (N,) index of one of BINS^2 cells, row by row
    scores: Float  # (2, N) along each axis of the polynomials
    binned: Float  # (2, BINS, BINS) their sums per cell
    star: Int | None  # (N,) star of each detection, from 0; None if each star has one detection

    def candidates(self, lengths: Float) -> list[tuple[int, int]]:
        """Rows and columns (j, i) of the longest walks.

        A single pair if each star has one detection.
        """
        n = 1 if self.star is None else WALK_CANDIDATES
        longest = np.argpartition(lengths.ravel(), -n)[-n:]
        rows, columns = np.unravel_index(longest, lengths.shape)
        return [(int(j), int(i)) for j, i in zip(rows, columns, strict=True)]

    def steps(self, axis: int, i: int, j: int) -> Float:
        """Step length of each star for a wave with i and j periods over the padded chip."""
        g = self.scores[axis]
        if self.star is None:
            return np.abs(g)
        row, column = np.divmod(self.cell, PATTERN_BINS)
        phase = (
            2 * np.pi * ((j * row + i * column) % (PADDED * PATTERN_BINS)) / (PADDED * PATTERN_BINS)
        )
        return np.hypot(*(np.bincount(self.star, g * f(phase)) for f in (np.cos, np.sin)))


def _walks(sample: ScoredSample) -> dict[int, _Walks]:
    """Scores of the detections, by the index of the chip."""
    parts = dict[int, list[tuple[Int, Float, Int]]]()
    code = cell_index(sample.X, sample.Y, (PATTERN_BINS, PATTERN_BINS))
    for block in sample.blocks:
        scores = block.frame.T @ sample.whole_score[:, block.rows]
        rows = code[block.rows], scores, sample.star[block.rows]
        parts.setdefault(block.chip, []).append(rows)
    out: dict[int, _Walks] = {}
    for chip, several in parts.items():
        cell, scores, star = (np.concatenate(p, axis=-1) for p in zip(*several, strict=True))
        binned = np.array(
            [np.bincount(cell, g, minlength=PATTERN_BINS * PATTERN_BINS) for g in scores]
        )
        distinct, star = np.unique(star, return_inverse=True)
        single = len(distinct) == len(star)
        binned = binned.astype(float).reshape(2, PATTERN_BINS, PATTERN_BINS)
        out[chip] = _Walks(cell, scores, binned, None if single else star)
    return out


def log_tail_of_walk(steps: Float, length: float) -> float:
    """Log probability that a random walk in the plane exceeds `length`.

    `steps` (N,) are its step lengths.

    The saddle-point approximation with the cumulants K(t) = sum log I_0(t steps) is exact for many
    small steps, for which the result is -length^2 / sum steps^2.  It is smaller if a few steps
    dominate the walk.
    """
    if length >= steps.sum():
        return -np.inf
    t = 2 * length / (steps**2).sum()
    for _ in range(50):
        ratio = i1e(t * steps) / i0e(t * steps)
        slope = (steps**2 * (1 - ratio**2) - steps * ratio / t).sum()
        step = (length - steps @ ratio) / slope
        t = max(t + step, 0.5 * t)
        if abs(step) < 1e-9 * t:
            break
    cumulants = (np.log(i0e(t * steps)) + t * steps).sum()
    return float(cumulants - t * length + 0.5 * np.log(length / (t * slope)))


@dataclass(frozen=True, eq=False)
class _Chip:
    """Scores of the detections on one chip."""

    code: int  # index into the model's chips
    x: Float  # (2, N) position from the middle of the chip, in longer half sides
    score: Float  # (2, N) along the axes of the polynomials
    cell: Int  # (N,) index of one of BINS^2 cells, row by row
    star: Int  # (N,) star number, from 0
    extent: Float  # (2,) half sides of the chip, in units of the longer one


@dataclass(frozen=True, eq=False)
class _Rings:
    """Rings on one chip: centre and curvature, with their uncorrected log probability."""

    log_p: float
    power: float  # normalised power of both axes together; two on average without rings
    chip: _Chip
    curvature: float
    centre: Float  # (2,) in longer half sides from the middle of the chip


def ring_test(sample: ScoredSample) -> Outcome | None:
    """Test for rings about any centre; None if there are fewer than `MIN_STARS` stars.

    Sums of the scores along both axes are random walks in the plane, as in the test for repeating
    patterns, and their probabilities are combined (Fisher).  The smallest is corrected for the
    number of centres and curvatures.
    """
    if len(np.unique(sample.star)) < MIN_STARS:
        return None
    best, trials = None, 0
    for chip in _chips(sample):
        for curvature in CURVATURES:
            allowed = _ring_frequencies(curvature, chip.extent)
            trials += int(allowed.sum())
            for rings in _candidates(chip, float(curvature), allowed):
                if best is None or rings.log_p < best.log_p:
                    best = rings
    if best is None:
        return None
    p_value = float(min(1.0, trials * np.exp(best.log_p)))
    chip, size = best.chip, np.array(sample.model.chips[best.chip.code].size)
    half = size.max() / 2
    centre = size / 2 + 0.5 + best.centre * half
    away = np.hypot(*(chip.x - best.centre[:, None])) * half
    closest, widest = np.pi * half**2 / (best.curvature * np.percentile(away, [95, 5]))
    name = f" of {sample.model.chips[chip.code].name}" if len(sample.model.chips) > 1 else ""
    present = (
        f"the residuals form rings about pixel ({centre[0]:.0f}, {centre[1]:.0f}){name}, "
        f"{closest:.0f} to {widest:.0f} pixels apart"
    )
    h = float(np.mean(sample.curvature[[0, 2]]))
    square = 1.0 / (len(chip.cell) * h)  # mean square of rings with unit power, on one axis
    return outcome(
        replace(RINGS, present=present),
        chi_square_of(p_value, 2),
        2,
        None,
        p_value,
        square=2 * square * best.power,
        noise=4 * square,
        unit=sample.model.unit,
        # a noncentral variable exceeds the limit with probability 0.9
        smallest=lambda level: float(np.sqrt(2 * square) * (np.sqrt(np.log(trials / level)) + 2.0)),
    )


def _chips(sample: ScoredSample) -> Iterator[_Chip]:
    """Iterate over the chips with enough detections, with their scores."""
    score = sample.uncorrelated[0].T
    cell = cell_index(sample.X, sample.Y, (RING_BINS, RING_BINS))
    for code, chip in enumerate(sample.model.chips):
        rows = np.flatnonzero(sample.used & (sample.chip == code))
        if len(rows) < MIN_STARS:
            continue
        extent = np.array(chip.size) / max(chip.size)
        x = np.stack([sample.X[rows], sample.Y[rows]]) * extent[:, None]
        star = np.unique(sample.star[rows], return_inverse=True)[1]
        yield _Chip(code, x, score[:, rows], cell[rows], star, extent)


def _centres(curvature: float, extent: Float) -> tuple[Float, Float]:
    """Coordinates (n, 1) and (1, n) of the ring centres for the frequencies of `fft2`."""
    n = PADDED * RING_BINS
    wave = -np.pi * np.fft.fftfreq(n, 1 / n) / (2 * curvature * PADDED)
    return (wave / extent[1])[:, None], (wave / extent[0])[None]


def _ring_frequencies(curvature: float, extent: Float) -> Bool:
    """Boolean mask of the frequencies of `fft2` for which the centre is within `FARTHEST`."""
    return np.asarray(np.hypot(*_centres(curvature, extent)) <= FARTHEST)


def _candidates(chip: _Chip, curvature: float, allowed: Bool) -> Iterator[_Rings]:
    """Iterate over the rings with the largest sums for one curvature."""
    phase = np.exp(-1j * curvature * (chip.x**2).sum(axis=0))
    power = np.zeros(allowed.shape, np.float32)
    for score in chip.score:
        transformed = fft2(_binned(chip.cell, score * phase), allowed.shape)
        power += (transformed.real**2 + transformed.imag**2) / (score**2).sum()
    power[~allowed] = 0.0
    n = RING_CANDIDATES if int(chip.star.max()) + 1 < len(chip.star) else 1
    y, x = _centres(curvature, chip.extent)
    largest = [power.argmax()] if n == 1 else np.argpartition(power.ravel(), -n)[-n:]
    for k in largest:
        j, i = np.unravel_index(k, power.shape)
        centre = np.array([x[0, i], y[j, 0]])
        wave = phase * np.exp(2j * curvature * (centre @ chip.x))
        # the probability of the product of two p-values follows from the sum of two exponentials
        log_q, total = 0.0, 0.0
        for score in chip.score:
            steps = _by_star(chip.star, score * wave)
            sizes = np.abs(steps)
            total += float(np.abs(steps.sum()) ** 2 / (sizes**2).sum())
            log_q += min(log_tail_of_walk(sizes[sizes > 0], _even_length(steps)), 0.0)
        log_q = max(log_q, LEAST_LOG)
        yield _Rings(log_q + np.log1p(-log_q), total, chip, curvature, centre)


def _even_length(steps: Complex) -> float:
    """Length of a walk of steps (N,) with random signs, rescaled as if its scatter were isotropic.

    The phases of a few stars are not spread evenly over the circle, in particular for the best of
    many centres.  The walk then extends farther along one direction than along the other.
    """
    plane = np.stack([steps.real, steps.imag])
    covariance, total = plane @ plane.T, plane.sum(axis=1)
    square = 0.5 * np.trace(covariance) * (total @ np.linalg.pinv(covariance) @ total)
    return float(np.sqrt(square))


def _binned(cell: Int, values: Complex) -> NDArray[np.complex64]:
    """Sums (BINS, BINS) of values (N,) in cells."""
    # single precision suffices to find candidates: their sums are computed again
    sums = np.empty(RING_BINS**2, np.complex64)
    sums.real, sums.imag = (
        np.bincount(cell, part, RING_BINS**2) for part in (values.real, values.imag)
    )
    return sums.reshape(RING_BINS, RING_BINS)


def _by_star(star: Int, values: Complex) -> Complex:
    """Sums of values (N,) over the detections of each star."""
    return np.asarray(np.bincount(star, values.real) + 1j * np.bincount(star, values.imag))
