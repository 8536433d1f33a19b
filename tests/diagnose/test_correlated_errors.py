"""Errors correlated between u and v: the same data as independent ones, seen along other axes.

If all matches have the covariance C = L L^T, a fit to (u, v) is that of L^-1 (u, v), whose errors
are independent and equal.  What the diagnostics say of the one must be what they say of the other.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose import score_tests
from bayesdist.diagnose.correlated.information import Information, cell_sums
from bayesdist.diagnose.residuals.misfit import misfits_of, residual_sums
from bayesdist.diagnose.score.motions import motion_test
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.infer import GaussianPriors, load
from bayesdist.infer.kernel.mixture import Constants
from bayesdist.infer.solution.solution import likelihood_of
from bayesdist.infer.stars.stars import prepare

from .support import SIGMA, Scene, by_name, unequal

pytestmark = pytest.mark.usefixtures("one_thread")
L = np.array([[1.0, 0.0], [1.8, 0.7]])  # a correlation of 0.93
SCENE = Scene(300, 3)


def turned(model, table, axes=L):
    """The same matches with u and v along other axes, and their fit."""
    uv = np.stack([table.u, table.v], axis=1) @ axes.T
    C = SIGMA**2 * np.tile(axes @ axes.T, (len(table), 1, 1))
    table = table.with_columns(u=uv[:, 0], v=uv[:, 1]).with_covariances(C)
    return table, SCENE.solve(model, table)


def squared_scores(table, fit):
    likelihood = likelihood_of(fit)
    sums = cell_sums(prepare(fit.model, table)[0], likelihood, 64)
    priors = GaussianPriors.none(fit.model)
    return Information(fit.model, likelihood.theta, sums, priors).squared_scores()


@pytest.mark.parametrize("noise", [None, unequal])
def test_the_sandwich_turns_with_the_axes(noise):
    scene = SCENE if noise is None else replace(SCENE, noise=noise)
    model, table = scene.data(1)
    plain = squared_scores(table, scene.solve(model, table))
    found = squared_scores(*turned(model, table))
    # coefficients of u and then those of v
    K = model.n_terms
    onto = np.kron(L, np.eye(K))
    for expected, cov in (
        (plain.covariance, found.covariance),
        (plain.sandwich(), found.sandwich()),
    ):
        expected = onto @ expected @ onto.T
        np.testing.assert_allclose(cov, expected, atol=1e-6 * np.abs(expected).max())
    assert found.scale == pytest.approx(plain.scale, rel=1e-6)
    assert found.weight == pytest.approx(plain.weight, abs=1e-6)


def test_score_tests_of_both_axes_do_not_depend_on_the_axes():
    model, table = Scene(400, 2).data(3)
    plain = by_name(score_tests(table, SCENE.solve(model, table)))
    found = by_name(score_tests(*turned(model, table)))
    # not "magnitude" and "edges", which also test displacements along one axis
    for name in ("order 3", "order 4", "colour", "jumps"):
        assert found[name].p_value == pytest.approx(plain[name].p_value, rel=1e-4), name


@pytest.mark.parametrize("with_mixture", [False, True])
def test_the_test_for_motions_does_not_depend_on_the_axes(with_mixture):
    """Also if the mixture takes moving stars for false matches, so that it is not asked."""
    scene = Scene(1500, 2, frames="shift", n_exposures=8)
    model, table = scene.data(5)
    rng = np.random.default_rng(5)
    star = np.arange(len(table)) % 200
    motion = 0.5 * SIGMA * rng.standard_normal((200, 2))
    moved = (table.epoch - table.epoch.mean())[:, None] * motion[star]
    table = table.with_columns(u=table.u + moved[:, 0], v=table.v + moved[:, 1], star=star)

    def tested(table, fit):
        sample = scored_sample(table, fit)
        if with_mixture:
            sample = replace(sample, mixture=Constants(*np.zeros((4, 1)), 1, 1.0))
        return motion_test(sample)

    plain = tested(table, scene.solve(model, table))
    uv = np.stack([table.u, table.v], axis=1) @ L.T
    C = SIGMA**2 * np.tile(L @ L.T, (len(table), 1, 1))
    other = table.with_columns(u=uv[:, 0], v=uv[:, 1]).with_covariances(C)
    # the frames of exposures are shifts, which are turned like the positions
    found = tested(other, scene.solve(model, other))
    assert found.p_value == pytest.approx(plain.p_value, rel=1e-3)
    assert plain.p_value < 1e-6


@pytest.mark.parametrize("spread", [False, True])
def test_no_structure_is_found_in_noise(spread):
    """Sums along both axes are nearly one if errors are nearly on a line."""
    rings, misfit = [], []
    for seed in range(40):
        rng = np.random.default_rng([46, seed])
        model, table = SCENE.data(seed)
        fit = SCENE.solve(model, table)
        rho = rng.uniform(0.8, 0.97, len(table)) * (1.0 if spread else 0.95)
        sign = np.sign(table.x - 500.0) if spread else 1.0
        C = SIGMA**2 * np.moveaxis(
            np.array([[1 + 0 * rho, sign * rho], [sign * rho, 1 + 0 * rho]]), 2, 0
        )
        errors = np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((300, 2)))
        uv = model.predict(np.asarray(fit.mean), table.x, table.y) + errors
        table = table.with_columns(u=uv[:, 0], v=uv[:, 1]).with_covariances(C)
        fit = SCENE.solve(model, table)
        rings.append(by_name(score_tests(table, fit))["rings"].p_value)
        with closing(load(model, table)) as shards:
            [found] = misfits_of(fit, *residual_sums(fit, shards, None))
        misfit.append(found.p_value)
    # p-values are bounds: no more small ones than the level says
    for p, level in product((rings, misfit), (0.01, 0.1, 0.3)):
        assert stats.binom.sf(np.sum(np.array(p) < level) - 1, len(p), level) > 1e-3, (level, p)
