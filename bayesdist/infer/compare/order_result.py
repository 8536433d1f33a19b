"""Result of a comparison of polynomial orders: statistics for each order, and the verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf, f_sf, norm_sf
from bayesdist.utils.numbers import p_words

CLEAR = 3.0  # standard errors from which on a higher order counts as better
CLEAR_P = float(norm_sf(CLEAR))


@dataclass(frozen=True, eq=False)
class OrderSurfaces:
    """Fits of each order to the means of the residuals in bins.

    A bin's mean is compared with the mean of the model over the same stars, not with its value at
    the bin's centre: neither curvature inside a bin nor its uneven filling matters.
    """

    orders: tuple[int, ...]
    n_bins: int  # bins that have stars
    chi2: Float  # remaining in u and v (orders, 2), relative to the noise of the bins' means
    dof: Int  # of one axis (orders,)
    # remaining in the bins of u and v (orders, 2), in the unit of u, v; bins weigh as their stars
    # do
    rms: Float
    noise: Float  # part (2,) of the rms that is noise of the bins' means

    def p_noise(self) -> Float:
        """Probability (orders, 2) of a larger chi-square if only noise is left."""
        return np.asarray(chi2_sf(self.chi2, self.dof[:, None]))

    def f_test(self, low: int, high: int) -> tuple[float, float]:
        """F of both axes together, and the probability of a larger F if the lower order is right.

        The noise is estimated from the surface itself, as the residuals of the higher order.
        """
        a, b = self.orders.index(low), self.orders.index(high)
        left = self.chi2.sum(axis=1)
        more, free = 2 * (self.dof[a] - self.dof[b]), 2 * self.dof[b]
        F = float((left[a] - left[b]) / more / (left[b] / free))
        return F, float(f_sf(F, more, free))


@dataclass(frozen=True, eq=False)
class HeldOutOrders:
    """Predictive density of groups of stars by each order, fitted to all other groups."""

    orders: tuple[int, ...]
    kind: str  # 'stars' or 'regions'
    # of L groups (L, orders, 2), of u and v, up to a constant that the orders share
    log_density: Float

    def difference(self, low: int, high: int) -> tuple[float, float]:
        """Log predictive density of a higher order minus that of a lower one, with its error.

        Both axes together; the standard error is from the scatter between the groups.  Where the
        p further coefficients of both axes stand out by d of their errors, that scatter sums to a
        variance of d^2 + p, since each group is held against an estimate that the groups share;
        the sum itself, half a non-central chi-square, has d^2 + p/2.
        """
        a, b = self.orders.index(low), self.orders.index(high)
        each = (self.log_density[:, b] - self.log_density[:, a]).sum(axis=-1)
        shared = ((high + 1) * (high + 2) - (low + 1) * (low + 2)) / 2  # p/2
        variance = max(len(each) * each.var(ddof=1) - shared, shared)
        return float(each.sum()), float(np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class OrderSelection:
    """Result of the selection of the polynomial order."""

    orders: tuple[int, ...]  # ascending
    surfaces: OrderSurfaces
    stars: HeldOutOrders  # for random subsets of the stars
    regions: HeldOutOrders  # for whole regions of the detector
    # rms (orders,) over the detector, both axes in quadrature, of the difference of each order's
    # fit from the highest, noise subtracted
    lost: Float
    pair_rms: float  # rms residual of a single match, both axes in quadrature
    # factor on all quoted errors by which the highest order has a chi-square of 1 per degree of
    # freedom
    error_scale: float
    n_used: int  # matches that were not clipped
    unit: str  # of `lost`, `pair_rms` and the surfaces

    def rows(self) -> list[dict[str, Any]]:
        """Row of surfaces and held-out stars for each order.

        Keys: order; terms (of one axis); rms_u, rms_v of the bins; chi2_u, chi2_v for each degree
        of freedom, and p_noise, the smaller of their two probabilities; F and p_surface of the
        F-test between this order and the chosen one; stars and stars_error, regions and
        regions_error: log density of the held-out stars, minus that of the chosen order; lost.
        None where the chosen order would be compared with itself.
        """
        noise, s = self.surfaces.p_noise(), self.surfaces
        out = []
        for k, order in enumerate(self.orders):
            one = {
                "order": order,
                "terms": (order + 1) * (order + 2) // 2,
                "rms_u": float(s.rms[k, 0]),
                "rms_v": float(s.rms[k, 1]),
                "chi2_u": float(s.chi2[k, 0] / s.dof[k]),
                "chi2_v": float(s.chi2[k, 1] / s.dof[k]),
                "p_noise": float(noise[k].min()),
            }
            lost = 0.0 if order == self.orders[-1] else float(self.lost[k])  # no rounding error
            out.append(one | self._against_chosen(order) | {"lost": lost})
        return out

    def _against_chosen(self, order: int) -> dict[str, float | None]:
        keys = ("F", "p_surface", "stars", "stars_error", "regions", "regions_error")
        if order == self.order:
            return dict.fromkeys(keys)
        low, high = sorted((order, self.order))
        sign = 1 if order == high else -1
        values = [*self.surfaces.f_test(low, high)]
        for held_out in (self.stars, self.regions):
            difference, error = held_out.difference(low, high)
            values += [sign * difference, error]
        return dict(zip(keys, values, strict=True))

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
        """Lowest order that neither surfaces nor held-out stars reject.

        Held-out regions are left out of this: where they disagree, `sentence` says so.
        """
        return max(self.by_surfaces, self.by_stars)

    def _lowest(self, better: Callable[[int, int], bool]) -> int:
        for k, low in enumerate(self.orders):
            if not any(better(low, high) for high in self.orders[k + 1 :]):
                return low
        raise AssertionError("no order is above the highest")

    @property
    def sentence(self) -> str:
        """Verdict on the order with its reason."""
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
        here, there = (self.lost[self.orders.index(n)] for n in (low, self.order))
        lost = float(np.sqrt(max(here**2 - there**2, 0.0)))
        F, p = self.surfaces.f_test(low, self.order)
        gain, error = self.stars.difference(low, self.order)
        # an effect below the error of one match shows only in the mean of many
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
        rest = self.orders[self.orders.index(self.order) + 1 :]
        gain, error, best = max((*self.stars.difference(self.order, m), m) for m in rest)
        p = min(self.surfaces.f_test(self.order, m)[1] for m in rest)
        return (
            f"Order {self.order} is as good as any up to {top}: of the higher ones order {best} "
            f"does best for held-out stars, with {gain:+.2g} +- {error:.2g} in log density, and "
            f"the least p of an F-test is {p:.2g}."
        )


def _clear(held_out: HeldOutOrders, low: int, high: int) -> bool:
    gain, error = held_out.difference(low, high)
    return gain > CLEAR * error
