"""The drift of one filter in another: identities of Gaussians by two routes, and invariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.solution.transforms import lines, reference_gauge, without_frames
from bayesdist.kinds.campaign.reference import drift_priors, with_drift_of
from bayesdist.model import TimeDependence
from bayesdist.model.alignment import turned, turned_model
from tests.infer.solution.test_transforms import Gaussian, acs


def bare(seed: int) -> Gaussian:
    """A solution without frames, with a full covariance."""
    view = without_frames(acs(seed))
    return Gaussian(view.model, view.mean, view.cov)


def lying(solution: Gaussian, angle: float, shift: complex) -> Gaussian:
    """The same in a catalogue that lies otherwise; then both axes of each term drift."""
    turn = np.exp(1j * angle)
    T = turned(solution.model, np.eye(solution.model.n_params), turn, 0.0).T
    mean = turned(solution.model, solution.mean, turn, shift)
    return Gaussian(turned_model(solution.model), mean, T @ solution.cov @ T.T)


def drift_of(solution) -> slice:
    return slice(solution.model.n_polynomial, solution.model.n_distortion)


@pytest.fixture(scope="module")
def reference():
    return bare(1)


@pytest.fixture(scope="module")
def solution():
    return bare(2)


def test_priors_do_not_depend_on_how_the_reference_lay(reference, solution):
    """The catalogue of the reference run may be turned and shifted: the drift is the detector's."""
    straight = drift_priors(reference, solution.model)
    other = drift_priors(lying(reference, 0.7, 400.0 - 80.0j), solution.model)
    assert straight.keys() == other.keys() == set(solution.model.names[drift_of(solution)])
    for name, (mean, sigma) in straight.items():
        assert other[name][0] == pytest.approx(mean, rel=1e-6, abs=1e-9)
        assert other[name][1] == pytest.approx(sigma, rel=1e-6)


def test_the_drift_is_taken_over_at_any_rotation_of_both(reference, solution):
    """The two catalogues lie by 0.9 rad apart: seen in the common gauge nothing changes."""
    # every term drifts on both axes, with an error of its own, so that nothing is left out
    both = [lying(one, 1e-3, 0.0) for one in (reference, solution)]
    both = [Gaussian(o.model, o.mean, o.cov + 1e-12 * np.eye(len(o.cov))) for o in both]
    straight = reference_gauge(with_drift_of(both[1], both[0]), 2)
    apart = with_drift_of(lying(both[1], 0.6, 3.0 + 5.0j), lying(both[0], -0.3, 100.0 + 0.0j))
    seen = reference_gauge(apart, 2)
    sigma = np.sqrt(np.maximum(np.diag(straight.cov), 1e-18))
    assert (np.abs(seen.mean - straight.mean) < 1e-4 * sigma + 1e-7).all()


def test_independent_priors_are_nowhere_tighter_than_the_reference(reference, solution):
    """For any combination of rates and steps the priors' variance is the larger one."""
    sigma = np.array([sigma for _, sigma in drift_priors(reference, solution.model).values()])
    view = reference_gauge(reference, 2)
    places = [view.model.names.index(n) for n in solution.model.names[drift_of(solution)]]
    cov = view.cov[np.ix_(places, places)]
    excess = (np.diag(sigma**2) - cov) / np.outer(sigma, sigma)
    assert np.linalg.eigvalsh(excess)[0] > -1e-9
    # and not by more than it takes
    assert np.linalg.eigvalsh(excess)[0] < 1e-6


def test_the_drift_is_that_of_the_reference(reference, solution):
    """Rates in both segments, in the common gauge."""
    given = with_drift_of(solution, reference)
    for s in (0, 1):
        ours = lines(reference_gauge(given, 2), s)
        theirs = lines(reference_gauge(reference, 2), s)
        for label in ("A_2", "B_2", "B_3"):
            for chip in ("WFC1", "WFC2"):
                k = ours.labels.index(f"{chip}.{label}.beta")
                assert ours.values[k] == pytest.approx(theirs.values[k], abs=1e-9)
                assert ours.sigma[k] == pytest.approx(theirs.sigma[k], rel=1e-3)


