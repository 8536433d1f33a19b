"""Matches of many exposures as one exposure at one date would have given them."""

from __future__ import annotations

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer.solution import Solution
from bayesdist.infer.transforms import without_frames

__all__ = ["in_one_frame"]


def in_one_frame(solution: Solution, matches: Matches, chip: int) -> Matches:
    """Matches of one chip with the frames and the drift of a solution taken out.

    Parameters
    ----------
    solution : Solution
    matches : Matches
        With errors, of the exposures of the solution's model.
    chip : int
        Number of the chip.

    Returns
    -------
    Matches
        In memory, of one exposure and without dates.  They lie as far from the polynomials alone,
        at their first reference date, as they lay from the solution; residuals and errors are along
        the axes of these polynomials.

    Raises
    ------
    InputError
        For matches without errors.
    """
    matches = matches.load()
    if len(solution.model.chips) > 1:
        matches = matches.select(matches.chip_number == chip)
    errors = np.stack([matches.column("sigma_u"), matches.column("sigma_v")], axis=1)
    model, bare = solution.model, without_frames(solution)
    x, y, epoch = matches.x, matches.y, matches.epoch
    seen = model.predict(solution.mean, x, y, exposure=matches.exposure, chip=chip, epoch=epoch)
    date = None if bare.model.time is None else bare.model.time.epoch0[0]
    alone = bare.model.predict(bare.mean, x, y, chip=chip, epoch=date)
    frames = np.array([model.frame(solution.mean, e)[0] for e in range(len(model.exposures))])
    back = np.linalg.inv(frames)[matches.exposure if len(frames) > 1 else 0]
    residual = np.stack([matches.u, matches.v], axis=1) - seen
    u, v = (alone + np.einsum("...ab,...b->...a", back, residual)).T
    sigma_u, sigma_v = np.sqrt(np.einsum("...ab,...b->...a", back**2, errors**2)).T
    return Matches.of_distinct_rows(
        x=x,
        y=y,
        u=u,
        v=v,
        unit=matches.unit,
        sigma_u=sigma_u,
        sigma_v=sigma_v,
        chip_numbers=(chip,),
    )
