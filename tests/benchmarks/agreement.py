"""Do two samplers sample the same posterior?"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["compare"]

Float = NDArray[np.float64]


def compare(draws: Float, ess: float, ours: Float, our_ess: float) -> dict[str, Any]:
    """Differences of means and standard deviations, largest over parameters.

    Parameters
    ----------
    draws, ours : ndarray, shape (..., D)
    ess, our_ess : float
        Their smallest effective sample sizes.

    Returns
    -------
    dict
        ``shift``: difference of means in standard deviations; ``shift_errors``: the same in
        Monte-Carlo errors; ``sd_ratio``: smallest and largest ratio of standard deviations;
        ``sd_errors``: largest deviation of that ratio from one, in Monte-Carlo errors.
    """
    a, b = (x.reshape(-1, x.shape[-1]) for x in (draws, ours))
    shift = np.abs(a.mean(axis=0) - b.mean(axis=0)) / b.std(axis=0)
    ratio = a.std(axis=0) / b.std(axis=0)
    error = np.sqrt(1 / ess + 1 / our_ess)
    kurtosis = (((b - b.mean(axis=0)) / b.std(axis=0)) ** 4).mean(axis=0)
    sd_error = error * np.sqrt((kurtosis - 1) / 4)
    return {
        "shift": float(shift.max()),
        "shift_errors": float(shift.max() / error),
        "sd_ratio": [float(ratio.min()), float(ratio.max())],
        "sd_errors": float((np.abs(np.log(ratio)) / sd_error).max()),
    }