def test_polynomials_follow_as_if_the_drift_had_been_measured(reference, solution):
    """A second route: very many exact measurements of the drift, added to the precision."""
    known = Gaussian(reference.model, reference.mean, 1e-12 * reference.cov)
    given = with_drift_of(solution, known)
    T = drift_of(solution)
    precision = np.linalg.inv(solution.cov)
    exact = np.zeros(len(precision))
    exact[T] = 1e8 / np.diag(solution.cov)[T]
    cov = np.linalg.inv(precision + np.diag(exact))
    mean = cov @ (precision @ solution.mean + exact * given.mean)
    k = solution.model.n_polynomial
    sigma = np.sqrt(np.diag(solution.cov))[:k]
    assert (np.abs(mean[:k] - given.mean[:k]) < 1e-3 * sigma).all()
    np.testing.assert_allclose(
        np.sqrt(np.diag(given.cov)[:k]), np.sqrt(np.diag(cov)[:k]), rtol=1e-3
    )


def test_what_the_solution_took_its_drift_to_be_does_not_matter(reference, solution):
    """A prior on the drift, even a wrong one, leaves no trace."""
    T = drift_of(solution)
    precision = np.linalg.inv(solution.cov)
    extra = np.zeros(len(precision))
    extra[T] = 4.0 / np.diag(solution.cov)[T]
    cov = np.linalg.inv(precision + np.diag(extra))
    wrong = solution.mean + 3 * np.sqrt(np.diag(solution.cov))
    with_prior = Gaussian(
        solution.model, cov @ (precision @ solution.mean + extra * wrong), (cov + cov.T) / 2
    )
    a, b = with_drift_of(solution, reference), with_drift_of(with_prior, reference)
    sigma = np.sqrt(np.diag(a.cov))
    # the gauges of the two differ by what the wrong prior does to the rotation
    assert (np.abs(a.mean - b.mean) < 1e-2 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(b.cov)), sigma, rtol=1e-3)


def test_draws_are_of_that_mean_and_covariance(reference, solution):
    given = with_drift_of(solution, reference)
    draws = given.draws(20_000, np.random.default_rng(3))
    sigma = np.sqrt(np.diag(given.cov))
    pulls = (draws.mean(axis=0) - given.mean) / sigma * np.sqrt(len(draws))
    assert np.abs(pulls).max() < 5
    R = given.cov / np.outer(sigma, sigma)
    assert np.abs(np.cov((draws / sigma).T) - R).max() < 0.05


def test_exposures_are_left_out(reference):
    """Frames of single exposures are no part of what a filter has in common."""
    given = with_drift_of(acs(2), reference)
    assert given.model == without_frames(acs(2)).model


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time": None}, "does not drift"),
        ({"unit": "mas"}, "units"),
        ({"time": TimeDependence((("u", 1, 0),), (2004.5, 2012.5), (2009.4,))}, "the term"),
        (
            {
                "time": TimeDependence(
                    (("u", 1, 0), ("v", 1, 0), ("v", 0, 1)), (2004.5, 2012.0), (2009.4,)
                )
            },
            "reference dates",
        ),
    ],
)
def test_drifts_that_cannot_be_taken_over(change, words, reference, solution):
    other = replace(reference.model, **change)
    alien = Gaussian(other, np.zeros(other.n_params), np.eye(other.n_params))
    with pytest.raises(InputError, match=words):
        drift_priors(alien, solution.model)


def test_a_drift_without_error(reference, solution):
    cov = solution.cov.copy()
    T = drift_of(solution)
    cov[T] = 0.0
    cov[:, T] = 0.0
    with pytest.raises(DegenerateError, match="no error"):
        with_drift_of(Gaussian(solution.model, solution.mean, cov), reference)
