"""A pattern that repeats over the detector: the largest peak of the spectrum of the scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import i0e, i1e

from bayesdist.diagnose.score.result import Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Bool, Float, Int

REPEATING = Family(
    "repeating pattern",
    "fit a look-up table with nodes closer than half the period",
    "",
    "no pattern repeats over the detector",
)
BINS = 256  # along each side of a chip: periods from a hundredth of it are seen
PADDED = 2  # finer frequencies than the bins', so that none falls between
SLOWEST = 1.5  # periods beyond the polynomial's own, below which it takes waves for terms
MIN_STARS = 100


def pattern_test(sample: ScoredSample) -> Outcome | None:
    """Test for a wave of any period and direction on a chip.

    At each frequency k the length of sum g exp(i k x), over the scores g of one axis, is that of a
    walk of steps |g| in directions of chance where there is no wave, whatever the errors of single
    stars.  The longest of all frequencies counts as one of so many walks: at lengths that matter,
    even neighbours of the finer frequencies hardly ever exceed it together.

    None for less than `MIN_STARS` detections.
    """
    if len(sample) < MIN_STARS:
        return None
    model = sample.model
    allowed = _frequencies(model.order)
    log_tail, power, trials, at = 0.0, 0.0, 0, (0, 0, 0, 0)
    for chip, (scores, binned) in _binned(sample).items():
        for axis in (0, 1):
            if not scores[axis].any():
                continue
            found = np.abs(np.fft.rfft2(binned[axis], (PADDED * BINS,) * 2))
            found[~allowed] = 0.0
            j, i = np.unravel_index(np.argmax(found), found.shape)
            trials += int(allowed.sum())
            tail = _log_tail(np.abs(scores[axis]), float(found[j, i]))
            if tail < log_tail:
                log_tail, at = tail, (int(i), int(j), chip, axis)
                power = float(found[j, i] ** 2 / (scores[axis] ** 2).sum())
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
        return float(unit * (np.sqrt(needed) + 1.0))

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
        square=float(unit**2 * power),
        noise=float(unit**2),
        unit=model.unit,
        smallest=smallest,
    )


def _frequencies(order: int) -> Bool:
    """Boolean mask of the frequencies of `rfft2` that the polynomial does not take up."""
    n = PADDED * BINS
    j, i = np.fft.fftfreq(n, 1 / n)[:, None], np.arange(n // 2 + 1)[None]
    waves = np.hypot(i, j) / PADDED  # over the chip
    return (waves > SLOWEST * (order + 1) / 2) & (waves < BINS / 2.5)


def _binned(sample: ScoredSample) -> dict[int, tuple[list[Float], Float]]:
    """Scores (N,) along each axis of the polynomials on each chip, and binned (2, BINS, BINS)."""
    found = dict[int, list[tuple[Int, Float]]]()
    code = cell_index(sample.X, sample.Y, (BINS, BINS))
    for block in sample.blocks:
        scores = block.frame.T @ sample.whole_score[:, block.rows]
        found.setdefault(block.chip, []).append((code[block.rows], scores))
    out: dict[int, tuple[list[Float], Float]] = {}
    for chip, parts in found.items():
        cells = np.concatenate([one for one, _ in parts])
        whole = np.concatenate([one for _, one in parts], axis=1)
        binned = np.array([np.bincount(cells, one, minlength=BINS * BINS) for one in whole])
        out[chip] = list(whole), binned.astype(float).reshape(2, BINS, BINS)
    return out


def _log_tail(steps: Float, length: float) -> float:
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
