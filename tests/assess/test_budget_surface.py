"""Second moments say of every place and epoch what the budget of single places says."""

import numpy as np
import pytest

from bayesdist.assess.budget import place_budget
from bayesdist.assess.budget_surface import JOINT, budget_surface
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.parameters import ScaleError
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.model.grid import grid_pixels, mesh
from tests.budgets import Curvature, detector_budget

SIZE = (201.0, 101.0)
CHIPS = tuple(Chip(k, f"WFC{k}", SIZE, (101.0, 51.0)) for k in (1, 2))
BREAK = 2009.4
TIME = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2005.0, 2010.0), (BREAK,))
GRID = (5, 4)


def drawn(solution_of, *, time=TIME, frames="none", exposures=("a",), aligned=False):
    model = DistortionModel(2, CHIPS, time=time, frames=frames, exposures=exposures)
    rng = np.random.default_rng(5)
    root = 0.01 * rng.normal(size=(model.n_params, model.n_params))
    # both chips hold pixels: with their slope, the rotation that alignment takes out is one
    mean = np.zeros(model.n_params)
    for chip in CHIPS:
        for axis, (c, half) in enumerate(zip(((1, 0), (0, 1)), (100.5, 50.5), strict=True)):
            k = model.basis(chip.number).terms.index(c)
            mean[model.coefficient_slice(chip.number, axis)][k] = half
    solution = solution_of(model, mean, root @ root.T)
    terms = (ScaleError("aberration", "scale", 1e-4, solution),) if time is TIME else ()
    what = {"grid": GRID, "n_draws": 300, "terms": terms, "aligned": aligned}
    model = error_model(solution, terms=terms, aligned=aligned)
    errors = model.drawn(300, np.random.default_rng(2))
    return solution, errors, what


def variance(surface, part, chip, x, y, epoch, origin=None):
    """By the definition: weights of Lagrange at the nodes, quadratic form of the basis."""
    span = [s for s in surface.spans if not s.nodes or epoch >= s.nodes[0]][-1]
    moments = span.moments[chip][part]
    weights = np.ones(1)
    if len(moments) > 1:
        t = np.array(span.nodes)
        weights = np.array(
            [np.prod((epoch - np.delete(t, k)) / (t[k] - np.delete(t, k))) for k in range(len(t))]
        )
    phi = surface.model.basis(chip).evaluate(x, y)
    if origin is not None:
        phi = phi - surface.model.basis(chip).evaluate(*origin)
    return np.einsum("n,naij,pi,pj->pa", weights, moments, phi, phi)


@pytest.mark.parametrize("epoch", [2002.0, 2006.7, 2009.39999, 2009.4, 2013.3, 2020.0])
def test_any_place_at_any_epoch_has_its_budget(solution_of, epoch):
    _, errors, _ = drawn(solution_of)
    surface = budget_surface(errors, GRID, years=(2002.0, 2020.0))
    assert [len(s.nodes) for s in surface.spans] == [3, 3]
    x, y = np.array([1.0, 33.5, 201.0]), np.array([101.0, 7.25, 50.0])
    for chip in (1, 2):
        truth = place_budget(errors, x, y, chip=chip, epoch=epoch)
        for term in truth.every:
            part = JOINT if term.name == "total" else term.name
            found = variance(surface, part, chip, x, y, epoch)
            np.testing.assert_allclose(found[:, 0], term.u**2, rtol=1e-7)
            np.testing.assert_allclose(found[:, 1], term.v**2, rtol=1e-7)
        between = place_budget(errors, x, y, chip=chip, epoch=epoch, relative=True).total
        found = variance(surface, JOINT, chip, x[1:], y[1:], epoch, origin=(x[:1], y[:1]))
        np.testing.assert_allclose(found[:, 0], between.u**2, rtol=1e-7)


def test_over_the_grid_it_is_the_budget_of_the_detector(solution_of):
    solution, errors, what = drawn(solution_of, frames="shift", exposures=("a", "b", "c"))
    budget = detector_budget(solution, epoch=2012.0, rng=np.random.default_rng(2), **what)
    surface = budget_surface(errors, GRID, epoch=2012.0, years=(2002.0, 2020.0))
    assert {row.name for row in surface.parts} == {t.name for t in budget.terms}
    x, y = mesh(*grid_pixels(SIZE, GRID))
    for row in budget.rows():
        part = JOINT if row["name"] == "total" else row["name"]
        mean = np.mean([variance(surface, part, c, x, y, 2012.0) for c in (1, 2)], axis=(0, 1))
        np.testing.assert_allclose(np.sqrt(mean), [row["u"], row["v"]], rtol=1e-7, atol=1e-9)


def test_what_does_not_depend_on_time_is_kept_once(solution_of):
    _, errors, _ = drawn(solution_of)
    for span in budget_surface(errors, GRID, years=(2002.0, 2020.0)).spans:
        kept = {part: len(m) for part, m in span.moments[1].items()}
        assert kept == {"coefficients": 1, "time dependence": 3, "aberration": 1, JOINT: 3}
    _, still, _ = drawn(solution_of, time=None)
    (span,) = budget_surface(still, GRID).spans
    assert span.nodes == () and {len(m) for m in span.moments[2].values()} == {1}


def test_alignment_hardly_depends_on_the_drift(solution_of):
    """What a rotation takes up follows the drifting positions: quadratic to first order only."""
    _, errors, _ = drawn(solution_of, aligned=True)
    surface = budget_surface(errors, GRID, years=(2002.0, 2020.0))
    truth = place_budget(errors, [10.0], [90.0], chip=1, epoch=2004.1).total
    found = variance(surface, JOINT, 1, [10.0], [90.0], 2004.1)
    assert found[0] == pytest.approx([truth.u[0] ** 2, truth.v[0] ** 2], rel=1e-3)


@pytest.mark.parametrize("place", [False, True])
def test_a_curved_drift_has_its_budget_at_any_epoch(solution_of, place):
    """Variances of the fourth degree: three epochs gave negative ones between them."""
    solution, _, _ = drawn(solution_of, time=TimeDependence((("u", 1, 0),), (2005.0,)))
    term = Curvature(solution, 1e-4)
    errors = error_model(solution, terms=(term,)).drawn(300, np.random.default_rng(2))
    surface = budget_surface(errors, GRID, epoch=2010.3, years=(2002.0, 2020.0))
    assert 2010.3 in surface.spans[0].nodes
    x, y = np.array([3.0, 190.0]), np.array([10.0, 95.0])
    for epoch in (2003.0, 2009.0, 2010.3, 2014.7, 2019.0):
        truth = place_budget(errors, x, y, chip=1, epoch=epoch, relative=place)
        for row in truth.every:
            part = JOINT if row.name == "total" else row.name
            at = (x[1:], y[1:]) if place else (x, y)
            origin = (x[:1], y[:1]) if place else None
            found = variance(surface, part, 1, *at, epoch, origin=origin)
            largest = np.abs(surface.spans[0].moments[1][part]).max()
            assert found.min() > -1e-12 * largest
            np.testing.assert_allclose(found[:, 0], row.u**2, rtol=1e-6, atol=1e-11 * largest)


@pytest.mark.parametrize("years", [None, (2010.0, 2010.0)])
def test_a_drift_needs_years_that_rise(solution_of, years):
    _, errors, _ = drawn(solution_of)
    with pytest.raises(InputError, match="years"):
        budget_surface(errors, GRID, years=years)
