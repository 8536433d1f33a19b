"""What matches have in common: the star, and the place on the detector.

A star of the catalogue has one error in all of its exposures, and a place on the detector, be it a
cell of a look-up table or a patch of what the model leaves out, one on all stars there.  Sums over
matches then vary by more than those of independent ones: scores of the position by the squares of
their sums over each star, those of the spread by

    cov(q_i, q_j) = 4 c_i c_j      c = (error that is shared)^2 / (whole error)^2

for two matches i, j of a star (two axes, Gaussian errors), and counts by those of clusters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bayesdist.data import Matches
from bayesdist.diagnose.clusters import joint_clusters, products_over, sums_over
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.holdout.rows import Rows

if TYPE_CHECKING:
    from bayesdist.diagnose.holdout.sums import BinSums

__all__ = ["ClusterSums"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


class ClusterSums:
    """Sums of matches over stars and cells, which take the place of those of single matches.

    Collects matches, and changes their sums once all are there.

    Parameters
    ----------
    predictive : Predictive
        With errors of the catalogue, of places, or both.
    n_bins : int
        Of the predictive probabilities.
    tails : sequence of float
        Limits, in sigma.
    """

    def __init__(self, predictive: Predictive, n_bins: int, tails: Sequence[float]) -> None:
        self._predictive = predictive
        self._n_bins, self._limits = n_bins, tuple(tails)
        self._parts: list[dict[str, NDArray[np.generic]]] = []
        self._codes: dict[str, list[Int]] = {}
        self._step = predictive.cell if predictive.local else None
        self._n = 0

    def add(
        self,
        table: Matches,
        rows: Rows,
        place: Float,
        uniforms: Float,
        size: Float,
        codes: Mapping[str, Int],
    ) -> None:
        """Some matches, with their scores and the bins that they lie in."""
        stars, index = self._predictive.stars, rows.index
        if stars is None or table.star is None:
            star = -1 - self._n - np.arange(len(index))  # each by itself
            variance = np.zeros(len(index))
        else:
            star = table.star[index]
            epoch = None if table.epoch is None else table.epoch[index]
            variance = stars.errors.at(star, epoch).mean(axis=1)
        self._n += len(index)
        whole = rows.cov[:, :2].mean(axis=1)
        part: dict[str, NDArray[np.generic]] = {
            "star": star,
            "place": place,
            "share": np.minimum(variance / whole, 1.0),
            "pit": np.clip((uniforms * self._n_bins).astype(np.int64), 0, self._n_bins - 1).T,
            "size": size,
        }
        if self._step is not None:
            chip = table.chip_number[index]
            x, y = table.x[index], table.y[index]
            local = self._predictive.local_variance(x, y, chip)
            part["local"] = (1 - self._predictive.fraction) * np.sqrt(local) / whole
            part["local_size"] = np.sqrt(local)
            part["local_share"] = np.minimum(local / whole, 1.0)
            across, up = (
                np.maximum(a // s, 0).astype(np.int64)
                for a, s in zip((x, y), self._step, strict=True)
            )
            part["cell"] = (chip * 2**20 + up) * 2**20 + across
        self._parts.append(part)
        for kind, code in codes.items():
            self._codes.setdefault(kind, []).append(code)

    def settle(self, bins: Mapping[str, BinSums]) -> None:
        """Put the sums of clusters into the place of those of single matches."""
        self._all = {k: np.concatenate([part[k] for part in self._parts]) for k in self._parts[0]}
        star = np.unique(self._all["star"], return_inverse=True)[1]
        self._star = star
        self._cell = None
        if self._step is not None:
            self._cell = np.unique(self._all["cell"], return_inverse=True)[1]
        for kind, parts in self._codes.items():
            self._settle_bins(bins[kind], np.concatenate(parts))

    def _settle_bins(self, sums: BinSums, code: Int) -> None:
        inside = np.flatnonzero(code >= 0)
        n_bins, at = len(sums.n), code[inside]
        sums.place_cov = products_over(at, self._star[inside], self._all["place"][inside], n_bins)
        for b in range(n_bins):
            sums.place_2[b] = sums.place_cov[2 * b : 2 * b + 2, 2 * b : 2 * b + 2]
        owner = _spread_together(sums, at, self._star[inside], self._all["share"][inside])
        sums.independent[:] = np.bincount(owner, minlength=n_bins)
        if self._cell is not None:
            _spread_together(sums, at, self._cell[inside], self._all["local_share"][inside])
            local = self._all["local"][inside]
            extra = products_over(at, self._cell[inside], local[:, None], n_bins)
            extra[np.diag_indices(n_bins)] -= np.bincount(at, local**2, n_bins)
            sums.place_cov += np.kron(extra, np.eye(2))

    @property
    def stars_repeat(self) -> bool:
        """Whether matches of one star share its error: else each match is by itself."""
        return self.n_stars < len(self._star)

    @property
    def n_stars(self) -> int:
        """Stars, each once."""
        return int(self._star.max()) + 1

    def pit_covariance(self, k: int, merge: int) -> Float:
        """Covariance (m, m) of the counts of predictive probabilities, in merged bins.

        By an error that a cell shares a count changes as by one of the solution's parameters: by
        the sum of score times error.  Squares of the counts of some tens of cells would not have
        the rank of a covariance.
        """
        m = self._n_bins // merge
        code = self._all["pit"][:, k] // merge
        if self.stars_repeat:
            out = _outer(code, self._star, m)
        else:
            out = len(code) * (np.eye(m) / m - 1 / m**2)
        if self._cell is not None:
            for score in (self._all["place"] * self._all["local_size"][:, None]).T:
                by = _by_bin(code, self._cell, m, score)
                out += by.T @ by
        return out

    def overdispersion(self, limit: float) -> float:
        """How much more the number of stars beyond a limit varies than that of independent ones."""
        far = (self._all["size"] > limit).astype(float)
        rest = far - far.mean()
        single = float((rest**2).sum())
        return max(1.0, float((sums_over(self._star, rest) ** 2).sum()) / single) if single else 1.0


def _spread_together(sums: BinSums, code: Int, member: Int, share: Float) -> Int:
    """Add what members of a cluster scatter together; the bin of each cluster."""
    n_bins = len(sums.n)
    owner, of = joint_clusters(code, member)
    p1, p2, p3 = (sums_over(of, share**k) for k in (1, 2, 3))
    pairs = np.maximum(p1**2 - p2, 0.0)
    triples = np.maximum(p1**3 - 3 * p1 * p2 + 2 * p3, 0.0)
    sums.spread_2 += np.bincount(owner, 4 * pairs, n_bins)
    sums.spread_3 += np.bincount(owner, 16 * (3 * pairs + triples), n_bins)
    return owner


def _outer(code: Int, cluster: Int, m: int) -> Float:
    """Sum of squares (m, m) of counts in m bins less their expectation, cluster by cluster."""
    counts = _by_bin(code, cluster, m, np.ones(len(code)))
    return np.asarray(counts.T @ counts)


def _by_bin(code: Int, cluster: Int, m: int, values: Float) -> Float:
    """Sums (clusters, m) of values by bin less the mean over bins."""
    n = int(cluster.max()) + 1
    sums = np.bincount(cluster * m + code, values, n * m).reshape(n, m)
    return np.asarray(sums - sums.sum(axis=1, keepdims=True) / m)
