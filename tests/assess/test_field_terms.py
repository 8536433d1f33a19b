"""Errors that are fields: of the shared stars, of a new exposure, and what its observer fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.assess import LocalErrors, Requirement, UserTerm, check_requirements
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.forms import Image, Row
from bayesdist.assess.terms.functions import Alignment, Functions
from bayesdist.assess.terms.parameters import (
    MOTIONS,
    CatalogueErrors,
    ExposureVariation,
    ScaleError,
    SolutionErrors,
)
from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from tests.budgets import detector_budget
from tests.infer.small_campaign import campaign_model, campaign_truth

from .drawn_fields import JOINT, drawn_fields, fields_at

N = 8000
TOLERANCE = 5 / np.sqrt(2 * N)  # five standard errors of a standard deviation
X, Y = (a.ravel() for a in np.meshgrid(np.linspace(1, 4096, 5), np.linspace(1, 2048, 4)))
TAU = {"scale": 7e-6, "shear_plus": 5e-6, "shear_cross": 3e-6}


def rng(seed=1):
    return np.random.default_rng(seed)


def scattering(*, apart=False, own=None):
    """A campaign's model in gauge 'held', and true parameters."""
    model = campaign_model(4, order=3, apart=apart)
    return model, campaign_truth(model, rng(3), own=own)


def scatter_of(model, mean, **tau):
    return ExposureVariation(model, mean, tuple(tau), np.array([list(tau.values())]))


def draw_errors(solution, n, rng, *, terms=(), aligned=False):
    return error_model(solution, terms=terms, aligned=aligned).drawn(n, rng)


def holding(solution, without, *catalogue):
    """Errors of a solution that hold those of the catalogue, shown beside another one's rows."""
    return SolutionErrors(solution, without, catalogue)


def sigmas(draws, chip, epoch=2006.0):
    return fields_at(draws, X, Y, chip=chip, epoch=epoch)


# -- the catalogue --------------------------------------------------------------------------------


@pytest.fixture
def shared(rich):
    """A solution, and a covariance that the catalogue causes."""
    size = np.sqrt(np.diag(rich.cov))
    a = rng(11).normal(size=rich.cov.shape)
    a[:, 0] = 20.0  # an error that all parameters share
    cov = size[:, None] * (a @ a.T / len(a)) * size
    return rich, CatalogueErrors(rich.model, rich.mean, cov)


@pytest.mark.parametrize("chip", [1, 2])
def test_the_row_of_the_catalogue_is_its_covariance_seen_through_the_model(shared, chip):
    """J C J^T at every point, by the Jacobian of positions."""
    solution, term = shared
    draws = draw_errors(solution, N, rng(), terms=[holding(solution, solution, term)])
    for epoch in (2003.0, 2013.0):
        found = np.stack(sigmas(draws, chip, epoch).sigma(term.name), axis=1)
        J = solution.model.jacobian(solution.mean, X, Y, epoch=epoch, chip=chip)
        expected = np.sqrt(np.einsum("nap,pq,naq->na", J, term.covariance, J))
        np.testing.assert_allclose(found, expected, rtol=TOLERANCE)


def test_one_draw_of_the_catalogue_serves_both_chips_and_all_epochs(shared):
    """Covariance between chips and epochs, J1 C J2^T, not only of each by itself."""
    solution, term = shared
    draws = draw_errors(solution, N, rng(), terms=[holding(solution, solution, term)])
    places = [(1, 2003.0), (2, 2013.0)]
    fields = [sigmas(draws, *place).field(term.name)[:, 7, 0] for place in places]
    J = [
        solution.model.jacobian(solution.mean, X[7], Y[7], chip=chip, epoch=epoch)[0, 0]
        for chip, epoch in places
    ]
    expected = np.array([[a @ term.covariance @ b for b in J] for a in J])
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(expected / size)[0, 1] > 0.2  # chips are correlated here
    found = np.cov(fields)
    np.testing.assert_allclose(found / size, expected / size, atol=5 * np.sqrt(2 / N))


def test_what_the_solution_holds_already_is_shown_and_not_added(shared):
    """The total is that of the solution; the other rows are those of the one without."""
    solution, term = shared
    wide = replace(solution, cov=9 * solution.cov)
    options = {"epoch": 2006.5, "grid": (3, 2), "aligned": True, "n_draws": N}
    beside = [holding(wide, solution, term)]
    shown = {r["name"]: r for r in detector_budget(wide, terms=beside, rng=rng(), **options).rows()}
    alone = {r["name"]: r for r in detector_budget(wide, rng=rng(), **options).rows()}
    inner = {r["name"]: r for r in detector_budget(solution, rng=rng(), **options).rows()}
    assert set(shown) == {*alone, term.name}
    for name in ("u", "v", "radial"):
        assert shown["total"][name] == pytest.approx(alone["total"][name], rel=1e-12)
        for row in ("coefficients", "time dependence"):
            assert shown[row][name] == pytest.approx(inner[row][name], rel=2 * TOLERANCE)
            assert shown[row][name] < 0.4 * alone[row][name]


