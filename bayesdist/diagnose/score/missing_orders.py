"""Missing orders, several above that of the model, and the residuals per chip that show them.

The score tests ask for the next orders one by one.  Their directions have a covariance that is
estimated from the scores, so that a test of some ten orders at once would have no power.  Terms of
such orders are found by a robust fit instead: if it reduces the scatter of the residuals by a
tenth, which neither noise nor displaced stars do, it is taken as evidence.  In fits of 200 to 5000
stars with false matches, heavy tails, unequal errors, merged visits, ghosts and blends the scatter
decreased by at most 5 %.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from bayesdist.diagnose.score.result import MISSING_ORDERS, Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.basis import MAX_ORDER, n_terms, polynomial_terms
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import f_sf

# largest ratio of the residuals' scatter with further orders to that without them
LARGEST_RATIO = 0.9
LEAST_GAIN = 1.05  # ratio of the variances of a lower order and of the best one that are equal
STARS_PER_FITTED_TERM = 15  # minimum, so that noise does not reduce the scatter as much
MAX_DETECTIONS = 20_000  # of a chip, for the robust fit: enough for 0.5 % of the scatter
MIN_STARS = 100  # of a chip, for any test
STARS_PER_TERM = 6  # minimum per subtracted polynomial term
LARGEST_LEVERAGE = 0.5
REST = 4.0  # width of the weights of a robust fit, in units of the scatter
PASSES = 4  # iterations of a robust fit
RIDGE = 1e-12  # of normal equations, relative to their mean diagonal
TINY = 1e-300
ALL = slice(None)


@dataclass(frozen=True, eq=False)
class ChipResiduals:
    """Residuals of one chip in units of their errors, along the detector axes."""

    order: int  # of the model
    rows: Int  # (n,) rows of the sample
    X: Float  # (n,) position, -1 to 1 over the chip
    Y: Float
    z: Float  # (2, n)
    error: Float  # (n,) the larger of the two errors, in the unit of u and v
    inlier: Float  # (n,)
    star: Int  # (n,) codes from 0
    exposure: Int  # (n,)
    sigma: float  # typical error per axis, in the unit of u and v
    size: tuple[float, float]  # pixels
    free: float = 1.0  # degrees of freedom of the residuals divided by their number
    # True if z are displacements divided by `error`, so that the functions are as well, and false
    # if they are whitened residuals
    per_error: bool = False

    @property
    def n_stars(self) -> int:
        """Number of stars."""
        return int(self.star.max(initial=-1)) + 1

    def at(self, rows: Int) -> ChipResiduals:
        """Subset of the detections."""
        return replace(
            self,
            rows=self.rows[rows],
            X=self.X[rows],
            Y=self.Y[rows],
            z=self.z[:, rows],
            error=self.error[rows],
            inlier=self.inlier[rows],
            star=np.unique(self.star[rows], return_inverse=True)[1],
            exposure=self.exposure[rows],
        )

    def by_exposure(self) -> Iterator[ChipResiduals]:
        """Iterate over the detections of each exposure."""
        for code in np.unique(self.exposure):
            yield self.at(np.flatnonzero(self.exposure == code))

    def orders(self, highest: int, stars_per_term: int = STARS_PER_TERM) -> list[int]:
        """Order of the model, and those above it up to `highest` that the stars constrain."""
        return [self.order] + [
            order
            for order in range(self.order + 1, highest + 1)
            if stars_per_term * n_terms(order) <= self.n_stars
        ]

    def scatter(self, *, weighted: bool = False) -> float:
        """Scatter per axis, from the median of the squares; weighted by `inlier` if asked for."""
        return _scatter(self.z, self.inlier if weighted else None)

    def without_polynomials(self, order: int) -> ChipResiduals:
        """Residuals minus a robust fit of polynomials up to `order`."""
        z = _minus_fit(self._functions(order), self.z)
        return replace(self, z=z, free=1.0 - n_terms(order) / self.n_stars)

    def without_terms(self, order: int) -> ChipResiduals:
        """Residuals minus polynomials up to `order` and low-order terms of each exposure."""
        rest = self.without_polynomials(order)
        z = rest.z
        codes, of = np.unique(self.exposure, return_inverse=True)
        if len(codes) > 1:
            z = z.copy()
            for k in range(len(codes)):
                at = np.flatnonzero(of == k)
                low = [n for n in (2, 1, 0) if STARS_PER_TERM * n_terms(n) <= len(at)]
                if low:
                    z[:, at] = _minus_fit(self._functions(low[0], at), z[:, at])
        return replace(rest, z=z)

    def _functions(self, order: int, rows: Int | slice = ALL) -> Float:
        """Polynomials (n, K) up to `order` that are fitted to z."""
        F = legendre_products(self.X[rows], self.Y[rows], polynomial_terms(order))
        return F / self.error[rows, None] if self.per_error else F

    def in_units_of_scatter(self) -> ChipResiduals:
        """Residuals divided by their scatter, with errors that are larger by the same factor."""
        scatter = self.scatter(weighted=True)
        z, error = self.z / scatter, self.error * scatter
        return replace(self, z=z, error=error, sigma=self.sigma * scatter)

    @cached_property
    def missing_orders(self) -> MissingOrders | None:
        """Orders that the residuals contain, from a robust fit; None without evidence for any."""
        step = -(-len(self.rows) // MAX_DETECTIONS)
        part = self.at(np.flatnonzero(self.star % step == 0)) if step > 1 else self
        orders = part.orders(MAX_ORDER, STARS_PER_FITTED_TERM)
        fits = [part.without_terms(order) for order in orders]
        variance = np.array([(fit.scatter() ** 2 / fit.free) for fit in fits])
        if variance.min() > LARGEST_RATIO**2 * variance[0]:
            return None
        k = int(np.argmax(variance <= LEAST_GAIN * variance.min()))
        dof = 2 * (n_terms(orders[k]) - n_terms(self.order))
        dof_residual = 2 * part.n_stars * fits[k].free
        return MissingOrders(
            orders[k],
            k == len(orders) - 1,
            len(orders) - 1,
            (variance[0] / variance[k] - 1) * dof_residual,
            dof,
            dof_residual,
            *(2 * self.sigma**2 * variance[[0, k]]),
        )


@dataclass(frozen=True)
class MissingOrders:
    """Lowest order that removes the terms that the model lacks, and the variances of its test."""

    order: int
    is_last: bool  # True if no higher order was fitted
    n_fits: int  # number of orders that were fitted
    statistic: float
    dof: int
    dof_residual: float
    square: float  # mean square of the residuals before the fit, both axes
    noise: float  # mean square of the residuals after it


def chip_residuals(sample: ScoredSample) -> list[ChipResiduals]:
    """Residuals of the chips that have at least `MIN_STARS` stars.

    Parameters
    ----------
    sample : ScoredSample

    Returns
    -------
    list of ChipResiduals
    """
    return list(_chip_residuals(sample))


def _chip_residuals(sample: ScoredSample) -> Iterator[ChipResiduals]:
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    usable = sample.used & (leverage.max(axis=0) < LARGEST_LEVERAGE) & (sample.inlier > 0)
    for code, chip in enumerate(sample.model.chips):
        rows = np.flatnonzero(usable & (sample.chip == code))
        if len(np.unique(sample.star[rows])) < MIN_STARS:
            continue
        variance = sample.variance[:, rows] * (1.0 - leverage[:, rows])
        # rotate to the detector axes; the scale factors of the frames are close to 1
        z = sample.whitened[:, rows] / np.sqrt(1.0 - leverage[:, rows])
        z = np.einsum("nji,jn->in", rotations(sample.turn[rows]), z)
        yield ChipResiduals(
            sample.model.order,
            rows,
            sample.X[rows],
            sample.Y[rows],
            z,
            np.sqrt(variance.max(axis=0)),
            sample.inlier[rows],
            np.unique(sample.star[rows], return_inverse=True)[1],
            sample.exposure[rows],
            float(np.sqrt(np.median(variance))),
            chip.size,
        )


def missing_orders_test(
    sample: ScoredSample, chips: Sequence[ChipResiduals], at_least: int
) -> Outcome | None:
    """Outcome of the robust fits of further orders; None if no chip lacks them.

    Parameters
    ----------
    sample : ScoredSample
    chips : sequence of ChipResiduals
        Residuals of the sample.
    at_least : int
        Highest order that other tests have found; no lower one is recommended.

    Returns
    -------
    Outcome or None
        The test has no result without evidence, because the robust fit of noise has no known
        distribution.  False alarms are limited by the required decrease of the scatter, and the
        p-value, corrected for the numbers of chips and fits, is that of normal errors.
    """
    results = [chip.missing_orders for chip in chips]
    evidence = [missing for missing in results if missing is not None]
    if not evidence:
        return None
    worst = max(evidence, key=lambda missing: missing.statistic / missing.dof)
    ratio = worst.statistic / worst.dof
    return outcome(
        _family(replace(worst, order=max(worst.order, at_least)), sample.model.order),
        worst.statistic,
        worst.dof,
        worst.dof_residual,
        min(1.0, len(chips) * worst.n_fits * float(f_sf(ratio, worst.dof, worst.dof_residual))),
        square=worst.square,
        noise=worst.noise,
        unit=sample.model.unit,
    )


def _family(missing: MissingOrders, order: int) -> Family:
    """Wording of the test, for a model of the order `order`."""
    or_higher = missing.is_last and missing.order < MAX_ORDER
    return Family(
        MISSING_ORDERS,
        f"raise model.order to {missing.order}{' or higher' if or_higher else ''}",
        f"the residuals hold terms up to order {missing.order}, and the model ends at order "
        f"{order}",
        "the residuals do not hold terms of further orders",
        group="orders",
        held_by="structure",
        denial="the missing orders do not explain it",
    )


def legendre_products(X: Float, Y: Float, terms: Sequence[tuple[int, int]]) -> Float:
    """Values (n, K) of products of Legendre polynomials with the powers `terms`."""
    i, j = np.array(terms).T
    return np.asarray(legendre.legvander(X, i.max())[:, i] * legendre.legvander(Y, j.max())[:, j])


def rotations(turn: Float) -> Float:
    """Rotations (n, 2, 2) nearest to linear maps (n, 2, 2)."""
    angle = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def _minus_fit(F: Float, z: Float) -> Float:
    """Residuals z (2, n) minus their robust fit with functions F (n, K)."""
    remainder, ridge = z, RIDGE * np.eye(F.shape[1])
    for _ in range(PASSES):
        weight = np.exp(-(remainder**2).sum(axis=0) / (2 * (REST * _scatter(remainder)) ** 2))
        WF = F * weight[:, None]
        normal = WF.T @ F
        remainder = z - (F @ np.linalg.solve(normal + np.trace(normal) * ridge, WF.T @ z.T)).T
    return np.asarray(remainder)


def _scatter(z: Float, weight: Float | None = None) -> float:
    """Scatter per axis of residuals (2, n), from the weighted median of their squares."""
    square = (z**2).sum(axis=0)
    if weight is None:
        return float(np.sqrt(max(np.median(square), TINY) / (2 * np.log(2))))
    order = np.argsort(square)
    total = np.cumsum(weight[order])
    median = square[order][np.searchsorted(total, total[-1] / 2)]
    return float(np.sqrt(max(median, TINY) / (2 * np.log(2))))
