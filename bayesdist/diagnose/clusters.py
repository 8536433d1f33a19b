"""Sums over detections with correlated errors: those of one star, one exposure, or one cell.

The variance of a statistic that is a sum over detections follows from the squares of its sums over
such clusters, not from those of single detections.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import csr_matrix

from bayesdist.utils.arrays import Float, Int


def sums_over(cluster: Int, values: Float, n: int = 0) -> Float:
    """Sums of values over clusters.

    `cluster` (N,) are codes from 0, `values` are (N, ...), and the result has at least `n` rows.
    """
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    sums = [np.bincount(cluster, column, n) for column in columns]
    return np.stack(sums, axis=1).reshape(-1, *values.shape[1:]).astype(np.float64)


def add_over(total: Float, cluster: Int, values: Float) -> None:
    """Add values (N, ...) to the totals (c, ...) of their clusters, a few of many.

    `total` is changed in place.
    """
    present, of = np.unique(cluster, return_inverse=True)
    total[present] += sums_over(of, values)


def joint_clusters(group: Int, cluster: Int) -> tuple[Int, Int]:
    """Split clusters by group: the group (c,) of each part, and the part (N,) of each value.

    `group` and `cluster` (N,) must not be negative.
    """
    n = int(cluster.max(initial=0)) + 1
    keys, of = np.unique(group * n + cluster, return_inverse=True)
    return keys // n, of


def squares_over(cluster: Int, values: Float, group: Int | None = None, n: int = 1) -> Float:
    """Squares (n, ...) of the sums over clusters, summed in each group.

    `cluster` (N,) must not be negative, `values` are (N, ...); there is a single group by default.
    """
    owner, of = joint_clusters(np.zeros_like(cluster) if group is None else group, cluster)
    return sums_over(owner, sums_over(of, values) ** 2, n)


def products_over(group: Int, cluster: Int, values: Float, n: int) -> Float:
    """Products between groups of the sums of k values over clusters, summed over the clusters.

    Returns a matrix (k n, k n) for values (N, k) in n groups.
    """
    k = values.shape[1]
    rows = (group[:, None] * k + np.arange(k)).ravel()
    shape = (n * k, int(cluster.max(initial=0)) + 1)
    table = csr_matrix((values.ravel(), (rows, np.repeat(cluster, k))), shape=shape)
    return np.asarray((table @ table.T).toarray())