def test_the_parts_of_the_catalogue_make_its_row(shared):
    """Positions and motions err independently: squares of their rows add up to the whole."""
    solution, whole = shared
    share = 0.3
    parts = [
        replace(whole, covariance=share * whole.covariance, name=MOTIONS),
        replace(whole, covariance=(1 - share) * whole.covariance),
    ]
    options = {"epoch": 2003.0, "n_draws": N}
    both, one = (
        drawn_fields(solution, X, Y, terms=[holding(solution, solution, *c)], rng=rng(), **options)
        for c in (parts, [whole])
    )
    assert set(both.parts) >= {MOTIONS, whole.name}
    summed = sum(np.square(both.sigma(p.name)) for p in parts)
    np.testing.assert_allclose(np.sqrt(summed), one.sigma(whole.name), rtol=2 * TOLERANCE)
    np.testing.assert_allclose(both.sigma(JOINT), one.sigma(JOINT), rtol=1e-12)


def test_aberration_is_a_part_of_the_scatter_and_not_added(solution_of):
    model, theta = scattering()
    solution = solution_of(model, theta)
    aberration = ScaleError("aberration", "scale", 2e-6, solution, in_total=False)
    alone = scatter_of(model, theta, **TAU)
    beside = replace(alone, aberration=aberration)
    options = {"epoch": 2006.0, "n_draws": 200}
    one, both = (
        drawn_fields(solution, X, Y, terms=[t], rng=rng(), **options) for t in (alone, beside)
    )
    np.testing.assert_array_equal(both.sigma(JOINT), one.sigma(JOINT))
    assert 0 < np.max(both.sigma("aberration")) < np.max(one.sigma(JOINT))
    # without it, scatter is smaller by its share
    errors = both.drawn.errors(both.domain, {"aberration": 0.0})(slice(0, 200), np.zeros(1))
    left = np.square(one.sigma(JOINT)) - np.square(both.sigma("aberration"))
    np.testing.assert_allclose(np.mean(errors**2, axis=0).T, left, rtol=1e-9)
    free = replace(aberration, in_total=True)
    added = drawn_fields(solution, X, Y, terms=[alone, free], rng=rng(), **options)
    assert np.max(added.sigma(JOINT)) > np.max(one.sigma(JOINT))


# -- a new exposure -------------------------------------------------------------------------------


@pytest.mark.parametrize("chip", [1, 2])
def test_scatter_at_a_pixel_is_known_in_closed_form(chip, solution_of):
    """u: (scale + plus) du + cross dv, v: (scale - plus) dv + cross du, along the detector's axes.

    Whatever the roll of the exposure whose place the new one takes.
    """
    model, theta = scattering()
    term = scatter_of(model, theta, **TAU)
    draws = draw_errors(solution_of(model, theta), N, rng(), terms=[term])
    found = np.stack(sigmas(draws, chip).sigma(term.name), axis=1)
    d = model.predict(theta, X, Y, chip=chip, epoch=2006.0) - model.origin
    along = TAU["scale"] ** 2 + TAU["shear_plus"] ** 2
    expected = np.sqrt(along * d**2 + TAU["shear_cross"] ** 2 * d[:, ::-1] ** 2)
    np.testing.assert_allclose(found, expected, rtol=TOLERANCE)


def test_a_chip_that_scatters_by_itself_errs_alone(solution_of):
    own = {"WFC1.shift_v": 0.01, "WFC1.rotation": 2e-6, "WFC1.scale": 4e-6}
    model, theta = scattering(apart=True, own=(0.0,) * 6)
    term = scatter_of(model, theta, **own)
    draws = draw_errors(solution_of(model, theta), N, rng(), terms=[term])
    first, second = (np.stack(sigmas(draws, c).sigma(term.name), axis=1) for c in (1, 2))
    np.testing.assert_array_equal(second, 0.0)
    at = [model.predict(theta, *p, chip=1, epoch=2006.0) for p in ((X, Y), (2048.0, 1024.0))]
    d = at[0] - at[1]
    expected = (4e-6 * d) ** 2 + (2e-6 * d[:, ::-1]) ** 2 + [0.0, 0.01**2]
    np.testing.assert_allclose(first, np.sqrt(expected), rtol=TOLERANCE)


