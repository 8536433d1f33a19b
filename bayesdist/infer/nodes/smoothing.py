"""Smoothing by a quadratic surface over 5 x 5 nodes (Anderson and King 2000, PASP 112, 1360).

The value of a node becomes that of the quadratic surface through the 25 values around it, all of
equal weight.  Away from edges and empty bins this is their fixed kernel, 27/175 in the middle.
Near an edge or an empty bin the surface is fitted to the values that exist.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

__all__ = ["HALF_WIDTH", "quadratic_smoother"]

Float = NDArray[np.float64]

HALF_WIDTH = 2  # nodes: a window of 5 x 5
# values for each coefficient of the surface: the 3 x 3 of a corner determine a quadratic
ENOUGH = 1.5


def quadratic_smoother(filled: NDArray[np.bool_]) -> scipy.sparse.csr_array:
    """Sparse linear map (n_nodes, n_nodes) from node values to smooth ones.

    `filled` (ny, nx) marks nodes with a value; columns of empty nodes are zero.  A node whose
    window holds few values gets a plane or their mean; one whose window holds none gets a row of
    zeros.
    """
    ny, nx = filled.shape
    rows, columns, entries = [], [], []
    for j in range(ny):
        for i in range(nx):
            low_j, low_i = max(j - HALF_WIDTH, 0), max(i - HALF_WIDTH, 0)
            window = filled[low_j : j + HALF_WIDTH + 1, low_i : i + HALF_WIDTH + 1]
            dj, di = np.nonzero(window)
            if not len(dj):
                continue
            dj, di = dj + low_j - j, di + low_i - i
            kernel = _kernel(tuple(di.tolist()), tuple(dj.tolist()))
            rows.append(np.full(len(dj), j * nx + i))
            columns.append((dj + j) * nx + di + i)
            entries.append(kernel)
    shape = (ny * nx, ny * nx)
    if not rows:
        return scipy.sparse.csr_array(shape)
    where = (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.coo_array((np.concatenate(entries), where), shape).tocsr()


@lru_cache(maxsize=4096)
def _kernel(dx: tuple[int, ...], dy: tuple[int, ...]) -> Float:
    """Weights of values at offsets (m,) in the surface's value at zero."""
    x, y = np.array(dx, float), np.array(dy, float)
    quadratic = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    for n in (6, 3, 1):
        design = quadratic[:, :n]
        if len(x) >= ENOUGH * n or n == 1:
            if np.linalg.matrix_rank(design) == n:
                break
    weights: Float = np.linalg.pinv(design)[0]
    return weights
