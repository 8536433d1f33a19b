"""A pattern that repeats over the detector: the largest peak of the spectrum of the scores."""

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
BINS = 256  # along each side of a chip: periods from a hundredth of it are seen
PADDED = 2  # finer frequencies than the bins', so that none falls between
SLOWEST = 1.5  # periods beyond the polynomial's own, below which it takes waves for terms
MIN_STARS = 100
CANDIDATES = 16  # longest walks that are compared where steps differ from wave to wave


def pattern_test(sample: ScoredSample) -> Outcome | None:
    """Test for a wave of any period and direction on a chip.

    At each frequency k the length of sum g exp(i k x), over the scores g of one axis, is that of a
    walk of steps |g| in directions of chance where there is no wave, whatever the errors of single
    stars.  Detections of one star share the error of its reference position, and are one step
    |sum g exp(i k x)|.  The longest of all frequencies counts as one of so many walks: at lengths
    that matter, even neighbours of the finer frequencies hardly ever exceed it together.

    None for less than `MIN_STARS` stars.
    """
    if len(np.unique(sample.star)) < MIN_STARS:
        return None
    model = sample.model
    allowed = _frequencies(model.order)
    log_tail, power, trials, at = 0.0, 0.0, 0, (0, 0, 0, 0)
    longer = 1.0  # square of the steps, over that of independent detections
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
    unit = np.sqrt(2 / (n * h))  # rms of a wave whose power is one, on one axis

    def smallest(level: float) -> float:
        needed = np.log(trials / level)
        # a noncentral exponential exceeds it with probability 0.9
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
    """Boolean mask of the frequencies of `rfft2` that the polynomial does not take up."""
    n = PADDED * BINS
    j, i = np.fft.fftfreq(n, 1 / n)[:, None], np.arange(n // 2 + 1)[None]
    waves = np.hypot(i, j) / PADDED  # over the chip
    return (waves > SLOWEST * (order + 1) / 2) & (waves < BINS / 2.5)


@dataclass(frozen=True, eq=False)
class _Walks:
    """Scores on one chip, whose sums with the phases of a wave are walks in the plane."""

    cell: Int  # (N,) of BINS^2, row by row
    scores: Float  # (2, N) along each axis of the polynomials
    binned: Float  # (2, BINS, BINS) sums of them
    star: Int | None  # (N,) star of each, from 0; None if each star has one detection

    def candidates(self, lengths: Float) -> list[tuple[int, int]]:
        """Rows and columns (j, i) of the longest walks, or of the longest if steps are alike."""
        n = 1 if self.star is None else CANDIDATES
        longest = np.argpartition(lengths.ravel(), -n)[-n:]
        rows, columns = np.unravel_index(longest, lengths.shape)
        return [(int(j), int(i)) for j, i in zip(rows, columns, strict=True)]

    def steps(self, axis: int, i: int, j: int) -> Float:
        """Length of the step of each star at a frequency of i and j waves over the padded chip."""
        g = self.scores[axis]
        if self.star is None:
            return np.abs(g)
        row, column = np.divmod(self.cell, BINS)
        phase = 2 * np.pi * ((j * row + i * column) % (PADDED * BINS)) / (PADDED * BINS)
        return np.hypot(*(np.bincount(self.star, g * f(phase)) for f in (np.cos, np.sin)))


def _walks(sample: ScoredSample) -> dict[int, _Walks]:
    """Scores on each chip, by its code."""
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
    """Log probability that a plane walk of steps (N,) in directions of chance gets beyond a length.

    By the saddle point of its cumulants K(t) = sum log I_0(t steps): exact for many small steps,
    where it is -length^2 / sum steps^2, and less where a few steps are much of the walk.
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
