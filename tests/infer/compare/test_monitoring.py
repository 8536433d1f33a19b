"""A release against new matches: no false alarms, known changes found, their dates told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest

from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture, fit_linear
from bayesdist.infer.compare.change_date import period_scores, scan_dates
from bayesdist.infer.compare.monitoring import change_of, fit_new
from bayesdist.model import TimeDependence
from bayesdist.simulate import simulate_matches
from tests.infer.support import CHIP, TWO_CHIPS, UNCLIPPED, simulated
from tests.reduced import case_in_full, only_in_full

DRIFT = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2010.0,))
DATES = np.linspace(2005.0, 2015.0, 6)
LATER = 2016.0 + 0.2 * np.arange(6)
EXACT = OutlierMixture("none", jitter=0.0)


def pair(seed, *, frames="none", time=DRIFT, chips=(CHIP,), n=1500, bend=0.0, since=0, **options):
    """A release, and new matches of the same truth but for a bend of u from one exposure on."""
    model, old, truth = simulated(
        seed, 2000, order=2, frames=frames, n_exposures=6, time=time, epochs=DATES, chips=chips
    )
    rng = np.random.default_rng(10_000 + seed)
    new = replace(model, exposures=tuple(f"n{k}" for k in range(6)))
    theta = np.zeros(new.n_params)
    theta[: new.n_distortion] = truth.theta[: new.n_distortion]
    for block in new.local_blocks:
        theta[block] = 0.01 * rng.standard_normal(new.n_frame)
        theta[block][:2] += 5 * rng.standard_normal(2)
    options = {"fraction": 0.0} | options
    matches, _ = simulate_matches(new, theta, n, rng=rng, epochs=LATER, **options)
    late = matches.epoch >= LATER[since]
    matches = replace(matches, u=matches.u + bend * late * ((matches.x - 500) / 500) ** 2)
    return fit_linear(old, model, **UNCLIPPED), matches


def monitored(release, matches, mixture=EXACT, **options):
    new = fit_new(release, matches, mixture=mixture, **(UNCLIPPED | options))
    change = change_of(new)
    return new, change, scan_dates(period_scores(new, change, matches), change)


@pytest.mark.parametrize(
    ("frames", "time", "dof"),
    [
        case_in_full("none", DRIFT, 12, instead="frames are run"),
        ("shift_rotation_scale", DRIFT, 8),
        case_in_full("affine", None, 6, instead="other frames are run"),
    ],
)
def test_without_a_change_p_is_uniform(frames, time, dof, full) -> None:
    n = 200 if full else 10
    values, scatters, since = [], [], []
    for seed in range(n):
        _, change, date = monitored(*pair(seed, frames=frames, time=time))
        assert change.test.dof == dof
        values.append(change.test.chi2)
        scatters.append(date.p_scatter)
        since.append(date.p_value)
    assert kstest(values, chi2(dof).cdf).pvalue > 1e-3
    # the best date takes a little of the scatter away, and the search over dates is corrected by
    # the number of dates: both probabilities err on the safe side, if at all
    assert kstest(scatters, "uniform", alternative="greater").pvalue > 1e-3
    assert np.mean(scatters) < 0.75
    assert np.sum(np.array(since) < 0.05) <= binom.ppf(0.999, n, 0.05)


@pytest.mark.slow
@only_in_full("without a change p is uniform")
def test_errors_that_are_too_small_are_no_change() -> None:
    """Quoted 0.05 px, true 0.07: the jitter takes it up; false matches do not matter either."""
    n = 60
    values = []
    for seed in range(n):
        release, matches = pair(seed, fraction=0.03, jitter=0.05, outlier_scale=1.0)
        new = fit_new(release, matches, mixture=OutlierMixture())
        assert new.hyper["j"] == pytest.approx(0.05, rel=0.25)
        values.append(change_of(new).test.chi2)
    assert kstest(values, chi2(12).cdf).pvalue > 1e-3


@pytest.mark.parametrize("chips", [(CHIP,), TWO_CHIPS])
def test_new_frames_alone_are_no_change(chips) -> None:
    """Exposures turned by half a radian and shifted by hundreds of pixels."""
    release, matches = pair(3, frames="shift_rotation", time=None, chips=chips)
    turn = np.exp(0.5j + 1j * 0.1 * matches.exposure)
    z = turn * (matches.u + 1j * matches.v) + 300 - 100j * matches.exposure
    _, change, _ = monitored(release, replace(matches, u=z.real, v=z.imag))
    assert change.test.dof == 12 * len(chips) - 3
    assert change.test.p_value > 1e-3
    size = np.abs(change.difference).max()
    assert size < 6 * np.sqrt(np.diag(change.cov)).max()


def test_a_known_change_is_found_with_its_size_and_date() -> None:
    """0.1 px of x^2 in u from the fourth new exposure on."""
    release, matches = pair(1, frames="shift_rotation", bend=0.1, since=3)
    _, change, date = monitored(release, matches)
    assert change.test.p_value < 1e-4 and date.p_value < 1e-4
    assert (date.after, date.before) == (pytest.approx(LATER[2]), pytest.approx(LATER[3]))
    assert date.interval[0] >= LATER[1] and date.interval[1] <= LATER[4]
    assert date.p_scatter > 1e-3  # the change explains all
    # ((x - 500) / 500)^2 = 2/3 P_2 + ...; what frames take up has no second order
    k = 3
    assert change.model.basis().terms[k] == (2, 0)
    found, sigma = date.change.difference[0, 0, k], np.sqrt(date.change.cov[k, k])
    assert found == pytest.approx(0.1 * 2 / 3, abs=4 * sigma)
    assert sigma < 0.01
    # half of the new matches have it
    assert change.difference[0, 0, k] == pytest.approx(0.1 / 3, abs=4 * np.sqrt(change.cov[k, k]))


def test_power_of_a_small_change(full) -> None:
    """The chi-square of a change is non-central by its own size: mean dof + lambda."""
    n = 60 if full else 20
    values, expected = [], []
    for seed in range(n):
        release, matches = pair(seed, bend=0.02, time=None)
        _, change, _ = monitored(release, matches)
        true = np.zeros(12)
        basis = change.model.basis()
        assert basis.reference_pixel[0] == 500 and basis.terms[3] == (2, 0)
        true[:6] = basis.from_monomials([0, 0, 0, 0.02 / 500**2, 0, 0])
        expected.append(12 + true @ np.linalg.solve(change.cov, true))
        values.append(change.test.chi2)
    spread = np.sqrt(2 * (12 + 2 * (np.mean(expected) - 12)) / n)
    assert np.mean(expected) > 20
    assert np.mean(values) == pytest.approx(np.mean(expected), abs=4 * spread)


def test_from_the_first_date_on_the_scan_is_the_test_itself() -> None:
    """Two ways to one number: the fit with its covariance, and sums of periods."""
    _, change, date = monitored(*pair(5, time=None))
    assert date.gain[0] == pytest.approx(change.test.chi2, rel=1e-6)


def test_periods_that_scatter_are_seen() -> None:
    """An error common to all matches of an exposure: 0.05 px of x^2, another sign each time."""
    release, matches = pair(2, n=3000)
    sign = np.where(matches.exposure % 2, 1.0, -1.0)
    matches = replace(matches, u=matches.u + 0.05 * sign * ((matches.x - 500) / 500) ** 2)
    _, _, date = monitored(release, matches)
    assert date.p_scatter < 1e-4 and date.scatter > 1.5


def test_what_does_not_go_together_is_refused() -> None:
    release, matches = pair(1)
    with pytest.raises(InputError, match="no epochs"):
        fit_new(release, replace(matches, epoch=None))
    with pytest.raises(InputError, match="arcsec"):
        fit_new(release, replace(matches, unit="arcsec"))
