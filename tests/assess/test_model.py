"""What every error term has to keep, and a term of which nothing but this file knows."""

from __future__ import annotations

import pickle
import weakref
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.budget import budget_of, place_budget
from bayesdist.assess.budget_surface import budget_surface
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.assess.requirements.margins import validity_period
from bayesdist.assess.terms.correlated import (
    STRUCTURE,
    STRUCTURE_IN_FIT,
    Deviations,
    LocalErrors,
    StructureErrors,
)
from bayesdist.assess.terms.forms import DrawnField, Image, Known, Row
from bayesdist.assess.terms.functions import Functions
from bayesdist.assess.terms.given import Centroids
from bayesdist.assess.terms.parameters import (
    CatalogueErrors,
    ExposureVariation,
    ScaleError,
    SolutionErrors,
)
from bayesdist.data import MagnitudeErrors
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import LinearDeviations
from bayesdist.diagnose.tables import MeanSquare
from bayesdist.model import Chip, DistortionModel, TimeDependence
from tests.budgets import detector_budget

from .by_draws import margins_by_draws
from .conftest import StandIn

SIZE, GRID, DRAWS = (201.0, 101.0), (4, 3), 2000
CHIPS = tuple(Chip(k, f"C{k}", SIZE, (101.0, 51.0)) for k in (1, 2))
MODEL = DistortionModel(
    2,
    CHIPS,
    time=TimeDependence((("u", 1, 0), ("v", 0, 1)), (2005.0,)),
    frames="affine",
    exposures=("a", "b", "c"),
    gauge="held",
)
SCATTERS = ("scale", "shear_plus")
EPOCH = 2008.0
NOISE = 5 / np.sqrt(2 * DRAWS)


def positions() -> np.ndarray:
    """Parameters of u = x, v = y, in pixels about the middle."""
    mean = np.zeros(MODEL.n_params)
    for chip in CHIPS:
        for axis, (term, half) in enumerate((((1, 0), 100.5), ((0, 1), 50.5))):
            k = MODEL.basis(chip.number).terms.index(term)
            mean[MODEL.coefficient_slice(chip.number, axis)][k] = half
    return mean


MEAN = positions()
CERTAIN = StandIn(MODEL, MEAN, np.zeros((MODEL.n_params, MODEL.n_params)))


@dataclass(frozen=True, eq=False)
class Wave:
    """Structure on a chip: draws of coefficients of three functions."""

    coefficients: np.ndarray

    def evaluate(self, X, Y):
        return np.stack([X**4, np.cos(3 * X) * Y, np.sin(5 * Y)], axis=1)


def discrepancy(n: int = 200) -> Discrepancy:
    """A fit that was drawn towards a structure on both chips, and a drift that bends."""
    rng = np.random.default_rng(9)
    waves = {c.number: Wave(0.003 * rng.standard_normal((n, 2, 3))) for c in CHIPS}
    theta = 1e-4 * rng.standard_normal((n, MODEL.n_params))
    for number, wave in waves.items():
        for axis in (0, 1):
            theta[:, MODEL.coefficient_slice(number, axis)][:, :3] -= (
                0.5 * wave.coefficients[:, axis]
            )
    scatter = {"shape": np.abs(1e-5 * rng.standard_normal(n))}
    linear = LinearDeviations(
        MODEL,
        1e-4 * rng.standard_normal((n, MODEL.n_params)),
        ((0, 0, 1), (1, 1, 2)),
        1e-4 * rng.standard_normal((n, 2)),
        2004.0,
        scatter,
        3,
        ("scale", "shear"),
    )
    cov = CERTAIN.cov
    return Discrepancy(MODEL, MEAN, cov, cov, waves, theta, linear)


def bilinear(x, y, chip, epoch):
    return np.stack([1e-5 * (x - 1), 0 * y + 1e-3 * chip], axis=1)


