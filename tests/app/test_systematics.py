"""A campaign's posterior with the errors of its catalogue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.app.campaign import systematics
from bayesdist.app.campaign.aberration import PERIOD, SWING, scale_error
from bayesdist.app.campaign.systematics import (
    catalogue_covariance,
    catalogue_terms,
    with_shared_stars,
)
from bayesdist.assess.terms.parameters import CATALOGUE as POSITIONS
from bayesdist.assess.terms.parameters import MOTIONS
from bayesdist.data import MatchTable, ReferenceCatalog
from bayesdist.infer import Posterior, Rejection, fit_linear
from bayesdist.infer.stars.mixture import OutlierMixture
from bayesdist.model import Chip, DistortionModel

STARS, EXPOSURES = 60, 9
CENTROID, CATALOGUE = 0.02, 0.05
MODEL = DistortionModel(2, (Chip(1, "A", (4096.0, 2048.0), (2048.0, 1024.0)),))


def stars():
    """Pixels of the stars, all over the chip."""
    rng = np.random.default_rng(5)
    return rng.uniform(1, 4096, STARS), rng.uniform(1, 2048, STARS)


@pytest.fixture(scope="module")
def matches():
    """The same stars on the same pixels in every exposure; codes leave gaps."""
    # a table does not hold a star twice: not quite the same pixel
    x, y = (np.tile(p, EXPOSURES) + 1e-9 * np.arange(STARS * EXPOSURES) for p in stars())
    quoted = np.full(x.size, np.hypot(CENTROID, CATALOGUE))
    code = np.tile(3 * np.arange(STARS) + 2, EXPOSURES)
    return MatchTable(x, y, x, y, sigma_u=quoted, sigma_v=quoted, star=code)


@pytest.fixture(scope="module")
def catalog():
    x, y = stars()
    sigma = np.full(STARS, CATALOGUE)
    rows = np.random.default_rng(2).permutation(STARS)  # not in the order of the codes
    return ReferenceCatalog(x[rows], y[rows], sigma, sigma, star=(3 * np.arange(STARS) + 2)[rows])


@pytest.fixture(scope="module")
def fit(matches):
    return fit_linear(matches, MODEL, rejection=Rejection(1e9, None))


def posterior_of(fit, n=1000, wider=1.0, seed=1):
    """A posterior of four chains that is so much wider than the fit."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((4, n, len(fit.mean))) * np.sqrt(wider)
    theta = fit.mean + z @ np.linalg.cholesky(fit.cov).T
    empty = dict(log_prob=None, n_stars=0, n_flagged=0, n_false=0.0, reference_sigma=1.0)
    return Posterior(
        MODEL, OutlierMixture("none"), theta, {}, convergence=None, sampler=None, **empty
    )


@pytest.mark.parametrize("wider", [1.0, 1.8])
def test_exposures_do_not_help_against_the_catalogue(wider, fit, matches, catalog, tmp_path):
    """Closed form: centroids average over 9 exposures, the errors of the catalogue do not.

    Where the scatter is larger than quoted, it is by errors of the single measurements.
    """
    posterior = posterior_of(fit, wider=wider)
    found = catalogue_covariance(tmp_path / "c.h5", fit, posterior, matches, catalog)
    draws = with_shared_stars(posterior, fit, found).flat
    phi = MODEL.basis().evaluate(*stars())
    inverse = np.kron(np.eye(2), np.linalg.inv(phi.T @ phi))
    single = wider * (CENTROID**2 + CATALOGUE**2) - CATALOGUE**2
    expected = (single / EXPOSURES + CATALOGUE**2) * inverse
    white = np.linalg.solve(np.linalg.cholesky(expected), (draws - fit.mean).T)
    assert stats.kstest((white**2).sum(axis=0), stats.chi2(len(fit.mean)).cdf).pvalue > 1e-3
    np.testing.assert_allclose(draws.mean(axis=0), posterior.mean, atol=1e-9)


def test_few_draws_keep_what_they_are(fit, matches, catalog, tmp_path):
    """Each draw is moved by one linear map: twenty of twelve parameters are enough."""
    posterior = posterior_of(fit, n=5)
    found = catalogue_covariance(tmp_path / "c.h5", fit, posterior, matches, catalog)
    spread = with_shared_stars(posterior, fit, found)
    a, b = (p.flat - posterior.mean for p in (posterior, spread))
    recolour, *_ = np.linalg.lstsq(a, b)
    np.testing.assert_allclose(a @ recolour, b, atol=1e-12)
    assert spread.hyper is posterior.hyper and spread.theta.shape == posterior.theta.shape


