"""What files differ by: beside the budget, in no total, known at every place."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bayesdist.assess.budget import place_budget, with_product
from bayesdist.assess.budget_surface import budget_surface
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.forms import PRODUCT, Known, Row
from bayesdist.model import Chip, DistortionModel
from tests.budgets import detector_budget

SIZE, GRID = (201.0, 101.0), (9, 5)
CHIPS = tuple(Chip(k, f"C{k}", SIZE, (101.0, 51.0)) for k in (1, 2))


def off(x, y, chip, epoch):
    """A tilted plane in u, upside down on the second chip; a constant in v."""
    sign = 1 if chip == 1 else -1
    return np.stack([sign * 1e-3 * (x - 101.0), np.full(len(x), -0.05)], axis=-1)


TERM = Known(Row("a.hdr, forward", PRODUCT, "measured in this run: a.hdr", in_total=False), off)


@pytest.fixture
def solution(solution_of):
    model = DistortionModel(1, CHIPS)
    return solution_of(model, np.zeros(model.n_params), 1e-4 * np.eye(model.n_params))


def budgets(solution):
    what = {"grid": GRID, "n_draws": 500}
    return (
        detector_budget(solution, rng=np.random.default_rng(1), terms=p, **what)
        for p in ((), (TERM,))
    )


def test_the_rows_are_the_field_and_the_total_is_as_before(solution):
    before, after = (b.rows() for b in budgets(solution))
    assert after[-1] == before[-1] and after[:-2] == before[:-1]
    row = after[-2]
    assert (row["name"], row["kind"], row["radial_error"]) == ("a.hdr, forward", PRODUCT, 0.0)
    x = np.linspace(1, 201, 9)
    assert row["u"] == pytest.approx(1e-3 * np.sqrt(np.mean((x - 101) ** 2)))
    assert row["v"] == pytest.approx(0.05)
    assert all(r["source"] for r in after)


def test_who_uses_the_file_has_both(solution):
    """A draw plus a constant, over many draws, against the sum of squares."""
    total = 0.03
    draws = np.random.default_rng(2).normal(0.0, total, 200_000) + 0.05
    seen = np.sqrt(np.mean(draws**2))
    assert with_product(total, 0.05) == pytest.approx(seen, rel=5e-3)


def test_at_a_place_it_is_the_field_and_between_two_the_difference(solution):
    def errors(terms):
        return error_model(solution, terms=terms).drawn(100, np.random.default_rng(3))

    x, y = [11.0, 151.0], [20.0, 90.0]
    single = place_budget(errors((TERM,)), x, y, chip=2).every
    alone = place_budget(errors(()), x, y, chip=2).every
    np.testing.assert_allclose(single[-2].u, [0.09, 0.05])
    np.testing.assert_allclose(single[-2].v, 0.05)
    np.testing.assert_array_equal(single[-1].u, alone[-1].u)
    between = place_budget(errors((TERM,)), x, y, chip=2, relative=True).every
    np.testing.assert_allclose(between[-2].u, [0.14])
    np.testing.assert_allclose(between[-2].v, 0.0)


def test_the_page_carries_it(solution):
    from bayesdist.report.sections.explorer import _product

    errors = error_model(solution, terms=(TERM,)).drawn(100, np.random.default_rng(3))
    surface = budget_surface(errors, GRID)
    carried = json.loads(json.dumps(_product(*surface.products)))
    [span] = carried["spans"]
    [[u, v]] = span["2"]  # one node of time
    x = np.tile(np.linspace(1, 201, 9), 5)
    np.testing.assert_allclose(u, -1e-3 * (x - 101), atol=1e-6)
    np.testing.assert_allclose(v, -0.05)
