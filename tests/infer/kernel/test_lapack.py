"""Factors in place against numpy's, and refusals of what LAPACK would not survive."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.kernel.lapack import add_square, cholesky, divided, inverse_of


@pytest.fixture
def matrix(rng):
    A = rng.normal(size=(37, 37))
    return A @ A.T + np.eye(37)


def test_factor_and_inverse(matrix):
    L = cholesky(matrix.copy())
    np.testing.assert_allclose(L, np.linalg.cholesky(matrix), rtol=1e-11, atol=1e-12)
    inverse = inverse_of(L)
    np.testing.assert_allclose(np.triu(inverse, 1), 0.0)
    np.testing.assert_allclose(
        inverse + np.tril(inverse, -1).T, np.linalg.inv(matrix), rtol=1e-9, atol=1e-11
    )


def test_solution(matrix, rng):
    values = np.asfortranarray(rng.normal(size=(37, 37)))
    want = np.linalg.solve(np.linalg.cholesky(matrix), values)
    np.testing.assert_allclose(
        divided(cholesky(matrix.copy()), values), want, rtol=1e-10, atol=1e-11
    )


def test_squares_are_added_to_the_lower_triangle(matrix, rng):
    total, rows = matrix.copy(), rng.normal(size=(50, 37))
    add_square(total, rows)
    add_square(total, rows[:0])
    np.testing.assert_array_equal(np.triu(total, 1), np.triu(matrix, 1))
    np.testing.assert_allclose(np.tril(total), np.tril(matrix + rows.T @ rows), atol=1e-11)


def test_rows_that_do_not_fit_are_refused(matrix, rng):
    rows = rng.normal(size=(50, 40))
    for other in (rows, rows[:, :37], np.asfortranarray(rows[:, :37]), rows[0, :37]):
        with pytest.raises(ValueError, match="rows of float64 as long as those of the matrix"):
            add_square(matrix, other)
    with pytest.raises(ValueError, match="rows of float64"):
        add_square(matrix, rows[:, :37].astype(np.float32))


def test_no_factor_of_what_is_not_positive_definite(matrix):
    matrix[5, 5] = -1.0
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(matrix)


@pytest.mark.parametrize(
    "other",
    [
        lambda m: m.astype(np.float32),
        lambda m: m[:, :30].copy(),
        lambda m: m[::2, ::2],
        np.asfortranarray,
    ],
    ids=["of 32 bits", "not square", "with gaps", "in the other order"],
)
def test_what_lapack_would_write_beside_is_refused(matrix, other):
    with pytest.raises(ValueError, match="square matrix of float64"):
        cholesky(other(matrix))
    with pytest.raises(ValueError, match="square matrix of float64"):
        add_square(other(matrix), matrix)
    with pytest.raises(ValueError, match="square matrix of float64"):
        inverse_of(other(matrix.T).T)
