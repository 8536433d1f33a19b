"""Symmetric arrow matrices: a dense border and many small blocks on the diagonal.

The normal matrix of a model with a frame per exposure has this form, since parameters of different
exposures are coupled only through the global parameters.  The local blocks are eliminated by the
Schur complement, so that the cost grows linearly with the number of exposures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

Float = NDArray[Any]  # numpy's stubs lose float64 in its linear algebra


@dataclass(frozen=True, eq=False)
class Arrow:
    """Symmetric matrix [[border, edge], [edge^T, diag(blocks)]].

    Vectors are ordered as (global, local blocks, tail).  The border (b, b), with b = n_global +
    n_tail, belongs to the first `n_global` and the last `n_tail` entries, and the blocks
    (n_blocks, q, q) to the entries in between.  The edge (n_blocks, b, q) couples the two.
    """

    border: Float
    edge: Float
    blocks: Float
    n_tail: int = 0

    @property
    def n_global(self) -> int:
        """Number of entries that precede the blocks."""
        return len(self.border) - self.n_tail

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.border) + self.blocks.shape[0] * self.blocks.shape[1]

    def __add__(self, other: Arrow) -> Arrow:
        return Arrow(
            self.border + other.border,
            self.edge + other.edge,
            self.blocks + other.blocks,
            self.n_tail,
        )

    @cached_property
    def _indices(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        n, q = self.blocks.shape[:2]
        local = self.n_global + np.arange(n * q)
        tail = self.n_global + n * q + np.arange(self.n_tail)
        return np.concatenate([np.arange(self.n_global), tail]), local

    def split(self, vector: Float) -> tuple[Float, Float]:
        """Split vectors (..., size) into border part (..., b) and local part (..., n_blocks, q)."""
        border, local = self._indices
        n, q = self.blocks.shape[:2]
        return vector[..., border], vector[..., local].reshape(*vector.shape[:-1], n, q)

    def join(self, border_part: Float, local_part: Float) -> Float:
        """Join a border part (..., b) and a local part (..., n_blocks, q): inverse of `split`."""
        border, local = self._indices
        out = np.empty((*border_part.shape[:-1], self.size))
        out[..., border] = border_part
        out[..., local] = local_part.reshape(*border_part.shape[:-1], len(local))
        return out

    def diagonal(self) -> Float:
        """Diagonal (size,)."""
        return self.join(
            np.diag(self.border).copy(), np.einsum("nqq->nq", self.blocks).astype(float)
        )

    def without_tail(self) -> Arrow:
        """Matrix without the rows and columns of the tail."""
        if not self.n_tail:
            return self
        g = self.n_global
        return Arrow(self.border[:g, :g], self.edge[:, :g], self.blocks)

    def dense(self) -> Float:
        """Full matrix (size, size), for small problems and tests."""
        border, local = self._indices
        n, q = self.blocks.shape[:2]
        out = np.zeros((self.size, self.size))
        out[np.ix_(border, border)] = self.border
        for e in range(n):
            rows = local[e * q : (e + 1) * q]
            out[np.ix_(rows, rows)] = self.blocks[e]
            out[np.ix_(border, rows)] = self.edge[e]
            out[np.ix_(rows, border)] = self.edge[e].T
        return out

    def factor(self) -> ArrowFactor:
        """Cholesky factorisation, with the local blocks eliminated first.

        Raises numpy.linalg.LinAlgError if the matrix is not positive definite.
        """
        chol_blocks = np.linalg.cholesky(self.blocks)
        inverse_blocks = np.linalg.inv(chol_blocks)
        # L_e^-1 B_e^T of all blocks, stacked
        half = inverse_blocks @ self.edge.mT
        rows = half.reshape(-1, len(self.border))
        chol_border = np.linalg.cholesky(self.border - rows.T @ rows)
        return ArrowFactor(self, chol_border, chol_blocks, inverse_blocks, inverse_blocks.mT @ half)


@dataclass(frozen=True, eq=False)
class ArrowFactor:
    """Cholesky factors of a positive definite `Arrow` H, for solutions, log det and draws."""

    matrix: Arrow
    chol_border: Float  # lower Cholesky factor (b, b) of the Schur complement
    chol_blocks: Float  # lower Cholesky factors (n_blocks, q, q) of the blocks
    inverse_blocks: Float  # inverses (n_blocks, q, q) of `chol_blocks`
    gain: Float  # C^-1 B^T (n_blocks, q, b), with C a block and B its edge (b, q)

    def solve(self, right: Float) -> Float:
        """Solve H x = right for vectors (..., size)."""
        b, l = self.matrix.split(right)
        b = b - np.einsum("nqb,...nq->...b", self.gain, l)
        top = cho_solve((self.chol_border, True), b.reshape(-1, b.shape[-1]).T).T.reshape(b.shape)
        white = np.einsum("nqr,...nr->...nq", self.inverse_blocks, l)
        low = np.einsum("nrq,...nr->...nq", self.inverse_blocks, white)
        return self.matrix.join(top, low - np.einsum("nqb,...b->...nq", self.gain, top))

    @cached_property
    def logdet(self) -> float:
        """Logarithm of the determinant of H."""
        out = 2 * np.log(np.diag(self.chol_border)).sum()
        return float(out + 2 * np.log(np.einsum("nqq->nq", self.chol_blocks)).sum())

    def colour(self, z: Float) -> Float:
        """Transform standard normal vectors z (..., size) to vectors x with covariance H^-1.

        x_b = L_S^-T z_b and x_e = L_e^-T z_e - C_e^-1 B_e^T x_b, so that |z|^2 = x^T H x.
        """
        b, l = self.matrix.split(z)
        top = b @ self._inverse_border
        low = np.einsum("nrq,...nr->...nq", self.inverse_blocks, l)
        return self.matrix.join(top, low - np.einsum("nqb,...b->...nq", self.gain, top))

    # Border and blocks are inverted explicitly: `colour` is called for every proposal with only a
    # few vectors, for which the overhead of a triangular solve is a hundred times its arithmetic.

    @cached_property
    def _inverse_border(self) -> Float:
        return solve_triangular(self.chol_border, np.eye(len(self.chol_border)), lower=True)

    def whiten(self, x: Float) -> Float:
        """Transform vectors x (..., size) to z with |z|^2 = x^T H x: the inverse of `colour`."""
        b, l = self.matrix.split(x)
        low = l + np.einsum("nqb,...b->...nq", self.gain, b)
        low = np.einsum("nrq,...nr->...nq", self.chol_blocks, low)
        return self.matrix.join(b @ self.chol_border, low)

    def variances(self) -> Float:
        """Diagonal (size,) of H^-1, computed without the off-diagonal elements."""
        root = self._inverse_border
        top = (root**2).sum(axis=0)
        spread = self.gain @ root.T
        low = (self.inverse_blocks**2).sum(axis=1) + (spread**2).sum(axis=2)
        return self.matrix.join(top, low)

    def covariance(self) -> Float:
        """H^-1 as a dense matrix (size, size)."""
        root = self.colour(np.eye(self.matrix.size))
        return root.T @ root