def term_list():
    found, rng = discrepancy(), np.random.default_rng(3)
    one = np.ones(2)
    root = 1e-3 * rng.standard_normal((MODEL.n_params, MODEL.n_params))
    wide = StandIn(MODEL, MEAN, 4 * root @ root.T)
    errors = MagnitudeErrors(np.array([14.0, 18.0]), 0.01 * one, 0.02 * one, one, one, one)
    sigma = {c.number: rng.uniform(0.01, 0.03, (4, 5, 2)) for c in CHIPS}
    aberration = ScaleError("aberration", "scale", 1e-5, CERTAIN, in_total=False)
    return {
        "offset": UserTerm("catalogue", "systematic", 0.01, 0.02),
        "random": UserTerm("background", "random", 0.02, 0.01),
        "scale": ScaleError("scale", "scale", 1e-4, CERTAIN),
        "rotation": ScaleError("rotation", "rotation", 1e-4, CERTAIN),
        "new exposure": ExposureVariation(
            MODEL, MEAN, SCATTERS, np.array([[2e-5, 1e-5], [4e-5, 2e-5]]), aberration
        ),
        "structure": StructureErrors(found),
        "structure with frames": StructureErrors(found, frames=True),
        "structure that tables hold": StructureErrors(found, left=False),
        "deviations": Deviations(found),
        "deviations of one": Deviations(found, single=True, frames=True),
        "tables": LocalErrors.on_grid(
            "tables", sigma, MODEL, squares={1: MeanSquare(4e-4 * one, 1e-4 * one)}
        ),
        "centroid": Centroids(errors),
        "file": Known(Row("a.hdr", "product", in_total=False), bilinear),
        "solution": SolutionErrors(wide),
        "solution with catalogue": SolutionErrors(
            wide, CERTAIN, (CatalogueErrors(MODEL, MEAN, root @ root.T),)
        ),
    }


TERMS = term_list()
SOLUTIONS = {name for name in TERMS if name.startswith("solution")}


def drawn(*terms, aligned=False, n=DRAWS, seed=1):
    [*own] = [t.solution for t in terms if isinstance(t, SolutionErrors)] or [CERTAIN]
    model = error_model(own[0], terms=terms, aligned=aligned, pixel_scale=50.0)
    return model.drawn(n, np.random.default_rng(seed))


def domain_of(**more) -> EvaluationDomain:
    return EvaluationDomain.of_chips(MODEL, GRID, **{"epoch": EPOCH} | more)


def star_of(name: str) -> dict[str, float]:
    """What a domain has to name for a term to be there."""
    return {"magnitude": 16.0} if name == "centroid" else {}


def errors_of(errors, domain, n=DRAWS, scale=None):
    normal = np.random.default_rng(5).standard_normal((n, domain.size, 2))
    return errors.errors(domain, scale)(slice(0, n), normal)


@pytest.mark.parametrize("aligned", [False, True])
@pytest.mark.parametrize("name", TERMS)
def test_the_budget_is_the_scatter_of_the_draws(name, aligned):
    """At every position, of all rows together, and of differences."""
    star = star_of(name)
    errors, domain = drawn(TERMS[name], aligned=aligned), domain_of(**star)
    found = errors_of(errors, domain)
    total = budget_of(errors, domain).total
    rms = np.sqrt(np.mean(found**2, axis=0))
    np.testing.assert_allclose(np.column_stack([total.u, total.v]), rms, rtol=NOISE, atol=1e-9)
    x, y = [1.0, 77.0, 201.0], [30.0, 99.0, 1.0]
    at = {"epoch": EPOCH} | star
    between = place_budget(errors, x, y, chip=2, relative=True, **at).total
    single = errors_of(errors, EvaluationDomain.at_pixels(MODEL, 2, x, y, **at))
    rms = np.sqrt(np.mean((single[:, 1:] - single[:, :1]) ** 2, axis=0))
    np.testing.assert_allclose(np.column_stack([between.u, between.v]), rms, rtol=NOISE, atol=1e-9)


