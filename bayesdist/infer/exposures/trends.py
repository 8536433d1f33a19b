"""Test for trends in time of exposures' deviations, which are assumed to scatter at random."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

__all__ = ["trend_p_values"]

Float = NDArray[np.float64]

FEWEST_FREE = 3  # degrees of freedom left by the lines


def trend_p_values(values: Float, epoch: Float, breaks: ArrayLike = ()) -> Float:
    """Probability (k,) of lines in time as steep by chance, for each kind of deviation (E, k).

    An F test of a line in each segment against a constant.  Its noise is the scatter of the
    exposures about the lines, which has all noise of the deviations.  `breaks` are the dates at
    which segments begin; 1 where there are too few exposures.
    """
    segment = np.searchsorted(np.asarray(breaks, float), epoch, side="right")
    constant = (segment[:, None] == np.unique(segment)).astype(float)
    middle = constant.T @ epoch / constant.sum(axis=0)
    lines = constant * (epoch[:, None] - middle)
    lines = lines[:, np.ptp(lines, axis=0) > 0]
    free = len(epoch) - constant.shape[1] - lines.shape[1]
    if free < FEWEST_FREE or not lines.shape[1]:
        return np.ones(values.shape[1])
    flat, bent = (
        values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        for design in (constant, np.column_stack([constant, lines]))
    )
    left = (bent**2).sum(axis=0)
    gain = np.maximum((flat**2).sum(axis=0) - left, 0.0)
    ratio = np.divide(gain / lines.shape[1], left / free, out=np.zeros_like(gain), where=left > 0)
    return np.asarray(stats.f.sf(ratio, lines.shape[1], free))
