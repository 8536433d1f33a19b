"""Numbers side by side in compiled loops against numpy, and the sums of moments in long double."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest
from numpy.polynomial import legendre as series

from bayesdist.infer.kernel.blocks import BLOCK, scratch
from bayesdist.infer.kernel.lanes import (
    ROWS,
    WIDE,
    WIDTH,
    choose,
    copy,
    first_lanes,
    larger,
    load,
    load_wide,
    product,
    put,
    smaller,
    spread,
    total,
)
from bayesdist.infer.kernel.moments import add_columns
from bayesdist.infer.kernel.numeric import legendre


@nb.njit
def _by_lanes(a, b, out):
    for s in range(0, a.shape[1], WIDTH):
        x, y = load(a, 0, s), load(b, 0, s)
        put(out, 0, s, x + 2.0 * y - x / y)
        put(out, 1, s, smaller(x, y))
        put(out, 2, s, larger(x, 0.5))
        put(out, 3, s, choose(x, y, x * y, spread(-1.0, x)))
        put(out, 4, s, first_lanes(20 - s, x, -7.0))


def test_lanes_are_numbers(rng):
    a, b = rng.uniform(0.1, 1, (2, 4 * WIDTH))
    out = np.empty((5, len(a)))
    _by_lanes(a[None], b[None], out)
    np.testing.assert_allclose(out[0], a + 2 * b - a / b, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(out[1], np.minimum(a, b))
    np.testing.assert_array_equal(out[2], np.maximum(a, 0.5))
    np.testing.assert_array_equal(out[3], np.where(a <= b, a * b, -1))
    np.testing.assert_array_equal(out[4], np.where(np.arange(len(a)) < 20, a, -7))


@nb.njit
def _across(a, start):
    return total(load_wide(a, 0, start)), product(load_wide(a, 0, start))


@pytest.mark.parametrize("start", [0, 1, 5])
def test_sums_and_products_across_lanes(start, rng):
    a = rng.uniform(0.5, 2, WIDE + 5)
    found, some = _across(a[None], start), a[start : start + WIDE]
    assert found == pytest.approx((some.sum(), some.prod()), rel=1e-14)


def test_scratch_begins_with_a_line_of_the_cache():
    for n in (1, 3, 11):
        assert scratch(n).shape == (n, BLOCK) and scratch(n).ctypes.data % 64 == 0


@nb.njit
def _through(a, first, out):
    copy(a[0], first, 3, out, 1)
    put(out, 0, 2, load(a, 1, first))


def test_rows_are_copied_and_read_where_they_begin(rng):
    a, out = rng.uniform(0, 1, (2, 30)), np.zeros((2, WIDTH + 2))
    _through(a, 5, out)
    np.testing.assert_array_equal(out[1], [*a[0, 5:8], *[0.0] * (WIDTH - 1)])
    np.testing.assert_array_equal(out[0], [0.0, 0.0, *a[1, 5 : 5 + WIDTH]])


def test_rows_that_do_not_follow_each_other_are_refused():
    a = np.zeros((4, 30))
    for wrong in (a[::2], a.T, a.astype(np.float32), a[0]):
        with pytest.raises(nb.TypingError, match="is not a C array of float64"):
            _across(wrong, 0)


@nb.njit
def _moments(stars, weights, n, order, P, Q, sums):
    legendre(stars, n, order, P, Q)
    for _ in range(2):  # they are added to what is there
        add_columns(weights, n, P, Q, sums)


@pytest.mark.parametrize("order", [0, 1, 2, 5, 6, 7, 13])
@pytest.mark.parametrize("n", [1, WIDTH, 100, BLOCK])
def test_sums_are_those_in_long_double(order, n, rng):
    """For all shapes of a triangle of moments, and stars that do not fill a vector."""
    stars, weights = scratch(2), scratch(ROWS)
    stars[:] = 1.0
    stars[:, :n] = rng.uniform(-1, 1, (2, n))
    weights[:] = 0.0
    weights[:, :n] = rng.standard_normal((ROWS, n))
    P, Q = scratch(order + 1), scratch(order + 1)
    lanes = np.zeros((1, order + 1, order + 1, ROWS, WIDTH))
    _moments(stars, weights, n, order, P, Q, lanes)
    X, Y = stars[:, :n].astype(np.longdouble)
    by_x, by_y = (
        np.array([series.legval(z, [0] * k + [1]) for k in range(order + 1)]) for z in (X, Y)
    )
    exact = 2 * np.einsum("rn,in,jn->ijr", weights[:, :n].astype(np.longdouble), by_x, by_y)
    inside = np.add.outer(np.arange(order + 1), np.arange(order + 1)) <= order
    size = np.abs(weights).sum()
    found = lanes[0].sum(axis=-1)
    assert np.abs(found - exact)[inside].max() < 1e-13 * size
    assert (found[~inside] == 0).all()


def test_blocks_hold_whole_vectors():
    """Of four vectors in polynomials, and of the eight stars whose densities are multiplied."""
    assert BLOCK % WIDE == BLOCK % (8 * WIDTH) == 0
