"""Rings about a centre inside or outside the detector, such as the tree rings of thick silicon.

The spacing of the rings decreases as the inverse of the radius, so that their phase is quadratic in
the position, kappa |x - c|^2.  Multiplied by exp(-i kappa |x|^2), the rings become plane waves with
the frequency 2 kappa c: one Fourier transform per kappa examines all centres c.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2

from bayesdist.diagnose.score.pattern import log_tail_of_walk
from bayesdist.diagnose.score.result import LOOK_UP_TABLE, Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.significance import chi_square_of
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Complex, Float, Int

RINGS = Family(
    "rings",
    f"correct the positions for rings of the silicon, or {LOOK_UP_TABLE} with nodes closer than "
    "half the distance of the rings; a higher order does not help",
    "",
    "the residuals do not form rings",
)
BINS = 128  # along each side of a chip
PADDED = 2  # oversampling of the frequencies, so that no wave falls between them
# Curvature of the phase, in radians per square of the longer half side. Rings with a smaller
# curvature are wider than the detector; those with a larger one are closer than 45 pixels in a
# corner of 2048 x 2048 pixels if the centre is in the middle. Halfway between neighbouring values
# the phase error is 0.5 rad rms.
CURVATURES = np.arange(8.0, 52.0, 2.5)
FARTHEST = 3.0  # largest distance of the centre from the middle of the chip, in longer half sides
MIN_STARS = 100
LEAST_LOG = -1e4  # smallest log probability, to avoid underflow
CANDIDATES = 4  # largest sums that are recomputed if the detections of one star form one step


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
            allowed = _frequencies(curvature, chip.extent)
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
    score = sample.on_detector[0].T
    cell = cell_index(sample.X, sample.Y, (BINS, BINS))
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
    n = PADDED * BINS
    wave = -np.pi * np.fft.fftfreq(n, 1 / n) / (2 * curvature * PADDED)
    return (wave / extent[1])[:, None], (wave / extent[0])[None]


def _frequencies(curvature: float, extent: Float) -> Bool:
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
    n = CANDIDATES if int(chip.star.max()) + 1 < len(chip.star) else 1
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
    sums = np.empty(BINS**2, np.complex64)
    sums.real, sums.imag = (np.bincount(cell, part, BINS**2) for part in (values.real, values.imag))
    return sums.reshape(BINS, BINS)


def _by_star(star: Int, values: Complex) -> Complex:
    """Sums of values (N,) over the detections of each star."""
    return np.asarray(np.bincount(star, values.real) + 1j * np.bincount(star, values.imag))
