"""The WCS in other packages: those that use it as it is, and objects that are made from it."""

from __future__ import annotations

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales
from numpy.testing import assert_allclose

from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError

from .cameras import PIXEL, POINT, SIZE, apart, camera, pixels
from .test_wcs import folded

pytestmark = pytest.mark.plugins

LIMIT = 1e-8  # pixels


@pytest.fixture(scope="module")
def wcs():
    """An image turned by 30 degrees, with look-up tables."""
    return camera(tables=True).wcs(position_angle=30.0)


# -- made from it ---------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [POINT, (350.0, 60.0), (10.0, 89.99)])
@pytest.mark.parametrize("tables", [False, True])
def test_gwcs_has_the_same_pixels_and_sky(point, tables):
    pytest.importorskip("gwcs")
    wcs = camera(tables=tables).wcs(point=point, position_angle=20.0)
    other = wcs.to_gwcs()
    x, y = pixels(500)
    ra, dec = other.pixel_to_world_values(x, y)
    assert apart(wcs.pixel_to_world_values(x, y), (ra, dec)) < LIMIT * PIXEL
    assert_allclose(np.stack(other.world_to_pixel_values(ra, dec)), [x, y], rtol=0, atol=LIMIT)
    assert other.pixel_to_world(3, 4).separation(wcs.pixel_to_world(3, 4)).arcsec < LIMIT * PIXEL
    assert other.world_axis_physical_types == wcs.world_axis_physical_types
    assert other.array_shape == wcs.array_shape
    other.bounding_box = wcs.bounding_box
    assert np.isnan(other.pixel_to_world_values(-300.0, 4.0)).all()


def test_gwcs_with_a_fitted_inverse_is_written_and_read(tmp_path):
    asdf = pytest.importorskip("asdf")
    pytest.importorskip("gwcs")
    calibration = replace(camera(tables=True), after=())
    wcs = calibration.wcs()
    asdf.AsdfFile({"wcs": wcs.to_gwcs(inverse_order=7)}).write_to(tmp_path / "wcs.asdf")
    x, y = pixels(500, beyond=0.0)
    with asdf.open(tmp_path / "wcs.asdf") as file:
        other = file["wcs"]
        ra, dec = other.pixel_to_world_values(x, y)
        back = np.stack(other.world_to_pixel_values(ra, dec))
    assert apart(wcs.pixel_to_world_values(x, y), (ra, dec)) < LIMIT * PIXEL
    assert_allclose(back, [x, y], rtol=0, atol=1e-4)
    with pytest.raises(InputError, match="after its polynomial"):
        camera(tables=True).wcs().to_gwcs(inverse_order=7)


def test_gwcs_of_a_plane():
    pytest.importorskip("gwcs")
    wcs = camera(plane=Plane()).wcs()
    other = wcs.to_gwcs()
    x, y = pixels(500)
    assert_allclose(other.pixel_to_world_values(x, y), wcs.pixel_to_world_values(x, y), atol=1e-9)
    assert other.world_axis_physical_types == wcs.world_axis_physical_types
    assert_allclose(other.world_to_pixel(*wcs.pixel_to_world(3.0, 4.0)), (3.0, 4.0), atol=LIMIT)


@pytest.mark.parametrize("on_sky", [True, False])
def test_the_model_of_astropy_goes_both_ways(on_sky):
    calibration = camera(tables=True, plane=None if on_sky else Plane())
    model = calibration.to_model()
    x, y = (one.reshape(50, 10) for one in pixels(500))
    values = calibration.wcs().pixel_to_world_values(x, y)
    assert_allclose(model(x, y), values, rtol=0, atol=LIMIT * PIXEL / (3600 if on_sky else 1))
    assert_allclose(model.inverse(*values), (x, y), rtol=0, atol=LIMIT)
    assert_allclose(model.inverse.inverse(x, y), values, rtol=1e-12)
    assert {"Polynomial2D", "Tabular2D"} < {
        type(part).__name__ for part in model.traverse_postorder()
    }
    assert_allclose(model.copy()(3.0, 4.0), model(3.0, 4.0))


def test_a_model_of_a_chip_at_a_point():
    calibration = camera(chips=2, plane=Plane(), drifts=True)
    sky = {"point": POINT, "position_angle": 12.0}
    model = calibration.to_model(2, epoch=2017.0, **sky)
    wcs = calibration.wcs(2, epoch=2017.0, **sky)
    assert_allclose(model(3.0, 4.0), wcs.pixel_to_world_values(3.0, 4.0), rtol=1e-12)


