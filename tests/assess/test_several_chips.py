"""Budgets and requirements of a detector of two chips, from draws that both share."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess import (
    LocalErrors,
    Requirement,
    UserTerm,
    check_requirements,
    error_budget,
)
from bayesdist.assess.solution import chip_places
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel
from tests.budgets import detector_budget

S = 0.03
CHIPS = tuple(Chip(k, f"C{k}", (100.0, 80.0), (50.0, 40.0)) for k in (1, 2))
TERMS = [UserTerm("catalogue", "systematic", 0.01, 0.02)]


def rng():
    return np.random.default_rng(3)


@pytest.fixture
def tied(solution_of):
    """u of both chips is shifted by S times the same normal number, on chip 2 the other way."""
    model = DistortionModel(1, CHIPS)
    direction = np.zeros(model.n_params)
    direction[model.names.index("C1.u_0_0")] = S
    direction[model.names.index("C2.u_0_0")] = -S
    return solution_of(model, cov=np.outer(direction, direction))


def test_one_set_of_draws_serves_all_chips(tied):
    """So the two fields differ in sign only, and their sigmas agree to the last digits."""
    budget = detector_budget(tied, n_draws=50, grid=(3, 2), rng=rng())
    one, two = (b.terms[0].u for b in budget.chips)
    np.testing.assert_allclose(one, two, rtol=1e-9)
    assert abs(one[0] / S - 1) > 1e-3  # fifty draws: their own scatter, shared by both


def test_a_systematic_offset_is_common_to_all_chips(tied):
    """max |u| = |o| + |d| where the chips lie at o + d and o - d; no less, no more."""
    limit = 0.08
    req = [Requirement("both", "u_max", limit)] + [
        Requirement(f"{k}", "u_max", limit, chip=k) for k in (1, 2)
    ]
    terms = [UserTerm("offset", "systematic", S, 0.0)]
    n = 20_000
    both, *single = check_requirements(tied, req, terms=terms, grid=(2, 2), n_draws=n, rng=rng())
    for m in single:  # o + d is normal with sigma sqrt(2) S
        expected = stats.halfnorm(scale=np.sqrt(2) * S).cdf(limit)
        assert m.probability_met == pytest.approx(expected, abs=5 * np.sqrt(0.25 / n))
    square = np.linspace(0.0, limit, 2001)
    density = stats.halfnorm(scale=S).pdf(square) * stats.halfnorm(scale=S).cdf(limit - square)
    assert both.probability_met == pytest.approx(
        np.trapezoid(density, square), abs=5 * np.sqrt(0.25 / n)
    )
    # draw by draw: the field of all chips is as bad as the worse of the two
    np.testing.assert_array_equal(both.draws, np.maximum(single[0].draws, single[1].draws))


def test_random_errors_are_independent_on_each_chip(solution_of):
    """The largest of 2 N independent errors."""
    s = solution_of(DistortionModel(1, CHIPS))
    n, N = 4000, 12
    limit = stats.halfnorm(scale=S).ppf(0.5 ** (1 / (2 * N)))
    terms = [UserTerm("centroid", "random", S, S)]
    req = [Requirement("r", "u_max", limit)]
    (m,) = check_requirements(s, req, terms=terms, grid=(4, 3), n_draws=n, rng=rng())
    assert m.probability_met == pytest.approx(0.5, abs=5 * np.sqrt(0.25 / n))


def test_local_errors_differ_from_place_to_place(solution_of):
    """max |u| <= L of independent Gaussians of unequal widths: a product of probabilities."""
    model = DistortionModel(1, CHIPS)
    certain = solution_of(model, cov=np.zeros((model.n_params, model.n_params)))
    widths = np.random.default_rng(5).uniform(0.01, 0.03, size=(2, 2, 3))  # chips, ny, nx
    chips = zip((1, 2), widths, strict=True)
    values = {k: np.stack([w, 0 * w], axis=-1) for k, w in chips}
    local = [LocalErrors.on_grid("tables", values, model)]
    limit, n = 0.05, 20_000
    req = [Requirement("all", "u_max", limit)]
    (margin,) = check_requirements(certain, req, terms=local, grid=(3, 2), n_draws=n, rng=rng())
    exact = np.prod(2 * stats.norm.cdf(limit / widths) - 1)
    assert margin.probability_met == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / n))

    budget = detector_budget(certain, terms=local, grid=(3, 2), n_draws=50, rng=rng())
    for chip, width in zip(budget.chips, widths, strict=True):
        np.testing.assert_allclose(chip.total.u, width.ravel())
        np.testing.assert_allclose(chip.terms[-1].u, width.ravel())
        assert chip.terms[-1].kind == "local"


def test_all_chips_of_everything_at_once_are_its_chips(rich):
    """Rms squared over both chips is the mean of those of each; the max is the larger one."""
    options = {"terms": TERMS, "grid": (5, 4), "epoch": 2006.5, "n_draws": 300}
    budget = detector_budget(rich, rng=rng(), **options)
    alone = [error_budget(rich, chip=k, rng=rng(), **options) for k in (1, 2)]
    for whole, one, two in zip(budget.rows(), *(b.rows() for b in alone), strict=True):
        for key in ("u", "v", "radial"):
            square = (one[key] ** 2 + two[key] ** 2) / 2
            assert whole[key] ** 2 == pytest.approx(square, rel=1e-9)
        assert whole["name"] == one["name"]
    table = budget.rows_by_chip()
    assert [r["chip"] for r in table] == ["all"] * 5 + ["1"] * 5 + ["2"] * 5
    assert budget.share.sum() == pytest.approx(1.0)
    req = [Requirement("a", "max", 1.0), *(Requirement("b", "max", 1.0, chip=k) for k in (1, 2))]
    both, one, two = check_requirements(rich, req, rng=rng(), **options)
    np.testing.assert_array_equal(both.draws, np.maximum(one.draws, two.draws))
    (given,) = check_requirements(rich, req[:1], chip=2, rng=rng(), **options)
    np.testing.assert_array_equal(given.draws, two.draws)


def test_a_chip_that_is_not_there(tied):
    with pytest.raises(InputError, match="requirement 'r': there is no chip 3; name one of 1, 2"):
        check_requirements(tied, [Requirement("r", "max", 1.0, chip=3)], rng=rng())
    with pytest.raises(InputError, match="no chip 9"):
        check_requirements(tied, [Requirement("r", "max", 1.0)], chip=9, rng=rng())


# -- where the chips lie --------------------------------------------------------------------------


def placed(solution_of, *offsets, turn=0.0, scale=1.0):
    """Places of chips of 100 x 80 at offsets in pixels of the first; u, v turned and scaled."""
    chips = tuple(Chip(k, f"C{k}", (100.0, 80.0), (50.0, 40.0)) for k in range(len(offsets)))
    model = DistortionModel(1, chips)
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    mean = np.zeros(model.n_params)
    for chip, (dx, dy) in zip(chips, offsets, strict=True):
        basis = model.basis(chip.number)
        rows = ((c * dx - s * dy, c, -s), (s * dx + c * dy, s, c))
        for axis, row in enumerate(rows):
            terms = dict(zip(((0, 0), (1, 0), (0, 1)), row, strict=True))
            monomial = [terms[t] for t in basis.terms]
            mean[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(monomial)
    return chip_places(solution_of(model, mean))


@pytest.mark.parametrize("turn", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("scale", [1.0, 0.05])
@pytest.mark.parametrize(
    ("offsets", "places"),
    [
        ([(0, 0)], [(0, 0)]),
        ([(0, 0), (3, 90)], [(1, 0), (0, 0)]),  # WFC2, and WFC1 above it
        ([(0, 0), (110, -2)], [(0, 0), (0, 1)]),
        ([(0, 0), (110, 0), (0, 90), (111, 91)], [(1, 0), (1, 1), (0, 0), (0, 1)]),
        ([(0, 0), (10, 10)], [(1, 0), (0, 0)]),  # one over the other: in a column
    ],
)
def test_chips_are_placed_as_they_lie(solution_of, offsets, places, turn, scale):
    assert list(placed(solution_of, *offsets, turn=turn, scale=scale)) == places
