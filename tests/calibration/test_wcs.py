"""The WCS of a calibration: positions, pixels, the interface of APE 14, and wrong input."""

from __future__ import annotations

import copy
import doctest
import pickle
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from astropy.wcs import WCS
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS, SlicedLowLevelWCS
from astropy.wcs.wcsapi.high_level_api import (
    high_level_objects_to_values,
    values_to_high_level_objects,
)
from astropy.wcs.wcsapi.low_level_api import validate_physical_types
from numpy.polynomial import polynomial
from numpy.testing import assert_allclose, assert_array_equal

import bayesdist as bd
from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.plane import Plane
from bayesdist.calibration.wcs import CalibrationWCS
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis

from .cameras import PIXEL, POINT, SIZE, apart, camera, pixels

LIMIT = 1e-9  # pixels
EXACT = 4 * 3600 * np.spacing(360.0)  # arcsec: rounding of right ascensions
APERTURE = Plane("aperture", v2v3=(80.0, -490.0), v3_angle=35.0, parity=-1)
CAMERAS = {
    "polynomial": {},
    "high order": {"order": 9},
    "look-up tables": {"tables": True},
    "drift": {"drifts": True},
}


def tangent(point=POINT) -> WCS:
    """Judge of the projection: astropy.wcs with xi and eta in arcsec as its pixels."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = "RA---TAN", "DEC--TAN"
    wcs.wcs.crval = point
    wcs.wcs.crpix = 0.0, 0.0
    wcs.wcs.cdelt = 1 / 3600, 1 / 3600
    wcs.wcs.set()
    return wcs


def plane_by_hand(calibration: Calibration, number: int, x, y) -> np.ndarray:
    """Position (2, N) at 0-based pixels, from the coefficients of powers of pixel offsets."""
    poly = calibration.chip(number, origin="stated").monomials()
    x0, y0 = poly.basis.reference_pixel
    matrix = np.zeros((2, poly.basis.order + 1, poly.basis.order + 1))
    for (i, j), value in zip(poly.terms, poly.values.T, strict=True):
        matrix[:, i, j] = value
    at = x + 1 - x0, y + 1 - y0
    return np.stack([polynomial.polyval2d(*at, c) for c in matrix])


# -- positions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("point", [POINT, (359.999, -60.0), (10.0, 89.99)])
def test_a_position_is_the_polynomial_in_the_tangent_plane(number, point):
    calibration = camera(chips=2)
    x, y = pixels()
    xi, eta = plane_by_hand(calibration, number, x, y)
    found = calibration.wcs(number, point=point).pixel_to_world_values(x, y)
    assert apart(found, tangent(point).all_pix2world(xi, eta, 1)) < EXACT


def test_pixels_are_counted_from_zero_and_tables_are_in():
    calibration = camera(tables=True, plane=Plane())
    x, y = pixels()
    found = calibration.wcs().pixel_to_world_values(x, y)
    at = calibration.forward(x + 1, y + 1, chip=1)
    assert_allclose(np.stack(found, axis=1), at, rtol=0, atol=1e-12)
    plain = replace(calibration, before=(), after=()).forward(x + 1, y + 1, chip=1)
    assert np.abs(at - plain).max() > 0.1 * PIXEL


def test_the_epoch_moves_positions_as_the_drift_says():
    calibration = camera(drifts=True, plane=Plane())
    x, y = pixels()
    early, late = (
        np.stack(calibration.wcs(epoch=date).pixel_to_world_values(x, y))
        for date in (2015.0, Time("2017-07-02T12:00:00", scale="tt"))
    )
    model = calibration.model
    rate = calibration.solution.mean[model.tdd_slice(1)]
    x0, y0 = model.chips[0].reference_pixel
    scaled = np.stack([(x + 1 - x0) / (SIZE[0] / 2), (y + 1 - y0) / (SIZE[1] / 2)])
    assert_allclose(late - early, 2.5 * rate[:, None] * scaled, rtol=0, atol=1e-6)
    assert_array_equal(early, calibration.wcs().pixel_to_world_values(x, y))  # the reference date


# -- and back -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("on_sky", [True, False])
def test_pixels_come_back_also_beyond_the_detector(kind, on_sky):
    calibration = camera(**CAMERAS[kind], plane=None if on_sky else Plane())
    wcs = calibration.wcs()
    x, y = pixels(5000)
    back = wcs.world_to_pixel_values(*wcs.pixel_to_world_values(x, y))
    assert np.hypot(back[0] - x, back[1] - y).max() < LIMIT


def test_pixels_come_back_to_the_rounding_of_degrees():
    """A double of 350 degrees has 2e-10 arcsec."""
    wcs = camera().wcs(point=(350.0, 60.0))
    x, y = pixels(5000)
    back = wcs.world_to_pixel_values(*wcs.pixel_to_world_values(x, y))
    rounding = 3600 * np.spacing(350.0) / PIXEL
    assert np.hypot(back[0] - x, back[1] - y).max() < LIMIT + 2 * rounding


def test_the_other_side_of_the_sky_has_no_pixels():
    wcs = camera().wcs()
    ra, dec = np.array([POINT[0] + 180, POINT[0] + 91, POINT[0], np.nan]), [-0.3, 0.0, -89.9, 0.0]
    assert np.isnan(wcs.world_to_pixel_values(ra, dec)).all()


def folded() -> Calibration:
    """u = X - X^2 / 2400 from the left edge of 1000 columns: no u above 600, which X = 1200 has."""
    basis = PolynomialBasis(2, (1000.0, 1000.0), (0.5, 0.5))
    monomials = np.zeros((2, 6))
    monomials[0, [1, 3]] = 1.0, -1 / 2400
    monomials[1, 2] = 1.0
    chip_map = ChipMap("folded", basis, "pix", basis.from_monomials(monomials))
    return calibration_of_maps({1: chip_map}, "folded", plane=Plane("detector"))


def test_beyond_a_fold_is_no_pixel_and_never_a_wrong_one():
    wcs = folded().wcs()
    X = np.linspace(0.0, 1190.0, 200)
    x, _ = wcs.world_to_pixel_values(X - X**2 / 2400, 500.0)
    assert_allclose(x + 0.5, X, rtol=0, atol=1e-6)
    x, y = wcs.world_to_pixel_values(np.linspace(600.1, 3000.0, 500), 500.0)
    assert np.isnan(x).all() and np.isnan(y).all()
    u_, v_ = np.meshgrid(np.linspace(-2000.0, 2000.0, 101), np.linspace(-2000.0, 2000.0, 11))
    x, y = wcs.world_to_pixel_values(u_, v_)
    seen = np.isfinite(x)
    again = wcs.pixel_to_world_values(x[seen], y[seen])
    assert seen.any() and (x[seen] < 1199.5).all()
    assert_array_equal(wcs.to_model().inverse(u_, v_), (x, y))
    assert_allclose(np.stack(again), np.stack([u_[seen], v_[seen]]), rtol=0, atol=1e-8)


# -- shapes and objects ---------------------------------------------------------------------------


def test_positions_have_any_shape():
    wcs = camera().wcs()
    number = wcs.pixel_to_world_values(3, 4)
    assert [np.ndim(one) for one in number] == [0, 0]
    assert [np.shape(one) for one in wcs.world_to_pixel_values(*number)] == [(), ()]
    row, column = np.arange(5.0), np.arange(3.0)[:, None]
    ra, dec = wcs.pixel_to_world_values(row, column)
    assert ra.shape == dec.shape == (3, 5)
    assert (ra[2, 4], dec[2, 4]) == pytest.approx(wcs.pixel_to_world_values(4, 2), rel=1e-15)
    assert wcs.pixel_to_world_values([], [])[0].shape == (0,)
    assert wcs.covariance(row, column).shape == (3, 5, 2, 2)
    assert wcs.covariance(1.0, 2.0).shape == (2, 2)
    assert wcs.covariance(row, column, joint=True).shape == (30, 30)
    assert np.isnan(wcs.pixel_to_world_values([np.nan, 1.0], [1.0, np.nan])).all()


def test_objects_on_the_sky():
    wcs = camera().wcs()
    x, y = pixels(20)
    sky = wcs.pixel_to_world(x, y)
    assert isinstance(sky, SkyCoord) and sky.frame.name == "icrs"
    for frame in ("icrs", "galactic", "fk5"):
        back = wcs.world_to_pixel(sky.transform_to(frame))
        assert_allclose(np.stack(back), np.stack([x, y]), rtol=0, atol=1e-7)
    row, column = wcs.world_to_array_index(wcs.pixel_to_world(7.2, 30.9))
    assert (row, column) == (31, 7)
    assert sky[0].separation(wcs.array_index_to_world(y[0], x[0])).arcsec < 1e-9


def test_objects_on_a_plane():
    wcs = camera(plane=Plane()).wcs()
    u_, v_ = wcs.pixel_to_world(10.0, 20.0)
    assert u_.unit == v_.unit == u.arcsec
    assert_allclose(wcs.world_to_pixel(u_.to(u.deg), v_.to(u.mas)), (10.0, 20.0), atol=1e-8)
    pix = camera(unit="pix", plane=Plane("detector")).wcs()
    assert pix.pixel_to_world(10.0, 20.0)[0].unit == u.pix


@pytest.mark.parametrize("plane", [None, Plane()])
def test_the_interface_describes_the_axes(plane):
    wcs = camera(plane=plane).wcs()
    assert isinstance(wcs, BaseLowLevelWCS) and isinstance(wcs, BaseHighLevelWCS)
    assert wcs.low_level_wcs is wcs
    validate_physical_types(wcs.world_axis_physical_types)
    for unit in wcs.world_axis_units:
        u.Unit(unit, format="vounit")
    assert (wcs.pixel_n_dim, wcs.world_n_dim) == (2, 2)
    assert len(wcs.pixel_axis_names) == len(wcs.world_axis_names) == 2
    assert wcs.array_shape == wcs.pixel_shape[::-1] == (800, 1200)
    assert wcs.pixel_bounds == ((-0.5, 1199.5), (-0.5, 799.5))
    assert wcs.axis_correlation_matrix.all() and not wcs.serialized_classes
    values = wcs.pixel_to_world_values(5.0, 6.0)
    objects = values_to_high_level_objects(*values, low_level_wcs=wcs)
    assert_allclose(high_level_objects_to_values(*objects, low_level_wcs=wcs), values, rtol=1e-14)


def test_a_slice_is_the_same_wcs():
    wcs = camera().wcs()
    part = SlicedLowLevelWCS(wcs, np.s_[100:200, 30:])
    assert_allclose(part.pixel_to_world_values(4.0, 5.0), wcs.pixel_to_world_values(34.0, 105.0))
    assert part.array_shape == (100, 1170)
    row = SlicedLowLevelWCS(wcs, np.s_[100, :])
    assert row.pixel_n_dim == 1 and row.world_n_dim == 2


@pytest.mark.parametrize("kind", CAMERAS)
def test_it_is_pickled_and_copied(kind):
    wcs = camera(**CAMERAS[kind]).wcs()
    x, y = pixels(10)
    for other in (pickle.loads(pickle.dumps(wcs)), copy.copy(wcs), copy.deepcopy(wcs)):
        assert_array_equal(other.pixel_to_world_values(x, y), wcs.pixel_to_world_values(x, y))
        drawn, same = (one.draw(1, 3)[0].pixel_to_world_values(x, y) for one in (other, wcs))
        assert_array_equal(drawn, same)
        assert repr(other) == repr(wcs)


def test_the_example_of_its_docstring_runs():
    [example] = doctest.DocTestFinder(recurse=False).find(
        CalibrationWCS, "CalibrationWCS", globs={"bd": bd, "np": np}
    )
    written = []
    assert example.examples
    assert not doctest.DocTestRunner(verbose=False).run(example, out=written.append).failed, written


def test_it_describes_itself():
    text = repr(camera().wcs())
    assert "'camera', chip 1, 1200 x 800 pixels" in text
    assert "parity as on the sky" in text and "ICRS" in text and "mas at the centre" in text
    assert "mirror image" in repr(camera().wcs(mirrored=True))
    plane = repr(camera(plane=Plane()).wcs())
    assert "not on the sky" in plane and "arcsec at the centre" in plane
    assert "not known" in repr(replace(camera(), errors="none").wcs())


# -- on the sky by a point ------------------------------------------------------------------------


def test_a_point_puts_a_plane_on_the_sky():
    calibration = camera(plane=Plane())
    x, y = pixels(50)
    of_plane = camera().wcs().pixel_to_world_values(x, y)
    for point in (POINT, SkyCoord(*POINT, unit="deg"), tuple(POINT * u.deg)):
        assert_array_equal(calibration.wcs(point=point).pixel_to_world_values(x, y), of_plane)


def test_a_stated_pixel_is_the_scale_of_pixels():
    calibration = camera(unit="pix", plane=Plane("detector"))
    x, y = pixels(50)
    given = calibration.wcs(point=POINT, pixel_scale=PIXEL).pixel_to_world_values(x, y)
    stated = replace(calibration, pixel_mas=1000 * PIXEL).wcs(point=POINT)
    assert_array_equal(stated.pixel_to_world_values(x, y), given)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("angle", [0.0, 30.0, 200.0])
def test_the_position_angle_is_that_of_v(angle, mirrored):
    """By the position angles of SkyCoord, of small steps along v and u from the tangent point."""
    wcs = camera(unit="pix", plane=Plane("detector")).wcs(
        point=(40.0, -50.0),
        position_angle=angle * u.deg,
        mirrored=mirrored,
        pixel_scale=200 * u.mas,
    )
    pixels_of = wcs.chip_map.pixels(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))[0] - 1
    centre, along_v, along_u = wcs.pixel_to_world(*pixels_of)
    right = angle - 90 if mirrored else angle + 90
    for end, expected in ((along_v, angle), (along_u, right)):
        difference = (centre.position_angle(end).deg - expected + 180) % 360 - 180
        assert abs(difference) < 1e-4
        assert centre.separation(end).arcsec == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("pa_v3", [0.0, 75.0])
def test_an_aperture_lies_as_pysiaf_says(pa_v3):
    """By its attitude matrix: V2, V3 are spherical, and a plane here, with second-order errors."""
    rotations = pytest.importorskip("pysiaf.utils.rotations")
    calibration = camera(plane=APERTURE)
    wcs = calibration.wcs(point=(120.0, 40.0), position_angle=pa_v3)
    x, y = pixels(50)
    at = calibration.forward(x + 1, y + 1, chip=1).T
    v2, v3 = np.array(APERTURE.v2v3)[:, None] + APERTURE.to_v2v3 @ at
    ra, dec = rotations.pointing(rotations.attitude(*APERTURE.v2v3, 120.0, 40.0, pa_v3), v2, v3)
    far, radian = np.hypot(*at).max(), np.degrees(3600)
    limit = far**2 * (np.hypot(*APERTURE.v2v3) + far) / radian**2
    assert apart(wcs.pixel_to_world_values(x, y), (ra, dec)) < limit < 1e-3


# -- wrong input ----------------------------------------------------------------------------------


def test_what_is_missing_is_asked_for():
    two = camera(chips=2)
    with pytest.raises(InputError, match=r"2 chips.*give chip, one of 1, 2"):
        two.wcs()
    with pytest.raises(InputError, match=r"no chip 7.*one of 1, 2"):
        two.wcs(7)
    undated = replace(camera(drifts=True), reference_date=None)
    with pytest.raises(InputError, match="no date is given"):
        undated.wcs()
    with pytest.raises(InputError, match=r"aperture.*position_angle"):
        camera(plane=APERTURE).wcs(point=POINT)
    with pytest.raises(InputError, match="pixel_scale"):
        camera(unit="pix", plane=Plane()).wcs(point=POINT)
    with pytest.raises(InputError, match="give the point"):
        camera(plane=Plane()).wcs(position_angle=3.0)
    with pytest.raises(InputError, match="pixel_scale"):
        camera(unit="pix", plane=Plane()).wcs(point=POINT, pixel_scale=0.0)


def test_what_makes_no_sense_is_refused():
    with pytest.raises(InputError, match="cannot be converted to arcsec"):
        camera(unit="pix", plane=Plane()).wcs(point=POINT, pixel_scale=3 * u.s)
    with pytest.raises(InputError, match="not a direction"):
        camera().wcs(point=(10.0, 120.0))
    with pytest.raises(InputError, match="not a year"):
        camera().wcs(epoch=57000.0)
    exact = replace(camera(), errors="none").wcs()
    for asked in (lambda: exact.covariance(1, 1), lambda: exact.draw(3, 1)):
        with pytest.raises(InputError, match=r"has no .*errors"):
            asked()
    with pytest.raises(InputError, match="neither a seed nor a generator"):
        camera().wcs().draw(3, "seed")
    for scale in (-0.2, 0.0, np.nan):
        with pytest.raises(InputError, match="pixel_scale is"):
            camera().wcs(pixel_scale=scale)
    for distance in (-1, np.nan):
        with pytest.raises(InputError, match=r"max_residual is .*in pixels, 0 or more"):
            camera().wcs().to_fits_sip(max_residual=distance)
    for order in (0, "4", 2.5, True):
        with pytest.raises(InputError, match="order of the inverse is"):
            camera().wcs().to_gwcs(inverse_order=order)
    for n in ("a", 2.5, None):
        with pytest.raises(InputError, match="number of draws"):
            camera().wcs().draw(n)
    with pytest.raises(InputError, match="number of draws"):
        camera().wcs().draw(-1, 3)
