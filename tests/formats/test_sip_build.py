"""SIP headers from solutions, read by astropy.wcs."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.wcs import WCS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from bayesdist.calibration.inverse import FIT_NODES, detector_grid
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import DegenerateError, InputError
from bayesdist.formats.idctab.table import read_idctab
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import sip_header
from bayesdist.formats.sip.header import worst_closure
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.missions.wise.published import WISE_COEFFICIENTS
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.model import Chip, DistortionModel, TimeDependence
from tests.reduced import only_in_full

from .support import StandIn, random_pixels, some_solution, wfc_solution


def astropy_plane(sip, x, y):
    """(xi, eta) in degrees as astropy.wcs has them: its SIP, then wcslib's CD matrix."""
    wcs = WCS(sip_header(sip))
    foc = wcs.sip_pix2foc(np.stack([x, y], axis=1), 1) + wcs.wcs.crpix
    return wcs.wcs.p2s(foc, 1)["imgcrd"].T


def model_plane(solution, sip, x, y, unit_deg, **where):
    """The same from the model."""
    uv = solution.model.predict(solution.mean, x, y, **where)
    return ((uv - sip.offset) * unit_deg).T


@pytest.mark.parametrize("order", range(1, 10))
@pytest.mark.parametrize("linear", ["cd", "sip"])
def test_astropy_maps_pixels_as_the_model_does(order: int, linear: str) -> None:
    solution = some_solution(order, offset=(0.4, -0.3), seed=order)
    sip = sip_from_solution(solution, linear=linear, scale_arcsec=0.1)
    x, y = random_pixels((1200, 900))
    unit_deg = 0.1 / 3600
    got = astropy_plane(sip, x, y)
    expected = model_plane(solution, sip, x, y, unit_deg)
    assert_allclose(got / unit_deg, expected / unit_deg, atol=1e-9, rtol=0)
    assert_allclose(np.stack(sip.plane(x, y)), got, atol=1e-12 * unit_deg * 1e3, rtol=0)


@pytest.mark.parametrize("unit", ["arcsec", "mas", "deg"])
def test_rotated_mirrored_angular_solution(unit: str) -> None:
    pixel = 0.05 / ARCSEC[unit]
    solution = some_solution(
        5, unit=unit, pixel=pixel, angle=2.2, flip=True, offset=(70 * pixel, -31 * pixel)
    )
    sip = sip_from_solution(solution, crval=(150.0, 2.0))
    x, y = random_pixels((1200, 900))
    pixel_deg = 0.05 / 3600
    got = astropy_plane(sip, x, y)
    expected = model_plane(solution, sip, x, y, ARCSEC[unit] / 3600)
    assert_allclose(got / pixel_deg, expected / pixel_deg, atol=1e-9, rtol=0)
    assert sip.offset == pytest.approx((70 * pixel, -31 * pixel), abs=20 * pixel)


def test_sky_of_the_whole_chain() -> None:
    # all_pix2world from the written file: gnomonic projection of the model's own (u, v)
    solution = some_solution(3, unit="arcsec", pixel=1.0, angle=0.3)
    sip = sip_from_solution(solution, crval=(1.0, 0.0))
    x, y = random_pixels((1200, 900), 500)
    ra, dec = WCS(sip_header(sip)).all_pix2world(x, y, 1)
    a, d = np.deg2rad(ra - 1.0), np.deg2rad(dec)
    xi, eta = np.tan(a), np.tan(d) / np.cos(a)  # tangent point on the equator
    expected = model_plane(solution, sip, x, y, np.pi / 180 / 3600)
    assert_allclose(np.stack([xi, eta]), expected, atol=1e-9 * np.pi / 180 / 3600, rtol=0)


def test_epoch_and_chip_are_those_asked_for() -> None:
    chips = (
        Chip(2, "a", (600.0, 500.0), (300.0, 250.0)),
        Chip(5, "b", (600.0, 500.0), (280.0, 250.0)),
    )
    time = TimeDependence((("u", 0, 1), ("v", 2, 0)), (2004.5,), ())
    model = DistortionModel(3, chips, "pix", time)
    theta = np.zeros(model.n_params)
    rng = np.random.default_rng(3)
    for n in (2, 5):
        one = some_solution(3, size=(600.0, 500.0), reference_pixel=model.chips[0].reference_pixel)
        for axis in (0, 1):
            source = one.mean[one.model.coefficient_slice(None, axis)]
            theta[model.coefficient_slice(n, axis)] = source + rng.normal(size=10) * 0.01
        theta[model.tdd_slice(n)] = rng.normal(size=2)
    solution = StandIn(model, theta, np.eye(theta.size) * 1e-6)
    sip = sip_from_solution(solution, chip=5, epoch=2011.25)
    x, y = random_pixels((600, 500))
    got = astropy_plane(sip, x, y) * 3600
    expected = model_plane(solution, sip, x, y, 1.0, chip=5, epoch=2011.25)
    assert_allclose(got, expected, atol=1e-9, rtol=0)
    with pytest.raises(InputError, match="one epoch"):
        sip_from_solution(solution, chip=5)
    with pytest.raises(InputError, match="no chip 3"):
        sip_from_solution(solution, chip=3, epoch=2011.25)


