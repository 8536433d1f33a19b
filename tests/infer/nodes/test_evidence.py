"""The marginal likelihood, against the textbook formula on the stars themselves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from bayesdist.infer.nodes import posterior
from bayesdist.infer.nodes.grid import node_sums
from bayesdist.infer.nodes.posterior import SMOOTHNESS, Evidence, Matern, fitted_field
from tests.infer.nodes.support import (
    CHIP,
    PATTERN,
    SIZE,
    STEP,
    bilinear,
    grid,
    joint_solution,
    matern_covariance,
    node_pixels,
    pattern,
    places,
    projector,
)
from tests.infer.support import legendre_design
from tests.reduced import case_in_full

NOISE = 0.03


def stars(rng, n: int, *, hole: bool = False, prior: Matern = PATTERN):
    d = pattern(rng, prior)
    x, y = places(rng, n, gradient=True)
    if hole:
        keep = (x < 380) | (y < 300)
        x, y = x[keep], y[keep]
    variance = NOISE**2 * rng.uniform(0.5, 4.0, len(x))
    r = bilinear(x, y) @ d + np.sqrt(variance)[:, None] * rng.standard_normal((len(x), 2))
    return x, y, r, variance


def evidence_of(x, y, r, variance) -> Evidence:
    return Evidence(grid(), node_sums(grid(), x, y, r, 1 / np.stack([variance] * 2, axis=1))[0])


def reml(x, y, r, variance, prior: Matern) -> float:
    """Patterson and Thompson (1971), with dense matrices over the stars."""
    W = bilinear(x, y) @ projector()
    V = W @ matern_covariance(prior, *node_pixels()) @ W.T + np.diag(variance)
    phi = legendre_design(3, x, y, size=SIZE)
    L = np.linalg.cholesky(V)
    z, F = np.linalg.solve(L, r), np.linalg.solve(L, phi)
    fitted = F @ np.linalg.lstsq(F, z, rcond=None)[0]
    return float(
        -np.log(np.diag(L)).sum() - 0.5 * np.linalg.slogdet(F.T @ F)[1] - 0.5 * z @ (z - fitted)
    )


def log_prior(prior: Matern) -> float:
    """Gamma-like in the amplitude, normal in the logarithm of the length about two steps."""
    return 2 * np.log(prior.amplitude) - 0.5 * np.log(prior.length / (2 * STEP[0])) ** 2


@pytest.mark.parametrize("nu", SMOOTHNESS)
def test_covariance_is_the_general_formula(nu):
    prior = Matern(0.1, 80.0, nu)
    want = matern_covariance(prior, *node_pixels())
    np.testing.assert_allclose(prior.covariance(grid()), want, rtol=1e-9)
    P = projector()
    np.testing.assert_allclose(prior.restricted(grid()), P @ want @ P, atol=1e-13)


@pytest.mark.parametrize("hole", [False, True])
def test_log_likelihood_is_that_of_the_stars(rng, hole):
    """Differences between hyperparameters: the constant is left out.  Empty bins included."""
    data = stars(rng, 900, hole=hole)
    evidence = evidence_of(*data)
    x, y, r, variance = data
    priors = [Matern(0.08, 70, 1.5), Matern(0.05, 70, 1.5), Matern(0.1, 40, 0.5), PATTERN]
    priors.append(Matern(0.03, 150, 2.5))
    want = np.array([reml(x, y, r[:, 0], variance, p) + log_prior(p) for p in priors])
    got = np.array([evidence.at(p).log_evidence for p in priors])
    np.testing.assert_allclose(np.diff(got), np.diff(want), atol=2e-3, rtol=1e-6)


@pytest.mark.parametrize("nu", SMOOTHNESS)
@pytest.mark.parametrize("part", ["at", "at_tiles"])
def test_slopes_are_those_of_the_density(rng, nu, part):
    """By differences."""
    density = getattr(evidence_of(*stars(rng, 5000, hole=True)), part)
    point, h = np.log([0.06, 60.0]), 1e-4
    here = density(Matern(*np.exp(point), nu))
    ends = [[density(Matern(*np.exp(point + s * e), nu)) for s in (h, -h)] for e in np.eye(2)]
    slope = [(up.log_evidence - down.log_evidence) / (2 * h) for up, down in ends]
    np.testing.assert_allclose(here.slope, slope, rtol=1e-5, atol=1e-4)


def test_the_field_is_that_of_the_stars(rng):
    """Node values and their number, against the posterior by a solve over the nodes."""
    x, y, r, variance = stars(rng, 3000)
    found = evidence_of(x, y, r, variance).at(PATTERN)
    joint = joint_solution(x, y, r, np.stack([variance] * 2, axis=1), [PATTERN] * 2)
    mean, cov = joint.nodes
    np.testing.assert_allclose(found.mean, mean[:, 0], atol=2e-7)
    W = bilinear(x, y) / np.sqrt(variance)[:, None]
    phi = legendre_design(3, x, y, size=SIZE) / np.sqrt(variance)[:, None]
    W -= phi @ np.linalg.lstsq(phi, W, rcond=None)[0]
    np.testing.assert_allclose(found.n_effective, np.trace(W.T @ W @ cov[0]), rtol=1e-5)


def test_hyperparameters_come_back(rng):
    """Within their stated errors, over ten truths; and those errors are not idle."""
    pulls = []
    for _ in range(10):
        found = fitted_field(evidence_of(*stars(rng, 20_000)), (1.5,), thorough=True)
        at = np.log([found.prior.amplitude, found.prior.length])
        off = at - np.log([PATTERN.amplitude, PATTERN.length])
        pulls.append(off @ found.curvature @ off)
        assert 0.02 < np.sqrt(np.linalg.inv(found.curvature)[0, 0]) < 0.3
    # sum of ten chi-squares of two degrees each: 20 +- 6.3; 99.9 % lie in 5.9 to 45.3
    assert 5.9 < sum(pulls) < 45.3


@pytest.mark.parametrize(
    "nu",
    [
        SMOOTHNESS[0],
        *(case_in_full(nu, instead="the least smooth are run") for nu in SMOOTHNESS[1:]),
    ],
)
def test_smoothness_is_told_apart(rng, nu):
    """Over three patterns: a single one of 320 nodes can leave it open."""
    total = dict.fromkeys(SMOOTHNESS, 0.0)
    for _ in range(3):
        evidence = evidence_of(*stars(rng, 30_000, prior=Matern(0.08, 100.0, nu)))
        each = {nu: fitted_field(evidence, (nu,), thorough=True) for nu in SMOOTHNESS}
        for other, found in each.items():
            total[other] += found.log_evidence
        best = max(SMOOTHNESS, key=lambda other: each[other].log_evidence)
        assert fitted_field(evidence, SMOOTHNESS, thorough=True).prior == each[best].prior
    assert max(total, key=lambda k: total[k]) == nu


def test_search_ends_at_the_top(rng):
    """No better point within a standard error in any direction."""
    evidence = evidence_of(*stars(rng, 5000))
    found = fitted_field(evidence, (1.5,), thorough=True)

    def density(point) -> float:
        return evidence.at(Matern(*np.exp(point), 1.5)).log_evidence

    top = np.log([found.prior.amplitude, found.prior.length])
    root = np.linalg.cholesky(np.linalg.inv(found.curvature))
    around = [density(top + root @ [np.cos(a), np.sin(a)]) for a in np.arange(8) * np.pi / 4]
    drop = density(top) - np.array(around)
    assert (drop > 0).all()
    # one standard error away a Gaussian has fallen by one half
    assert abs(drop.mean() - 0.5) < 0.15


@pytest.mark.parametrize("which", [0, 1])
def test_search_at_a_bound_ends_at_the_best_point_along_it(rng, which, monkeypatch):
    """Amplitude and length hang together: where one may not rise, the other makes up for it."""
    data = stars(rng, 5000)
    top = fitted_field(evidence_of(*data), (1.5,), thorough=True)
    best = np.log([top.prior.amplitude, top.prior.length])
    low, high = best - 3.0, best + 3.0
    high[which] = best[which] - 1.0
    monkeypatch.setattr(posterior, "_bounds", lambda _: (low, high))
    monkeypatch.setattr(Evidence, "start", (low + high) / 2)
    evidence = evidence_of(*data)
    found = fitted_field(evidence, (1.5,), thorough=True)
    at = np.log([found.prior.amplitude, found.prior.length])
    np.testing.assert_allclose(at[which], high[which], rtol=1e-12)

    def density(value: float) -> float:
        point = high.copy()
        point[1 - which] = value
        return -evidence.at(Matern(*np.exp(point), 1.5)).log_evidence

    along = minimize_scalar(density, bounds=(low[1 - which], high[1 - which]), method="bounded")
    assert found.log_evidence > -along.fun - posterior.SETTLED


def test_the_start_on_tiles_is_near_the_end(rng):
    evidence = evidence_of(*stars(rng, 20_000))
    early = fitted_field(evidence, (1.5,), thorough=False)
    late = fitted_field(evidence, (1.5,), thorough=True)
    assert abs(np.log(early.prior.amplitude / late.prior.amplitude)) < 0.5
    assert abs(np.log(early.prior.length / late.prior.length)) < 0.5


def test_grid_knows_its_chip():
    assert grid().shape == (16, 20)
    assert grid().blank.first == (16.5, 16.5) and grid().blank.step == STEP
    assert grid().table(np.zeros((2, 320))).chip == CHIP.number
