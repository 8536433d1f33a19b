"""SIP headers of stars on the sky, against astropy.wcs: right by themselves, nothing given."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from numpy.testing import assert_allclose

import bayesdist as bd
from bayesdist.errors import InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import read_sip, sip_header, write_sip
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.infer import load_fit, save_fit

from .support import StandIn, astropy_wcs, random_pixels, some_solution

PIXEL = 0.3  # arcsec
SIZE = (1200, 900)
POINTS = {"field": (150.1, 2.2), "ra 0": (0.001, -35.0), "near a pole": (211.0, 89.9)}


def on_the_sky(u, v, point) -> SkyCoord:
    """Sky of (u, v) in arcsec on the plane at a point, by wcslib."""
    plane = WCS(naxis=2)
    plane.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    plane.wcs.crval, plane.wcs.lonpole = point, 180.0
    plane.wcs.cdelt = [1 / 3600, 1 / 3600]
    return SkyCoord(*plane.wcs_pix2world(u, v, 1), unit="deg")


def worst(solution, sip, point) -> float:
    """Largest separation over the detector of header and solution, arcsec."""
    x, y = random_pixels(SIZE, 2000)
    header = SkyCoord(*astropy_wcs(sip_header(sip)).all_pix2world(x, y, 1), unit="deg")
    u, v = solution.model.predict(solution.mean, x, y).T
    return float(header.separation(on_the_sky(u, v, point)).arcsec.max())


@pytest.mark.parametrize(
    ("order", "flip", "place"),
    [(3, flip, place) for flip in (False, True) for place in POINTS]
    + [(order, order == 5, "near a pole") for order in (1, 5, 9)],
)
def test_the_header_is_right_by_itself(order: int, flip: bool, place: str) -> None:
    solution = some_solution(
        order, unit="arcsec", pixel=PIXEL, angle=2.2, flip=flip, offset=(-1.4, 1.3), strength=20.0
    )
    sip = sip_from_solution(solution, tangent_point=POINTS[place])
    assert worst(solution, sip, POINTS[place]) < 2e-5 * PIXEL
    assert sip.crpix == solution.model.chips[0].reference_pixel
    assert sip.order == (max(order, 2),) * 2
    # the distortion of the model itself has either sign of determinant
    assert (np.linalg.det(sip.cd) < 0) == (np.linalg.det(solution_linear(solution)) < 0)
    assert not any(sum(powers) < 2 for powers in sip.a)


def solution_linear(solution) -> np.ndarray:
    x, y = np.array([610.3, 611.3, 610.3]), np.array([444.7, 444.7, 445.7])
    uv = solution.model.predict(solution.mean, x, y)
    return (uv[1:] - uv[0]).T


@pytest.mark.parametrize("pixel", [0.3, 10.0])
def test_a_reference_pixel_far_from_the_tangent_point(pixel: float) -> None:
    """A chip of a mosaic one field away: 3 degrees across, the order is raised where it must."""
    point = (0.0, 60.0)
    solution = some_solution(2, unit="arcsec", pixel=pixel, offset=(900 * pixel, 1200 * pixel))
    sip = sip_from_solution(solution, tangent_point=point)
    assert worst(solution, sip, point) < 2e-5 * pixel
    assert sip.offset == pytest.approx(tuple(solution.model.predict(
        solution.mean, [610.3], [444.7])[0]))  # fmt: skip


@pytest.mark.parametrize("crval", [(0.03, 60.01), (0.0, 60.0), (359.7, 59.9)])
def test_a_given_crval_is_honoured(crval) -> None:
    """On the chip, and off it: CRPIX is where the solution has it."""
    point = (0.0, 60.0)
    solution = some_solution(4, unit="arcsec", pixel=PIXEL, offset=(-1.4, 1.3), strength=2.0)
    sip = sip_from_solution(solution, tangent_point=point, crval=crval)
    assert sip.crval == crval
    assert not any(sum(powers) < 2 for powers in sip.a)
    assert worst(solution, sip, point) < 2e-5 * PIXEL


def test_a_crval_that_no_pixel_has_is_honoured_with_constants() -> None:
    point = (20.0, -10.0)
    solution = some_solution(3, unit="arcsec", pixel=PIXEL, strength=2.0)
    sip = sip_from_solution(solution, tangent_point=point, crval=(21.0, -9.0))
    assert sip.crval == (21.0, -9.0) and (0, 0) in sip.a
    assert worst(solution, sip, point) < 2e-5 * PIXEL
    assert any("stwcs and gwcs drop them" in f.message for f in lint_sip(sip))


def test_constant_and_linear_terms_in_a_and_b() -> None:
    solution = some_solution(4, unit="arcsec", pixel=PIXEL, offset=(-1.4, 1.3), strength=2.0)
    sip = sip_from_solution(solution, linear="sip", tangent_point=(150.1, 2.2))
    assert {(0, 0), (1, 0), (0, 1)} <= set(sip.a)
    assert worst(solution, sip, (150.1, 2.2)) < 2e-5 * PIXEL


def test_a_pole_as_crval_is_turned_as_it_should() -> None:
    solution = some_solution(3, unit="arcsec", pixel=PIXEL, strength=2.0)
    for ra in (0.0, 137.0):
        sip = sip_from_solution(solution, tangent_point=(ra, 89.99), crval=(ra, 90.0))
        assert worst(solution, sip, (ra, 89.99)) < 2e-5 * PIXEL


def test_sigmas_are_those_of_draws_on_the_sky(full: bool) -> None:
    solution = some_solution(3, unit="mas", pixel=100.0, angle=0.1, offset=(3e6, 2e6))
    point = {"tangent_point": (150.0, 30.0)}
    sip = sip_from_solution(solution, **point)
    drawn = [
        sip_from_solution(StandIn(solution.model, theta, solution.cov), inverse_order=2, **point)
        for theta in solution.draws(200 if full else 60, np.random.default_rng(11))
    ]
    assert set(sip.sigma_a) == set(sip.a)
    for own, sigma in (("a", sip.sigma_a), ("b", sip.sigma_b)):
        for power, value in sigma.items():
            spread = np.std([getattr(d, own)[power] for d in drawn], ddof=1)
            assert spread == pytest.approx(value, rel=5 / np.sqrt(2 * len(drawn)))


def test_it_comes_back_from_a_file(tmp_path) -> None:
    solution = some_solution(4, unit="arcsec", pixel=PIXEL)
    sip = sip_from_solution(solution, tangent_point=(150.1, 2.2))
    write_sip(sip, tmp_path / "sip.hdr")
    back = read_sip(tmp_path / "sip.hdr")
    assert_allclose(back.crval, sip.crval, rtol=0, atol=0)
    header = sip_header(back)
    assert (header["BDTAN1"], header["BDTAN2"], header["LONPOLE"]) == (150.1, 2.2, 180.0)


@pytest.mark.parametrize(
    ("unit", "options", "message"),
    [
        ("pix", {}, "tangent point is given together with u, v in pixels"),
        ("arcsec", {"origin": (0.0, 0.0)}, "tangent point is given together with"),
        ("arcsec", {"crval": (200.0, -30.0)}, "90 degrees or more"),
        ("arcsec", {"crval": (20.0, 95.0)}, "not a right ascension and declination"),
        ("arcsec", {"crval": (20.0, float("nan"))}, "not a right ascension and declination"),
    ],
)
def test_what_cannot_be_is_refused(unit, options, message) -> None:
    solution = some_solution(3, unit=unit, pixel=1.0 if unit == "pix" else PIXEL)
    with pytest.raises(InputError, match=message):
        sip_from_solution(solution, tangent_point=(20.0, 30.0), **options)


def test_fit_posterior_and_their_files_know_the_tangent_point(tmp_path):
    """Stars of a TAN header of astropy: the SIP headers of all of them give their positions."""
    rng = np.random.default_rng(43)
    truth = WCS(naxis=2)
    truth.wcs.ctype, truth.wcs.crval = ["RA---TAN", "DEC--TAN"], [202.5, 47.2]
    truth.wcs.crpix, truth.wcs.cd = [480.0, 510.0], [[-4e-5, 3e-6], [3e-6, 4e-5]]
    x, y = rng.uniform(1, 1000, (2, 300))
    sky = truth.pixel_to_world(x - 1, y - 1)
    stars = bd.Matches.from_sky(x, y, sky, sigma=0.001)
    fit = bd.fit_linear(stars, bd.build_model(stars, order=2, size=(1000, 1000)))
    posterior = bd.sample(fit, stars, seed=1, target_ess=100)
    save_fit(fit, tmp_path / "fit.nc")
    bd.save_posterior(posterior, None, tmp_path / "posterior.nc")
    solutions = (fit, posterior, load_fit(tmp_path / "fit.nc"),
                 bd.load_posterior(tmp_path / "posterior.nc"))  # fmt: skip
    for solution in solutions:
        assert solution.tangent_point == stars.tangent_point
        header = sip_header(sip_from_solution(solution))
        found = WCS(header).all_pix2world(x, y, 1)
        off = np.hypot((found[0] - sky.ra.deg) * np.cos(sky.dec.rad), found[1] - sky.dec.deg)
        assert off.max() * 3600 < 1e-3  # as the quoted errors; there is no noise
    plain = bd.Matches(x=x, y=y, u=stars.u, v=stars.v, sigma_u=stars.sigma_u,
                       sigma_v=stars.sigma_v, unit="arcsec")  # fmt: skip
    free = bd.fit_linear(plain, fit.model)
    save_fit(free, tmp_path / "free.nc")
    assert free.tangent_point is None and load_fit(tmp_path / "free.nc").tangent_point is None
    assert sip_from_solution(free).crval == (0.0, 0.0)
