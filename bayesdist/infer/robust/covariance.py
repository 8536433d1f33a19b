"""The covariance of a solution whose stars err together: measured from cells of the detector.

A formal covariance takes stars for independent.  A pattern on the detector that the model leaves
out is shared by neighbours, and does not average out with more of them; an error of the catalogue,
or of what was done to an exposure, is shared by an exposure.  With A the information and g_c the
score of a cluster of stars,

    V = A^-1 [sum_c g_c g_c^T] A^-1

needs independence of clusters only (Liang and Zeger 1986).  For cells and exposures at once it is
V_cells + V_exposures - V_both (Cameron, Gelbach and Miller 2011).

Neighbouring cells are not independent where a pattern crosses their border.  What V misses is in
proportion to the border, to first order, so that twice the V of cells of two by two less the V of
these cells misses nothing of that order.  In one dimension this weighs the products of the scores
of two stars by a trapezium of their separation, as the flat-top kernels of spectral estimation do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from bayesdist.errors import InputError
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.robust.cells import Cells
from bayesdist.infer.robust.gains import gains
from bayesdist.infer.robust.level import exposure_influence, level_of
from bayesdist.infer.robust.result import RobustCovariance
from bayesdist.infer.robust.scores import scores_of
from bayesdist.infer.robust.sums import cluster_sums, require_room
from bayesdist.infer.settling import Settling
from bayesdist.infer.shards import Compute, Matches, Shards, opened
from bayesdist.infer.views import Solution

__all__ = ["robust_covariance"]

Float = NDArray[np.float64]


# a second BLAS thread gains little here and loses much on a machine that has other work
@threadpool_limits.wrap(limits=1, user_api="blas")
def robust_covariance(
    matches: Matches | Shards,
    solution: Solution,
    cells: Cells,
    *,
    exposures: bool = False,
    priors: GaussianPriors | None = None,
    frames: bool = True,
    settling: Settling | None = None,
    detector: bool = True,
    known: Sequence[Float] = (),
    compute: Compute | None = None,
) -> RobustCovariance:
    """Measure the covariance of a solution from its residuals: one pass over the stars.

    Parameters
    ----------
    matches : MatchTable, PartitionedMatches or Shards
        That the solution was made from.
    solution : Posterior, LinearFit or HierarchicalFit
        Without extra weight in the corners.
    cells : Cells
        See `recommended_cells`; cells of two by two of them are taken for independent but for what
        crosses their borders.
    exposures : bool
        Whether the stars of an exposure err together as well.  Stars are known to belong to
        different exposures where the model has frames, or dates.
    priors : GaussianPriors, optional
        That the solution was made with.  Deviations of exposures that scatter by them are errors of
        the exposures, and count once.
    frames : bool
        Whether the covariance is that of all parameters, or of polynomials and drift alone: a
        small part of the cost where there are a hundred exposures.
    settling : Settling, optional
        What was done to the shifts of single chips afterwards; for polynomials and drift.
    detector : bool
        Whether cells tell what stars of a place have in common.  They do not where the place itself
        was fitted, as by look-up tables: these have taken it.
    known : sequence of ndarray, shape (D, D)
        By cells of each of `cells.factors`: what they add to the formal variance that is
        counted elsewhere, as the error that a star of the catalogue has in all exposures.
    compute : Compute, optional

    Returns
    -------
    RobustCovariance

    Raises
    ------
    InputError
        For a view of a solution, cells of another number of chips, too many cells in too many
        exposures, or a single exposure where exposures are asked for.
    """
    model, scores = solution.model, scores_of(solution)
    if len(cells.shapes) != len(model.chips):
        raise InputError(
            f"cells are given for {len(cells.shapes)} chips and the model has {len(model.chips)}",
            where="cells",
            do="give them by recommended_cells(model, reach)",
        )
    with opened(model, matches, compute) as shards:
        require_room(model, shards.groups, cells)
        sums = shards.sum(cluster_sums, scores, cells)
    priors = priors or GaussianPriors.none(model)
    matrix, _ = sums.equations.assemble(model, scores.theta)
    inverse = (matrix + priors.matrix(model)).factor().covariance()
    D = model.n_params if frames else model.n_distortion
    rows, settled = inverse[:D], np.zeros(0, np.int64)
    if settling is not None:
        # predictions stay, so that only the rows that are asked for have to be settled
        rows = settling.mean(inverse).T[:D]
        settled = np.unique(np.concatenate([settled, *(p.constants for p in settling.places)]))
    gain = gains(sums, model, scores.theta, rows, priors)
    by_exposure = exposure_influence(sums, gain) if exposures else None
    if by_exposure is not None and len(by_exposure) < 2:
        raise InputError(
            "the model tells no exposures apart",
            where="exposures",
            do="fit frames, or leave exposures out",
        )
    pulls = rows * priors.precision
    return RobustCovariance(
        model=model,
        mean=scores.theta,
        formal=rows[:, :D] if settling is None else settling.mean(rows)[:, :D],
        by_priors=pulls @ rows.T,
        cells=cells,
        levels=tuple(level_of(sums, cells, f, gain, within=exposures) for f in cells.factors),
        exposures=by_exposure,
        groups=sums.groups,
        by_frames=pulls[:, model.n_distortion :] @ rows[:, model.n_distortion :].T,
        whole=None if frames else inverse,
        settled=settled,
        detector=detector,
        known=tuple(known),
    )
