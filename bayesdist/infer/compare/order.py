"""Selection of the polynomial order, by binned surfaces and by stars held out.

WSDC D-T033, section 3, fits surfaces of order 3 to 9 to mean offsets in bins, and finds order 3
just short and order 4 as good as those above.  In addition each order predicts stars that it was
not fitted to.  All of it comes from two passes over the data, beyond those of one fit of the
highest order.
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
    """Comparison of two or more polynomial orders, for one chip without frames and time dependence.

    Stars are clipped once, by the two-pass fit of the highest order, and alike for all orders; the
    model's own order does not matter.  `bins` (surfaces) and `regions` (held out, each made of
    whole bins) are numbers along each axis; `folds` is the number of random subsets of the stars
    that are held out, one at a time.

    Raises InputError for fewer than two orders, unusable ones, a model of several chips, or numbers
    of bins, regions and subsets that do not fit together; DegenerateError as `fit_linear`, for the
    highest order, and when too few bins have stars, or a group holds all that determines a
    coefficient.
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
            held_out_gain(one.filled(), about, n_terms) / scale2 for one in (by_fold, region)
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
    """Orders in ascending sequence; InputError if a setting cannot be used."""
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
            do="select one chip, and bring the exposures to one frame before",
        )
    if not 2 <= regions <= bins or folds < 2:
        raise InputError(
            f"{bins} bins, {regions} regions and {folds} folds do not go together",
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
            left = mean - basis @ truncated(weight, right, about[axis], k)
            chi2[m, axis] = w @ left**2 / scale2
            rms[m, axis] = np.sqrt(w @ left**2 / w.sum())
    return OrderSurfaces(orders, n, chi2, n - np.array(n_terms), rms, noise)


def _lost(
    sums: FoldStatistics, about: Float, n_terms: list[int], scale2: float, fit: LinearFit
) -> Float:
    """Rms over the detector of the difference of each order's fit from the highest."""
    area = fit.model.basis().mean_squares
    square = (departures(sums, about, n_terms) ** 2 @ area).sum(axis=1)
    weight = sums.weight.sum(axis=0)
    variance = np.empty(len(n_terms))
    for m, k in enumerate(n_terms):
        low = np.linalg.inv(weight[:, :k, :k])
        variance[m] = np.einsum("akk,k->", low, area[:k])
    # errors of nested fits: that of the difference is the difference of theirs
    noise = scale2 * (variance[-1] - variance)
    return np.sqrt(np.maximum(square - noise, 0.0))


def in_one_frame(solution: Solution, matches: Matches, chip: int) -> Matches:
    """Matches of one chip with the frames and the drift of a solution taken out.

    `matches`: with errors, of the exposures of the solution's model. `chip`: number of the chip.
    Result: in memory, of one exposure and without dates. They lie as far from the polynomials
    alone, at their first reference date, as they lay from the solution; residuals and errors are
    along the axes of these polynomials. InputError for matches without errors.
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
