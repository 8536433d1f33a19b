"""Selection of the polynomial order by fits to binned residuals and by held-out stars.

WSDC D-T033, section 3, fits surfaces of order 3 to 9 to mean offsets in bins.  It finds that order
3 is just inadequate and that order 4 is as good as higher orders.  Here, in addition, each order
predicts stars that were not used to fit it.  This takes two passes over the data in addition to a
fit of the highest order.

The terms of a polynomial are sorted by total order, so that the normal matrix of a lower order is
the leading block of that of a higher order.  A fold is a bin of the detector or a random subset of
the stars.  From the sums of each fold, every order can be fitted to all folds, to all but one, or
to the means of the folds, without another pass over the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import kernel
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import Stars, Sums
from bayesdist.model import DistortionModel
from bayesdist.model.basis import MAX_ORDER
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf, f_sf, norm_sf
from bayesdist.utils.random import mixed
from bayesdist.utils.text import p_words

DEFAULT_ORDERS = tuple(range(3, 10))

CLEAR = 3.0  # standard errors above which a higher order counts as better
CLEAR_P = float(norm_sf(CLEAR))


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
            f"{n} bins have stars, but order {orders[-1]} has {n_terms[-1]} terms",
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
    turned = Matches.of_distinct_rows(x=x, y=y, u=u, v=v, unit=matches.unit, chip_numbers=(chip,))
    return turned.with_covariances(back @ matches.covariances() @ np.swapaxes(back, -1, -2))


# -- result of a comparison of polynomial orders: statistics per order, and the selected order -----


@dataclass(frozen=True, eq=False)
class OrderSurfaces:
    """Fits of each order to the mean residuals in bins.

    The mean of a bin is compared with the mean of the model over the same stars, not with the model
    at the centre of the bin.  Curvature within a bin and uneven coverage therefore have no effect.
    """

    orders: tuple[int, ...]
    n_bins: int  # number of bins with stars
    chi2: Float  # chi-square (orders, 2) in u and v, relative to the noise of the bin means
    dof: Int  # degrees of freedom (orders,) per axis
    # rms residual (orders, 2) of the bins in u and v, in their unit, weighted like the stars
    rms: Float
    noise: Float  # rms noise (2,) of the bin means

    def p_noise(self) -> Float:
        """Probability (orders, 2) of a larger chi-square if the residuals are only noise."""
        return np.asarray(chi2_sf(self.chi2, self.dof[:, None]))

    def f_test(self, low: int, high: int) -> tuple[float, float]:
        """F statistic of both axes, and probability of a larger F if the lower order is adequate.

        `low` and `high` are the two orders.  The noise is estimated from the residuals of the
        higher order.
        """
        a, b = self.orders.index(low), self.orders.index(high)
        chi2 = self.chi2.sum(axis=1)
        n_added, free = 2 * (self.dof[a] - self.dof[b]), 2 * self.dof[b]
        F = float((chi2[a] - chi2[b]) / n_added / (chi2[b] / free))
        return F, float(f_sf(F, n_added, free))


@dataclass(frozen=True, eq=False)
class HeldOutOrders:
    """Predictive density of held-out groups of stars for each order, fitted to the other groups."""

    orders: tuple[int, ...]
    kind: str  # 'stars' or 'regions'
    # log density (L, orders, 2) of L groups in u and v, up to a constant common to all orders
    log_density: Float

    def difference(self, low: int, high: int) -> tuple[float, float]:
        """Log predictive density of order `high` minus that of order `low`, and its standard error.

        Both axes are summed.  The standard error is derived from the scatter between the groups.
        If the p additional coefficients of both axes deviate from zero by d standard errors in
        total, the scatter implies a variance of d^2 + p, because the groups are compared with
        estimates that have most data in common.  The actual variance of the sum, half a non-central
        chi-square, is d^2 + p/2; this is corrected.
        """
        a, b = self.orders.index(low), self.orders.index(high)
        each = (self.log_density[:, b] - self.log_density[:, a]).sum(axis=-1)
        shared = ((high + 1) * (high + 2) - (low + 1) * (low + 2)) / 2  # p/2
        variance = max(len(each) * each.var(ddof=1) - shared, shared)
        return float(each.sum()), float(np.sqrt(variance))


class OrderRow(TypedDict):
    """Statistics of an order.

    Those that compare it with the selected order are None for that order itself.
    """

    order: int
    terms: int  # per axis
    rms_u: float  # of the bins
    rms_v: float
    chi2_u: float  # per degree of freedom
    chi2_v: float
    p_noise: float  # the smaller of the probabilities of the two axes
    F: float | None  # of the F-test against the selected order
    p_surface: float | None
    stars: float | None  # log density of the held-out stars minus that of the selected order
    stars_error: float | None
    regions: float | None  # the same for held-out regions
    regions_error: float | None
    lost: float


@dataclass(frozen=True, eq=False)
class OrderSelection:
    """Result of the selection of the polynomial order."""

    orders: tuple[int, ...]  # ascending
    surfaces: OrderSurfaces
    stars: HeldOutOrders  # random subsets of the stars held out
    regions: HeldOutOrders  # regions of the detector held out
    # rms difference (orders,) over the detector between the fit of each order and that of the
    # highest, both axes in quadrature, noise subtracted
    lost: Float
    pair_rms: float  # rms residual of a single match, both axes in quadrature
    # factor on the quoted errors that gives the highest order a chi-square of 1 per degree of
    # freedom
    error_scale: float
    n_used: int  # number of matches that were not clipped
    unit: str  # unit of `lost`, `pair_rms` and the surfaces

    def rows(self) -> list[OrderRow]:
        """Statistics of each order."""
        noise, s = self.surfaces.p_noise(), self.surfaces
        rows: list[OrderRow] = []
        for k, order in enumerate(self.orders):
            ratio, p_surface, stars, stars_error, regions, regions_error = self._against(order)
            rows.append(
                {
                    "order": order,
                    "terms": (order + 1) * (order + 2) // 2,
                    "rms_u": float(s.rms[k, 0]),
                    "rms_v": float(s.rms[k, 1]),
                    "chi2_u": float(s.chi2[k, 0] / s.dof[k]),
                    "chi2_v": float(s.chi2[k, 1] / s.dof[k]),
                    "p_noise": float(noise[k].min()),
                    "F": ratio,
                    "p_surface": p_surface,
                    "stars": stars,
                    "stars_error": stars_error,
                    "regions": regions,
                    "regions_error": regions_error,
                    # zero without a rounding error for the highest order
                    "lost": 0.0 if order == self.orders[-1] else float(self.lost[k]),
                }
            )
        return rows

    def _against(self, order: int) -> tuple[float | None, ...]:
        """F and its probability, and differences of held-out stars and regions with their errors.

        They compare an order with the selected one, for which all are None.
        """
        if order == self.order:
            return (None,) * 6
        low, high = sorted((order, self.order))
        sign = 1 if order == high else -1
        values = [*self.surfaces.f_test(low, high)]
        for held_out in (self.stars, self.regions):
            difference, error = held_out.difference(low, high)
            values += [sign * difference, error]
        return tuple(values)

    @property
    def by_surfaces(self) -> int:
        """Lowest order that no higher order improves significantly by the F-test (3 sigma)."""
        return self._lowest(lambda low, high: self.surfaces.f_test(low, high)[1] < CLEAR_P)

    @property
    def by_stars(self) -> int:
        """Lowest order that no higher order improves by 3 standard errors for held-out stars."""
        return self._lowest(lambda low, high: _clear(self.stars, low, high))

    @property
    def by_regions(self) -> int:
        """Lowest order that no higher order improves by 3 standard errors for held-out regions."""
        return self._lowest(lambda low, high: _clear(self.regions, low, high))

    @property
    def order(self) -> int:
        """Selected order: the lowest one that neither surfaces nor held-out stars reject.

        Held-out regions are not considered; `sentence` mentions any disagreement.
        """
        return max(self.by_surfaces, self.by_stars)

    def _lowest(self, better: Callable[[int, int], bool]) -> int:
        for k, low in enumerate(self.orders):
            if not any(better(low, high) for high in self.orders[k + 1 :]):
                return low
        raise AssertionError("no order is above the highest")

    @property
    def sentence(self) -> str:
        """The selected order and the reasons for it, as text."""
        parts = [self._of_the_chosen()]
        k = self.orders.index(self.order)
        if k > 0:
            parts.insert(0, self._of_the_one_below(self.orders[k - 1]))
        if self.by_surfaces != self.by_stars:
            parts.append(
                f"Surfaces ask for order {self.by_surfaces}, held-out stars for {self.by_stars}."
            )
        if self.by_regions > self.order:
            parts.append(
                f"Held-out regions ask for order {self.by_regions}: look at a map of the residuals."
            )
        elif self.by_regions < self.order:
            parts.append(
                f"Across regions without stars order {self.by_regions} predicts as well: "
                "the higher terms are not to be extrapolated."
            )
        p = float(self.surfaces.p_noise()[k].min())
        if p < CLEAR_P:
            rms = float(np.hypot(*self.surfaces.rms[k]))
            noise = float(np.hypot(*self.surfaces.noise))
            parts.append(
                f"The bins keep {rms:.2g} {self.unit} rms where noise is {noise:.2g} "
                f"({p_words(p, 2)}): order {self.order} does not describe all that is there."
            )
        return " ".join(parts)

    def _of_the_one_below(self, low: int) -> str:
        lost_low, lost_selected = (self.lost[self.orders.index(n)] for n in (low, self.order))
        lost = float(np.sqrt(max(lost_low**2 - lost_selected**2, 0.0)))
        F, p = self.surfaces.f_test(low, self.order)
        gain, error = self.stars.difference(low, self.order)
        # an effect below the error of a single match is visible only in averages
        word = "just inadequate" if lost < self.pair_rms else "inadequate"
        return (
            f"Order {low} is {word}: order {self.order} differs from it by {lost:.2g} {self.unit} "
            f"rms (a pair has {self.pair_rms:.2g}), the residual surface asks for it with "
            f"F = {F:.3g} ({p_words(p, 2)}), and it predicts held-out stars better by {gain:.4g} "
            f"+- {error:.2g} in log density."
        )

    def _of_the_chosen(self) -> str:
        top = self.orders[-1]
        if self.order == top:
            return (
                f"Order {top} is the highest that was tried, and the next lower one does not "
                "suffice: try higher orders, or look-up tables."
            )
        higher = self.orders[self.orders.index(self.order) + 1 :]
        gain, error, best = max((*self.stars.difference(self.order, m), m) for m in higher)
        p = min(self.surfaces.f_test(self.order, m)[1] for m in higher)
        return (
            f"Order {self.order} is as good as any up to {top}: of the higher ones order {best} "
            f"does best for held-out stars, with {gain:+.2g} +- {error:.2g} in log density, and "
            f"the least p of an F-test is {p:.2g}."
        )


def _clear(held_out: HeldOutOrders, low: int, high: int) -> bool:
    gain, error = held_out.difference(low, high)
    return gain > CLEAR * error


# -- normal equations of the highest order for groups of stars; they include all lower orders ------


@dataclass(frozen=True, eq=False)
class FoldStatistics(Sums):
    """Sums over the stars of each of F folds, for residuals from a given polynomial."""

    count: Int  # number (F,) of stars, including clipped stars
    weight: Float  # sum (F, 2, K, K) of w phi phi^T for u and v
    right: Float  # sum (F, 2, K) of w r phi, with r the residual

    def joined(self, code: Int, n: int) -> FoldStatistics:
        """Merge the folds to `n` larger folds; `code` (F,) is the new fold of each."""

        def joined(column: NDArray[Any]) -> NDArray[Any]:
            out = np.zeros((n, *column.shape[1:]), column.dtype)
            np.add.at(out, code, column)
            return out

        return FoldStatistics(joined(self.count), joined(self.weight), joined(self.right))

    def filled(self) -> FoldStatistics:
        """Drop the folds without weight."""
        has = self.weight[:, 0, 0, 0] > 0
        return FoldStatistics(self.count[has], self.weight[has], self.right[has])


def bin_sums(stars: Stars, theta: Float, clip: Clip, bins: int) -> FoldStatistics:
    """Sums for `bins` x `bins` equal bins that cover the detector; fold number iy * bins + ix.

    The model must have one chip and no frames.  Residuals are computed at `theta`, and `clip` has
    the rejection limits.
    """
    code = cell_index(stars.X, stars.Y, (bins, bins))
    return _sums(stars, code, bins * bins, theta, clip)


def fold_sums(stars: Stars, theta: Float, clip: Clip, folds: int) -> FoldStatistics:
    """Sums for `folds` random subsets of the stars; see `bin_sums` for the other arguments.

    The subset of a star is a hash of its coordinates, so that it depends neither on the order of
    the rows nor on the division of the data into chunks.
    """
    bits = np.zeros(len(stars), np.uint64)
    for column in (stars.X, stars.Y, stars.u, stars.v):
        bits = mixed(bits ^ np.ascontiguousarray(column).view(np.uint64))
    return _sums(stars, (bits % np.uint64(folds)).astype(np.int64), folds, theta, clip)


def _sums(stars: Stars, code: Int, n: int, theta: Float, clip: Clip) -> FoldStatistics:
    stars = stars.without_correlations()  # both axes are solved separately
    count = np.bincount(code, minlength=n)
    order = np.argsort(code, kind="stable")
    present = np.flatnonzero(count)
    starts = np.concatenate([[0], np.cumsum(count[present])])

    def powers(at: Float) -> Float:
        return np.repeat(stars.powers(at), len(present), axis=0)

    moments = kernel.least_squares_moments(
        kernel.pieces_of(starts, kernel.PIECE),
        tuple(column[order] if len(column) else column for column in stars.columns),
        powers(theta),
        powers(clip.theta),
        stars.model.order,
        chi2_limit=clip.chi2_limit,
        abs_limit=clip.abs_limit,
        spared_chi2=clip.spared_chi2,
    )
    K = stars.model.n_terms
    weight, right = np.zeros((n, 2, K, K)), np.zeros((n, 2, K))
    weight[present] = moments.weight[:, 0::2]
    right[present] = moments.right
    return FoldStatistics(count, weight, right)


def truncated(weight: Float, right: Float, about: Float, n_terms: int) -> Float:
    """Fit only the first `n_terms` terms; return the coefficients (..., K) minus `about`.

    `weight` (..., K, K) and `right` (..., K) are the normal equations for residuals from the
    polynomial `about` (..., K).
    """
    low, high = slice(None, n_terms), slice(n_terms, None)
    out = -np.broadcast_to(about, right.shape)
    # the fit lacks the high-order terms of `about`, so add their contribution to the residuals
    owed = np.einsum("...kl,...l->...k", weight[..., low, high], out[..., high])
    out[..., low] = np.linalg.solve(weight[..., low, low], (right[..., low] - owed)[..., None])[
        ..., 0
    ]
    return out


def departures(sums: FoldStatistics, about: Float, n_terms: list[int]) -> Float:
    """Difference (orders, 2, K) between each order's fit to all folds and the coefficients `about`.

    `about` has shape (2, K), and `n_terms` is the number of terms of each order.
    """
    weight, right = sums.weight.sum(axis=0), sums.right.sum(axis=0)
    return np.stack([truncated(weight, right, about, k) for k in n_terms])


def held_out_gain(sums: FoldStatistics, about: Float, n_terms: list[int]) -> Float:
    """Log predictive density (F, orders, 2) of each fold in u and v, for each order.

    The coefficients are fitted to all other folds; `n_terms` is the number of terms of each order.
    The density is minus half the chi-square of the fold, relative to that of the coefficients
    `about` (2, K), and thus up to a constant common to all orders.  The uncertainty of the
    coefficients is not added to the errors.  For a small leverage h of the stars, this would change
    the expectation only to second order in h.
    """
    weight = sums.weight.sum(axis=0) - sums.weight
    right = sums.right.sum(axis=0) - sums.right
    out = np.empty((len(sums.count), len(n_terms), 2))
    for m, k in enumerate(n_terms):
        d = truncated(weight, right, about, k)
        out[:, m] = np.einsum("lak,lak->la", sums.right, d)
        out[:, m] -= 0.5 * np.einsum("lak,lakm,lam->la", d, sums.weight, d, optimize=True)
    return out
