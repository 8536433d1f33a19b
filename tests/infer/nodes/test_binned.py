"""The report's way: clipped means in bins, smoothed, with errors by propagation."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.nodes import binned_table
from tests.infer.nodes.support import CHIP, SIZE, STEP, bilinear, node_pixels, pattern, places

NOISE = 0.03


def smooth_shift(x, y) -> np.ndarray:
    X, Y = x / SIZE[0] - 0.5, y / SIZE[1] - 0.5
    return np.stack([0.1 + 0.2 * X - 0.1 * X * Y, -0.05 + 0.3 * Y * Y], axis=1)


def table_of(x, y, r, **options):
    return binned_table(x, y, r, chip=CHIP, step=STEP, **options)


def flat(planes) -> np.ndarray:
    return planes.reshape(2, -1).T


@pytest.mark.parametrize("smooth", [True, False])
def test_errors_are_right_where_the_pattern_is_flat(rng, smooth):
    """Pulls of all nodes N(0, 1): a flat truth leaves noise alone."""
    x, y = places(rng, 60_000, gradient=True)
    r = np.array([0.1, -0.2]) + NOISE * rng.standard_normal((len(x), 2))
    table = table_of(x, y, r, smooth=smooth, clip=np.inf)
    pull = (flat(table.values) - [0.1, -0.2]) / flat(table.sigma)
    independent = 640 if not smooth else 640 * 27 / 175  # smooth nodes share their noise
    assert abs((pull**2).mean() - 1) < 4 * np.sqrt(2 / independent)


def test_a_quadratic_pattern_comes_back(rng):
    x, y = places(rng, 60_000)
    r = smooth_shift(x, y) + NOISE * rng.standard_normal((len(x), 2))
    table = table_of(x, y, r)
    pull = (flat(table.values) - smooth_shift(*node_pixels())) / flat(table.sigma)
    assert np.sqrt((pull**2).mean()) < 1.3  # the mean of a bin is not quite the value in its middle


@pytest.mark.parametrize("fraction", [0.03, 0.10])
def test_false_matches_do_not_pull(rng, fraction):
    x, y = places(rng, 60_000)
    r = NOISE * rng.standard_normal((len(x), 2))
    false = rng.random(len(x)) < fraction
    r[false] = rng.normal([2.0, -1.0], 1.0, (false.sum(), 2))  # all to one side
    plain = table_of(x, y, r, clip=np.inf, smooth=False)
    clipped = table_of(x, y, r, smooth=False)
    assert abs(flat(plain.values).mean(axis=0)[0]) > 0.5 * fraction * 2.0
    pull = flat(clipped.values) / flat(clipped.sigma)
    assert np.abs(flat(clipped.values).mean(axis=0)).max() < 0.1 * NOISE
    assert 0.8 < (pull**2).mean() < 1.3


def test_bins_without_stars_take_their_neighbours_and_far_ones_say_so(rng):
    x, y = places(rng, 60_000)
    hole = (x > 400) & (y > 300)
    x, y = x[~hole], y[~hole]
    r = smooth_shift(x, y) + NOISE * rng.standard_normal((len(x), 2))
    table = table_of(x, y, r)
    nx, ny = node_pixels()
    inside = (nx > 400) & (ny > 300)
    deep = (nx > 480) & (ny > 380)
    sigma, values = flat(table.sigma), flat(table.values)
    assert (values[deep] == 0).all()
    rms = np.sqrt((values[~deep] ** 2).mean(axis=0))
    np.testing.assert_allclose(sigma[deep], np.broadcast_to(rms, sigma[deep].shape), rtol=0.05)
    rim = inside & (nx < 432) & (ny < 450) | inside & (ny < 332) & (nx < 580)
    assert np.median(sigma[rim]) > 1.5 * np.median(sigma[~inside])


def test_a_rough_pattern_is_smoothed_away_in_part(rng):
    """What the field is for: a fixed kernel blurs a pattern as fine as its window."""
    d = pattern(rng)
    x, y = places(rng, 60_000)
    r = bilinear(x, y) @ d + NOISE * rng.standard_normal((len(x), 2))
    error = flat(table_of(x, y, r, order=3).values) - d
    quoted = flat(table_of(x, y, r, order=3).sigma)
    assert error.std() > 3 * np.median(quoted)


def test_the_polynomial_part_is_taken_off_on_demand(rng):
    x, y = places(rng, 20_000)
    r = smooth_shift(x, y) + NOISE * rng.standard_normal((len(x), 2))
    assert np.abs(flat(table_of(x, y, r).values)).max() > 0.1
    without = flat(table_of(x, y, r, order=3).values)
    assert np.abs(without).max() < 6 * NOISE / np.sqrt(20_000 / 320)
    X, Y = (p / n - 0.5 for p, n in zip(node_pixels(), SIZE, strict=True))
    for phi in (np.ones_like(X), X, Y, X * Y, X**3, X * Y**2):
        assert np.abs(phi @ without).max() < 1e-12


def test_wrong_input_is_named(rng):
    x, y = places(rng, 100)
    r = np.zeros((100, 2))
    with pytest.raises(InputError, match="clipped at -1"):
        table_of(x, y, r, clip=-1)
    with pytest.raises(InputError, match=r"'shift' has shape \(100,\)"):
        table_of(x, y, r[:, 0])
    bad = r.copy()
    bad[6, 1] = np.nan
    with pytest.raises(InputError, match="star 7"):
        table_of(x, y, bad)
    with pytest.raises(DegenerateError, match="no bin holds two stars"):
        table_of(x[:1], y[:1], r[:1])
    with pytest.raises(InputError, match="no stars"):
        table_of(x[:0], y[:0], r[:0])
