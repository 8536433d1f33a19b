"""The 5 x 5 quadratic kernel."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from bayesdist.infer.nodes import quadratic_smoother

NY, NX = 12, 17


def surface(rng) -> np.ndarray:
    j, i = np.mgrid[:NY, :NX] / 10
    a = rng.standard_normal(6)
    return a[0] + a[1] * i + a[2] * j + a[3] * i * i + a[4] * i * j + a[5] * j * j


def kernel(smoother) -> np.ndarray:
    row = smoother[[6 * NX + 8]].toarray().reshape(NY, NX)
    return row[4:9, 6:11]


def test_inside_it_is_the_published_kernel():
    """Anderson and King (2000) print 0.1543, 0.0971, -0.0743, ...: multiples of 1/175."""
    want = [
        [-13, 2, 7, 2, -13],
        [2, 17, 22, 17, 2],
        [7, 22, 27, 22, 7],
        [2, 17, 22, 17, 2],
        [-13, 2, 7, 2, -13],
    ]
    exact = np.array([[float(Fraction(k, 175)) for k in row] for row in want])
    got = kernel(quadratic_smoother(np.ones((NY, NX), bool)))
    np.testing.assert_allclose(got, exact, atol=1e-14)


def test_quadratics_pass_unchanged_up_to_the_edges_and_around_holes(rng):
    values = surface(rng)
    filled = np.ones((NY, NX), bool)
    j, i = np.mgrid[:NY, :NX]
    corner = ((j < 3) | (j >= NY - 3)) & ((i < 3) | (i >= NX - 3))
    for holes in (0, 12):
        filled.ravel()[rng.choice(np.flatnonzero(~corner), holes, replace=False)] = False
        H = quadratic_smoother(filled)
        smooth = (H @ np.where(filled, values, 1e6).ravel()).reshape(NY, NX)
        np.testing.assert_allclose(smooth, values, atol=1e-11)


def test_a_thin_window_falls_back_and_an_empty_one_is_said():
    filled = np.zeros((NY, NX), bool)
    filled[0, 0] = True  # a single value: its neighbourhood is that value
    filled[8, 5:15] = True  # a row: no plane and no quadratic goes through it, a mean does
    H = quadratic_smoother(filled)
    values = np.full(NY * NX, 3.0)
    smooth = (H @ values).reshape(NY, NX)
    reached = (np.diff(H.indptr) > 0).reshape(NY, NX)
    np.testing.assert_allclose(smooth[reached], 3.0, rtol=1e-12)
    assert reached[:3, :3].all() and reached[6:11, 3:17].all()
    assert not reached[:6, 3:].any() and not smooth[~reached].any()


def test_white_noise_shrinks_by_the_sum_of_squares(rng):
    """Of a least-squares fit, the variance of a fitted value is its own weight: 27/175."""
    H = quadratic_smoother(np.ones((NY, NX), bool))
    square = np.asarray(H.power(2).sum(axis=1)).ravel()
    np.testing.assert_allclose(square, H.diagonal(), atol=1e-13)
    assert abs(square[6 * NX + 8] - 27 / 175) < 1e-13