def test_the_scatter_of_each_draw_is_a_draw_of_tau(solution_of):
    """Fourth moments tell a mixture from one scatter: 3 <tau^4> against 3 <tau^2>^2."""
    model, theta = scattering()
    tau = np.array([[1e-6], [9e-6]])
    term = ExposureVariation(model, theta, ("scale",), tau)
    draws = draw_errors(solution_of(model, theta), N, rng(), terms=[term])
    u = sigmas(draws, 1).field(term.name)[:, 0, 0]
    mean_square, fourth = (tau**2).mean(), (tau**4).mean()
    assert (u**4).mean() / (u**2).mean() ** 2 == pytest.approx(
        3 * fourth / mean_square**2, rel=0.15
    )


def test_scatter_adds_to_the_total_in_quadrature(solution_of):
    model, theta = scattering()
    a = 1e-5 * rng(4).normal(size=(len(theta), len(theta)))
    solution, term = solution_of(model, theta, a @ a.T), scatter_of(model, theta, **TAU)
    draws = draw_errors(solution, N, rng(), terms=[term], aligned=True)
    found = sigmas(draws, 2)
    alone = sigmas(draw_errors(solution, N, rng(), aligned=True), 2)
    parts = np.hypot(alone.sigma("model"), found.sigma(term.name))
    np.testing.assert_allclose(found.sigma("model"), parts, rtol=2 * TOLERANCE)
    assert found.parts == (
        "coefficients",
        "time dependence",
        "exposure-to-exposure variation",
        "model",
    )


def test_in_gauge_held_a_star_may_lie_in_the_first_exposure(solution_of):
    """Its scale is fitted as that of all others: if it alone errs, a quarter of the draws do."""
    model, theta = scattering()
    cov = np.zeros((len(theta), len(theta)))
    k = model.names.index("j001.scale")
    cov[k, k] = 1e-12
    found = drawn_fields(solution_of(model, theta, cov), X, Y, epoch=2006.0, n_draws=N, rng=rng())
    errs = np.abs(found.field("exposure frame")).max(axis=(1, 2)) > 1e-9
    assert errs.mean() == pytest.approx(0.25, abs=5 * np.sqrt(0.25 * 0.75 / N))
    np.testing.assert_allclose(found.field("model"), found.field("exposure frame"), atol=1e-12)


# -- what the observer fits -----------------------------------------------------------------------


def test_shift_and_rotation_are_no_error(solution_of):
    model, theta = scattering()
    positions = {}
    errors = {}
    for chip in (1, 2):
        positions[chip] = np.stack([theta[model.coefficient_slice(chip, a)] for a in (0, 1)])
        u, v = positions[chip]
        shift = np.zeros((2, model.n_terms))
        shift[:, 0] = 0.3, -0.2
        errors[chip] = np.stack([shift, np.stack([-v, u]), shift + 2 * np.stack([-v, u])])
    for rest in Alignment(model, positions).without(errors).values():
        assert np.abs(rest).max() < 1e-9


def test_what_is_left_is_what_least_squares_leaves(solution_of):
    """Another route: a fit of shift and rotation to stars that cover both chips evenly."""
    model, theta = scattering()
    mean = {c: np.stack([theta[model.coefficient_slice(c, a)] for a in (0, 1)]) for c in (1, 2)}
    errors = {c: rng(c).normal(size=(3, 2, model.n_terms)) for c in (1, 2)}
    rest = Alignment(model, mean).without(errors)
    # nodes of Gauss and Legendre: sums over such stars are integrals over the chips
    nodes, weights = np.polynomial.legendre.leggauss(8)
    x, y = (a.ravel() for a in np.meshgrid(2048.5 + 2048 * nodes, 1024.5 + 1024 * nodes))
    root = np.sqrt(np.tile(np.outer(weights, weights).ravel(), 2))[:, None]
    phi = {c: model.basis(c).evaluate(x, y) for c in (1, 2)}

    def stars(polynomials):
        return np.concatenate([phi[c] @ np.swapaxes(polynomials[c], -1, -2) for c in (1, 2)], -2)

    u, v = stars(mean).T
    one, zero = np.ones_like(u), np.zeros_like(u)
    A = np.stack([np.stack(p, 1) for p in ((one, zero), (zero, one), (-v, u))], 2)
    A = (A * root[..., None]).reshape(-1, 3)
    for before, after in zip(stars(errors), stars(rest), strict=True):
        b = (before * root).ravel()
        expected = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
        np.testing.assert_allclose((after * root).ravel(), expected, atol=1e-9)


def test_after_that_the_gauge_does_not_matter(solution_of):
    """The same draws in the gauge of the fit and in that of the reference chip."""
    model, theta = scattering()
    # an error of shift and rotation that is larger than all others, as the first exposure has it
    a = 1e-4 * rng(4).normal(size=(len(theta), len(theta)))
    solution = solution_of(model, theta, a @ a.T)
    views = [without_frames(solution), reference_gauge(without_frames(solution), 2)]
    for chip in (1, 2):
        plain, aligned = (
            [
                np.hypot(*drawn_fields(v, X, Y, aligned=al, rng=rng(), **where).sigma("model"))
                for v in views
            ]
            for al in (False, True)
            for where in [{"epoch": 2006.0, "chip": chip, "n_draws": 500}]
        )
        assert np.abs(plain[0] / plain[1] - 1).max() > 0.05
        np.testing.assert_allclose(aligned[0], aligned[1], rtol=1e-5)