def test_it_is_computed_once_for_a_posterior(fit, matches, catalog, tmp_path, monkeypatch):
    path = tmp_path / "c.h5"
    posterior, other = (posterior_of(fit, n=50, seed=s) for s in (1, 2))
    first = catalogue_covariance(path, fit, posterior, matches, catalog)
    calls = []
    true = systematics.star_covariance
    monkeypatch.setattr(
        systematics, "star_covariance", lambda *a, **k: calls.append(1) or true(*a, **k)
    )
    again = catalogue_covariance(path, fit, posterior, matches, catalog)
    np.testing.assert_array_equal(first.total, again.total)
    np.testing.assert_array_equal(first.counted, again.counted)
    assert not calls
    catalogue_covariance(path, fit, other, matches, catalog)  # sampled again: never a stale one
    assert len(calls) == 1
    path.write_bytes(b"broken")
    catalogue_covariance(path, fit, other, matches, catalog)
    assert len(calls) == 2


def test_without_codes_or_errors_there_is_none(fit, matches, catalog, tmp_path):
    posterior, zero = posterior_of(fit, n=5), np.zeros(STARS)
    exact = replace(catalog, sigma_u=zero, sigma_v=zero)
    bare = replace(catalog, sigma_u=None, sigma_v=None)
    for table, reference in (
        (replace(matches, star=None), catalog),
        (matches, exact),
        (matches, bare),
    ):
        path = tmp_path / "c.h5"
        assert catalogue_covariance(path, fit, posterior, table, reference) is None
        assert not path.exists()


# -- rows of the budget ---------------------------------------------------------------------------


def test_motions_have_a_row_of_their_own_and_count_once(fit, matches, catalog, tmp_path):
    """Positions and motions together are the whole, also when both come from the file."""
    moving = replace(
        catalog,
        pm_u=np.zeros(STARS),
        pm_v=np.zeros(STARS),
        sigma_pm_u=np.full(STARS, 0.01),
        sigma_pm_v=np.full(STARS, 0.01),
        epoch=np.full(STARS, 2005.0),
    )
    # the matches' errors hold those of the catalogue: 0.01 over 2 years is less than the centroid's
    dated = replace(matches, epoch=np.repeat(np.linspace(2004.0, 2006.0, EXPOSURES), STARS))
    posterior = posterior_of(fit, n=50)
    first, kept = (
        catalogue_covariance(tmp_path / "m.h5", fit, posterior, dated, moving) for _ in range(2)
    )
    np.testing.assert_array_equal(first.motions, kept.motions)
    terms = catalogue_terms(posterior, kept, "/somewhere/stars.ecsv")
    assert [t.name for t in terms] == [POSITIONS, MOTIONS]
    np.testing.assert_allclose(sum(t.covariance for t in terms), first.total, atol=1e-15)
    assert np.trace(terms[1].covariance) > 0
    for term, what in zip(terms, ("positions", "proper motions"), strict=True):
        assert term.source.startswith("given by the user: ") and "stars.ecsv" in term.source
        assert f"errors of {what}" in term.source
    still = catalogue_covariance(tmp_path / "s.h5", fit, posterior, matches, catalog)
    again = catalogue_covariance(tmp_path / "s.h5", fit, posterior, matches, catalog)
    assert still.motions is None and again.motions is None
    assert [t.name for t in catalogue_terms(posterior, again, "stars.ecsv")] == [POSITIONS]


@pytest.mark.parametrize("exptime", [30.0, 375.0, 1200.0])
def test_the_scale_changes_while_an_exposure_lasts(exptime):
    """Orbits at any phase: the factor of an instant against that of another in the exposure."""
    rng = np.random.default_rng(4)
    start, at = rng.uniform(0, PERIOD, 200_000), rng.uniform(0, exptime, 200_000)
    factor = [SWING / 2 * np.sin(2 * np.pi * t / PERIOD) for t in (start + at, start + exptime / 2)]
    seen = np.std(np.subtract(*factor))
    # to first order in the exposure's part of an orbit: an arc is longer than its chord
    assert scale_error(exptime) == pytest.approx(seen, rel=0.02 + (exptime / PERIOD) ** 2 * 2)
    assert scale_error(exptime) < scale_error(None) == pytest.approx(np.std(factor[0]), rel=0.01)
