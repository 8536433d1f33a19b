"""What cells show of errors that are known already: those of the stars of a catalogue."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.star_errors import star_covariance
from bayesdist.infer.star_influence import StarErrors

__all__ = ["catalogue_in_cells"]

Float = NDArray[np.float64]


def catalogue_in_cells(
    fit: LinearFit, matches: MatchTable, errors: StarErrors, cells: Cells
) -> tuple[Float, ...]:
    """What one error of a star in all exposures adds to the variance by cells.

    Parameters
    ----------
    fit : LinearFit
        Of these matches, whose errors contain the catalogue's.
    matches : MatchTable
        With codes of the stars.
    errors : StarErrors
    cells : Cells

    Returns
    -------
    tuple of ndarray, shape (n_distortion, n_distortion)
        For each of the `cells.factors`, as `robust_covariance` takes off what is known.
    """
    assert matches.star is not None
    model, n, out = fit.model, fit.model.n_distortion, []
    cell = np.zeros(len(matches), np.int64)
    numbers = matches.chip_number
    on = [np.flatnonzero(numbers == chip.number) for chip in model.chips]
    for k, (chip, rows) in enumerate(zip(model.chips, on, strict=True)):
        scaled = model.basis(chip.number).scaled(matches.x[rows], matches.y[rows])
        cell[rows] = cells.codes(*scaled, k)
    for factor in cells.factors:
        key = matches.star * (len(on) * cells.most)
        for k, (rows, into) in enumerate(zip(on, cells.merged(factor)[1], strict=True)):
            key[rows] += k * cells.most + into[cell[rows]]
        # a star is another one in each cell: what it has in common there is what cells see
        names, code = np.unique(key, return_inverse=True)
        star, motion = names // (len(on) * cells.most), {}
        if errors.motion is not None and errors.epoch is not None:
            motion = {
                "motion_u": errors.motion[star, 0],
                "motion_v": errors.motion[star, 1],
                "epoch0": errors.epoch[star],
            }
        found = star_covariance(
            fit,
            matches,
            *errors.position[star].T,
            **motion,
            star=code,
            frames=False,
        )
        out.append(found.extra[:n, :n])
    return tuple(out)
