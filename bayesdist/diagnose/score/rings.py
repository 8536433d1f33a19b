"""Rings about a centre inside or outside the detector, as tree rings of thick silicon make them.

The phase of rings whose distance falls outwards as the inverse of the radius is quadratic in the
position, kappa |x - c|^2. Multiplied by exp(-i kappa |x|^2) they are plane waves with the
frequency 2 kappa c: one Fourier transform for each kappa looks at all centres c.
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
    explained_by="orders",
    denial="the rings do not explain it",
)
BINS = 128  # along each side of a chip
PADDED = 2  # finer frequencies than the bins', so that none falls between
# Curvature of the phase, in radians per square of the longer half side. Rings of smaller ones are
# wider than the detector; larger ones are closer than 45 pixels in a corner of 2048 x 2048 pixels
# if the centre is in the middle. Halfway between neighbours the phase is off by 0.5 rad rms.
CURVATURES = np.arange(8.0, 52.0, 2.5)
FARTHEST = 3.0  # distance of the centre from the middle of the chip, in longer half sides
MIN_STARS = 100
LEAST_LOG = -1e4  # of a probability
CANDIDATES = 4  # largest sums that are compared where detections of one star make one step


@dataclass(frozen=True, eq=False)
class _Chip:
    """Scores of the detections on one chip."""

    code: int  # into the model's chips
    x: Float  # (2, N) position from the middle of the chip, in longer half sides
    score: Float  # (2, N) along the axes of the polynomials
    cell: Int  # (N,) of BINS^2, row by row
    star: Int  # (N,) from 0
    extent: Float  # (2,) half sides of the chip, in longer ones


@dataclass(frozen=True, eq=False)
class _Rings:
    """Rings of one chip, centre and curvature, with their probability by themselves."""

    log_p: float
    power: float  # of both axes together; two on average without rings
    chip: _Chip
    curvature: float
    centre: Float  # (2,) in longer half sides from the middle of the chip


def ring_test(sample: ScoredSample) -> Outcome | None:
    """Test for rings of any centre; None for less than `MIN_STARS` stars.

    Sums of the scores along both axes are walks in the plane, as in the test of repeating patterns;
    their probabilities are combined (Fisher). The smallest one counts as one of all centres and
    curvatures.
    """
    if len(np.unique(sample.star)) < MIN_STARS:
        return None
    found, trials = None, 0
    for chip in _chips(sample):
        for curvature in CURVATURES:
            allowed = _frequencies(curvature, chip.extent)
            trials += int(allowed.sum())
            for rings in _candidates(chip, float(curvature), allowed):
                if found is None or rings.log_p < found.log_p:
                    found = rings
    if found is None:
        return None
    p_value = float(min(1.0, trials * np.exp(found.log_p)))
    chip, size = found.chip, np.array(sample.model.chips[found.chip.code].size)
    half = size.max() / 2
    centre = size / 2 + 0.5 + found.centre * half
    away = np.hypot(*(chip.x - found.centre[:, None])) * half
    closest, widest = np.pi * half**2 / (found.curvature * np.percentile(away, [95, 5]))
    name = f" of {sample.model.chips[chip.code].name}" if len(sample.model.chips) > 1 else ""
    present = (
        f"the residuals form rings about pixel ({centre[0]:.0f}, {centre[1]:.0f}){name}, "
        f"{closest:.0f} to {widest:.0f} pixels apart"
    )
    h = float(np.mean(sample.curvature[[0, 2]]))
    square = 1.0 / (len(chip.cell) * h)  # rms squared of rings whose power is one, on one axis
    return outcome(
        replace(RINGS, present=present),
        chi_square_of(p_value, 2),
        2,
        None,
        p_value,
        square=2 * square * found.power,
        noise=4 * square,
        unit=sample.model.unit,
        # a noncentral variable exceeds it with probability 0.9
        smallest=lambda level: float(np.sqrt(2 * square) * (np.sqrt(np.log(trials / level)) + 2.0)),
    )


def _chips(sample: ScoredSample) -> Iterator[_Chip]:
    """Scores of each chip."""
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
    """Coordinates of the centre (n, 1) and (1, n) that belong to the frequencies of `fft2`."""
    n = PADDED * BINS
    wave = -np.pi * np.fft.fftfreq(n, 1 / n) / (2 * curvature * PADDED)
    return (wave / extent[1])[:, None], (wave / extent[0])[None]


def _frequencies(curvature: float, extent: Float) -> Bool:
    """Boolean mask of the frequencies of `fft2` whose centre is not too far away."""
    return np.asarray(np.hypot(*_centres(curvature, extent)) <= FARTHEST)


def _candidates(chip: _Chip, curvature: float, allowed: Bool) -> Iterator[_Rings]:
    """Rings with the largest sums of one curvature."""
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
        # the product of two probabilities is that of a sum of two exponentials
        log_q, total = 0.0, 0.0
        for score in chip.score:
            steps = _by_star(chip.star, score * wave)
            sizes = np.abs(steps)
            total += float(np.abs(steps.sum()) ** 2 / (sizes**2).sum())
            log_q += min(log_tail_of_walk(sizes[sizes > 0], _even_length(steps)), 0.0)
        log_q = max(log_q, LEAST_LOG)
        yield _Rings(log_q + np.log1p(-log_q), total, chip, curvature, centre)


def _even_length(steps: Complex) -> float:
    """Length of a walk of steps (N,) whose signs are of chance, if its scatter had no direction.

    Few stars have phases that are not spread evenly over the circle, the more so where the best of
    many centres is taken: the walk then gets farther along one direction than along the other.
    """
    plane = np.stack([steps.real, steps.imag])
    covariance, total = plane @ plane.T, plane.sum(axis=1)
    square = 0.5 * np.trace(covariance) * (total @ np.linalg.pinv(covariance) @ total)
    return float(np.sqrt(square))


def _binned(cell: Int, values: Complex) -> NDArray[np.complex64]:
    """Sums (BINS, BINS) of values (N,) in cells."""
    sums = np.empty(BINS**2, np.complex64)  # candidates alone: their sums are computed again
    sums.real, sums.imag = (np.bincount(cell, part, BINS**2) for part in (values.real, values.imag))
    return sums.reshape(BINS, BINS)


def _by_star(star: Int, values: Complex) -> Complex:
    """Sums of values (N,) over the detections of each star."""
    return np.asarray(np.bincount(star, values.real) + 1j * np.bincount(star, values.imag))
