"""Errors of positions with what the model leaves out, over many simulated fields: do they cover?"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.diagnose.tests import selfcal_discrepancy, selfcal_score_tests
from bayesdist.kinds.selfcal.infer.mode import gauge_of, solve
from bayesdist.kinds.selfcal.infer.problem import prepare
from tests.kinds.selfcal.infer.fields import SIZE, field
from tests.reduced import case_in_full

pytestmark = pytest.mark.slow

GRID = 9
RMS = 0.004  # px: of the structure, on each axis


def waves(rng, length):
    """A random smooth field of unit variance over scaled positions, (N, 2)."""
    k = rng.standard_normal((2, 2, 200)) / length
    phase = rng.uniform(0, 2 * np.pi, (2, 200))

    def at(X, Y):
        angle = np.einsum("nk,akw->anw", np.stack([X, Y], axis=1), k) + phase[:, None]
        return np.sqrt(2 / 200) * np.cos(angle).sum(axis=-1).T

    return at


@cache
def solved(seed: int, rms: float):
    """The solution of a field with structure, the field and the structure at scaled positions."""
    rng = np.random.default_rng(900 + seed)
    simulated = field(seed, 12, 1200, sigma=0.02, disturbed=0.02)
    structure, size = waves(rng, 0.5), rms
    d = simulated.detections
    X, Y = (2 * z / SIZE[0] - (SIZE[0] + 1) / SIZE[0] for z in (d.x, d.y))
    moved = size * structure(X, Y)
    # the map has the structure in addition, so that a star falls on another pixel
    detections = replace(d, x=d.x - moved[:, 0], y=d.y - moved[:, 1])
    theta = simulated.theta
    problem = prepare(simulated.model, detections, theta, match_radius=1.0)
    information = Prior.none(theta)
    held = gauge_of(problem, theta, information).held
    free = np.setdiff1d(np.arange(problem.model.n_params), held)
    solution = solve(problem, theta, free, information)
    gauge = gauge_of(solution.problem, solution.theta, information, solution)
    return solution, simulated, gauge, lambda X, Y: size * structure(X, Y)


def pulls(seed: int, rms: float) -> np.ndarray:
    """Errors of positions over their stated standard deviations, (positions, 2)."""
    solution, simulated, gauge, structure = solved(seed, rms)
    model, theta = solution.problem.model, solution.theta
    found = selfcal_discrepancy(solution, rng=np.random.default_rng(seed))
    basis, line = model.basis(1), np.linspace(-0.95, 0.95, GRID)
    X, Y = (a.ravel() for a in np.meshgrid(line, line))
    phi, K = basis.evaluate_scaled(X, Y), model.n_terms

    def polynomial(change, at=phi):
        """Fields (..., N, 2) of changes of the parameters."""
        return np.stack([change[..., :K] @ at.T, change[..., K : 2 * K] @ at.T], axis=-1)

    # the truth's polynomials hold what those of the structure are, over the detector
    nodes, weights = np.polynomial.legendre.leggauss(30)
    inner = [a.ravel() for a in np.meshgrid(nodes, nodes)]
    weight, dense = np.outer(weights, weights).ravel(), basis.evaluate_scaled(*inner)
    onto = np.linalg.solve(dense.T @ (weight[:, None] * dense), dense.T * weight)
    true = simulated.theta.copy()
    true[: 2 * K] += (onto @ structure(*inner)).T.ravel()
    left = structure(X, Y) - polynomial(true - simulated.theta)
    # to where what is held has no error
    null, held = gauge.null, gauge.held
    off = theta - true
    off = off - null @ np.linalg.solve(null[held], off[held])
    error = polynomial(off) - left
    n = found.n_draws
    noise = np.random.default_rng(0).multivariate_normal(
        np.zeros(len(theta)), found.noise, n, method="eigh"
    )
    chip = found.structure[1]
    drawn = np.swapaxes(chip.coefficients @ chip.evaluate(X, Y).T, 1, 2)
    total = polynomial(noise + found.structure_theta + found.linear.theta) + drawn
    # nothing is corrected: what is left out is an error with all of its mean
    return error / np.sqrt(np.mean(total**2, axis=0))


@pytest.mark.parametrize(
    "rms",
    [
        case_in_full(0.0, instead="test_p_values_are_those_of_chance has such fields", id="inside"),
        pytest.param(RMS, id="structure"),
    ],
)
def test_errors_cover(rms, full, capsys):
    z = np.abs([pulls(seed, rms) for seed in range(40 if full else 6)])
    within = [np.mean(z < k) for k in (1.0, 1.96)]
    with capsys.disabled():
        print(f"\n{rms} px: {within[0]:.3f} within one error, {within[1]:.3f} within 1.96")
    room = 0.0 if full else 0.07  # fields of one solution are worth a few numbers
    assert 0.60 - room < within[0] < 0.85 + room
    assert within[1] > 0.90 - room


def p_values(seed: int) -> dict[str, float]:
    solution, simulated, _, _ = solved(seed, 0.0)
    d = simulated.detections
    mag = np.random.default_rng(seed).normal(size=solution.problem.n_stars)[solution.problem.star]
    epoch = np.linspace(2000.0, 2006.0, len(d.exposure_names))[d.exposure[solution.problem.rows]]
    return {t.name: t.p_value for t in selfcal_score_tests(solution, mag=mag, epoch=epoch)}


def test_p_values_are_those_of_chance(full):
    found = [p_values(seed) for seed in range(60 if full else 6)]
    for name in found[0]:
        p = np.array([one[name] for one in found])
        least = 1e-4 if full else 1e-3
        assert p.min() > least / len(p) * 5, (name, p)
        assert np.mean(p < 0.1) < (0.25 if full else 0.55), (name, p)
