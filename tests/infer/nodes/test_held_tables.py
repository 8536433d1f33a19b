"""The detector's tables taken from elsewhere: two routes to one table, and errors that are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.nodes import fit_with_tables, held_sigma
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected
from tests.infer.nodes.support import (
    CHIP,
    ORDER,
    SIZE,
    STEP,
    grid,
    pattern,
    places,
    position_sigma,
    predict,
    table_sigma,
)
from tests.infer.nodes.test_fit import OPTIONS, bent

NOISE = 0.02
DETECTOR, FILTER = "F606W", "F814W"


@pytest.fixture(scope="module")
def model():
    return DistortionModel(ORDER, (CHIP,))


@pytest.fixture(scope="module")
def matches(model):
    """Two filters: the first sees the detector's pattern alone, the second one of its own too."""
    rng = np.random.default_rng(11)
    detector, of_filter = (pattern(rng).T for _ in range(2))
    tables = [grid().table(detector), grid().table(0.5 * of_filter, filter=FILTER)]
    parts = {}
    for k, name in enumerate((DETECTOR, FILTER)):
        x, y = places(rng, 6000)
        px, py = corrected(tables, x, y, chip=1, filter=name)
        u, v = model.predict(bent(model), px, py, chip=1).T
        u, v = u + NOISE * rng.standard_normal(len(x)), v + NOISE * rng.standard_normal(len(x))
        parts[name] = (x, y, u, v, np.full(len(x), k))
    x, y, u, v, code = (np.concatenate(column) for column in zip(*parts.values(), strict=True))
    sigma = np.full(len(x), NOISE)
    return Matches(
        x=x,
        y=y,
        u=u,
        v=v,
        sigma_u=sigma,
        sigma_v=sigma.copy(),
        filter=code,
        filter_names=(DETECTOR, FILTER),
        unit="pix",
    )


@pytest.fixture(scope="module")
def detector(matches, model):
    """The detector's table, from the first filter."""
    return fit_with_tables(matches.select(matches.filter == 0), model, **OPTIONS)


@pytest.fixture(scope="module")
def over(matches, model, detector):
    """The second filter over that table: with its covariance, and with the nodes' errors alone."""
    some = matches.select(matches.filter == 1)
    return [
        fit_with_tables(some, model, filter=FILTER, beneath=beneath, **OPTIONS)
        for beneath in (detector.fitted, detector.tables)
    ]


def test_tables_do_not_depend_on_what_is_known_of_those_beneath(detector, over):
    joint, bound = over
    for fit in over:
        assert [t.filter for t in fit.tables] == ["", FILTER]
        np.testing.assert_array_equal(fit.tables[0].values, detector.tables[0].values)
    np.testing.assert_array_equal(joint.tables[1].values, bound.tables[1].values)
    x, y = places(np.random.default_rng(1), 50)
    np.testing.assert_array_equal(predict(joint, x, y, chip=1), predict(bound, x, y, chip=1))


def test_a_held_table_is_a_correction_made_beforehand(matches, model, over):
    """Second route: pixels corrected first, and then a table of nothing but the filter."""
    some, fit = matches.select(matches.filter == 1), over[1]
    x, y = corrected(fit.tables[:1], some.x, some.y, chip=1)
    inside = (x > 0.5) & (x < SIZE[0] + 0.5) & (y > 0.5) & (y < SIZE[1] + 0.5)
    moved = some.select(inside).with_columns(x=x[inside], y=y[inside])
    found = fit_with_tables(moved, model, **OPTIONS)
    # the few stars at the rim are left out here
    assert (np.abs(found.tables[0].values - fit.tables[1].values) < 0.3 * fit.tables[1].sigma).all()


def test_the_error_with_held_nodes_is_not_below_that_with_their_covariance(over):
    """Their nodes' errors alone bound what their covariance would say."""
    x, y = places(np.random.default_rng(2), 300)
    known, bound = (table_sigma(fit, x, y, chip=1) for fit in over)
    assert (bound > 0.999 * known).all()
    assert (position_sigma(over[1], x, y, chip=1) > bound).all()


def test_nodes_that_err_together_reach_the_bound():
    """Any correlation of the nodes gives at most this error, and full correlation gives it."""
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.01, 0.03, (2, *grid().shape))
    table = grid().table(np.zeros_like(sigma), sigma)
    x, y = places(rng, 200)
    bound = held_sigma([table], x, y, chip=1)
    index, weight = table.weights(x, y)
    for axis in (0, 1):
        s = sigma[axis].ravel()[index] * weight
        np.testing.assert_allclose(bound[:, axis], s.sum(axis=1))  # correlation 1
        assert (np.sqrt((s**2).sum(axis=1)) <= bound[:, axis] + 1e-15).all()  # correlation 0
    assert not held_sigma([table], x, y, chip=2).any()
    assert not held_sigma([replace(table, sigma=None)], x, y, chip=1).any()


def test_a_table_of_a_filter_is_not_the_detectors(matches, model):
    alien = LookupTable(1, np.zeros((2, 4, 4)), FILTER, (80.5, 64.5), (160.0, 128.0))
    with pytest.raises(InputError, match="not a table of the detector"):
        fit_with_tables(matches, model, beneath=[alien], step=STEP)
