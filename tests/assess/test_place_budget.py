import numpy as np
import pytest

from bayesdist.assess import UserTerm, error_budget
from bayesdist.assess.budget import place_budget
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.correlated import LocalErrors
from bayesdist.assess.terms.given import Centroids
from bayesdist.data import MagnitudeErrors
from bayesdist.diagnose.tables import MeanSquare
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel

SIZE = (101.0, 81.0)
MODEL = DistortionModel(1, (Chip(1, "A", SIZE, (51.0, 41.0)),))
EDGE = 50.0 / 50.5  # scaled position of the outermost pixels
DRAWS = 20_000
NOISE = 5 / np.sqrt(2 * DRAWS)


def errors_of(solution_of, *, sigma=(0.03, 0.02), terms=()):
    """Errors of the shift and the scale of u."""
    cov = np.zeros((6, 6))
    cov[0, 0], cov[1, 1] = np.square(sigma)
    model = error_model(solution_of(MODEL, cov=cov), terms=terms)
    return model.drawn(DRAWS, np.random.default_rng(1))


def named(budget):
    return {t.name: t for t in budget.every}


TERMS = [
    UserTerm("catalogue", "systematic", 0.01, 0.01, source="a paper"),
    UserTerm("background", "random", 0.02, 0.02),
]


def test_at_the_points_of_a_grid_it_is_the_budget_of_the_grid(solution_of):
    errors = errors_of(solution_of, terms=TERMS)
    whole = error_budget(
        errors.solution,
        terms=TERMS,
        grid=(3, 3),
        n_draws=DRAWS,
        rng=np.random.default_rng(1),
    )
    found = named(place_budget(errors, whole.x, whole.y, chip=1))
    for term in whole.terms:
        assert found[term.name].u == pytest.approx(term.u, rel=1e-9)
        assert found[term.name].source == term.source
    assert found["total"].u == pytest.approx(whole.total.u, rel=1e-9)
    assert found["total"].v == pytest.approx(whole.total.v, rel=1e-9)


def test_between_two_positions_what_they_share_drops_out(solution_of):
    one = np.array([1])
    centroid = MagnitudeErrors(np.array([-12.0]), 0.04 * one, 0.05 * one, one, one, one)
    errors = errors_of(solution_of, terms=[*TERMS, Centroids(centroid)])
    found = place_budget(
        errors, [1.0, 101.0, 26.0], [41.0, 41.0, 41.0], chip=1, magnitude=-12.0, relative=True
    )
    terms = named(found)
    assert list(found.x) == [101.0, 26.0]
    # of the scale alone: twice the edge, and half of it; the shift is in both positions
    expected = 0.02 * EDGE * np.array([2.0, 0.5])
    assert terms["coefficients"].u == pytest.approx(expected, rel=NOISE)
    assert (terms["catalogue"].u == 0).all()
    assert terms["background"].u == pytest.approx(np.full(2, np.sqrt(2) * 0.02))
    assert terms["centroid"].v == pytest.approx(np.full(2, np.sqrt(2) * 0.05))
    total = np.sqrt(expected**2 + 2 * 0.02**2 + 2 * 0.04**2)
    assert terms["total"].u == pytest.approx(total, rel=NOISE)


def test_local_terms_are_interpolated_and_counted_twice_in_a_difference(solution_of):
    values = np.zeros((3, 3, 2))
    values[..., 0] = [[0.0, 0.1, 0.2]]  # grows with x
    square = MeanSquare(np.array([0.02, 0.0]), np.array([0.004, 0.0]))
    local = [LocalErrors.on_grid("tables", {1: values}, MODEL, squares={1: square})]
    errors = errors_of(solution_of, sigma=(0.0, 0.0), terms=local)
    single = named(place_budget(errors, [26.0, 101.0], [10.0, 70.0], chip=1))
    assert single["tables"].u == pytest.approx([0.05, 0.2])
    assert single["tables"].relative_error == pytest.approx(0.1, rel=1e-4)  # hardly cut
    both = named(place_budget(errors, [26.0, 101.0], [10.0, 70.0], chip=1, relative=True))
    assert both["tables"].u == pytest.approx([np.hypot(0.05, 0.2)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x": [200.0]}, "x = 200 is not on chip 1"),
        ({"y": [0.0]}, "y = 0 is not on chip 1"),
        ({"relative": True}, "needs two positions"),
        ({"magnitude": 3.0}, "magnitude 3 is not known"),
        ({"chip": 7}, "chip 7"),
    ],
)
def test_places_that_are_none_are_refused(solution_of, options, message):
    place = {"x": [10.0], "y": [10.0], "chip": 1} | options
    with pytest.raises(InputError, match=message):
        place_budget(errors_of(solution_of), **place)