@pytest.mark.parametrize("order", [1, 2, 5, 9])
@pytest.mark.parametrize(
    "sky", [{}, {"point": (350.0, 60.0), "position_angle": 100.0, "mirrored": True}]
)
def test_a_polynomial_is_exact_in_sip(order, sky):
    wcs = camera(order=order).wcs(**sky)
    other = wcs.to_fits_sip()
    assert isinstance(other, WCS) and other.array_shape == wcs.array_shape
    again = WCS(other.to_header(relax=True))
    x, y = pixels(500)
    for judge in (other, again):
        at = judge.pixel_to_world_values(x, y)
        assert apart(wcs.pixel_to_world_values(x, y), at) < LIMIT * PIXEL
        back = np.stack(wcs.world_to_pixel_values(*at))
        assert_allclose(back, [x, y], rtol=0, atol=LIMIT)
        assert_allclose(judge.world_to_pixel_values(*at), back, rtol=0, atol=1e-5)  # its iteration
    assert other.world_axis_physical_types == list(wcs.world_axis_physical_types)


def test_u_and_v_in_pixels_are_exact_in_sip():
    wcs = camera(unit="pix", plane=Plane()).wcs(point=POINT, pixel_scale=PIXEL)
    x, y = pixels(500)
    at = wcs.to_fits_sip().pixel_to_world_values(x, y)
    assert apart(wcs.pixel_to_world_values(x, y), at) < LIMIT * PIXEL


def test_what_sip_cannot_hold_is_fitted_as_well_as_it_says(wcs):
    with pytest.raises(InputError, match="look-up tables") as refused:
        wcs.to_fits_sip()
    words = str(refused.value)
    worst = float(words.split("by up to ")[1].split()[0])
    limit = float(words.split("max_residual=")[1].split()[0])
    assert worst <= limit <= 1.2 * worst
    other = wcs.to_fits_sip(max_residual=limit)
    x, y = pixels(5000, beyond=0.0)
    largest = apart(wcs.pixel_to_world_values(x, y), other.pixel_to_world_values(x, y)) / PIXEL
    assert 0.3 * worst < largest < 1.1 * worst
    tenth = camera(order=10).wcs()
    with pytest.raises(InputError, match="above order 9"):
        tenth.to_fits_sip()
    found = tenth.to_fits_sip(max_residual=1.0).pixel_to_world_values(x, y)
    assert apart(tenth.pixel_to_world_values(x, y), found) < 0.1 * PIXEL


def test_a_plane_without_sky_has_no_sip_header():
    with pytest.raises(InputError, match="give the argument point"):
        folded().wcs().to_fits_sip()


# -- photutils ------------------------------------------------------------------------------------


def test_photutils_brings_apertures_to_the_sky_and_back(wcs):
    aperture = pytest.importorskip("photutils.aperture")
    x, y = pixels(5, beyond=0.0)
    circle = aperture.CircularAperture(np.stack([x, y], axis=1), r=3.0)
    sky = circle.to_sky(wcs)
    assert sky.positions.separation(wcs.pixel_to_world(x, y)).arcsec.max() < 1e-9
    assert_allclose(sky.r.to_value("arcsec"), 3.0 * PIXEL, rtol=0.05)
    assert_allclose(sky.to_pixel(wcs).positions, circle.positions, atol=1e-7)


def test_photutils_measures_positions_of_sources(wcs):
    segmentation = pytest.importorskip("photutils.segmentation")
    rows, columns = np.mgrid[: wcs.array_shape[0], : wcs.array_shape[1]]
    stars = np.array([[100.3, 200.7], [1000.1, 640.4]])
    image = sum(np.exp(-((columns - a) ** 2 + (rows - b) ** 2) / 8) for a, b in stars)
    found = segmentation.SourceCatalog(
        image, segmentation.detect_sources(image, 1e-3, n_pixels=5), wcs=wcs
    )
    sky = found.sky_centroid
    at = wcs.pixel_to_world(found.x_centroid, found.y_centroid)
    assert sky.separation(at).arcsec.max() < 1e-9
    assert sky.separation(wcs.pixel_to_world(*stars.T)).arcsec.max() < 0.01 * PIXEL


# -- reproject ------------------------------------------------------------------------------------


