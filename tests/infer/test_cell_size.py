"""Which cells show what stars have in common: patterns of known size, and none."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer import fit_linear
from bayesdist.infer.robust import by_fitting_cells, recommended_cells, robust_covariance

from .patterned import patterned
from .support import UNCLIPPED


@pytest.fixture(scope="module", autouse=True)
def alone(one_thread):
    pass


def by_smallest(seed, side, rms=0.1):
    p = patterned(seed, 3000, order=2, side=side, rms=rms, fraction=0.0)
    fit = fit_linear(p.matches, p.model, **UNCLIPPED)
    return robust_covariance(p.matches, fit, recommended_cells(p.model))


def test_cells_grow_with_the_pattern():
    """Blocks of 128 px: what their stars share, by theory; cells of 64 px cut it in pieces."""
    expected = 1 + 3000 * 128**2 / 2048**2 * 0.1**2 / 0.05**2
    smallest = [by_smallest(seed, 128.0) for seed in range(16)]
    fitting = [by_fitting_cells(one) for one in smallest]
    assert np.mean([one.ratio.value for one in smallest]) < 0.8 * expected
    values, errors = (np.array([getattr(r.ratio, n) for r in fitting]) for n in ("value", "error"))
    assert abs(values.mean() - expected) < 3.3 * np.sqrt(np.mean(errors**2) / 16)
    assert sum(one.cells.sides(one.model)[0] >= 128 for one in fitting) > 8


def test_larger_cells_are_those_that_were_there():
    smallest = by_smallest(1, 256.0)
    found = by_fitting_cells(smallest)
    k = len(smallest.levels) - len(found.levels)
    assert k > 0 and found.exceeds
    assert found.cells.shapes == (tuple(n // 2**k for n in smallest.cells.shapes[0]),)
    for one, other in zip(found.by_size, smallest.by_size[k:], strict=True):
        assert (one.pixels, one.ratio) == (other.pixels, other.ratio)
    np.testing.assert_array_equal(found.from_cells(), smallest.from_cells(k))


def test_small_cells_stay_where_stars_err_independently():
    """1 in 100 by chance: none of ten seeds that are fixed."""
    for seed in range(10):
        found = by_smallest(seed, 64.0, rms=0.0)
        assert not found.exceeds and by_fitting_cells(found) is found
