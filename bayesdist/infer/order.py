"""Which polynomial order do the data ask for?  By binned surfaces, and by stars held out.

WSDC D-T033, section 3: offsets of pairs were averaged in bins and fitted as surfaces of order 3 to
9; "third order was seen to be just inadequate, but fourth order left residuals as small as any of
the higher orders".  Beside it stands how well each order predicts what it has not seen.  All of it
comes from two passes over the data, beyond those of one fit of the highest order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.linear import LinearFit, fit_linear
from bayesdist.infer.order_sums import (
    LotSums,
    bin_sums,
    departures,
    held_out_gain,
    share_sums,
    truncated,
)
from bayesdist.infer.shards import Compute, Matches, Shards, opened
from bayesdist.model import DistortionModel
from bayesdist.model.basis import MAX_ORDER

__all__ = ["HeldOutOrders", "OrderSelection", "OrderSurfaces", "select_order"]

Float = NDArray[np.float64]

DEFAULT_ORDERS = tuple(range(3, 10))
CLEAR = 3.0  # standard errors from which on a higher order is better
CLEAR_P = float(stats.norm.sf(CLEAR))


@dataclass(frozen=True, eq=False)
class OrderSurfaces:
    """Fits of each order to the means of the residuals in bins.

    A bin's mean is compared with the mean of the model over the same stars, not with its value at
    the bin's centre: neither curvature inside a bin nor its uneven filling matters.

    Parameters
    ----------
    orders : tuple of int
    n_bins : int
        Bins that have stars.
    chi2 : ndarray, shape (orders, 2)
        Of what is left in u and v, against the noise of the bins' means.
    dof : ndarray of int, shape (orders,)
        Of one axis.
    rms : ndarray, shape (orders, 2)
        Of what is left in the bins of u and v, in the unit of u, v; bins weigh as their stars do.
    noise : ndarray, shape (2,)
        What of that is noise of the bins' means.
    """

    orders: tuple[int, ...]
    n_bins: int
    chi2: Float
    dof: NDArray[np.int64]
    rms: Float
    noise: Float

    def p_noise(self) -> Float:
        """Probability of a larger chi-square if only noise is left, (orders, 2)."""
        return np.asarray(stats.chi2.sf(self.chi2, self.dof[:, None]))

    def f_test(self, low: int, high: int) -> tuple[float, float]:
        """Does a higher order leave less than chance would make it?

        The noise is that of the surface itself, as what the higher order leaves tells it.

        Parameters
        ----------
        low, high : int
            Orders.

        Returns
        -------
        F, p : float
            Of both axes together, and the probability of a larger F if the lower order is right.
        """
        a, b = self.orders.index(low), self.orders.index(high)
        left = self.chi2.sum(axis=1)
        more, free = 2 * (self.dof[a] - self.dof[b]), 2 * self.dof[b]
        F = float((left[a] - left[b]) / more / (left[b] / free))
        return F, float(stats.f.sf(F, more, free))


@dataclass(frozen=True, eq=False)
class HeldOutOrders:
    """How well each order predicts lots of stars from all others.

    Parameters
    ----------
    orders : tuple of int
    kind : str
        'stars' or 'regions'.
    log_density : ndarray, shape (L, orders, 2)
        Of each lot, of u and v, up to a constant that the orders share.
    """

    orders: tuple[int, ...]
    kind: str
    log_density: Float

    def difference(self, low: int, high: int) -> tuple[float, float]:
        """Log predictive density of a higher order minus that of a lower one, both axes.

        Parameters
        ----------
        low, high : int
            Orders.

        Returns
        -------
        difference, error : float
            The standard error is from the scatter between the lots.
        """
        a, b = self.orders.index(low), self.orders.index(high)
        each = (self.log_density[:, b] - self.log_density[:, a]).sum(axis=-1)
        return float(each.sum()), float(np.sqrt(len(each)) * each.std(ddof=1))


@dataclass(frozen=True, eq=False)
class OrderSelection:
    """What the data say of the polynomial order.

    Parameters
    ----------
    orders : tuple of int
        Rising.
    surfaces : OrderSurfaces
    stars, regions : HeldOutOrders
        With arbitrary shares of the stars held out, and with whole regions of the detector.
    lost : ndarray, shape (orders,)
        Rms over the detector, both axes in quadrature, of how a fit of each order differs from
        that of the highest; the part that is noise is taken off.
    pair_rms : float
        Rms residual of a single pair, both axes in quadrature.
    error_scale : float
        What all quoted errors were multiplied by: with it the highest order has a chi-square of 1
        for each degree of freedom.
    n_used : int
        Pairs; the others were clipped.
    unit : str
        Of `lost`, `pair_rms` and the surfaces.
    """

    orders: tuple[int, ...]
    surfaces: OrderSurfaces
    stars: HeldOutOrders
    regions: HeldOutOrders
    lost: Float
    pair_rms: float
    error_scale: float
    n_used: int
    unit: str

    @property
    def by_surfaces(self) -> int:
        """Lowest order on which no higher one improves by the F-test, at 3 sigma."""
        return self._lowest(lambda low, high: self.surfaces.f_test(low, high)[1] < CLEAR_P)

    @property
    def by_stars(self) -> int:
        """Lowest order on which no higher one improves by 3 standard errors for held-out stars."""
        return self._lowest(lambda low, high: _clear(self.stars, low, high))

    @property
    def by_regions(self) -> int:
        """As `by_stars`, for held-out regions."""
        return self._lowest(lambda low, high: _clear(self.regions, low, high))

    @property
    def order(self) -> int:
        """The lowest order to which nothing objects: neither surfaces nor held-out stars.

        Held-out regions do not vote: where they disagree, `sentence` says so.
        """
        return max(self.by_surfaces, self.by_stars)

    def _lowest(self, better: Callable[[int, int], bool]) -> int:
        for k, low in enumerate(self.orders):
            if not any(better(low, high) for high in self.orders[k + 1 :]):
                return low
        raise AssertionError("no order is above the highest")

    @property
    def sentence(self) -> str:
        """The verdict with its reason."""
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
                f"The bins keep {rms:.2g} {self.unit} rms where noise is {noise:.2g} ({_p(p)}): "
                f"order {self.order} does not describe all that is there."
            )
        return " ".join(parts)

    def _of_the_one_below(self, low: int) -> str:
        here, there = (self.lost[self.orders.index(n)] for n in (low, self.order))
        lost = float(np.sqrt(max(here**2 - there**2, 0.0)))
        F, p = self.surfaces.f_test(low, self.order)
        gain, error = self.stars.difference(low, self.order)
        # what is smaller than the error of one pair shows only in the mean of many
        word = "just inadequate" if lost < self.pair_rms else "inadequate"
        return (
            f"Order {low} is {word}: order {self.order} differs from it by {lost:.2g} {self.unit} "
            f"rms (a pair has {self.pair_rms:.2g}), the residual surface asks for it with "
            f"F = {F:.3g} ({_p(p)}), and it predicts held-out stars better by {gain:.4g} +- "
            f"{error:.2g} in log density."
        )

    def _of_the_chosen(self) -> str:
        top = self.orders[-1]
        if self.order == top:
            return (
                f"Order {top} is the highest that was tried, and the next lower one does not "
                "suffice: try higher orders, or look-up tables."
            )
        rest = self.orders[self.orders.index(self.order) + 1 :]
        gain, error, best = max((*self.stars.difference(self.order, m), m) for m in rest)
        p = min(self.surfaces.f_test(self.order, m)[1] for m in rest)
        return (
            f"Order {self.order} is as good as any up to {top}: of the higher ones order {best} "
            f"does best for held-out stars, with {gain:+.2g} +- {error:.2g} in log density, and "
            f"the least p of an F-test is {p:.2g}."
        )


def select_order(
    matches: Matches | Shards,
    model: DistortionModel,
    *,
    orders: Sequence[int] = DEFAULT_ORDERS,
    bins: int = 31,
    regions: int = 10,
    shares: int = 100,
    clip_chi2: float = 25.0,
    clip_abs: float | None = 2.0,
    compute: Compute | None = None,
) -> OrderSelection:
    """Compare polynomial orders.

    Stars are clipped once, by the two-pass fit of the highest order, and alike for all orders.

    Parameters
    ----------
    matches : MatchTable, PartitionedMatches or Shards
        With errors; shards are those of the model of the highest order.
    model : DistortionModel
        One chip, without frames and time dependence; its own order does not matter.
    orders : sequence of int
        At least two.
    bins : int
        Bins of the surfaces on each axis.
    regions : int
        Regions that are held out, on each axis; each is made of whole bins.
    shares : int
        Shares of the stars that are held out, one at a time.
    clip_chi2, clip_abs
        As `fit_linear`.
    compute : Compute, optional

    Returns
    -------
    OrderSelection

    Raises
    ------
    InputError
        For fewer than two orders, orders that are none, a model of several chips, or numbers of
        bins, regions and shares that do not go together.
    DegenerateError
        As `fit_linear`, for the highest order; when too few bins have stars, or a lot holds all
        that determines a coefficient.
    """
    chosen = _checked(orders, model, bins, regions, shares)
    top = replace(model, order=chosen[-1])
    with opened(top, matches, compute) as shards:
        fit = fit_linear(shards, top, clip_chi2=clip_chi2, clip_abs=clip_abs)
        binned = shards.sum(bin_sums, fit.mean, fit.clip, bins)
        shared = shards.sum(share_sums, fit.mean, fit.clip, shares)
    n_terms = [(n + 1) * (n + 2) // 2 for n in chosen]
    about = fit.mean.reshape(2, -1)
    scale2 = fit.chi2 / fit.dof
    iy, ix = np.divmod(np.arange(bins * bins), bins)
    region = binned.joined(iy * regions // bins * regions + ix * regions // bins, regions**2)
    try:
        by_stars, by_regions = (
            held_out_gain(lots.filled(), about, n_terms) / scale2 for lots in (shared, region)
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
        lost=_lost(shared, about, n_terms, scale2, fit),
        pair_rms=float(np.hypot(fit.rms_u, fit.rms_v)),
        error_scale=float(np.sqrt(scale2)),
        n_used=fit.n_used,
        unit=model.unit,
    )


def _checked(
    orders: Sequence[int], model: DistortionModel, bins: int, regions: int, shares: int
) -> tuple[int, ...]:
    """The orders, rising."""
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
    if not 2 <= regions <= bins or shares < 2:
        raise InputError(
            f"{bins} bins, {regions} regions and {shares} shares do not go together",
            where="orders",
            do="give at least 2 regions and shares, and no more regions than bins",
        )
    return chosen


def _clear(held_out: HeldOutOrders, low: int, high: int) -> bool:
    gain, error = held_out.difference(low, high)
    return gain > CLEAR * error


def _p(p: float) -> str:
    """A probability, also where it is below what a float holds."""
    return f"p = {p:.2g}" if p > 0 else "p < 1e-300"


def _surfaces(
    sums: LotSums, about: Float, orders: tuple[int, ...], n_terms: list[int], scale2: float
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


def _lost(sums: LotSums, about: Float, n_terms: list[int], scale2: float, fit: LinearFit) -> Float:
    """Rms over the detector of what each order lacks of the highest."""
    i, j = np.array(fit.model.basis().terms).T
    area = 1.0 / ((2 * i + 1) * (2 * j + 1))  # mean square of a product of Legendre polynomials
    square = (departures(sums, about, n_terms) ** 2 @ area).sum(axis=1)
    weight = sums.weight.sum(axis=0)
    variance = np.empty(len(n_terms))
    for m, k in enumerate(n_terms):
        low = np.linalg.inv(weight[:, :k, :k])
        variance[m] = np.einsum("akk,k->", low, area[:k])
    # errors of nested fits: that of the difference is the difference of theirs
    noise = scale2 * (variance[-1] - variance)
    return np.sqrt(np.maximum(square - noise, 0.0))