def test_reproject_brings_an_image_to_a_plain_wcs(wcs):
    """A linear function of the sky: bilinear interpolation in a nearly linear image is exact."""
    reproject = pytest.importorskip("reproject")
    rows, columns = np.mgrid[: wcs.array_shape[0], : wcs.array_shape[1]]
    ra, dec = wcs.pixel_to_world_values(columns, rows)
    plain = WCS(naxis=2)
    plain.wcs.ctype = "RA---TAN", "DEC--TAN"
    plain.wcs.crval, plain.wcs.crpix = POINT, (51.0, 51.0)
    plain.wcs.cdelt = -PIXEL / 3600, PIXEL / 3600
    wanted_ra, wanted_dec = plain.array_index_to_world_values(*np.mgrid[:101, :101])
    for values, wanted in ((ra, wanted_ra), (dec, wanted_dec)):
        image, footprint = reproject.reproject_interp((values, wcs), plain, shape_out=(101, 101))
        assert footprint.all()
        assert 3600 * np.abs(image - wanted).max() < 0.05 * PIXEL  # kinks of the tables


# -- regions --------------------------------------------------------------------------------------


def test_regions_go_to_the_sky_and_back(wcs):
    regions = pytest.importorskip("regions")
    point = regions.PointPixelRegion(regions.PixCoord(100.0, 50.0))
    sky = point.to_sky(wcs)
    assert sky.center.separation(wcs.pixel_to_world(100.0, 50.0)).arcsec < 1e-9
    back = sky.to_pixel(wcs)
    assert_allclose((back.center.x, back.center.y), (100.0, 50.0), atol=1e-7)
    polygon = regions.PolygonSkyRegion(wcs.pixel_to_world([10, 60, 35], [10, 12, 50])).to_pixel(wcs)
    assert_allclose(polygon.vertices.x, [10, 60, 35], atol=1e-7)
    circle = regions.CircleSkyRegion(wcs.pixel_to_world(400.0, 300.0), 10 * u.arcsec).to_pixel(wcs)
    assert circle.radius == pytest.approx(10 / PIXEL, rel=0.05)


# -- ndcube, NDData, axes -------------------------------------------------------------------------


def test_ndcube_slices_it(wcs):
    ndcube = pytest.importorskip("ndcube")
    cube = ndcube.NDCube(np.zeros(wcs.array_shape), wcs=wcs)
    part = cube[100:200, 300:500]
    assert_allclose(
        part.wcs.low_level_wcs.pixel_to_world_values(1.0, 2.0),
        wcs.pixel_to_world_values(301.0, 102.0),
    )
    corners = [wcs.pixel_to_world(30.0, 40.0)], [wcs.pixel_to_world(90.0, 130.0)]
    cropped = cube.crop(*corners)
    assert min(cropped.data.shape) > 30 and max(cropped.data.shape) < 200
    centres = part.axis_world_coords()[0]
    assert centres.shape == (100, 200)
    assert centres[2, 1].separation(wcs.pixel_to_world(301, 102)).arcsec < 1e-9


def test_nddata_carries_it(wcs):
    data = NDData(np.zeros(wcs.array_shape), wcs=wcs)
    assert data.wcs.pixel_to_world_values(3, 4) == wcs.pixel_to_world_values(3, 4)


def test_axes_are_drawn_with_it(wcs):
    import matplotlib.pyplot as plt

    figure = plt.figure()
    axes = figure.add_subplot(projection=wcs)
    axes.imshow(np.zeros(wcs.array_shape))
    ra, dec = wcs.pixel_to_world_values(600.0, 400.0)
    axes.plot(ra, dec, "o", transform=axes.get_transform("world"))
    axes.coords.grid()
    figure.canvas.draw()
    shown = axes.lines[0].get_transform().transform([(ra, dec)])
    assert_allclose(shown, axes.transData.transform([(600.0, 400.0)]), atol=1e-3)
    plt.close(figure)


def test_pixel_scales_are_those_of_the_sip_header():
    wcs = camera().wcs()
    scales = proj_plane_pixel_scales(wcs.to_fits_sip()) * 3600
    text = repr(wcs)
    stated = [float(t) for t in text.split("pixel     ")[1].split(" arcsec")[0].split(" x ")]
    assert_allclose(stated, scales, rtol=0.01)
    centre = SkyCoord(*wcs.pixel_to_world_values((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2), unit="deg")
    assert f"RA {centre.ra.deg:.7f}" in text
