"""What tables leave between their nodes: known truth, closed forms, pairs counted one by one."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose.tables import between_nodes
from bayesdist.errors import DegenerateError
from bayesdist.infer.nodes import Matern, NodeGrid, field_table
from bayesdist.model import Chip

CHIP = Chip(1, "A", (512.0, 512.0), (256.0, 256.0))
STEP, FINE = (128.0, 128.0), (16.0, 16.0)
ORDER, STARS, EXPOSURES, SIGMA = 2, 9000, 12, 0.03
DETECTORS = 8


@lru_cache(maxsize=1)
def root():
    """Of a field that is rough on the scale of the nodes."""
    grid = NodeGrid(CHIP, ORDER, FINE)
    return np.linalg.cholesky(Matern(0.05, 250.0, 1.5).covariance(grid))


def truth_of(kind, rng):
    """Shifts of a detector at 16 px, or at the very nodes that are fitted: nothing between them."""
    if kind == "fine":
        grid = NodeGrid(CHIP, ORDER, FINE)
        return grid.table((root() @ rng.standard_normal((grid.n_nodes, 2))).T)
    grid = NodeGrid(CHIP, ORDER, STEP)
    # a table holds no polynomial
    return grid.table(grid.without_polynomials(0.05 * rng.standard_normal((grid.n_nodes, 2))).T)


def measured(kind, seed):
    """Mean squares as measured with their errors, and of the truth less the nearest table."""
    rng = np.random.default_rng(seed)
    truth = truth_of(kind, rng)
    x, y = rng.uniform(0.5, 512.5, (2, STARS))
    quoted = SIGMA * rng.choice([0.5, 1.0, 2.0], STARS)
    shift = truth.evaluate(x, y) + quoted[:, None] * rng.standard_normal((STARS, 2))
    variance = np.repeat(quoted[:, None] ** 2, 2, axis=1)
    found = field_table(x, y, shift, variance, chip=CHIP, order=ORDER, step=STEP)
    grid = found.grid

    def fitted(px, py):
        W, phi = grid.interpolation(px, py), grid.basis.evaluate(px, py)
        return np.stack(
            [W @ a.mean + phi @ a.sums.polynomial_of(a.mean) for a in found.axes], axis=1
        )

    def taken(px, py):
        phi = grid.basis.evaluate(px, py)
        own = [((phi @ a.sums.polynomial_root) ** 2).sum(axis=1) for a in found.axes]
        return found.position_sigma(px, py, refitted=True) ** 2 + np.stack(own, axis=1)

    seen = between_nodes(
        x,
        y,
        shift - fitted(x, y),
        1 / (variance + found.jitter**2),
        star=rng.integers(STARS // 6, size=STARS),
        exposure=rng.integers(EXPOSURES, size=STARS),
        chip=CHIP,
        step=STEP,
        taken=taken,
    )
    # what the best table of all leaves, had every pixel a star without error
    px, py = (a.ravel() for a in np.meshgrid(*[np.arange(2.5, 512, 4.0)] * 2))
    W = grid.without_polynomials(grid.interpolation(px, py).toarray().T).T
    A, b = np.hstack([W, grid.basis.evaluate(px, py)]), truth.evaluate(px, py)
    left = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
    return seen, (left**2).mean(axis=0)


@pytest.mark.parametrize("kind", ["fine", "nodes"])
def test_the_mean_square_is_the_true_one_within_its_error(kind):
    """Of eight detectors and two axes: neither bias nor errors of the wrong size."""
    found = [measured(kind, seed) for seed in range(DETECTORS)]
    pull = np.concatenate([(seen.square - true) / seen.error for seen, true in found])
    n = len(pull)
    assert abs(pull.mean()) < stats.norm.ppf(0.9995) / np.sqrt(n)
    low, high = stats.chi2.ppf([0.0005, 0.9995], n)
    assert low < (pull**2).sum() < high
    if kind == "nodes":
        assert all((true < 1e-12).all() for _, true in found)
    else:  # it tells something: the rms to a few per cent
        size = np.array([np.sqrt(seen.left.mean) for seen, _ in found])
        true = np.array([np.sqrt(t) for _, t in found])
        assert np.abs(size / true - 1).max() < 0.25
        assert max(seen.left.relative_error for seen, _ in found) < 0.1


def test_pairs_are_of_different_stars_and_exposures():
    """One cell after the other, one pair after the other."""
    rng = np.random.default_rng(3)
    n = 400
    x, y = rng.uniform(0.5, 512.5, (2, n))
    residual, precision = rng.standard_normal((n, 2)), rng.uniform(0.5, 2.0, (n, 2))
    precision[:20] = 0
    star, exposure = rng.integers(40, size=n), rng.integers(5, size=n)
    star[:40], exposure[:40] = np.divmod(np.arange(40), 5)  # no star twice in an exposure
    keep = np.unique(np.stack([star, exposure]), axis=1, return_index=True)[1]
    x, y, residual, precision, star, exposure = (
        a[keep] for a in (x, y, residual, precision, star, exposure)
    )
    seen = between_nodes(
        x,
        y,
        residual,
        precision,
        star=star,
        exposure=exposure,
        chip=CHIP,
        step=(512.0, 512.0),
        taken=lambda px, py: np.zeros((len(px), 2)),
    )
    cell = {8: 64.0, 4: 128.0}
    number = 0
    for i, j in product(range(len(x)), repeat=2):
        # squares begin half a step before the first node
        same = all((a[i] + 255.5) // cell[8] == (a[j] + 255.5) // cell[8] for a in (x, y))
        apart = star[i] != star[j] and exposure[i] != exposure[j]
        number += i < j and same and apart and bool(precision[i].all() and precision[j].all())
    assert seen.n_pairs == number


def test_too_few_stars_tell_nothing():
    one = np.array([1.0, 300.0])
    with pytest.raises(DegenerateError, match="0 pairs of stars"):
        between_nodes(
            one,
            one,
            np.ones((2, 2)),
            np.ones((2, 2)),
            star=np.array([0, 1]),
            exposure=np.array([0, 1]),
            chip=CHIP,
            step=STEP,
            taken=lambda px, py: np.zeros((len(px), 2)),
        )
