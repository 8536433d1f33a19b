"""New exposures of a campaign against its release: scatter is no change, and changes are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, kstest

from bayesdist.infer import OutlierMixture
from bayesdist.infer.catalogue.star_covariance import star_covariance
from bayesdist.infer.compare.change_date import period_scores, scan_dates
from bayesdist.infer.compare.monitoring import change_of, fit_new, with_star_errors_of
from bayesdist.infer.exposures.hierarchy import fit_hierarchical
from bayesdist.simulate import simulate_matches
from tests.diagnose.held_campaign import field
from tests.infer.small_campaign import campaign, campaign_truth, with_star_errors
from tests.infer.support import UNCLIPPED
from tests.reduced import only_in_full

EXACT = OutlierMixture("none", jitter=0.0)
TAU, OWN = (7e-6, 5e-6, 3e-6), (8e-3, 8e-3, 2e-6, 2e-6, 1.5e-6, 1e-6)
N_OLD, N_NEW, STARS = 24, 8, 250
DATES = 2005.0 + 0.1 * np.arange(N_NEW)


def new_exposures(model, theta, seed, *, change=None, since=0):
    """Exposures of the same detector that point and roll as they like."""
    rng = np.random.default_rng([seed, 99])
    new = replace(model, exposures=tuple(f"n{k}" for k in range(N_NEW)))
    drawn = campaign_truth(new, rng, tau=TAU, own=OWN)
    drawn[: model.n_distortion] = theta[: model.n_distortion]
    matches, _ = simulate_matches(
        new, drawn, N_NEW * STARS, rng=rng, sigma=0.02, fraction=0.0, epochs=DATES
    )
    if change is None:
        return matches
    late = matches.epoch >= DATES[since]
    x, y = matches.x + late * change(matches), matches.y
    place = {"epoch": matches.epoch, "exposure": matches.exposure, "chip": matches.chip_number}
    moved = new.predict(drawn, x, y, **place) - new.predict(drawn, matches.x, y, **place)
    return replace(matches, u=matches.u + moved[:, 0], v=matches.v + moved[:, 1])


def monitored(seed, **options):
    model, old, theta = campaign(seed, N_OLD, STARS, order=2, tau=TAU, own=OWN)
    joint = fit_hierarchical(old, model, n_tau=64, **UNCLIPPED)
    matches = new_exposures(model, theta, seed, **options)
    tau = np.sqrt((joint.tau_draws**2).mean(axis=0))
    scatter = dict(zip(joint.scatter.kinds, tau, strict=True))
    new = fit_new(joint, matches, mixture=EXACT, scatter=scatter, **UNCLIPPED)
    change = change_of(new)
    return new, change, scan_dates(period_scores(new, change, matches), change)


@pytest.mark.slow
@only_in_full("tests/app/test_campaign_holdout confirms a release")
def test_exposures_that_scatter_are_no_change() -> None:
    n = 100
    values, scatters, since = [], [], []
    for seed in range(n):
        _, change, date = monitored(seed)
        # two chips, two axes, six terms, and three parameters of a frame
        assert change.test.dof == 24 - 3
        values.append(change.test.p_value)
        scatters.append(date.p_scatter)
        since.append(date.p_value)
    assert kstest(values, "uniform").pvalue > 1e-3
    assert kstest(scatters, "uniform").pvalue > 1e-3
    assert np.sum(np.array(since) < 0.05) <= binom.ppf(0.999, n, 0.05)


def test_scatter_that_is_ignored_would_be_a_change() -> None:
    """Two exposures, taken for as rigid as a hundredth of their scatter."""
    model, old, theta = campaign(3, N_OLD, STARS, order=2, tau=TAU, own=OWN)
    joint = fit_hierarchical(old, model, n_tau=64, **UNCLIPPED)
    matches = new_exposures(model, theta, 3)
    matches = matches.select(matches.exposure < 2)
    matches = replace(matches, exposure_names=("n0", "n1"))
    tau = np.sqrt((joint.tau_draws**2).mean(axis=0))
    found = []
    for factor in (1.0, 0.01):
        scatter = dict(zip(joint.scatter.kinds, factor * tau, strict=True))
        new = fit_new(joint, matches, mixture=EXACT, scatter=scatter, **UNCLIPPED)
        found.append(change_of(new).test.p_value)
    assert found[1] < 0.01 < found[0]


def test_a_change_of_the_detector_its_size_and_date() -> None:
    """0.05 pixels of x^2 on both chips from the fourth new exposure on."""
    bend = lambda m: 0.05 * ((m.x - 2048) / 2048) ** 2  # noqa: E731
    _, change, date = monitored(5, change=bend, since=3)
    assert change.test.p_value < 1e-6 and date.p_value < 1e-6
    assert (date.after, date.before) == (pytest.approx(DATES[2]), pytest.approx(DATES[3]))
    assert date.p_scatter > 1e-3
    k = change.model.basis(2).terms.index((2, 0))
    A2 = change.released[0, 0, change.model.basis(2).terms.index((1, 0))] / 2048
    cov = date.change.cov
    found, sigma = date.change.difference[0, 0, k], np.sqrt(cov[k, k])
    assert found == pytest.approx(0.05 * 2 / 3 * A2, abs=4 * sigma)
    assert sigma < 0.005


def test_a_chip_that_moves_is_a_change() -> None:
    """The other chip by 0.05 pixels along x: five times what its exposures scatter together."""
    step = lambda m: 0.05 * (m.chip_number == 1)  # noqa: E731
    _, change, _ = monitored(6, change=step)
    assert change.test.p_value < 1e-4


def test_from_the_first_date_on_the_scan_is_the_test_itself() -> None:
    """Two ways to one number: the fit with its covariance, and sums of periods."""
    _, change, date = monitored(7)
    assert date.gain[0] == pytest.approx(change.test.chi2, rel=1e-3)


def test_a_catalogue_that_both_sides_share_is_no_change(full) -> None:
    """All exposures see the same stars in the same places, whose errors are twice the centroids'.

    Taken for independent they make probabilities that are anything but uniform.
    """
    values, ignored = [], []
    for seed in range(60 if full else 3):
        one = field(seed, n_exposures=30, n_stars=200, one_pointing=True, centroid=0.004)
        early = one.matches.exposure < 24
        old, new = one.matches.select(early), one.matches.select(~early)
        names = one.matches.exposure_names
        old = replace(old, exposure_names=names[:24])
        new = replace(new, exposure=new.exposure - 24, exposure_names=names[24:])
        model = replace(one.model, exposures=names[:24])
        joint = fit_hierarchical(old, model, n_tau=64, **UNCLIPPED)
        shared = star_covariance(joint.fit, old, one.errors)
        release = with_star_errors(joint, shared)
        tau = np.sqrt((joint.tau_draws**2).mean(axis=0))
        scatter = dict(zip(joint.scatter.kinds, tau, strict=True))
        found = fit_new(release, new, mixture=EXACT, scatter=scatter, **UNCLIPPED)
        ignored.append(change_of(found).test.p_value)
        known = with_star_errors_of(one.errors, found, new, (joint.fit, old))
        values.append(change_of(known).test.p_value)
    assert kstest(values, "uniform").pvalue > 1e-3
    assert kstest(ignored, "uniform").pvalue < kstest(values, "uniform").pvalue
