"""Result of a comparison of polynomial orders: statistics per order, and the selected order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf, f_sf, norm_sf
from bayesdist.utils.numbers import p_words

CLEAR = 3.0  # standard errors above which a higher order counts as better
CLEAR_P = float(norm_sf(CLEAR))


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

        The noise is estimated from the residuals of the higher order.
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
        """Log predictive density of a higher order minus that of a lower one, with its error.

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

    def rows(self) -> list[dict[str, Any]]:
        """Statistics of each order as a list of dictionaries.

        The keys are: order; terms (per axis); rms_u, rms_v of the bins; chi2_u, chi2_v per degree
        of freedom; p_noise, the smaller of their two probabilities; F and p_surface of the F-test
        between this order and the selected one; stars, stars_error, regions, regions_error: log
        density of the held-out stars minus that of the selected order, with errors; lost.  Values
        that compare with the selected order are None for that order itself.
        """
        noise, s = self.surfaces.p_noise(), self.surfaces
        out = []
        for k, order in enumerate(self.orders):
            statistics = {
                "order": order,
                "terms": (order + 1) * (order + 2) // 2,
                "rms_u": float(s.rms[k, 0]),
                "rms_v": float(s.rms[k, 1]),
                "chi2_u": float(s.chi2[k, 0] / s.dof[k]),
                "chi2_v": float(s.chi2[k, 1] / s.dof[k]),
                "p_noise": float(noise[k].min()),
            }
            lost = 0.0 if order == self.orders[-1] else float(self.lost[k])  # no rounding error
            out.append(statistics | self._against_chosen(order) | {"lost": lost})
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