def test_scatter_does_not_know_about_which_point_it_acts(solution_of):
    """A scale is the same about any origin, once the observer has fitted the shift."""
    model, theta = scattering()
    there = replace(model, origin=(1500.0, -700.0))
    here, other = (
        sigmas(
            draw_errors(
                solution_of(m, theta),
                500,
                rng(),
                terms=[scatter_of(m, theta, **TAU)],
                aligned=True,
            ),
            1,
        ).sigma("exposure-to-exposure variation")
        for m in (model, there)
    )
    np.testing.assert_allclose(here, other, rtol=1e-6)


def test_a_chip_of_its_own_is_aligned_with_all_of_them(solution_of):
    """One of two chips shifted by d: each is off by d / 2, also where only one is judged."""
    model, theta = scattering(apart=True, own=(0.0,) * 6)
    term = scatter_of(model, theta, **{"WFC1.shift_v": 0.02})
    req = [Requirement(f"{c}", "v_mean", 1.0, chip=c) for c in (1, 2)]
    options = {"terms": [term], "aligned": True, "epoch": 2006.0, "grid": (9, 5), "n_draws": 2000}
    one, two = check_requirements(solution_of(model, theta), req, rng=rng(), **options)
    for m in (one, two):
        assert np.sqrt(np.mean(m.draws**2)) == pytest.approx(0.01, rel=5 / np.sqrt(2 * 2000))


def test_the_alignment_is_fitted_once_for_all_domains(solution_of):
    """It depends on the functions and the positions aligned by, not on the domain judged."""
    model, theta = scattering(apart=True, own=(0.0,) * 6)
    calls = []

    def functions(chip, x, y):
        calls.append(len(x))
        return np.cos(np.outer(x + 100 * chip, [1e-3, 3e-3])) + np.outer(y, [1e-4, 0.0])

    def drawn():
        return Functions(Row("s", "local"), coefficients, functions, 50)

    coefficients = {c: rng(c).normal(size=(50, 2, 2)) for c in (1, 2)}
    domains = [
        EvaluationDomain(model, np.full(len(X), c), X + shift, Y)
        for c in (1, 2)
        for shift in (0, 1)
    ]
    turned = theta.copy()  # an alignment by other positions
    turned[model.coefficient_slice(1, 0)] *= 1.5
    of_all = drawn()
    for mean in (theta, turned):
        calls.clear()
        found = [of_all.on(domain, Image(None, mean)).total() for domain in domains]
        assert sum(n != len(X) for n in calls) == len(model.chips)  # integrals over the chips
        for domain, total in zip(domains, found, strict=True):
            alone = drawn().on(domain, Image(None, mean)).total()
            np.testing.assert_array_equal(total, alone)
    assert np.abs(alone / drawn().on(domain, Image(None, theta)).total() - 1).max() > 0.01


# -- budget and requirements ----------------------------------------------------------------------


def test_budget_and_requirements_agree(solution_of):
    """The mean square of the field's rms over the draws is the square of the budget's total."""
    model, theta = scattering()
    a = 1e-5 * rng(4).normal(size=(len(theta), len(theta)))
    source = solution_of(model, theta, a @ a.T)
    solution = solution_of(model, theta, 2 * a @ a.T)
    options = {
        "terms": [
            holding(solution, source, CatalogueErrors(model, theta, a @ a.T)),
            scatter_of(model, theta, **TAU),
            UserTerm("offset", "systematic", 0.004, 0.003),
            UserTerm("centroids", "random", 0.01, 0.02),
            LocalErrors.on_grid("tables", {c: np.full((4, 5, 2), 0.01) for c in (1, 2)}, model),
        ],
        "aligned": True,
        "grid": (5, 4),
        "epoch": 2006.0,
        "n_draws": 8000,
    }
    req = [Requirement(s, s, 1.0) for s in ("rms", "u_rms", "v_rms")]
    margins = check_requirements(solution, req, rng=rng(5), **options)
    total = detector_budget(solution, rng=rng(6), **options).rows()[-1]
    for margin, name in zip(margins, ("radial", "u", "v"), strict=True):
        assert np.mean(margin.draws**2) == pytest.approx(total[name] ** 2, rel=0.06)
    terms = [options["terms"][0], *options["terms"][2:]]
    without = options | {"terms": terms}
    (for_one,) = check_requirements(solution, req[:1], rng=rng(5), **without)
    assert np.mean(for_one.draws**2) < 0.8 * np.mean(margins[0].draws ** 2)