@pytest.mark.slow
@only_in_full("on the sky they are")
@pytest.mark.parametrize("linear", ["cd", "sip"])
def test_sigmas_are_those_of_draws(linear: str) -> None:
    solution = some_solution(3, unit="arcsec", pixel=0.1, angle=0.1)
    names = {"scale_arcsec": 0.1} if linear == "sip" else {}
    sip = sip_from_solution(solution, linear=linear, **names)
    drawn = [
        sip_from_solution(
            StandIn(solution.model, theta, solution.cov), linear=linear, inverse_order=2, **names
        )
        for theta in solution.draws(200, np.random.default_rng(11))
    ]
    n = len(drawn)
    for own, sigma in (("a", sip.sigma_a), ("b", sip.sigma_b)):
        for power, value in sigma.items():
            spread = np.std([getattr(d, own)[power] for d in drawn], ddof=1)
            # the standard deviation of n draws is known to 1 / sqrt(2 n): five of those
            assert spread == pytest.approx(value, rel=5 / np.sqrt(2 * n))


def test_order_one_is_written_as_two_with_zeros() -> None:
    sip = sip_from_solution(some_solution(1, seed=4))
    assert sip.order == (2, 2)
    assert set(sip.a.values()) == {0.0}
    assert WCS(sip_header(sip)).sip is not None  # astropy ignores A_ORDER = 1
    assert sip.dmax == (0.0, 0.0)


# -- the inverse ---------------------------------------------------------------------------------


def test_closure_on_wfc1_is_as_published(data_dir) -> None:
    """facts: 0.070, 0.0067, 7e-4, 7e-5 px for orders 4 to 7, A_DMAX 59 px, on a uniform grid."""
    tab = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    solution = wfc_solution(tab)
    for order, published in ((4, 0.070), (5, 0.0067), (6, 7e-4), (7, 7e-5)):
        sip = sip_from_solution(solution, chip=1, epoch=2004.5, inverse_order=order)
        # nodes that crowd at the edges leave less in the corners, but no miracle
        assert published / 4 < sip.closure <= published * 1.05
    assert sip.a_dmax == pytest.approx(59, abs=0.5)


def test_stated_closure_is_reached_and_not_exceeded() -> None:
    solution = some_solution(5, strength=20.0)
    sip = sip_from_solution(solution)
    assert sip.inverse_order == (6, 6)
    x, y = random_pixels((1199, 899), 40_000)
    back = sip.inverse(*sip.forward(x + 0.5, y + 0.5))
    worst = np.hypot(back[0] - x - 0.5, back[1] - y - 0.5).max()
    assert worst <= sip.closure * 1.01
    corners = np.array([[1, 1200, 1, 1200], [1, 1, 900, 900]], float)
    edge = np.array(sip.inverse(*sip.forward(*corners))) - corners
    assert np.hypot(*edge).max() <= sip.closure
    assert worst_closure(sip, (1200, 900)) == sip.closure


def test_ap_is_what_astropy_reads() -> None:
    # sip_foc2pix is the only place where astropy evaluates AP and BP
    sip = sip_from_solution(some_solution(4))
    wcs = WCS(sip_header(sip))
    x, y = random_pixels((1200, 900), 1000)
    U, V = sip.forward(x, y)
    theirs = wcs.sip_foc2pix(np.stack([U, V], axis=1), 1).T
    ours = np.stack(sip.inverse(U, V))
    assert_allclose(theirs, ours, atol=1e-9, rtol=0)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), order=st.integers(2, 6))
