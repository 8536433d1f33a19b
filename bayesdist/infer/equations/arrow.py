"""Symmetric arrow matrices: a dense border and many small blocks on the diagonal.

The normal matrix of a model with a frame per exposure has this form, since parameters of different
exposures are coupled only through the global parameters.  The local blocks are eliminated by the
Schur complement, so that the cost grows linearly with the number of exposures.

The global parameters of a mosaic are those of its chips, which are coupled only through exposures
and hyperparameters.  With many chips and few exposures, the chips are the blocks that are
eliminated, so that memory and cost grow linearly with the number of chips.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_solve, solve_triangular

Float = NDArray[Any]  # numpy's stubs lose float64 in its linear algebra
Int = NDArray[np.int64]

MANY = 100  # global entries; a border with fewer takes little memory and time as a dense matrix
# largest ratio of the other entries to the global ones for which independent parts are eliminated
FEW_OTHERS = 0.25


@dataclass(frozen=True, eq=False)
class Arrow:
    """Symmetric matrix [[border, edge], [edge^T, diag(blocks)]].

    Vectors are ordered as (global, local blocks, tail).  The border (b, b), with b = n_global +
    n_tail, belongs to the first `n_global` and the last `n_tail` entries, and the blocks
    (n_blocks, q, q) to the entries in between.  The edge (n_blocks, b, q) couples the two.

    `parts` (n_global,) are the numbers, from 0, of the parts that the global entries belong to, for
    example the chips; None if there is a single part.  Parts of equal size that are not coupled
    within the border can be eliminated in place of the blocks (see `factor`).  The matrix then has
    another `order` (size,): the indices in the vector of the entries of the border, followed by
    those of the blocks.
    """

    border: Float
    edge: Float
    blocks: Float
    n_tail: int = 0
    parts: Int | None = None
    order: Int | None = None

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
            other.parts if self.parts is None else self.parts,
        )

    @cached_property
    def _indices(self) -> tuple[Int, Int]:
        if self.order is not None:
            border, local = np.split(self.order, [len(self.border)])
            return border, local
        n, q = self.blocks.shape[:2]
        local = self.n_global + np.arange(n * q)
        tail = self.n_global + n * q + np.arange(self.n_tail)
        return np.concatenate([np.arange(self.n_global), tail]), local

    @property
    def entries(self) -> Int:
        """The `order` (size,) of the matrix, also if it is the usual one."""
        return np.concatenate(self._indices)

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
        g, (border, local) = self.n_global, self._indices
        return Arrow(
            self.border[:g, :g],
            self.edge[:, :g],
            self.blocks,
            parts=self.parts,
            order=None if self.order is None else np.concatenate([border[:g], local]),
        )

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

        If the global entries have many independent `parts` and there are few other entries, the
        parts are eliminated instead.  Raises numpy.linalg.LinAlgError if the matrix is not positive
        definite.
        """
        return self._with_parts_as_blocks()._factor()

    def _with_parts_as_blocks(self) -> Arrow:
        """Same matrix with the parts of the global entries as blocks, if that is much smaller."""
        g, (n, q) = self.n_global, self.blocks.shape[:2]
        m = n * q
        if self.parts is None or g < MANY or m + self.n_tail > FEW_OTHERS * g:
            return self
        if len(set(np.bincount(self.parts))) > 1:
            return self
        members = np.argsort(self.parts, kind="stable").reshape(self.parts.max() + 1, -1)
        blocks = self.border[members[:, :, None], members[:, None, :]]
        if np.count_nonzero(self.border[:g, :g]) > np.count_nonzero(blocks):
            return self  # a prior couples the parts
        border = np.zeros((m + self.n_tail, m + self.n_tail))
        border[:m, :m] = block_diag(*self.blocks) if n else 0.0
        border[m:, m:] = self.border[g:, g:]
        border[:m, m:] = self.edge[:, g:].mT.reshape(m, self.n_tail)
        border[m:, :m] = border[:m, m:].T
        edge = np.concatenate([self.edge[:, :g].mT.reshape(m, g), self.border[g:, :g]])
        of_border, local = self._indices
        order = np.concatenate([local, of_border[g:], of_border[members].ravel()])
        return Arrow(border, edge[:, members].swapaxes(0, 1), blocks, self.n_tail, order=order)

    def _factor(self) -> ArrowFactor:
        chol_blocks = np.linalg.cholesky(self.blocks)
        inverse_blocks = np.linalg.inv(chol_blocks)
        # L_e^-1 B_e^T of all blocks, stacked
        half = inverse_blocks @ self.edge.mT
        rows = half.reshape(half.shape[0] * half.shape[1], len(self.border))
        chol_border = np.linalg.cholesky(self.border - rows.T @ rows)
        return ArrowFactor(self, chol_border, chol_blocks, inverse_blocks, inverse_blocks.mT @ half)


@dataclass(frozen=True, eq=False)
class ArrowFactor:
    """Cholesky factors of a positive definite `Arrow` H, for solutions, log det and draws."""

    matrix: Arrow  # H, with the blocks that are eliminated
    chol_border: Float  # lower Cholesky factor (b, b) of the Schur complement
    chol_blocks: Float  # lower Cholesky factors (n_blocks, q, q) of the blocks
    inverse_blocks: Float  # inverses (n_blocks, q, q) of `chol_blocks`
    gain: Float  # C^-1 B^T (n_blocks, q, b), with C a block and B its edge (b, q)

    def solve(self, right: Float) -> Float:
        """Solve H x = right for vectors (..., size)."""
        b, l = self.matrix.split(right)
        b = b - np.einsum("nqb,...nq->...b", self.gain, l)
        if b.size:  # older versions of scipy refuse empty matrices
            columns = b.reshape(-1, b.shape[-1]).T
            top = cho_solve((self.chol_border, True), columns).T.reshape(b.shape)
        else:
            top = b
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
        unit = np.eye(len(self.chol_border))
        return solve_triangular(self.chol_border, unit, lower=True) if unit.size else unit

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
