"""A probability estimated by counting draws, and its effective number of independent draws."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bayesdist.assess.terms.forms import Pool
from bayesdist.utils.arrays import Bool, Float, Int


@dataclass(eq=False)
class Tally:
    """Draws of a statistic compared with its limit, in one or several sets of draws.

    Parameters
    ----------
    limit : float
        Limit in the unit of the values.
    values : list of ndarray
        The statistic of each draw, for each set of draws.
    pools : list of tuple of Pool
        Finite sets from which the draws of the errors were taken, for each set of draws; with the
        same terms in the same order.
    """

    limit: float
    values: list[Float] = field(default_factory=list)
    pools: list[tuple[Pool, ...]] = field(default_factory=list)

    def add(self, values: Float, pools: tuple[Pool, ...]) -> None:
        """Add further draws."""
        self.values.append(values)
        self.pools.append(pools)

    @property
    def all_values(self) -> Float:
        """The statistic of every draw, shape (n,)."""
        return np.concatenate(self.values)

    @property
    def n(self) -> int:
        """Number of draws."""
        return sum(len(values) for values in self.values)

    @property
    def fraction(self) -> float:
        """Fraction of draws that do not exceed the limit."""
        return float(np.mean(self.all_values <= self.limit))

    def effective(self) -> tuple[float, float]:
        """Effective number of independent draws, and its limit for an infinite number of draws.

        Let n draws contain terms that are taken from finite sets of m independent draws each. The
        variance of the fraction p of the draws that meet the limit is at most

            p (1 - p) / n + sum(s / m)

        where s is the covariance of two draws that use the same draw of the set (Hoeffding's
        decomposition; the sum of s is at most p (1 - p)). It is estimated from such pairs, and two
        standard errors are added; without pairs it is p (1 - p).

        Returns
        -------
        now, limit : float
            At least 1; the second is infinite without finite sets.
        """
        met = self.all_values <= self.limit
        n, p = len(met), float(np.mean(met))
        variance = p * (1.0 - p)
        sizes, shares = [], []
        for k in range(len(self.pools[0])):
            term_pools = [pools[k] for pools in self.pools]
            sizes.append(
                sum(pool.size for pool in term_pools)
                if term_pools[0].renewed
                else term_pools[0].size
            )
            shares.append(_share(met, p, term_pools) if variance > 0 else 1.0)
        if not sizes:
            return float(n), np.inf
        worst = 1.0 / min(sizes)
        fixed = min(float(np.dot(shares, 1.0 / np.array(sizes))), worst)
        return max(1.0 / (1.0 / n + fixed), 1.0), max(1.0 / fixed, 1.0) if fixed > 0 else np.inf


def _share(met: Bool, p: float, pools: list[Pool]) -> float:
    """Covariance of two draws with the same draw of a set, relative to their variance.

    `met`: True for each draw that meets the limit, shape (n,). `p`: mean of `met`. `pools`: the set
    for each set of draws.
    """
    rows: list[Int] = []
    first = 0
    for pool in pools:
        if pool.rows is None:
            return 1.0
        rows.append(pool.rows + first)
        if pool.renewed:
            first += int(pool.rows.max()) + 1
    number = np.concatenate(rows)
    n_draws = np.bincount(number).astype(float)
    n_met = np.bincount(number, met)
    n_pairs = float(np.sum(n_draws * (n_draws - 1.0)))
    if n_pairs == 0:
        return 1.0
    products = (n_met - p * n_draws) ** 2 - (n_met * (1.0 - 2.0 * p) + p**2 * n_draws)
    share = float(products.sum()) / n_pairs / (p * (1.0 - p))
    # each of the n_pairs / 2 distinct pairs has a product with variance (p (1 - p))^2
    return float(np.clip(share + 2.0 * np.sqrt(2.0 / n_pairs), 0.0, 1.0))
