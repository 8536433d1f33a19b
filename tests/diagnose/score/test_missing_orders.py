"""Orders far above that of the model are found and named, and nothing else is taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.score.missing_orders import (
    LARGEST_RATIO,
    STARS_PER_FITTED_TERM,
    ChipResiduals,
)
from bayesdist.model.basis import MAX_ORDER, n_terms
from tests.adversarial.fields import of_rms, random_polynomial, ridges, tree_rings

from .shaped import SHAPE, SIDE, SIGMA, examined, scaled, scene, true_map
from .test_shape import DISPLACED, INSIDE

pytestmark = pytest.mark.usefixtures("one_thread")


def lacking(order: int, rms: float, n: int = 2000):
    """Stars whose true map has terms of one further order."""
    rng = np.random.default_rng([order, n])
    field = of_rms(random_polynomial(rng, {order: 1.0}), rms)
    return scene(rng, n, lambda _, x, y: field(x, y))


@pytest.mark.parametrize(("order", "rms"), [(5, 0.1), (6, 0.05), (7, 0.02), (7, 0.2), (10, 0.03)])
def test_the_order_that_is_missing_is_named(order, rms):
    """Its jumps, rings and lopsided patches are not mistaken for anything else."""
    found = examined(lacking(order, rms))
    assert found["missing orders"].significant
    remedies = {test.remedy for test in found.values() if test.significant}
    assert remedies == {f"raise model.order to {order}"}
    assert found["missing orders"].size == pytest.approx(rms, rel=0.35)
    after = examined(lacking(order, rms), order)
    assert "missing orders" not in after
    assert not any(test.significant for test in after.values())


@pytest.mark.parametrize("name", [name for name in INSIDE if name != "many"])
def test_noise_does_not_reduce_the_scatter_as_much(name):
    noise, false, radius, n, order = INSIDE[name]
    n = max(n, STARS_PER_FITTED_TERM * n_terms(order + 1))  # so that an order above is fitted
    smallest = []
    for seed in range(20):
        matches = scene(
            np.random.default_rng([9, seed]), n, noise=noise, false=false, radius=radius
        )
        z = (np.stack([matches.u, matches.v], axis=1) - true_map(matches.x, matches.y)).T / SIGMA
        ones, rows = np.ones(n), np.arange(n)
        X, Y = scaled(matches.x), scaled(matches.y)
        zeros = np.zeros(n, int)
        chip = ChipResiduals(order, rows, X, Y, z, ones, ones, rows, zeros, SIGMA, (SIDE, SIDE))
        assert chip.missing_orders is None
        highest = chip.orders(MAX_ORDER, STARS_PER_FITTED_TERM)[-1]
        assert highest > order
        fits = [chip.without_terms(k) for k in (order, highest)]
        variances = [fit.scatter() ** 2 / fit.free for fit in fits]
        smallest.append(np.sqrt(variances[1] / variances[0]))
    assert min(smallest) > LARGEST_RATIO + 0.03


@pytest.mark.parametrize("name", DISPLACED)
def test_displaced_stars_are_no_missing_orders(name):
    displaced, n, test = DISPLACED[name]
    found = examined(scene(np.random.default_rng(1), n, displaced))
    assert "missing orders" not in found and found[test].significant


def jump(x, _):
    return 0.1 * (x > 900)[:, None] * np.array([0.8, -0.6])


@pytest.mark.parametrize("kind", ["jumps", "repeating pattern", "rings"])
def test_what_polynomials_follow_in_part_has_its_own_remedy(kind):
    rng = np.random.default_rng(7)
    field = {
        "jumps": jump,
        "repeating pattern": ridges(rng, 300.0, 0.03),
        "rings": of_rms(tree_rings(rng, 1.0), 0.008),
    }[kind]
    found = examined(scene(rng, 3000, lambda _, x, y: field(x, y)))
    assert not any(name in found and found[name].significant for name in SHAPE)
    remedies = {test.remedy for test in found.values() if test.significant}
    assert remedies == {found[kind].remedy} and "raise model.order" not in found[kind].remedy
