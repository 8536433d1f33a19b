import numpy as np
import pytest

from bayesdist.assess import error_budget
from bayesdist.assess.terms.parameters import ScaleError
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel
from tests.budgets import detector_budget

SIZE = (1001.0, 501.0)
SCALE = 0.05  # arcsec per pixel
DRAWS = 20_000


def solution_with_positions(solution_of, chips):
    """u, v in arcsec: x and y from the first chip's reference pixel; the second 600 rows above."""
    model = DistortionModel(2, chips, unit="arcsec")
    mean = np.zeros(model.n_params)
    for k, chip in enumerate(chips):
        basis = model.basis(chip.number)
        for axis in (0, 1):
            monomials = np.zeros(basis.n_terms)
            monomials[basis.terms.index((1, 0) if axis == 0 else (0, 1))] = SCALE
            monomials[0] = 600.0 * SCALE * k * axis
            mean[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(monomials)
    return solution_of(model, mean=mean)


@pytest.mark.parametrize("kind", ["scale", "rotation"])
def test_an_error_of_scale_or_rotation_grows_with_the_distance(solution_of, kind):
    chips = (Chip(2, "B", SIZE, (501.0, 251.0)), Chip(1, "A", SIZE, (501.0, 251.0)))
    solution = solution_with_positions(solution_of, chips)
    term = ScaleError("aberration", kind, 1e-5, solution)
    budget = detector_budget(
        solution, terms=[term], grid=(5, 3), n_draws=DRAWS, rng=np.random.default_rng(1)
    )
    for k, one in enumerate(budget.chips):
        [found] = [t for t in one.terms if t.name == "aberration"]
        dx, dy = one.x - 501.0, one.y - 251.0 + 600.0 * k
        expected = 1e-5 * SCALE * np.abs([dx, dy] if kind == "scale" else [dy, dx])
        noise = 5 / np.sqrt(2 * DRAWS)
        assert found.u == pytest.approx(expected[0], rel=noise, abs=1e-15)
        assert found.v == pytest.approx(expected[1], rel=noise, abs=1e-15)
        assert found.source == "given by the user"
        # the solution itself has no error here
        assert one.total.u == pytest.approx(found.u, abs=1e-15)


def test_the_error_of_a_drawn_term_is_that_of_its_draws(solution_of):
    solution = solution_with_positions(solution_of, (Chip(1, "A", SIZE, (501.0, 251.0)),))
    rows = [
        error_budget(
            solution,
            terms=[ScaleError("aberration", "scale", 1e-5, solution, "a paper")],
            grid=(3, 3),
            n_draws=200,
            rng=np.random.default_rng(seed),
        ).rows()
        for seed in range(200)
    ]
    found = np.array([next(r for r in one if r["name"] == "aberration")["radial"] for one in rows])
    [row] = [r for r in rows[0] if r["name"] == "aberration"]
    assert row["source"] == "a paper"
    assert found.std() == pytest.approx(row["radial_error"], rel=5 / np.sqrt(2 * 200))
    assert rows[0][-1]["radial_error"] == pytest.approx(row["radial_error"], rel=1e-9)


@pytest.mark.parametrize(
    ("kind", "sigma", "message"), [("shear", 1.0, "kind"), ("scale", -1.0, "sigma is -1")]
)
def test_what_is_no_such_term_is_refused(solution_of, kind, sigma, message):
    solution = solution_with_positions(solution_of, (Chip(1, "A", SIZE, (501.0, 251.0)),))
    with pytest.raises(InputError, match=message):
        ScaleError("aberration", kind, sigma, solution)
