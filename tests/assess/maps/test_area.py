import numpy as np
import pytest
from astropy.io import fits

from bayesdist.assess import area_map
from bayesdist.errors import InputError


def area_by_differences(solution, theta, x, y, h=0.5, **where):
    def predict(dx, dy):
        return solution.model.predict(theta, x + dx, y + dy, **where)

    ux, vx = ((predict(h, 0) - predict(-h, 0)) / (2 * h)).T
    uy, vy = ((predict(0, h) - predict(0, -h)) / (2 * h)).T
    return np.abs(ux * vy - uy * vx)


@pytest.fixture
def cubic(from_monomials):
    rng = np.random.default_rng(2)
    u = {(1, 0): 0.98, (0, 1): 0.05, (2, 0): 3e-6, (1, 1): 8e-6, (0, 3): 2e-10}
    v = {(1, 0): -0.04, (0, 1): -1.02, (0, 2): 7e-6, (2, 1): -5e-10}
    a = rng.normal(size=(20, 20))
    return from_monomials(
        u,
        v,
        order=3,
        size=(4096.0, 2048.0),
        reference_pixel=(2000.0, 1100.0),
        cov=1e-4 * a @ a.T,
    )


def test_area_is_that_of_a_pixel_mapped_by_the_model(cubic):
    m = area_map(cubic, grid=(7, 5))
    X, Y = np.meshgrid(m.x, m.y)
    xr, yr = 2000.0, 1100.0
    # central differences over one pixel err by h^2 u''' / 6, 1e-10 here
    area = area_by_differences(cubic, cubic.mean, X.ravel(), Y.ravel())
    reference = area_by_differences(cubic, cubic.mean, np.array([xr]), np.array([yr]))
    np.testing.assert_allclose(m.area.ravel(), area / reference, rtol=1e-8)
    assert m.reference_area == pytest.approx(reference[0], rel=1e-8)
    assert m.reference_area == pytest.approx(0.98 * 1.02 - 0.05 * 0.04, rel=1e-10)


def test_sigma_is_the_scatter_of_areas(cubic):
    m = area_map(cubic, grid=(4, 3))
    n = 500
    X, Y = (a.ravel() for a in np.meshgrid(m.x, m.y))
    areas = []
    for theta in cubic.draws(n, np.random.default_rng(5)):
        both = area_by_differences(cubic, theta, np.append(X, 2000.0), np.append(Y, 1100.0))
        areas.append(both[:-1] / both[-1])
    np.testing.assert_allclose(m.sigma.ravel(), np.std(areas, axis=0), rtol=5 / np.sqrt(2 * n))


def test_a_linear_solution_has_equal_pixels_whatever_its_errors(from_monomials):
    a = np.random.default_rng(1).normal(size=(6, 6))
    s = from_monomials(
        {(1, 0): 0.05, (0, 1): 0.01},
        {(1, 0): 0.01, (0, 1): -0.05},
        order=1,
        size=(100.0, 80.0),
        reference_pixel=(50.0, 40.0),
        unit="arcsec",
        cov=1e-3 * a @ a.T,
    )
    m = area_map(s, grid=(5, 5))
    np.testing.assert_allclose(m.area, 1.0, rtol=1e-12)
    np.testing.assert_allclose(m.sigma, 0.0, atol=1e-7)
    assert m.reference_area == pytest.approx(0.0026, rel=1e-12) and m.unit == "arcsec"


def test_the_reference_pixel_is_the_unit(from_monomials):
    a = np.random.default_rng(4).normal(size=(20, 20))
    s = from_monomials(
        {(1, 0): 1.0, (2, 0): 1e-4, (1, 2): 1e-6},
        {(0, 1): 1.0, (1, 1): 2e-4},
        order=3,
        size=(101.0, 81.0),
        reference_pixel=(51.0, 41.0),
        cov=1e-6 * a @ a.T,
    )
    m = area_map(s, grid=(3, 3))
    assert m.area[1, 1] == pytest.approx(1.0, rel=1e-12)
    assert m.sigma[1, 1] < 1e-9 < 1e-6 < m.sigma[0, 0]


@pytest.mark.parametrize("exposure", [None, "b", "d"])
def test_the_map_serves_every_exposure(rich, exposure):
    """A frame is linear: it changes all areas alike."""
    where = dict(epoch=2010.0, chip=2)
    m = area_map(rich, grid=(5, 4), **where)
    X, Y = (np.append(a, r) for a, r in zip(np.meshgrid(m.x, m.y), (2100.0, 900.0), strict=True))
    area = area_by_differences(rich, rich.mean, X, Y, exposure=exposure, **where)
    np.testing.assert_allclose(m.area.ravel(), area[:-1] / area[-1], rtol=1e-7)
    assert (m.epoch, m.chip) == (2010.0, 2)


def test_a_collapsed_solution_is_refused(from_monomials):
    s = from_monomials(
        {(1, 0): 1.0}, {(1, 0): 1.0}, order=1, size=(64.0, 64.0), reference_pixel=(32.0, 32.0)
    )
    with pytest.raises(InputError, match="area is zero at the reference pixel"):
        area_map(s)


@pytest.mark.parametrize("name", ["qbu1641sj", "0461802ej"])
def test_acs_wfc_pixels_vary_as_the_handbook_says(data_dir, from_monomials, name):
    """Handbook 4.1.4: "from 0.89 to 1.08 times the central value", over both chips of the WFC."""
    table = fits.getdata(data_dir / "hst_reference" / f"{name}_idc.fits", 1)
    areas = {}
    for number in (1, 2):
        row = next(
            r for r in table if r["DETCHIP"] == number and r["DIRECTION"].strip() == "FORWARD"
        )
        order = max(int(c[2]) for c in table.names if c[:2] == "CX" and c[2:].isdigit())
        # CXij multiplies x^j y^(i-j)
        u, v = (
            {
                (j, i - j): float(row[f"{c}{i}{j}"])
                for i in range(1, order + 1)
                for j in range(i + 1)
            }
            for c in ("CX", "CY")
        )
        size = (4096.0, 2048.0)
        reference = (float(row["XREF"]), float(row["YREF"]))
        s = from_monomials(u, v, order=order, size=size, reference_pixel=reference, unit="arcsec")
        m = area_map(s, grid=(65, 33))
        areas[number] = m.area * m.reference_area
    central = areas[1][0, 32]  # WFC1 lies above WFC2: the middle of its lowest row
    both = np.stack(list(areas.values())) / central
    assert (round(both.min(), 2), round(both.max(), 2)) == (0.89, 1.08)
