"""Small matrices in bulk against LAPACK, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.series.small import cholesky, inverse_of_factor, precision_of, solve_factor


@pytest.mark.parametrize("k", [1, 2, 4, 7])
def test_bulk_is_one_by_one(k, rng):
    raw = rng.standard_normal((5, 6, k, k + 2))
    single = raw @ np.swapaxes(raw, -1, -2)
    bulk = np.moveaxis(single, (2, 3), (0, 1))
    factor = cholesky(bulk)
    back = np.moveaxis(factor, (0, 1), (2, 3))
    np.testing.assert_allclose(back, np.linalg.cholesky(single), rtol=1e-10, atol=1e-12)
    inverse = np.moveaxis(inverse_of_factor(factor), (0, 1), (2, 3))
    np.testing.assert_allclose(inverse @ back, np.broadcast_to(np.eye(k), back.shape), atol=1e-8)
    precision = np.moveaxis(precision_of(factor), (0, 1), (2, 3))
    np.testing.assert_allclose(precision, np.linalg.inv(single), rtol=1e-6, atol=1e-9)
    vector = rng.standard_normal((k, 5, 6))
    solved = np.moveaxis(solve_factor(factor, vector), 0, -1)
    expected = np.linalg.solve(back, np.moveaxis(vector, 0, -1)[..., None])[..., 0]
    np.testing.assert_allclose(solved, expected, rtol=1e-8, atol=1e-10)
