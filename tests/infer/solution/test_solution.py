"""What every form of a solution answers, and what a change of its covariance leaves."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.infer import Rejection, fit_linear, residuals, sample
from bayesdist.infer.solution.solution import Solution, TransformedSolution, likelihood_of
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.infer.stars.stars import in_table_order, prepare
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches

from ..support import simulated

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def fitted():
    model, matches, _ = simulated(
        2, 300, order=2, frames="shift_rotation", n_exposures=3, sigma=0.05
    )
    return matches, fit_linear(matches, model, rejection=Rejection(clip_chi2=4.0))


def forms(fit) -> list[Solution]:
    bare = without_frames(fit)
    return [fit, bare, bare.mapped(2 * np.eye(len(bare.mean))), fit.mapped(np.eye(18))]


def test_all_forms_answer_the_same_questions(fitted):
    matches, fit = fitted
    for one in forms(fit):
        assert isinstance(one, Solution)
        assert (one.convergence, one.mixture) == (None, None)
        assert one.kind == "least squares" and one.unit == fit.unit
        np.testing.assert_allclose(one.sigma, np.sqrt(np.diag(one.cov)))
        draws = one.draws(4000, np.random.default_rng(1))
        assert np.abs((draws.mean(axis=0) - one.mean) / one.sigma).max() < 0.1
        assert np.abs(draws.std(axis=0) / one.sigma - 1).max() < 0.06
    assert not fit.uses(matches).all() and without_frames(fit).uses(matches).all()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fit)).cov, fit.cov)


def test_deviations_are_mapped(fitted):
    _, fit = fitted
    matrix = np.diag(np.linspace(0.5, 2.0, len(fit.mean)))
    found = fit.mapped(matrix)
    assert type(found) is type(fit)
    np.testing.assert_array_equal(found.mean, fit.mean)
    np.testing.assert_allclose(found.cov, matrix @ fit.cov @ matrix.T)
    bare = without_frames(fit)
    n = len(bare.mean)
    moved = bare.mapped(matrix[:n, :n])
    assert isinstance(moved, TransformedSolution)
    np.testing.assert_allclose(moved.sigma, np.diag(matrix)[:n] * bare.sigma)
    a, b = (one.draws(5, np.random.default_rng(3)) - one.mean for one in (bare, moved))
    np.testing.assert_allclose(b, a * np.diag(matrix)[:n], rtol=1e-9, atol=1e-15)


def test_only_fits_and_posteriors_have_a_likelihood(fitted):
    matches, fit = fitted
    stars, order = prepare(fit.model, matches)
    found = likelihood_of(fit)
    np.testing.assert_array_equal(
        in_table_order(found.inliers(stars), order).astype(bool), fit.uses(matches)
    )
    scores = in_table_order(found.scores(stars).T, order)
    expected = fit.uses(matches) * residuals(fit, matches)[:, 0] / matches.sigma_u**2
    np.testing.assert_allclose(scores[:, 0], expected, rtol=1e-12, atol=1e-9)
    for one in forms(fit)[1:3]:
        with pytest.raises(InputError, match="has no likelihood"):
            likelihood_of(one)


def test_solutions_say_what_they_are_in_a_line() -> None:
    model = DistortionModel(2, (Chip(1, "WFC1", (1000.0, 800.0), (500.5, 400.5)),))
    theta = np.zeros(model.n_params)
    matches, _ = simulate_matches(
        model, theta, 200, rng=np.random.default_rng(2), sigma=0.02, outlier_scale=0.5
    )
    fit = fit_linear(matches, model)
    text = repr(fit)
    for part in ("order 2", "1 chip (WFC1)", "12 parameters", f"{fit.n_used} of 200 stars",
                 f"chi2/dof {fit.chi2:.5g}/{fit.dof}"):  # fmt: skip
        assert part in text
    posterior = sample(fit, matches)
    said = repr(posterior)
    for part in ("order 2", "200 stars", "converged", "R-hat", f"{len(posterior.flat)} draws"):
        assert part in said
    for line in (text, said):
        assert "\n" not in line and len(line) < 250 and "array" not in line
