"""A campaign's posterior with the errors of its catalogue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess.model import with_shared_stars
from bayesdist.assess.terms.parameters import CATALOGUE as POSITIONS
from bayesdist.assess.terms.parameters import MOTIONS, catalogue_terms
from bayesdist.data import Matches, ReferenceCatalog
from bayesdist.data.sky import parallax_factors
from bayesdist.diagnose.diagnostics import catalogue_covariance
from bayesdist.infer import Posterior, Rejection, fit_linear
from bayesdist.infer.stars.likelihood import OutlierMixture
from bayesdist.kinds.campaign.inputs import errors_by_star
from bayesdist.kinds.campaign.matching import PERIOD, SWING, scale_error
from bayesdist.model import Chip, DistortionModel

STARS, EXPOSURES = 60, 9
CENTROID, CATALOGUE = 0.02, 0.05
UNLIMITED = Rejection(1e9, None)
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
    return Matches(x, y, x, y, sigma_u=quoted, sigma_v=quoted, star=code)


@pytest.fixture(scope="module")
def catalog():
    x, y = stars()
    sigma = np.full(STARS, CATALOGUE)
    rows = np.random.default_rng(2).permutation(STARS)  # not in the order of the codes
    return ReferenceCatalog(x[rows], y[rows], sigma, sigma, star=(3 * np.arange(STARS) + 2)[rows])


@pytest.fixture(scope="module")
def fit(matches):
    return fit_linear(matches, MODEL, rejection=UNLIMITED)


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
def test_exposures_do_not_help_against_the_catalogue(wider, fit, matches, catalog):
    """Closed form: centroids average over 9 exposures, the errors of the catalogue do not.

    Where the scatter is larger than quoted, it is by errors of the single measurements.
    """
    posterior = posterior_of(fit, wider=wider)
    found = catalogue_covariance(fit, matches, errors_by_star(catalog))
    draws = with_shared_stars(posterior, fit, found).flat
    phi = MODEL.basis().evaluate(*stars())
    inverse = np.kron(np.eye(2), np.linalg.inv(phi.T @ phi))
    single = wider * (CENTROID**2 + CATALOGUE**2) - CATALOGUE**2
    expected = (single / EXPOSURES + CATALOGUE**2) * inverse
    white = np.linalg.solve(np.linalg.cholesky(expected), (draws - fit.mean).T)
    assert stats.kstest((white**2).sum(axis=0), stats.chi2(len(fit.mean)).cdf).pvalue > 1e-3
    np.testing.assert_allclose(draws.mean(axis=0), posterior.mean, atol=1e-9)


def test_few_draws_keep_what_they_are(fit, matches, catalog):
    """Each draw is moved by one linear map: twenty of twelve parameters are enough."""
    posterior = posterior_of(fit, n=5)
    found = catalogue_covariance(fit, matches, errors_by_star(catalog))
    spread = with_shared_stars(posterior, fit, found)
    a, b = (p.flat - posterior.mean for p in (posterior, spread))
    recolour, *_ = np.linalg.lstsq(a, b)
    np.testing.assert_allclose(a @ recolour, b, atol=1e-12)
    assert spread.hyper is posterior.hyper and spread.theta.shape == posterior.theta.shape


def test_without_codes_or_errors_there_is_none(fit, matches, catalog):
    zero = np.zeros(STARS)
    exact = replace(catalog, sigma_u=zero, sigma_v=zero)
    bare = replace(catalog, sigma_u=None, sigma_v=None)
    assert errors_by_star(exact) is None and errors_by_star(bare) is None
    errors = errors_by_star(catalog)
    assert catalogue_covariance(fit, replace(matches, star=None), errors) is None
    assert catalogue_covariance(fit, matches, None) is None


# -- rows of the budget ---------------------------------------------------------------------------


def test_motions_have_a_row_of_their_own_and_count_once(fit, matches, catalog):
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
    found = catalogue_covariance(fit, dated, errors_by_star(moving))
    terms = catalogue_terms(posterior, found, "stars.ecsv")
    assert [t.name for t in terms] == [POSITIONS, MOTIONS]
    np.testing.assert_allclose(sum(t.covariance for t in terms), found.total, atol=1e-15)
    assert np.trace(terms[1].covariance) > 0
    for term, what in zip(terms, ("positions", "proper motions"), strict=True):
        assert term.source.startswith("given by the user: ") and "stars.ecsv" in term.source
        assert f"errors of {what}" in term.source
    still = catalogue_covariance(fit, matches, errors_by_star(catalog))
    assert still.motions is None
    assert [t.name for t in catalogue_terms(posterior, still, "stars.ecsv")] == [POSITIONS]


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


@pytest.mark.parametrize("mirrored", [False, True])
def test_errors_of_stars_are_those_of_their_positions_with_parallax(rng, mirrored):
    """Of a catalogue with all correlations, at any date."""
    n = 30
    root = rng.standard_normal((n, 5, 5))
    C = root @ np.swapaxes(root, 1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", C))
    names = ("sigma_u", "sigma_v", "sigma_parallax", "sigma_pm_u", "sigma_pm_v")
    zero, point = np.zeros(n), (40.0, -20.0)
    catalog = ReferenceCatalog(
        zero, zero, pm_u=zero, pm_v=zero, parallax=zero, epoch=2016.0, unit="mas",
        tangent_point=point, star=2 * np.arange(n),
        correlations=C / (sigma[:, :, None] * sigma[:, None]),
        **dict(zip(names, sigma.T, strict=True)),
    )  # fmt: skip
    sign = np.array([-1.0 if mirrored else 1.0, 1.0])
    free = catalog.correlations.copy()
    free[:, 2] = free[:, :, 2] = np.eye(5)[2]
    own = C.copy()
    own[:, 2, [0, 1, 3, 4]] = own[:, [0, 1, 3, 4], 2] = 0.0
    none = np.where(np.eye(5), C, 0.0)
    for stars_, expected in (
        (catalog, C),
        (replace(catalog, correlations=free), own),
        (replace(catalog, correlations=None), none),
    ):
        errors = errors_by_star(stars_, mirrored=mirrored)
        for epoch in (2000.0, 2016.0, 2030.5):
            dt, (east, north) = epoch - 2016.0, parallax_factors(epoch, *point)[0]
            A = np.array([[1, 0, east, dt, 0], [0, 1, north, 0, dt]])
            part = errors.covariances_at(catalog.star, np.full(n, epoch))
            np.testing.assert_allclose(part, np.outer(sign, sign) * (A @ expected @ A.T), rtol=1e-9)


def test_exposures_of_one_season_do_not_help_against_parallaxes(matches, catalog):
    """Closed form: the displacement by a parallax is the same in all exposures of a date."""
    sigma, point, epoch = 0.075, (40.0, -20.0), 2005.3
    zero = np.zeros(STARS)
    seen = replace(
        catalog, pm_u=zero, pm_v=zero, sigma_pm_u=zero, sigma_pm_v=zero, parallax=zero,
        sigma_parallax=np.full(STARS, sigma), epoch=epoch, unit="mas", tangent_point=point,
    )  # fmt: skip
    factors = parallax_factors(epoch, *point)[0]
    common = CATALOGUE**2 * np.eye(2) + sigma**2 * np.outer(factors, factors)
    each = np.tile(common + CENTROID**2 * np.eye(2), (len(matches), 1, 1))
    dated = matches.with_columns(epoch=np.full(len(matches), epoch)).with_covariances(each)
    fit = fit_linear(replace(dated, unit="mas"), replace(MODEL, unit="mas"), rejection=UNLIMITED)
    found = catalogue_covariance(fit, replace(dated, unit="mas"), errors_by_star(seen))
    phi = MODEL.basis().evaluate(*stars())
    inverse = np.linalg.inv(phi.T @ phi)
    unit = CATALOGUE**2 * np.abs(inverse).max()
    np.testing.assert_allclose(found.total, np.kron(common, inverse), atol=1e-6 * unit)
    counted = np.kron(common, inverse) / EXPOSURES
    np.testing.assert_allclose(found.counted, counted, atol=1e-6 * unit)