def test_higher_inverse_order_closes_better(seed: int, order: int) -> None:
    """In the mean over the nodes of the fit, as nested least squares must; the worst may not."""
    solution = some_solution(order, seed=seed, strength=4.0)
    x, y = detector_grid(solution.model.chips[0].size, FIT_NODES, chebyshev=True)
    closures = []
    for n in (order, order + 1, order + 2):
        sip = sip_from_solution(solution, inverse_order=n)
        back_x, back_y = sip.inverse(*sip.forward(x, y))
        closures.append(np.sqrt(np.mean((back_x - x) ** 2 + (back_y - y) ** 2)))
        assert sip.closure > closures[-1]
    assert closures[0] > closures[1] > closures[2]


def test_a_folding_distortion_has_no_inverse() -> None:
    model = DistortionModel(2, (Chip(1, "A", (100.0, 100.0), (50.0, 50.0)),))
    monomials = np.zeros((2, 6))
    monomials[0, 1] = monomials[1, 2] = 1.0
    monomials[0, 3] = 0.02  # du/dx = 1 + 0.04 x' changes sign at x' = -25
    theta = model.basis().from_monomials(monomials).ravel()
    with pytest.raises(InputError, match="no inverse"):
        sip_from_solution(StandIn(model, theta, np.eye(12)))


# -- WISE ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("absolute", [True, False])
def test_wise_w2_is_written_as_it_was_published(absolute: bool) -> None:
    """Constant and linear terms in A and B; A_DMAX 2.083 and B_DMAX 1.089 px as printed."""
    model, theta = wise_solution("W2")
    if not absolute:  # offsets from the reference pixel in place of positions
        for axis, ref in enumerate(model.chips[0].reference_pixel):
            theta[model.coefficient_slice(None, axis).start] -= ref
    solution = StandIn(model, theta, np.eye(theta.size) * 1e-8)
    sip = sip_from_solution(solution, linear="sip", scale_arcsec=2.75)
    for terms, published in zip((sip.a, sip.b), WISE_COEFFICIENTS["W2"], strict=True):
        assert tuple(terms) == model.basis().terms
        # seven digits were printed; the constants carry the rounding of a position of 508.5
        assert_allclose(list(terms.values()), published, rtol=1e-9, atol=2e-13)
    assert round(sip.a_dmax, 3) == 2.083
    assert round(sip.b_dmax, 3) == 1.089
    assert sip.offset == (model.chips[0].reference_pixel if absolute else (0.0, 0.0))
    assert sip.inverse_order == (5, 5)


def test_origin_can_be_given() -> None:
    model, theta = wise_solution("W2")
    solution = StandIn(model, theta, np.eye(theta.size) * 1e-8)
    sip = sip_from_solution(solution, linear="sip", origin=(500.0, 510.0))
    x, y = random_pixels((1016, 1016), 100)
    expected = model_plane(solution, sip, x, y, 1 / 3600)
    assert sip.offset == (500.0, 510.0)
    assert_allclose(astropy_plane(sip, x, y) * 3600, expected * 3600, atol=1e-9, rtol=0)


# -- refusals ------------------------------------------------------------------------------------


def test_nominal_scale_is_called_so() -> None:
    solution = some_solution(2)
    nominal = sip_header(sip_from_solution(solution))
    assert any("nominal" in line for line in nominal["COMMENT"])
    told = sip_header(sip_from_solution(solution, scale_arcsec=0.04))
    assert not any("nominal" in line for line in told["COMMENT"])
    assert told["CD1_1"] == pytest.approx(nominal["CD1_1"] * 0.04, rel=1e-14)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"linear": "pc"}, "choose 'cd' or 'sip'"),
        ({"inverse_order": 1}, "inverse order is 1"),
        ({"inverse_order": 10}, "inverse order is 10"),
        ({"scale_arcsec": 0.0}, "positive"),
        ({"scale_arcsec": float("nan")}, "positive"),
    ],
)
def test_wrong_arguments_are_refused(names: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        sip_from_solution(some_solution(3), **names)


def test_sip_mode_refuses_a_rotated_frame() -> None:
    with pytest.raises(InputError, match="choose 'cd'"):
        sip_from_solution(some_solution(3, angle=1.5), linear="sip")


def test_a_singular_linear_part_is_degenerate() -> None:
    solution = some_solution(2)
    theta = solution.mean.copy()
    v, u = (solution.model.coefficient_slice(None, axis) for axis in (1, 0))
    theta[v] = 2 * theta[u]
    with pytest.raises(DegenerateError, match="singular"):
        sip_from_solution(StandIn(solution.model, theta, solution.cov))


def test_our_own_headers_are_clean() -> None:
    for order in (1, 4, 6):
        sip = sip_from_solution(some_solution(order, strength=0.5), scale_arcsec=0.1)
        assert [f for f in lint_sip(sip) if f.level != "note"] == []
