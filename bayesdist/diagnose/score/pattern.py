"""Test for a pattern that repeats over the detector: a peak in the spectrum of the scores."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import i0e, i1e

from bayesdist.diagnose.score.result import LOOK_UP_TABLE, Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int

REPEATING = Family(
    "repeating pattern",
    f"correct the positions for it, or {LOOK_UP_TABLE} with nodes closer than half the period",
    "",
    "no pattern repeats over the detector",
)
BINS = 256  # along each side of a chip: periods down to about 1/100 of the side are detected
PADDED = 2  # oversampling of the frequencies, so that no wave falls between them
# multiple of the polynomial's highest frequency below which the polynomial absorbs waves
SLOWEST = 1.5
MIN_STARS = 100
CANDIDATES = 16  # longest walks that are recomputed if steps depend on the wave


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
    allowed = _frequencies(model.order)
    log_tail, power, trials, at = 0.0, 0.0, 0, (0, 0, 0, 0)
    longer = 1.0  # mean square of the steps divided by that of independent detections
    for chip, walks in _walks(sample).items():
        for axis in (0, 1):
            if not walks.scores[axis].any():
                continue
            lengths = np.abs(np.fft.rfft2(walks.binned[axis], (PADDED * BINS,) * 2))
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
    signed = row if row <= PADDED * BINS // 2 else row - PADDED * BINS
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


def _frequencies(order: int) -> Bool:
    """Boolean mask of the frequencies of `rfft2` that the polynomial does not absorb."""
    n = PADDED * BINS
    j, i = np.fft.fftfreq(n, 1 / n)[:, None], np.arange(n // 2 + 1)[None]
    waves = np.hypot(i, j) / PADDED  # number of waves over the chip
    return (waves > SLOWEST * (order + 1) / 2) & (waves < BINS / 2.5)


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
        n = 1 if self.star is None else CANDIDATES
        longest = np.argpartition(lengths.ravel(), -n)[-n:]
        rows, columns = np.unravel_index(longest, lengths.shape)
        return [(int(j), int(i)) for j, i in zip(rows, columns, strict=True)]

    def steps(self, axis: int, i: int, j: int) -> Float:
        """Step length of each star for a wave with i and j periods over the padded chip."""
        g = self.scores[axis]
        if self.star is None:
            return np.abs(g)
        row, column = np.divmod(self.cell, BINS)
        phase = 2 * np.pi * ((j * row + i * column) % (PADDED * BINS)) / (PADDED * BINS)
        return np.hypot(*(np.bincount(self.star, g * f(phase)) for f in (np.cos, np.sin)))


def _walks(sample: ScoredSample) -> dict[int, _Walks]:
    """Scores of the detections, by the index of the chip."""
    parts = dict[int, list[tuple[Int, Float, Int]]]()
    code = cell_index(sample.X, sample.Y, (BINS, BINS))
    for block in sample.blocks:
        scores = block.frame.T @ sample.whole_score[:, block.rows]
        rows = code[block.rows], scores, sample.star[block.rows]
        parts.setdefault(block.chip, []).append(rows)
    out: dict[int, _Walks] = {}
    for chip, several in parts.items():
        cell, scores, star = (np.concatenate(p, axis=-1) for p in zip(*several, strict=True))
        binned = np.array([np.bincount(cell, g, minlength=BINS * BINS) for g in scores])
        distinct, star = np.unique(star, return_inverse=True)
        single = len(distinct) == len(star)
        binned = binned.astype(float).reshape(2, BINS, BINS)
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
