"""Draws of sky positions against the covariance of `sky_positions`, and what a SkyCoord does."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time
from astropy.uncertainty import Distribution

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import FurtherError
from bayesdist.calibration.plane import Plane
from bayesdist.calibration.sky_positions import sky_distribution, sky_positions
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.model import Chip, DistortionModel

CHIPS = (Chip(1, "S1", (400, 300), (200.5, 150.5)), Chip(2, "S2", (400, 300), (200.5, 150.5)))
N = 5
DRAWS = 20_000


def camera(point=(359.9999, 40.0), further=True):
    rng = np.random.default_rng(1)
    model = DistortionModel(3, CHIPS, "arcsec")
    theta = 0.05 * rng.normal(size=model.n_params)
    for number, offset in ((1, 0.0), (2, 90.0)):
        for axis in (0, 1):
            start = model.coefficient_slice(number, axis).start
            theta[start] = offset * (1 - axis)
            theta[start + 1 + axis] = 0.26 * (200, 150)[axis] * (-1, 1)[axis]
    root = 0.003 * rng.normal(size=(model.n_params, model.n_params)) / np.sqrt(model.n_params)
    errors = (
        FurtherError("catalogue", "systematic", 0.004, 0.003),
        FurtherError("structure", "random", 0.002, 0.002),
    )
    return Calibration(
        "camera",
        GaussianSolution(model, theta, root @ root.T),
        Plane("sky", point=point),
        further=errors if further else (),
    )


@pytest.fixture(scope="module")
def pixels():
    rng = np.random.default_rng(2)
    return rng.uniform(1, 400, N), rng.uniform(1, 300, N), np.array([1, 2, 1, 2, 2])


@pytest.mark.parametrize("point", [(359.9999, 40.0), (120.0, 89.999)])
@pytest.mark.parametrize("further", [True, False])
def test_the_covariance_of_the_draws_is_that_of_the_positions(pixels, point, further):
    x, y, chip = pixels
    calibration, centroids = camera(point, further), (np.full(N, 0.01), np.linspace(0.01, 0.02, N))
    at = sky_positions(calibration, x, y, chip, centroids=centroids, joint=True)
    sky = sky_distribution(
        calibration, x, y, chip=chip, centroids=centroids, n_draws=DRAWS, rng=3
    )  # fmt: skip
    draws = SkyCoord(sky.ra.distribution, sky.dec.distribution)
    assert draws.shape == (N, DRAWS)
    centre = SkyCoord(at.ra * u.deg, at.dec * u.deg)
    east, north = centre[:, None].spherical_offsets_to(draws)
    offsets = np.stack([east.to_value("mas"), north.to_value("mas")], axis=1).reshape(2 * N, -1)
    found, scale = np.cov(offsets), np.sqrt(np.outer(np.diag(at.joint), np.diag(at.joint)))
    # variance of a sample covariance: (S_ii S_jj + S_ij^2) / n
    error = np.sqrt((scale**2 + at.joint**2) / DRAWS)
    assert (np.abs(found - at.joint) < 5 * error).all()
    mean_error = np.sqrt(np.diag(at.joint) / DRAWS)
    assert (np.abs(offsets.mean(axis=1)) < 5 * mean_error).all()
    assert np.abs(at.joint[0, 4]) > 5 * error[0, 4]  # stars of one chip are correlated


def test_a_sky_coordinate_of_distributions_works(pixels):
    x, y, chip = pixels
    calibration = camera()
    sky = sky_distribution(calibration, x, y, chip=chip, n_draws=4000, rng=1)
    sigma = sky_positions(calibration, x, y, chip).sigma
    assert isinstance(sky, SkyCoord) and isinstance(sky.ra, Distribution) and sky.shape == (N,)
    assert sky.ra.n_samples == 4000
    np.testing.assert_allclose(sky.dec.pdf_std().to_value("mas"), sigma[1], rtol=0.06)
    cos = np.cos(sky.dec.pdf_mean())
    np.testing.assert_allclose((sky.ra.pdf_std() * cos).to_value("mas"), sigma[0], rtol=0.06)
    # the other frames and separations from a fixed point, too
    total = np.hypot(*sigma)
    galactic = sky.galactic
    spread = np.hypot(galactic.l.pdf_std() * np.cos(galactic.b.pdf_mean()), galactic.b.pdf_std())
    np.testing.assert_allclose(spread.to_value("mas"), total, rtol=0.06)
    pole = SkyCoord(0 * u.deg, 90 * u.deg)
    np.testing.assert_allclose(sky.separation(pole).pdf_std().to_value("mas"), sigma[1], rtol=0.06)


def test_seeds_and_units(pixels):
    x, y, chip = pixels
    calibration = camera(point=(30.0, 5.0))
    first = sky_distribution(calibration, x, y, chip=chip, n_draws=10, rng=1)
    again = sky_distribution(
        calibration, x * u.pix, y * u.pix, chip=chip, n_draws=10, rng=np.random.default_rng(1),
        point=SkyCoord(2 * u.hourangle, 300 * u.arcmin), epoch=Time("2020-01-01"),
    )  # fmt: skip
    np.testing.assert_allclose(
        first.ra.distribution.deg, again.ra.distribution.deg, rtol=0, atol=1e-11
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"n_draws": 1}, "n_draws is 1; give a whole number of 2 or more"),
        ({"rng": 1.5}, "rng is 1.5, which is neither a seed nor a generator"),
        ({"chip": None}, "camera: has 2 chips, but none is given; give chip, one of 1, 2"),
        ({"x": np.ones(N) * u.deg}, "x is given in deg, which cannot be converted to pix"),
        ({"point": 3.0}, "point is 3.0, which is not a direction; give a SkyCoord"),
    ],
)
def test_wrong_input_is_one_sentence(pixels, change, says):
    x, y, chip = pixels
    given = {"x": x, "y": y, "chip": chip, "n_draws": 10, "rng": 1} | change
    with pytest.raises(InputError, match=says):
        sky_distribution(camera(), given.pop("x"), given.pop("y"), **given)
