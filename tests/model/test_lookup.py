"""Look-up tables: what they mean, held against astropy.wcs."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.wcs import WCS, DistortionLookupTable
from numpy.testing import assert_allclose, assert_array_equal

from bayesdist.errors import InputError
from bayesdist.model.lookup import LookupTable, corrected


def rough(rng, chip=1, shape=(5, 7), size=0.2, **names) -> LookupTable:
    """A table without any smoothness."""
    return LookupTable(chip, rng.normal(size=(2, *shape)) * size, **names)


def astropy_det2im(table: LookupTable, x, y):
    """Corrected pixels as astropy.wcs has them; its tables are in single precision."""
    wcs = WCS(naxis=2)
    wcs.det2im1, wcs.det2im2 = (
        DistortionLookupTable(np.asarray(plane, np.float32), (1.0, 1.0), table.first, table.step)
        for plane in table.values
    )
    return np.stack(wcs.det2im(x, y, 1), axis=-1)


@pytest.mark.parametrize(
    ("shape", "first", "step"),
    [((5, 7), (32.5, 32.5), (64.0, 64.0)), ((2, 2), (1.0, 10.0), (100.0, 37.5)),
     ((32, 64), (32.5, 32.5), (64.0, 64.0))],
)  # fmt: skip
def test_astropy_interpolates_the_same_on_the_grid_and_beyond_it(rng, shape, first, step) -> None:
    table = rough(rng, shape=shape, first=first, step=step)
    nodes = table.nodes()
    span = [(n[0] - 3 * d, n[-1] + 3 * d) for n, d in zip(nodes, step, strict=True)]
    x, y = (rng.uniform(*s, 2000) for s in span)
    ours = np.stack([x, y], axis=-1) + table.evaluate(x, y)
    assert_allclose(ours, astropy_det2im(table, x, y), atol=1e-7)  # half a unit of float32 at 1 px


def test_a_node_gives_its_value_and_beyond_the_last_one_nothing_changes(rng) -> None:
    table = rough(rng)
    x, y = (a.ravel() for a in np.meshgrid(*table.nodes()))
    assert_allclose(table.evaluate(x, y), table.values.reshape(2, -1).T, atol=1e-15)
    assert_allclose(table.evaluate(1e6, -1e6)[0], table.values[:, 0, -1], atol=1e-15)
    assert_allclose(table.evaluate(32.5 + 32.0, 32.5)[0], table.values[:, 0, :2].mean(axis=1))


def test_bilinear_functions_are_reproduced(rng) -> None:
    c = rng.normal(size=(2, 4)) * [0.1, 1e-3, 1e-3, 1e-6]
    bare = LookupTable(1, np.zeros((2, 6, 4)), first=(-7.0, 3.0), step=(20.0, 11.0))

    def function(x, y):
        return c[:, 0] + np.stack([x, y, x * y], axis=-1) @ c[:, 1:].T

    gx, gy = np.meshgrid(*bare.nodes())
    table = LookupTable(1, np.moveaxis(function(gx, gy), -1, 0), first=bare.first, step=bare.step)
    x, y = rng.uniform(-7, 53, 500), rng.uniform(3, 58, 500)
    assert_allclose(table.evaluate(x, y), function(x, y), atol=1e-14)
    expected = np.empty((500, 2, 2))
    expected[:, :, 0] = c[:, 1] + c[:, 3] * y[:, None]
    expected[:, :, 1] = c[:, 2] + c[:, 3] * x[:, None]
    assert_allclose(table.gradient(x, y) - np.eye(2), expected, atol=1e-14)


def test_weights_are_the_derivatives_by_the_nodes(rng) -> None:
    """Positive, sum 1, and linear in the values: moving one node moves a pixel by its weight."""
    table = rough(rng, shape=(4, 3))
    x, y = rng.uniform(-50, 300, 200), rng.uniform(-50, 400, 200)
    index, weight = table.weights(x, y)
    assert index.dtype == np.int64 and index.shape == weight.shape == (200, 4)
    assert index.min() >= 0 and index.max() < 12
    assert weight.min() >= 0
    assert_allclose(weight.sum(axis=1), 1.0, rtol=1e-14)
    dense = np.zeros((200, 12))
    np.add.at(dense, (np.arange(200)[:, None], index), weight)
    for node in range(12):
        moved = table.values.copy()
        moved.reshape(2, -1)[0, node] += 1.0
        difference = LookupTable(1, moved).evaluate(x, y) - table.evaluate(x, y)
        assert_allclose(difference[:, 0], dense[:, node], atol=1e-14)
        assert_array_equal(difference[:, 1], 0.0)


def test_the_gradient_is_the_slope_of_the_corrected_pixel(rng) -> None:
    table = rough(rng)
    inside = rng.uniform(0.02, 0.98, (300, 2)) + rng.integers(-2, 9, (300, 2))  # off the nodes
    x, y = (32.5 + 64.0 * inside).T
    h = 1e-4
    for axis, (dx, dy) in enumerate(((h, 0.0), (0.0, h))):
        up = table.evaluate(x + dx, y + dy) + np.stack([x + dx, y + dy], axis=1)
        down = table.evaluate(x - dx, y - dy) + np.stack([x - dx, y - dy], axis=1)
        assert_allclose(table.gradient(x, y)[:, :, axis], (up - down) / (2 * h), atol=2e-8)
    outside = table.gradient([-1e4, 1e4], [-1e4, 1e4])
    assert_array_equal(outside, np.broadcast_to(np.eye(2), (2, 2, 2)))


def test_the_detector_comes_first_and_the_filter_sees_the_corrected_pixel(rng) -> None:
    # a detector that shifts by a whole step brings the filter to its next node
    step = LookupTable(1, np.stack([np.full((3, 5), 64.0), np.zeros((3, 5))]))
    filter_table = rough(rng, shape=(3, 5), filter="F606W")
    x, y = corrected([filter_table, step], 32.5, 96.5, chip=1, filter="F606W")
    assert_allclose(x - 32.5 - 64.0, filter_table.values[0, 1, 1], atol=1e-13)
    assert_allclose(y - 96.5, filter_table.values[1, 1, 1], atol=1e-13)


def test_each_star_gets_the_tables_of_its_chip_and_filter(rng) -> None:
    tables = [rough(rng, chip=c, filter=f) for c in (1, 2) for f in ("", "F606W")]
    n = 400
    x, y = rng.uniform(0, 400, n), rng.uniform(0, 300, n)
    chip = rng.integers(1, 4, n)
    name = rng.choice(["F606W", "F814W"], n)
    got = np.stack(corrected(tables, x, y, chip=chip, filter=name), axis=1)
    for c in (1, 2, 3):
        for f in ("F606W", "F814W"):
            rows = (chip == c) & (name == f)
            assert rows.any()
            expected = np.stack([x[rows], y[rows]], axis=1)
            for wanted in ("", f):
                for table in tables:
                    if (table.chip, table.filter) == (c, wanted):
                        expected = expected + table.evaluate(*expected.T)
            assert_array_equal(got[rows], expected)


def test_the_input_stays_as_it_was(rng) -> None:
    values = np.zeros((2, 3, 3))
    table = LookupTable(1, values)
    values += 1.0
    assert_array_equal(table.values, 0.0)
    x = np.array([10.0, 20.0])
    out, _ = corrected([rough(rng)], x, [1.0, 2.0], chip=1)
    assert_array_equal(x, [10.0, 20.0])
    assert not np.shares_memory(x, out)
    same, _ = corrected([], x, 3.0, chip=1)
    assert_array_equal(same, x)


GOOD = np.zeros((2, 3, 4))


def bad(value: float) -> np.ndarray:
    out = GOOD.copy()
    out[1, 2, 0] = value
    return out


@pytest.mark.parametrize(
    ("values", "names", "message"),
    [
        (np.zeros((3, 4)), {}, r"the values have shape \(3, 4\)"),
        (np.zeros((2, 1, 4)), {}, "at least two nodes"),
        (bad(np.nan), {}, "the value of y at node row 3, column 1 is nan"),
        (GOOD, {"sigma": bad(-0.1)}, "the sigma of y at node row 3, column 1 is -0.1"),
        (GOOD, {"sigma": np.zeros((2, 4, 3))}, r"sigma has shape \(2, 4, 3\)"),
        (GOOD, {"step": (64.0, 0.0)}, "do not define a grid"),
        (GOOD, {"first": (np.nan, 1.0)}, "do not define a grid"),
    ],
)
def test_what_is_no_table_is_refused(values, names, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        LookupTable(2, values, "F814W", **names)
    assert "look-up table of chip 2, filter F814W" in str(caught.value)


def test_two_tables_of_one_place_and_a_lost_pixel_are_refused(rng) -> None:
    table = rough(rng)
    with pytest.raises(InputError, match="2 look-up tables of chip 1"):
        corrected([table, table], 1.0, 1.0, chip=1)
    with pytest.raises(InputError, match="pixel coordinate y is not finite"):
        table.evaluate(1.0, np.nan)
