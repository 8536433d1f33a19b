"""Selection of the polynomial order by fits to binned residuals and by held-out stars.

WSDC D-T033, section 3, fits surfaces of order 3 to 9 to mean offsets in bins.  It finds that order
3 is just inadequate and that order 4 is as good as higher orders.  Here, in addition, each order
predicts stars that were not used to fit it.  This takes two passes over the data in addition to a
fit of the highest order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.compare.order_result import HeldOutOrders, OrderSelection, OrderSurfaces
from bayesdist.infer.compare.order_sums import (
    FoldStatistics,
    bin_sums,
    departures,
    fold_sums,
    held_out_gain,
    truncated,
)
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Shards
from bayesdist.model import DistortionModel
from bayesdist.model.basis import MAX_ORDER
from bayesdist.utils.arrays import Float

DEFAULT_ORDERS = tuple(range(3, 10))


def select_order(
    matches: Matches | Shards,
    model: DistortionModel,
    *,
    orders: Sequence[int] = DEFAULT_ORDERS,
    bins: int = 31,
    regions: int = 10,
    folds: int = 100,
    rejection: Rejection = DEFAULT_REJECTION,
) -> OrderSelection:
    """Compare polynomial orders on one chip, without frames and time dependence.

    Stars are clipped once, by the two-pass fit of the highest order, for all orders.

    Parameters
    ----------
    matches : Matches or Shards
        Stars with errors.
    model : DistortionModel
        Model of one chip; its order is ignored.
    orders : sequence of int
        At least two polynomial orders.
    bins : int
        Number of bins along each axis in which residuals are averaged.
    regions : int
        Number of regions along each axis that are held out one at a time. Regions consist of whole
        bins.
    folds : int
        Number of random subsets of the stars that are held out one at a time.
    rejection : Rejection
        See `fit_linear`.

    Returns
    -------
    OrderSelection

    Raises
    ------
    InputError
        If there are fewer than two orders or an order is out of range, the model has several chips,
        frames or time dependence, or the numbers of bins, regions and folds are inconsistent.
    DegenerateError
        If the data do not determine the highest order (see `fit_linear`), also without one of the
        held-out groups, or if too few bins have stars.
    """
    chosen = _checked(orders, model, bins, regions, folds)
    top = replace(model, order=chosen[-1])
    with opened(top, matches) as shards:
        fit = fit_linear(shards, top, rejection=rejection)
        binned = shards.sum(bin_sums, fit.mean, fit.clip, bins)
        by_fold = shards.sum(fold_sums, fit.mean, fit.clip, folds)
    n_terms = [(n + 1) * (n + 2) // 2 for n in chosen]
    about = fit.mean.reshape(2, -1)
    scale2 = fit.chi2 / fit.dof
    iy, ix = np.divmod(np.arange(bins * bins), bins)
    region = binned.joined(iy * regions // bins * regions + ix * regions // bins, regions**2)
    try:
        by_stars, by_regions = (
            held_out_gain(sums.filled(), about, n_terms) / scale2 for sums in (by_fold, region)
        )
    except np.linalg.LinAlgError:
        raise DegenerateError(
            f"without one region the stars do not determine order {chosen[-1]}",
            where="orders",
            do="lower the highest order, or give more regions",
        ) from None
    return OrderSelection(
        orders=chosen,
        surfaces=_surfaces(binned.filled(), about, chosen, n_terms, scale2),
        stars=HeldOutOrders(chosen, "stars", by_stars),
        regions=HeldOutOrders(chosen, "regions", by_regions),
        lost=_lost(by_fold, about, n_terms, scale2, fit),
        pair_rms=float(np.hypot(fit.rms_u, fit.rms_v)),
        error_scale=float(np.sqrt(scale2)),
        n_used=fit.n_used,
        unit=model.unit,
    )


def _checked(
    orders: Sequence[int], model: DistortionModel, bins: int, regions: int, folds: int
) -> tuple[int, ...]:
    """Orders, ascending and distinct; raises InputError if a setting is invalid."""
    chosen = tuple(sorted({int(n) for n in orders}))
    if len(chosen) < 2 or chosen[0] < 1 or chosen[-1] > MAX_ORDER:
        raise InputError(
            f"the orders to compare are {list(orders)}",
            where="orders",
            do=f"give at least two between 1 and {MAX_ORDER}",
        )
    if len(model.chips) > 1 or model.n_frame or model.time is not None:
        raise InputError(
            "orders are compared on one chip, without frames and time dependence",
            where="model",
            do="select one chip, and transform the exposures to one frame first",
        )
    if not 2 <= regions <= bins or folds < 2:
        raise InputError(
            f"{bins} bins, {regions} regions and {folds} folds are inconsistent",
            where="orders",
            do="give at least 2 regions and folds, and no more regions than bins",
        )
    return chosen


def _surfaces(
    sums: FoldStatistics, about: Float, orders: tuple[int, ...], n_terms: list[int], scale2: float
) -> OrderSurfaces:
    n = len(sums.count)
    if n <= n_terms[-1]:
        raise DegenerateError(
            f"{n} bins have stars, and order {orders[-1]} has {n_terms[-1]} terms",
            where="orders",
            do="give more bins or lower the highest order",
        )
    chi2, rms = np.empty((len(orders), 2)), np.empty((len(orders), 2))
    noise = np.empty(2)
    for axis in (0, 1):
        w = sums.weight[:, axis, 0, 0]
        basis = sums.weight[:, axis, 0] / w[:, None]  # mean over the stars of a bin
        mean = sums.right[:, axis, 0] / w
        weight, right = (basis * w[:, None]).T @ basis, (basis * w[:, None]).T @ mean
        noise[axis] = np.sqrt(scale2 * n / w.sum())
        for m, k in enumerate(n_terms):
            residual = mean - basis @ truncated(weight, right, about[axis], k)
            chi2[m, axis] = w @ residual**2 / scale2
            rms[m, axis] = np.sqrt(w @ residual**2 / w.sum())
    return OrderSurfaces(orders, n, chi2, n - np.array(n_terms), rms, noise)


def _lost(
    sums: FoldStatistics, about: Float, n_terms: list[int], scale2: float, fit: LinearFit
) -> Float:
    """Rms difference (orders,) over the detector between each order and the highest, denoised."""
    area = fit.model.basis().mean_squares
    square = (departures(sums, about, n_terms) ** 2 @ area).sum(axis=1)
    weight = sums.weight.sum(axis=0)
    variance = np.empty(len(n_terms))
    for m, k in enumerate(n_terms):
        low = np.linalg.inv(weight[:, :k, :k])
        variance[m] = np.einsum("akk,k->", low, area[:k])
    # nested fits: the variance of the difference is the difference of the variances
    noise = scale2 * (variance[-1] - variance)
    return np.sqrt(np.maximum(square - noise, 0.0))


def in_one_frame(solution: Solution, matches: Matches, chip: int) -> Matches:
    """Remove the frames and the drift of a solution from the matches of one chip.

    Parameters
    ----------
    solution : Solution
    matches : Matches
        Stars with errors, of exposures of the solution's model.
    chip : int
        Number of the chip.

    Returns
    -------
    Matches
        Stars in memory, as a single exposure without dates. Their residuals from the polynomials at
        the first reference date are those from the solution. Residuals and errors are rotated to
        the axes of the polynomials.

    Raises
    ------
    InputError
        If the matches have no errors.
    """
    matches = matches.load()
    if len(solution.model.chips) > 1:
        matches = matches.select(matches.chip_number == chip)
    errors = np.stack([matches.column("sigma_u"), matches.column("sigma_v")], axis=1)
    model, bare = solution.model, without_frames(solution)
    x, y, epoch = matches.x, matches.y, matches.epoch
    predicted = model.predict(
        solution.mean, x, y, exposure=matches.exposure, chip=chip, epoch=epoch
    )
    date = None if bare.model.time is None else bare.model.time.epoch0[0]
    alone = bare.model.predict(bare.mean, x, y, chip=chip, epoch=date)
    frames = np.array([model.frame(solution.mean, e)[0] for e in range(len(model.exposures))])
    back = np.linalg.inv(frames)[matches.exposure if len(frames) > 1 else 0]
    residual = np.stack([matches.u, matches.v], axis=1) - predicted
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
