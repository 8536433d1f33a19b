"""The scatter of matches about a polynomial, for tables that say nothing about their errors."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from bayesdist.data import Matches
from bayesdist.model.basis import polynomial_terms

__all__ = ["guessed_sigma"]

ORDER = 4
ROUNDS = 20
NORMAL = 1.4826022185056018  # 1 / (median of |z|, z standard normal)
CLIP = 4.0  # robust standard deviations
EACH = 4  # stars for each coefficient, at least


def guessed_sigma(table: Matches) -> float | None:
    """Robust scatter along an axis about polynomials on each chip of each exposure, two digits.

    Parameters
    ----------
    table : Matches

    Returns
    -------
    float or None
        In the unit of u, v; None of too few stars, or without scatter.
    """
    i, j = np.array(polynomial_terms(ORDER)).T
    groups = table.exposure * len(table.chip_numbers) + table.chip
    residuals: list[NDArray[np.float64]] = []
    for group in np.unique(groups):
        rows = groups == group
        if rows.sum() < EACH * len(i):
            continue
        X, Y = (2 * (z - z.min()) / max(np.ptp(z), 1.0) - 1 for z in (table.x[rows], table.y[rows]))
        basis = legendre.legvander(X, ORDER)[:, i] * legendre.legvander(Y, ORDER)[:, j]
        data = np.stack([table.u[rows], table.v[rows]], axis=-1)
        used = np.ones(len(X), bool)
        for _ in range(ROUNDS):
            left = data - basis @ np.linalg.lstsq(basis[used], data[used])[0]
            size = NORMAL * np.median(np.abs(left[used]))
            now = (np.abs(left) <= CLIP * size).all(axis=1)
            if (now == used).all() or now.sum() < 2 * len(i):
                break
            used = now
        # what the fit has taken up is given back
        residuals.append(left[used].ravel() * np.sqrt(used.sum() / (used.sum() - len(i))))
    if not residuals:
        return None
    sigma = NORMAL * float(np.median(np.abs(np.concatenate(residuals))))
    return float(f"{sigma:.2g}") if sigma > 0 else None
