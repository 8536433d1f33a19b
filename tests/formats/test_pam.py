"""Pixel area maps against finite differences, stwcs, and the spread of draws."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.assess import area_map
from bayesdist.calibration.apply import Subarray, subarray_at_corner
from bayesdist.calibration.area import pixel_area_map, pixel_areas
from bayesdist.calibration.calibration import calibration_of
from bayesdist.errors import InputError
from bayesdist.formats.idctab.format import idctab_calibration
from bayesdist.formats.idctab.table import read_idctab
from bayesdist.products.maps_file import write_pam

from .acs_offline import Pointing, corrected
from .support import F606W, some_solution

SCALE = 0.05


@pytest.fixture(scope="module")
def table(data_dir):
    return data_dir / "hst_reference" / "0461802ej_idc.fits"


@pytest.fixture(scope="module")
def chips(table):
    return idctab_calibration(read_idctab(table), "F606W,CLEAR2L").in_frame()


@pytest.fixture(scope="module")
def maps(chips):
    return {n: pixel_area_map(c, SCALE) for n, c in chips.items()}


def test_areas_of_the_real_table_are_its_jacobian(table, maps):
    """Central differences of the table's own polynomials at some thousand pixels of both chips."""
    tab = read_idctab(table)
    rng = np.random.default_rng(8)
    x, y = rng.integers(1, 4097, 2000), rng.integers(1, 2049, 2000)
    h = 0.5
    for chip, one in maps.items():
        assert one.area.shape == (2048, 4096) and one.sigma is None and one.chip == chip
        ends = [
            np.stack(tab.evaluate(chip, x + dx, y + dy, filter=F606W))
            for dx, dy in ((h, 0), (-h, 0), (0, h), (0, -h))
        ]
        (xx, yx), (xy, yy) = ends[0] - ends[1], ends[2] - ends[3]
        wanted = (xx * yy - xy * yx) / SCALE**2
        # what is left is the third derivative: 1e-9 of the slope
        assert_allclose(one.area[y - 1, x - 1], wanted, rtol=5e-9)


def test_areas_on_the_sky_are_those_of_stwcs(table, tmp_path):
    """Corners of pixels taken to the sky, at a date, in units of IDCSCALE squared."""
    pointing = Pointing("2012-04-11", (5.66, -72.07), 31.0)
    at_date = idctab_calibration(read_idctab(table), "F606W,CLEAR2L").in_frame(pointing.epoch)
    rng = np.random.default_rng(2)
    x, y = rng.integers(1, 4097, 300), rng.integers(1, 2049, 300)
    for chip, wcs in corrected(tmp_path, "exposure", pointing, idctab=table).items():
        one = pixel_area_map(at_date[chip], SCALE)
        corners = []
        for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
            sky = wcs.all_pix2world(np.stack([x + dx, y + dy], axis=1), 1)
            ra, dec = np.deg2rad(sky - [5.66, 0.0]).T
            corners.append([ra * np.cos(dec), dec])
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = np.array(corners)
        area = np.abs((cx - ax) * (dy - by) - (dx - bx) * (cy - ay)) / 2
        area *= np.rad2deg(3600.0) ** 2
        # cos(dec) varies by 1e-9 within a pixel; plane and sphere differ by 1e-6 over the field
        assert_allclose(one.area[y - 1, x - 1] * SCALE**2, area, rtol=1e-5)


def test_errors_are_the_spread_of_draws():
    """Determinants of 4000 draws: standard deviations within five of their errors."""
    s = some_solution(4, unit="arcsec", pixel=0.05, size=(60.0, 40.0), reference_pixel=(30.0, 20.0))
    one = pixel_area_map(calibration_of(s, "made up").chip(origin="stated"), SCALE)
    basis, theta = s.model.basis(), s.draws(4000, np.random.default_rng(6))
    x, y = np.array([1.0, 60.0, 33.0]), np.array([40.0, 5.0, 21.0])
    by_x, by_y = basis.gradient(x, y)
    u, v = (theta[:, s.model.coefficient_slice(None, axis)] for axis in (0, 1))
    areas = ((u @ by_x.T) * (v @ by_y.T) - (u @ by_y.T) * (v @ by_x.T)) / SCALE**2
    found = one.sigma[y.astype(int) - 1, x.astype(int) - 1]
    assert_allclose(found, areas.std(axis=0), rtol=5 / np.sqrt(2 * 4000))
    assert_allclose(one.sigma_magnitude, 1.0857362 * one.sigma / one.area, rtol=1e-6)
    assert_allclose(one.magnitude, -2.5 * np.log10(one.area))


