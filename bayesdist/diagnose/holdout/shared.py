"""Errors that matches share: those of a star, and those of a position on the detector.

A star of the catalogue has the same error in all exposures.  Errors of a look-up table, or of
structure that the model lacks, are the same for all stars in a cell of the detector.  Sums over
matches therefore vary by more than those of independent matches.  The variance of position scores
follows from the squares of their sums per star, and that of counts from sums per cluster.  For
spread scores,

    cov(q_i, q_j) = 4 c_i c_j      c = (shared error)^2 / (total error)^2

for two matches i, j of a star (two axes, Gaussian errors).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data import Matches
from bayesdist.diagnose.clusters import joint_clusters, products_over, squares_over, sums_over
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.holdout.rows import HeldRows
from bayesdist.utils.arrays import Float, Int


class SharedErrors:
    """Matches, with the stars and cells through which their errors are correlated.

    `predictive` contains errors of the catalogue, of positions on the detector, or both.
    Predictive probabilities are counted in `n_bins` bins.
    """

    def __init__(self, predictive: Predictive, n_bins: int) -> None:
        self._predictive, self._n_bins = predictive, n_bins
        self._parts: list[dict[str, NDArray[Any]]] = []
        self._codes: dict[str, list[Int]] = {}
        self._step = predictive.cell if predictive.local else None
        self._n = 0

    def add(
        self,
        table: Matches,
        rows: HeldRows,
        place: Float,
        uniforms: Float,
        size: Float,
        codes: Mapping[str, Int],
    ) -> None:
        """Add matches, with their scores and the bins that they belong to."""
        stars, index = self._predictive.stars, rows.index
        if stars is None or table.star is None:
            star = -1 - self._n - np.arange(len(index))  # each match is a separate star
            variance = np.zeros(len(index))
        else:
            star = table.star[index]
            epoch = None if table.epoch is None else table.epoch[index]
            variance = stars.errors.at(star, epoch).mean(axis=1)
        self._n += len(index)
        total_variance = rows.cov[:, :2].mean(axis=1)
        part: dict[str, NDArray[Any]] = {
            "star": star,
            "place": place,
            "share": np.minimum(variance / total_variance, 1.0),
            "pit": np.clip((uniforms * self._n_bins).astype(np.int64), 0, self._n_bins - 1).T,
            "size": size,
        }
        if self._step is not None:
            chip = table.chip_number[index]
            x, y = table.x[index], table.y[index]
            local = self._predictive.local_variance(x, y, chip)
            part["local"] = (1 - self._predictive.fraction) * np.sqrt(local) / total_variance
            part["local_size"] = np.sqrt(local)
            part["local_share"] = np.minimum(local / total_variance, 1.0)
            across, up = (
                np.maximum(a // s, 0).astype(np.int64)
                for a, s in zip((x, y), self._step, strict=True)
            )
            part["cell"] = (chip * 2**20 + up) * 2**20 + across
        self._parts.append(part)
        for kind, code in codes.items():
            self._codes.setdefault(kind, []).append(code)

    @cached_property
    def _all(self) -> dict[str, NDArray[Any]]:
        """Columns of all matches, with stars and cells numbered from 0."""
        out = {k: np.concatenate([part[k] for part in self._parts]) for k in self._parts[0]}
        for k in {"star", "cell"} & set(out):
            out[k] = np.unique(out[k], return_inverse=True)[1]
        return out

    def _inside(self, kind: str, *names: str) -> list[NDArray[Any]]:
        """Bins (n,) and columns of the matches that belong to a bin of a partition."""
        code = np.concatenate(self._codes[kind])
        inside = np.flatnonzero(code >= 0)
        return [code[inside], *(self._all[name][inside] for name in names)]

    def place_covariance(self, kind: str, n: int) -> tuple[Float, Float]:
        """Covariances (2 n, 2 n) of position scores in n bins, without and with errors of cells."""
        at, star, place = self._inside(kind, "star", "place")
        by_star = products_over(at, star, place, n)
        if self._step is None:
            return by_star, by_star
        at, cell, local = self._inside(kind, "cell", "local")
        extra = products_over(at, cell, local[:, None], n)
        extra[np.diag_indices(n)] -= np.bincount(at, local**2, n)
        return by_star, by_star + np.kron(extra, np.eye(2))

    def spread_moments(self, kind: str, n: int) -> tuple[Float, Float]:
        """Second and third moments (n,) that correlated errors add to the spread scores."""
        out = np.zeros((2, n))
        pairs = [("star", "share")]
        if self._step is not None:
            pairs.append(("cell", "local_share"))
        for names in pairs:
            at, member, share = self._inside(kind, *names)
            owner, of = joint_clusters(at, member)
            p1, p2, p3 = (sums_over(of, share**k) for k in (1, 2, 3))
            two = np.maximum(p1**2 - p2, 0.0)
            three = np.maximum(p1**3 - 3 * p1 * p2 + 2 * p3, 0.0)
            out[0] += np.bincount(owner, 4 * two, n)
            out[1] += np.bincount(owner, 16 * (3 * two + three), n)
        return out[0], out[1]

    def independent(self, kind: str, n: int) -> Float:
        """Number (n,) of distinct stars in each bin."""
        at, star = self._inside(kind, "star")
        return np.bincount(joint_clusters(at, star)[0], minlength=n).astype(np.float64)

    @property
    def stars_repeat(self) -> bool:
        """True if several matches share the error of one star."""
        return self.n_stars < self._n

    @cached_property
    def n_stars(self) -> int:
        """Number of distinct stars."""
        return int(self._all["star"].max()) + 1

    def pit_covariance(self, k: int, merge: int) -> Float:
        """Covariance (m, m) of the counts of predictive probabilities, in merged bins.

        The error that a cell shares changes a count like a parameter of the solution does: by the
        sum of score times error.  Squares of the counts of a few tens of cells would not give a
        covariance of full rank.
        """
        m = self._n_bins // merge
        code = self._all["pit"][:, k] // merge
        if self.stars_repeat:
            by = _by_bin(code, self._all["star"], m, np.ones(len(code)))
            out = by.T @ by
        else:
            out = len(code) * (np.eye(m) / m - 1 / m**2)
        if self._step is not None:
            for score in (self._all["place"] * self._all["local_size"][:, None]).T:
                by = _by_bin(code, self._all["cell"], m, score)
                out += by.T @ by
        return np.asarray(out)

    def overdispersion(self, limit: float) -> float:
        """Variance of the number of stars beyond a limit, divided by that of independent stars."""
        far = (self._all["size"] > limit).astype(float)
        deviation = far - far.mean()
        single = float((deviation**2).sum())
        clustered = float(squares_over(self._all["star"], deviation)[0])
        return max(1.0, clustered / single) if single else 1.0


def _by_bin(code: Int, cluster: Int, m: int, values: Float) -> Float:
    """Sums (clusters, m) of values per bin, minus their mean over the bins."""
    n = int(cluster.max()) + 1
    sums = np.bincount(cluster * m + code, values, n * m).reshape(n, m)
    return np.asarray(sums - sums.sum(axis=1, keepdims=True) / m)
