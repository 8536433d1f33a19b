"""Matches at pixels corrected by look-up tables, and residuals converted to pixel shifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.stars import errors_of, groups_of
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected
from bayesdist.utils.arrays import Bool, Float

FOLDED = 1e-6  # determinant of the Jacobian over its squared norm, below which it is singular


@dataclass(frozen=True, eq=False)
class PixelShifts:
    """Residuals of matched stars in pixels of the detector.

    Parameters
    ----------
    shift : ndarray, shape (N, 2)
        Corrections to be added to x and y, in pixels.
    variance : ndarray, shape (N, 2)
        Variances of the shifts from the quoted errors, in square pixels. The correlation of a few
        per cent between x and y that a skewed polynomial causes is neglected.
    """

    shift: Float
    variance: Float


def pixel_shifts(solution: Solution, matches: Matches) -> PixelShifts:
    """Convert residuals in u, v to pixel shifts with the inverse of the local Jacobian.

    Parameters
    ----------
    solution : Solution
        Its mean is used.
    matches : Matches
        N stars with errors, in the unit of the solution.

    Returns
    -------
    PixelShifts
        Accurate to first order in the residual. The second-order term is below 1e-5 pixels for
        residuals of 0.2 pixels and the curvature of ACS/WFC.

    Raises
    ------
    InputError
        If the matches have no errors or another unit than the model.
    DegenerateError
        If the Jacobian of the polynomial is singular at a star.
    """
    sigma_u, sigma_v = errors_of(matches)
    model, groups = solution.model, groups_of(solution.model, matches)
    fitted, J = model.linearised(solution.mean, groups, matches.x, matches.y)
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    folded = np.abs(det) <= FOLDED * (J**2).sum(axis=(1, 2))
    if folded.any():
        k = int(np.argmax(folded))
        number = matches.chip_numbers[matches.chip[k]]
        raise DegenerateError(
            "the polynomial maps neighbouring pixels to one position",
            where=f"pixel ({matches.x[k]:.1f}, {matches.y[k]:.1f}) of chip {number}",
            do="check the match, or give a lower order",
        )
    inverse = np.empty_like(J)
    inverse[:, 0, 0], inverse[:, 1, 1] = J[:, 1, 1] / det, J[:, 0, 0] / det
    inverse[:, 0, 1], inverse[:, 1, 0] = -J[:, 0, 1] / det, -J[:, 1, 0] / det
    residual = np.stack([matches.u, matches.v], axis=1) - fitted
    variance = np.stack([sigma_u, sigma_v], axis=1) ** 2
    return PixelShifts(
        np.einsum("nab,nb->na", inverse, residual), np.einsum("nab,nb->na", inverse**2, variance)
    )


def corrected_matches(tables: Sequence[LookupTable], matches: Matches) -> Matches:
    """Apply look-up tables to the pixel coordinates of matches.

    Parameters
    ----------
    tables : sequence of LookupTable
        Tables of the detector and of at most one filter.
    matches : Matches
        Stars at raw pixel coordinates.

    Returns
    -------
    Matches
        The same stars at corrected pixel coordinates.
    """
    filter = next((table.filter for table in tables if table.filter), "")
    x, y = corrected(tables, matches.x, matches.y, chip=matches.chip_number, filter=filter)
    return matches.with_columns(x=x, y=y)


def on_the_chips(matches: Matches, model: DistortionModel) -> Matches:
    """Remove the few matches that a table has moved off their chip.

    The polynomial is not defined outside the chip; the tables still use these stars.

    Parameters
    ----------
    matches : Matches
        Stars at corrected pixel coordinates.
    model : DistortionModel

    Returns
    -------
    Matches
    """
    inside = inside_chips(matches, model)
    return matches if inside.all() else matches.select(inside, reason="moved off the chip")


def inside_chips(matches: Matches, model: DistortionModel) -> Bool:
    """Boolean mask that is True for matches on their chip.

    Parameters
    ----------
    matches : Matches
    model : DistortionModel

    Returns
    -------
    ndarray of bool, shape (N,)
    """
    size = np.array([model.chips[model.chip_code(c)].size for c in matches.chip_numbers])
    nx, ny = size[matches.chip].T
    x, y = matches.x, matches.y
    return np.asarray((x >= 0.5) & (x <= nx + 0.5) & (y >= 0.5) & (y <= ny + 0.5))