@pytest.mark.parametrize("order", [1, 3, 9])
def test_exact_at_every_order(order):
    """Values and errors by nodes are those at the pixels themselves."""
    from bayesdist.calibration.area import determinant

    s = some_solution(order, size=(50.0, 30.0), reference_pixel=(20.0, 20.0))
    c = calibration_of(s, "made up").chip(origin="stated")
    x, y = np.array([1.0, 17.5, 50.0]), np.array([1.0, 30.0])
    area, sigma = pixel_areas(c, x, y)
    X, Y = (a.ravel() for a in np.meshgrid(x, y))
    det, d = determinant(c.basis, c.coefficients, X, Y)
    assert_allclose(area.ravel(), np.abs(det), rtol=1e-11)
    wanted = np.sqrt(np.einsum("nk,kl,nl->n", d, c.cov, d))
    assert_allclose(sigma.ravel(), wanted, rtol=1e-8)


def test_relative_to_the_zero_point_it_is_the_map_of_the_assessment():
    s = some_solution(3, size=(64.0, 48.0), reference_pixel=(30.0, 20.0))
    theirs = area_map(s, grid=(64, 48))
    ours = pixel_area_map(calibration_of(s, "made up").chip(origin="stated"), 1.0)
    assert_allclose(ours.area / ours.area[19, 29], theirs.area, rtol=1e-12)


def test_a_mirrored_detector_has_areas_too():
    plain, flipped = (some_solution(3, flip=flip, size=(64.0, 48.0)) for flip in (False, True))
    a, b = (
        pixel_area_map(calibration_of(s, "made up").chip(origin="stated"), 1.0)
        for s in (plain, flipped)
    )
    assert a.area.min() > 0 and b.area.min() > 0


def test_subarrays_are_cut_from_the_whole(chips, maps):
    part = Subarray((-1000.0, -300.0), size=(256, 128))
    one = pixel_area_map(chips[1], SCALE, image=part)
    assert_allclose(one.area, maps[1].area[300:428, 1000:1256], rtol=1e-12)
    binned = pixel_area_map(chips[1], SCALE, image=Subarray((0.25, 0.25), (0.5, 0.5), (100, 50)))
    four = maps[1].area[:100, :200].reshape(50, 2, 100, 2).mean(axis=(1, 3))
    assert_allclose(binned.area, four, rtol=1e-6)
    with pytest.raises(InputError, match="size of the subarray"):
        pixel_area_map(chips[1], SCALE, image=subarray_at_corner(10, 10))
    with pytest.raises(InputError, match="has 4096 x 2048 pixels"):
        pixel_area_map(chips[1], SCALE, image=Subarray((-4000.0, 0.0), size=(256, 256)))
    with pytest.raises(InputError, match="the scale is 0"):
        pixel_area_map(chips[1], 0.0)


def test_files_of_one_chip_and_of_two(tmp_path, chips):
    part = Subarray((-10.0, -20.0), size=(40, 30))
    maps = [pixel_area_map(chips[n], SCALE, image=part) for n in (2, 1)]
    write_pam(tmp_path / "two.fits", maps, instrument="ACS", detector="WFC", source="a_idc.fits")
    with fits.open(tmp_path / "two.fits", checksum=True) as hdus:
        assert [(h.name, h.ver) for h in hdus[1:]] == [("SCI", 1), ("SCI", 2)]
        assert [h.header["CCDCHIP"] for h in hdus[1:]] == [2, 1]
        assert hdus[0].header["DETECTOR"] == "WFC" and hdus[1].header["PAMSCALE"] == SCALE
        assert (hdus[1].header["LTV1"], hdus[1].header["LTV2"]) == (-10.0, -20.0)
        assert_allclose(hdus["SCI", 2].data, maps[1].area, rtol=1e-7)
    s = some_solution(2, size=(30.0, 20.0), reference_pixel=(15.0, 10.0))
    one = pixel_area_map(calibration_of(s, "made up").chip(origin="stated"), 1.0)
    write_pam(tmp_path / "one.fits", [one])
    with fits.open(tmp_path / "one.fits") as hdus:
        assert_allclose(hdus[0].data, one.area, rtol=1e-7)
        assert hdus[0].data.dtype.name == "float32" and hdus[0].header["CCDCHIP"] == 1
        assert [h.name for h in hdus[1:]] == ["ERR"]
        assert_allclose(hdus["ERR"].data, one.sigma, rtol=1e-6)
    with pytest.raises(InputError, match="no map"):
        write_pam(tmp_path / "none.fits", [])
    assert not (tmp_path / "none.fits").exists()