@pytest.mark.parametrize("name", TERMS)
def test_a_row_is_what_its_factor_multiplies(name):
    """With one row at nothing, the mean square shrinks by that of the row, if it is independent."""
    errors, domain = drawn(TERMS[name]), domain_of(**star_of(name))
    squares = {
        n: s for one in errors.at(domain) for n, s in one.squares().items() if one.total().any()
    }
    independent = name not in ("structure", "structure with frames", *SOLUTIONS)
    whole = np.mean(errors_of(errors, domain) ** 2, axis=0)
    for row, square in squares.items():
        left = np.mean(errors_of(errors, domain, scale={row: 0.0}) ** 2, axis=0)
        if independent and square.any():
            np.testing.assert_allclose(whole - left, square, rtol=2 * NOISE, atol=2e-9)
        same = errors_of(errors, domain, scale={row: 1.0})
        np.testing.assert_allclose(same, errors_of(errors, domain), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("name", TERMS)
def test_one_chance_serves_all_chips_and_epochs(name):
    """Chips together are chips by themselves, and what is asked first does not matter."""
    errors, again = drawn(TERMS[name], n=64), drawn(TERMS[name], n=64)
    every, still, star = slice(0, 64), np.zeros(1), star_of(name)
    for epoch in (EPOCH, 2001.0):
        both = errors.errors(domain_of(epoch=epoch, **star))(every, still)
        for chip, rows in domain_of().by_chip():
            there = domain_of(epoch=epoch, chips=(chip,), **star)
            alone = again.errors(there)(every, still)
            np.testing.assert_allclose(both[:, rows], alone, rtol=1e-9, atol=1e-12)
    some, whole = (
        d.errors(domain_of(**star))(rows, still)
        for d, rows in ((errors, slice(8, 24)), (again, every))
    )
    np.testing.assert_allclose(some, whole[8:24], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", sorted(TERMS.keys() - SOLUTIONS))
def test_other_terms_change_nothing(name):
    term = TERMS[name]
    others = [
        TERMS[n] for n in TERMS.keys() - SOLUTIONS if TERMS[n].rows[0].name != term.rows[0].name
    ]
    alone, among = drawn(term, n=50), drawn(*others, term, n=50)
    # terms without a unit take that of the solution
    k = [t.rows[0].name for t in among.terms].index(term.rows[0].name)
    one, other = (d.draws[i].on(domain_of(), d.image) for d, i in ((alone, 1), (among, k)))
    for key, square in one.squares().items():
        np.testing.assert_array_equal(square, other.squares()[key])
    if isinstance(one, DrawnField):
        np.testing.assert_array_equal(one.errors(slice(0, 50), {}), other.errors(slice(0, 50), {}))


@pytest.mark.parametrize("name", TERMS)
def test_terms_and_draws_are_kept_in_files(name):
    term = pickle.loads(pickle.dumps(TERMS[name]))
    errors = drawn(TERMS[name], n=20)
    kept = pickle.loads(pickle.dumps(errors))
    for one in (drawn(term, n=20), kept):
        at = EvaluationDomain.of_chips(one.solution.model, GRID, epoch=EPOCH, **star_of(name))
        np.testing.assert_array_equal(
            errors.errors(domain_of(**star_of(name)))(slice(0, 20), np.zeros(1)),
            one.errors(at)(slice(0, 20), np.zeros(1)),
        )


def test_two_terms_of_one_name_are_two_chances():
    term = UserTerm("catalogue", "systematic", 0.01, 0.01)
    errors = drawn(term, term)
    a, b = (
        one.on(domain_of(), errors.image).errors(slice(0, DRAWS), {}) for one in errors.draws[1:3]
    )
    correlation = np.corrcoef(a[:, 0, 0], b[:, 0, 0])[0, 1]
    assert abs(correlation) < 5 / np.sqrt(DRAWS)


# -- structure ------------------------------------------------------------------------------------


def test_structure_is_its_functions_at_any_pixel():
    """Also off the points of a grid, together with the error of the parameters that followed it."""
    found = discrepancy()
    x, y = np.array([17.3, 180.01]), np.array([88.8, 3.3])
    at = EvaluationDomain.at_pixels(MODEL, 2, x, y, epoch=EPOCH)
    errors = drawn(StructureErrors(found), n=200).errors(at)(slice(0, 200), np.zeros(1))
    phi = found.structure[2].evaluate(*MODEL.basis(2).scaled(x, y))
    D = MODEL.n_distortion
    theta = np.tile(MEAN, (200, 1))
    theta[:, :D] += found.structure_theta[:, :D]
    fit = np.stack([MODEL.predict(t, x, y, chip=2, epoch=EPOCH) for t in theta])
    expected = fit - MODEL.predict(MEAN, x, y, chip=2, epoch=EPOCH)
    expected = expected + np.swapaxes(found.structure[2].coefficients @ phi.T, 1, 2)
    np.testing.assert_allclose(errors, expected, atol=1e-12)


def test_neighbours_have_structure_in_common():
    """The error of a small separation is small; what is left counts beyond the part in the fit."""
    errors = drawn(StructureErrors(discrepancy()))
    near = place_budget(errors, [50.0, 50.5], [30.0, 30.0], chip=1, epoch=EPOCH, relative=True)
    single = place_budget(errors, [50.0], [30.0], chip=1, epoch=EPOCH)
    assert near.total.u[0] < 0.05 * single.total.u[0]
    rows = {t.name: t.u[0] for t in single.terms}
    assert rows[STRUCTURE] ** 2 + rows[STRUCTURE_IN_FIT] ** 2 == pytest.approx(
        max(single.total.u[0] ** 2, rows[STRUCTURE_IN_FIT] ** 2)
    )


# -- a new term -----------------------------------------------------------------------------------


def waves(chip, x, y):
    return np.sin(x / 20.0)[:, None]


@dataclass(frozen=True)
class Ripple:
    """All that a new term has to give."""

    sigma: float

    @property
    def rows(self):
        return (Row("ripple", source="published: a toy"),)

    def draw(self, n, rng):
        size = self.sigma * rng.standard_normal((n, 2, 1))
        return Functions(self.rows[0], {None: size}, waves, n)


def test_errors_at_positions_are_freed_with_their_draws():
    """Not when Python next looks for reference cycles: they are the largest arrays of a run."""
    draws = Ripple(0.03).draw(DRAWS, np.random.default_rng(2))
    domain = EvaluationDomain.of_chips(MODEL, (9, 3), epoch=EPOCH)
    errors = draws.on(domain, Image())
    assert draws.on(domain, Image()) is errors
    freed = weakref.ref(errors)
    del errors, draws
    assert freed() is None


def test_a_term_that_is_new_is_in_every_result():
    toy, options = Ripple(0.03), {"grid": (9, 3), "epoch": EPOCH}
    rng = np.random.default_rng(2)
    budget = detector_budget(CERTAIN, terms=[toy], n_draws=DRAWS, rng=rng, **options)
    [row] = [t for t in budget.terms if t.name == "ripple"]
    np.testing.assert_allclose(row.u, 0.03 * np.abs(np.sin(budget.x / 20)), rtol=NOISE)
    assert row.source == "published: a toy"
    assert budget.rows()[-1]["radial"] == pytest.approx(
        np.sqrt(2) * 0.03 * np.sqrt(np.mean(np.sin(budget.x / 20) ** 2)), rel=NOISE
    )
    highest = np.abs(np.sin(budget.x / 20)).max()
    limit = 0.05
    asked = Requirement("edge", "max", limit, epoch=EPOCH)
    (margin,) = margins_by_draws(CERTAIN, [asked], terms=[toy], n_draws=DRAWS, rng=rng, grid=(9, 3))
    expected = stats.rayleigh(scale=0.03 * highest).cdf(limit)
    assert margin.probability_met == pytest.approx(expected, abs=5 * np.sqrt(0.25 / DRAWS))
    assert margin.verdict == "not shown" and margin.remedy.term == "ripple"
    errors = drawn(toy)
    course = validity_period(errors, asked, [2008.0, 2009.0, 2010.0], grid=(9, 3))
    np.testing.assert_allclose(course.probability, expected, atol=5 * np.sqrt(0.25 / DRAWS))
    surface = budget_surface(errors, (9, 3), epoch=EPOCH, years=(2000.0, 2010.0))
    [local] = [t for t in surface.local if t.row.name == "ripple"]
    np.testing.assert_allclose(
        local.values[0][1][0], np.stack([row.u, row.v], 1)[:27], rtol=2 * NOISE
    )
