"""A pattern that repeats over the detector: the largest peak of the spectrum of the scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.score.families import FAMILIES
from bayesdist.diagnose.score.result import Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.grid import cell_index

__all__ = ["pattern_test"]

Float = NDArray[np.float64]

BINS = 256  # along each side of a chip: periods from a hundredth of it are seen
PADDED = 2  # finer frequencies than the bins', so that none falls between
INDEPENDENT = 2.0  # frequencies that the padding makes of one, as far as maxima go
SLOWEST = 1.5  # periods beyond the polynomial's own, below which it takes waves for terms
MIN_STARS = 100


def pattern_test(sample: ScoredSample) -> Outcome | None:
    """Test for a wave of any period and direction on a chip.

    At each frequency k the power |sum g exp(i k x)|^2 of the scores g of one axis, over the sum of
    their squares, is exponential where there is no wave, whatever the errors of single stars.

    None for less than `MIN_STARS` detections.
    """
    if len(sample) < MIN_STARS:
        return None
    model = sample.model
    power, trials, at = 0.0, 0.0, (0, 0, 0, 0)
    for chip, (scores, squares) in _binned(sample).items():
        allowed = _frequencies(model.order)
        for axis in (0, 1):
            found = np.abs(np.fft.rfft2(scores[axis], (PADDED * BINS,) * 2)) ** 2
            found /= max(float(squares[axis]), 1e-300)
            found[~allowed] = 0.0
            j, i = np.unravel_index(np.argmax(found), found.shape)
            trials += allowed.sum() / PADDED**2 * INDEPENDENT
            if found[j, i] > power:
                power, at = float(found[j, i]), (int(i), int(j), chip, axis)
    p_value = float(-np.expm1(trials * np.log1p(-np.exp(-power)))) if power > 0 else 1.0
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
        replace(FAMILIES["repeating pattern"], present=present),
        2 * power,
        2,
        None,
        p_value,
        square=float(unit**2 * power),
        noise=float(unit**2),
        unit=model.unit,
        smallest=smallest,
    )


def _frequencies(order: int) -> NDArray[np.bool_]:
    """Boolean mask of the frequencies of `rfft2` that the polynomial does not take up."""
    n = PADDED * BINS
    j, i = np.fft.fftfreq(n, 1 / n)[:, None], np.arange(n // 2 + 1)[None]
    waves = np.hypot(i, j) / PADDED  # over the chip
    return (waves > SLOWEST * (order + 1) / 2) & (waves < BINS / 2.5)


def _binned(sample: ScoredSample) -> dict[int, tuple[Float, Float]]:
    """Scores (2, BINS, BINS) along the axes of the polynomials on each chip, and their squares."""
    out = dict[int, tuple[Float, Float]]()
    code = cell_index(sample.X, sample.Y, (BINS, BINS))
    for block in sample.blocks:
        g = block.frame.T @ sample.whole_score[:, block.rows]
        scores, squares = out.setdefault(block.chip, (np.zeros((2, BINS, BINS)), np.zeros(2)))
        for axis in (0, 1):
            binned = np.bincount(code[block.rows], g[axis], minlength=BINS * BINS)
            scores[axis] += binned.reshape(BINS, BINS)
            squares[axis] += float((g[axis] ** 2).sum())
    return out
