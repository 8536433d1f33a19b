"""Covariance and draws of a WCS, and exposures with frames of their own."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy import stats

import bayesdist as bd
from bayesdist.calibration.calibration import calibration_of, calibration_of_exposure
from bayesdist.calibration.plane import Plane
from bayesdist.calibration.sky_positions import sky_positions
from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture, fit_linear
from bayesdist.model import TimeDependence
from bayesdist.utils.arrays import Float

from ..infer.support import CHIP, TWO_CHIPS, posterior_at, simulated, target_of
from .cameras import FURTHER, POINT, camera, pixels

DRAWS = 4000


# -- covariance -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [{}, {"tables": True}, {"chips": 2}, {"drifts": True}])
def test_the_covariance_is_that_of_apply(kind):
    calibration = camera(**kind, further=FURTHER)
    number = calibration.numbers[-1]
    x, y = pixels(30)
    wcs = calibration.wcs(number)
    at = sky_positions(calibration, x + 1, y + 1, number, joint=True)
    cov = wcs.covariance(x, y)
    assert cov.unit == "mas2"
    assert_allclose(cov.value, at.cov, rtol=1e-9)
    assert_allclose(wcs.covariance(x, y, joint=True).value, at.joint, rtol=1e-9, atol=1e-9)
    table = Table({"x": x + 1, "y": y + 1, "chip": np.full(x.shape, number)})
    sky = calibration.to_sky(table, covariance=True)
    assert_allclose(cov[:, 0, 0].value, sky["sigma_ra"].to_value("mas") ** 2, rtol=1e-9)
    assert_allclose(cov[:, 1, 1].value, sky["sigma_dec"].to_value("mas") ** 2, rtol=1e-9)


def test_further_errors_are_in_and_can_be_left_out():
    """On the tangent point they are the squares of their sizes, in mas."""
    wcs = camera(further=FURTHER).wcs()
    at = wcs.world_to_pixel_values(*POINT)
    difference = wcs.covariance(*at) - wcs.covariance(*at, further=False)
    assert_allclose(difference.value, np.diag([3**2 + 1**2, 2**2 + 4**2]), rtol=1e-6, atol=1e-6)
    x, y = pixels(2)
    both = (
        wcs.covariance(x, y, joint=True) - wcs.covariance(x, y, joint=True, further=False)
    ).value
    assert_allclose(np.diag(both[:2, 2:]), [3**2, 2**2], rtol=1e-4)  # what the stars share


def test_the_covariance_turns_with_the_plane():
    free = camera(plane=Plane())
    x, y = pixels(20)
    angle = np.radians(30.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    at_pole_of_plane = free.wcs(point=POINT).covariance(x, y).value
    turned = free.wcs(point=POINT, position_angle=30.0).covariance(x, y).value
    # the tangent plane is flat to 1e-6 over the detector
    assert_allclose(turned, turn @ at_pole_of_plane @ turn.T, rtol=1e-5, atol=1e-4)
    plane = free.wcs().covariance(x, y)
    assert plane.unit == "arcsec2"
    assert_allclose(plane.to_value("mas2"), at_pole_of_plane, rtol=1e-5, atol=1e-4)


# -- draws ----------------------------------------------------------------------------------------


def east_and_north(wcs, drawn, x: Float, y: Float) -> Float:
    """Deviations (n, N, 2) of drawn positions, to the east and north in mas."""
    ra, dec = wcs.pixel_to_world_values(x, y)
    at = np.stack([one.pixel_to_world_values(x, y) for one in drawn])
    return 3.6e6 * np.stack([(at[:, 0] - ra) * np.cos(np.radians(dec)), at[:, 1] - dec], axis=-1)


def assert_covariance(deviations: Float, cov: Float) -> None:
    """Draws (n, m) have this covariance (m, m): a chi-square for each of its directions."""
    n, m = deviations.shape
    values, vectors = np.linalg.eigh(cov)
    keep = values > 1e-6 * values.max()
    scaled = deviations @ vectors[:, keep] / np.sqrt(values[keep])
    p = stats.chi2.cdf((scaled**2).sum(axis=0), n)
    assert np.all((p > 1e-3 / m) & (p < 1 - 1e-3 / m)), p
    product = np.corrcoef(scaled.T) * np.sqrt(n)
    assert np.abs(product[np.triu_indices(keep.sum(), 1)]).max() < 5


@pytest.mark.parametrize("kind", [{}, {"tables": True}])
def test_covariance_and_draws_agree(kind):
    wcs = camera(**kind, further=FURTHER).wcs(position_angle=40.0)
    x, y = np.array([0.0, 1199.0, 600.0, 10.0]), np.array([0.0, 799.0, 300.0, 700.0])
    deviations = east_and_north(wcs, wcs.draw(DRAWS, 5), x, y).reshape(DRAWS, -1)
    cov = wcs.covariance(x, y, joint=True, further=False).value
    assert_covariance(deviations, cov)
    single = wcs.covariance(x, y, further=False).value
    assert_allclose(
        [cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(4)], single, rtol=1e-9
    )


def test_draws_are_plain_and_repeatable():
    wcs = camera().wcs()
    first, again = (wcs.draw(2, seed) for seed in (7, np.random.default_rng(7)))
    for one, same in zip(first, again, strict=True):
        assert one.pixel_to_world_values(3.0, 4.0) == same.pixel_to_world_values(3.0, 4.0)
        back = one.world_to_pixel_values(*one.pixel_to_world_values(3.0, 4.0))
        assert_allclose(back, (3.0, 4.0), atol=1e-9)
        with pytest.raises(InputError, match="has no errors"):
            one.covariance(3.0, 4.0)
    assert wcs.draw(0, 1) == []
    assert "draw 2" in repr(first[1])


# -- exposures ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def campaign():
    """Fit of two chips in three exposures, with drift: frames of shift, scale and rotation."""
    time = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2010.0,))
    model, matches, _ = simulated(
        3,
        1500,
        frames="shift_rotation_scale",
        n_exposures=3,
        chips=TWO_CHIPS,
        time=time,
        epochs=[2009.0, 2010.0, 2011.0],
    )
    return fit_linear(matches, model)


@pytest.mark.parametrize("exposure", ["e1", "e3"])
@pytest.mark.parametrize("number", [1, 2])
def test_the_frame_of_an_exposure_is_folded_in(campaign, exposure, number):
    """The positions and derivatives that the model itself predicts for stars of that exposure."""
    calibration = calibration_of_exposure(campaign, exposure, epoch=2010.7)
    wcs = calibration.wcs(number)
    x, y = pixels(15)
    where = {"epoch": 2010.7, "exposure": exposure, "chip": number}
    at = campaign.model.predict(campaign.mean, x + 1, y + 1, **where)
    assert_allclose(np.stack(wcs.pixel_to_world_values(x, y), axis=1), at, rtol=0, atol=1e-9)
    slope = campaign.model.jacobian(campaign.mean, x + 1, y + 1, **where).reshape(30, -1)
    cov = wcs.covariance(x, y, joint=True).value
    assert_allclose(cov, slope @ campaign.cov @ slope.T, rtol=1e-7, atol=1e-12)
    drawn = wcs.draw(3, 9)
    theta = campaign.draws(3, np.random.default_rng(9))
    for one, vector in zip(drawn, theta, strict=True):
        at = campaign.model.predict(vector, x + 1, y + 1, **where)
        assert_allclose(np.stack(one.pixel_to_world_values(x, y), axis=1), at, rtol=0, atol=1e-9)


def test_without_frames_it_is_the_first_exposure(campaign):
    x, y = pixels(15)
    first = calibration_of_exposure(campaign, "e1", epoch=2010.7).wcs(2)
    bare = calibration_of(campaign).wcs(2, epoch=2010.7)
    assert_allclose(first.pixel_to_world_values(x, y), bare.pixel_to_world_values(x, y), rtol=1e-12)
    assert_allclose(first.covariance(x, y).value, bare.covariance(x, y).value, rtol=1e-9)


def test_an_exposure_that_is_not_there(campaign):
    with pytest.raises(InputError, match=r"no exposure 'e9'.*choose one of e1, e2, e3"):
        calibration_of_exposure(campaign, "e9", epoch=2010.0)
    with pytest.raises(InputError, match=r"no epoch is given.*decimal years"):
        calibration_of_exposure(campaign, "e2")
    _, matches, _ = simulated(3, 100)
    fit = fit_linear(matches, bd.DistortionModel(2, (CHIP,)))
    with pytest.raises(InputError, match="no frames of exposures"):
        calibration_of_exposure(fit, "e1")


def test_the_wcs_of_an_exposure_is_pickled(campaign):
    wcs = calibration_of_exposure(campaign, "e2", epoch=2010.7).wcs(1)
    other = pickle.loads(pickle.dumps(wcs))
    assert other.pixel_to_world_values(3, 4) == wcs.pixel_to_world_values(3, 4)
    assert other.draw(1, 2)[0].pixel_to_world_values(3, 4) == (
        wcs.draw(1, 2)[0].pixel_to_world_values(3, 4)
    )


def test_the_wcs_of_a_posterior_is_pickled_and_drawn_from():
    model, stars, truth = simulated(4, 100)
    target, _ = target_of(model, stars, OutlierMixture("none"))
    rng = np.random.default_rng(3)
    psi = rng.normal(0.0, 0.01, (2000, target.n_theta + 1))
    psi[:, :-1] += truth.theta
    posterior = posterior_at(target, psi)
    wcs = calibration_of(posterior).wcs(point=POINT, pixel_scale=0.05)
    other = pickle.loads(pickle.dumps(wcs))
    x, y = np.array([0.0, 500.0]), np.array([0.0, 400.0])
    assert_allclose(other.covariance(x, y).value, wcs.covariance(x, y).value)
    deviations = east_and_north(wcs, other.draw(2000, 5), x, y).reshape(2000, -1)
    cov = wcs.covariance(x, y, joint=True).value
    assert_allclose(np.diag(np.cov(deviations.T)), np.diag(cov), rtol=5 * np.sqrt(2 / 2000))


def test_a_calibration_keeps_what_is_not_its_solution():
    calibration = replace(camera(chips=2, tables=True, further=FURTHER), filter="F606W")
    wcs = calibration.wcs(2)
    assert wcs.calibration.filter == "F606W" and wcs.calibration.further == FURTHER
    assert {table.chip for table in wcs.calibration.before} == {2}
    assert wcs.chip == 2
