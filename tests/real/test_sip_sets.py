"""1728 real SIP solutions at mixed orders, and the WISE headers, against astropy.wcs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy import stats

from bayesdist.calibration.inverse import detector_grid, fit_inverse
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import read_sip, sip_header, write_sip
from bayesdist.formats.sip.header import worst_closure
from bayesdist.missions.wise.rotate import pixel_matrix, rotated_sip
from bayesdist.missions.wise.simulate import wise_solution
from tests.reduced import only_in_full

from ..formats.support import StandIn, astropy_wcs, random_pixels
from ..missions.wise.test_rotate import moved_pixels
from .sip_sets import LAST_MEASURED, SIZE, Set, curved, read_sets

EXACT = 1e-9  # px
TURNS = [(turn, mirror) for mirror in (False, True) for turn in (0, 90, 180, 270)]


@pytest.fixture(scope="module")
def sets(data_dir) -> list[Set]:
    return read_sets(data_dir / "tess" / "TESS_wcs_data.json.bz2")


def by_astropy(one: Set, x, y) -> np.ndarray:
    return one.astropy.pix2foc(np.stack([x, y], axis=1), 1).T


# -- TESS -----------------------------------------------------------------------------------------


def test_all_orders_are_there(sets) -> None:
    """What a count of A_ORDER in the file gives."""
    assert len(sets) == 16 * 108
    orders, counts = np.unique([one.sip.order[0] for one in sets], return_counts=True)
    assert dict(zip(orders.tolist(), counts.tolist(), strict=True)) == {
        4: 1640, 5: 79, 6: 7, 7: 1, 9: 1}  # fmt: skip


def test_orders_are_those_of_the_other_file(sets, data_dir) -> None:
    table = Table.read(data_dir / "tess" / "tess_sector_linear_sip.csv")
    stated = {(r["sector"], r["cam"], r["ccd"]): (r["order"], r["a11"], r["b20"]) for r in table}
    for one in sets:
        order, a11, b20 = stated[(one.sector, *one.ccd)]
        assert one.sip.order == (order, order)
        assert_allclose((one.sip.a[1, 1], one.sip.b[2, 0]), (a11, b20), rtol=1e-12)


def test_both_directions_are_those_of_astropy(sets) -> None:
    x, y = random_pixels(SIZE, 100)
    for one in sets:
        U, V = one.sip.forward(x, y)
        assert_allclose(np.stack([U, V]), by_astropy(one, x, y), atol=EXACT, rtol=0)
        back = one.astropy.foc2pix(np.stack([U, V], axis=1), 1).T
        assert_allclose(np.stack(one.sip.inverse(U, V)), back, atol=EXACT, rtol=0)


def test_written_headers_come_back_and_astropy_reads_them(sets, tmp_path, full) -> None:
    """All sets, or one in twenty-five and the odd orders."""
    x, y = random_pixels(SIZE, 100)
    path = tmp_path / "tess.hdr"
    for number, one in enumerate(sets):
        if not full and number % 25 and one.sip.order[0] <= 5:
            continue
        write_sip(one.sip, path)
        back = read_sip(path)
        for name in ("crpix", "crval", "ctype", "order", "a", "b", "inverse_order", "ap", "bp",
                     "size"):  # fmt: skip
            assert getattr(back, name) == getattr(one.sip, name), name
        assert np.array_equal(back.cd, one.sip.cd)
        if number % 25 == 0 or one.sip.order[0] > 5:
            read = astropy_wcs(sip_header(back))
            found = read.sip_pix2foc(np.stack([x, y], axis=1), 1).T
            assert_allclose(found, by_astropy(one, x, y), atol=EXACT, rtol=0)


@pytest.mark.slow
@only_in_full("tests/missions/wise/test_rotate turns headers")
def test_turned_headers_agree_with_astropy_at_turned_pixels(sets, full) -> None:
    """All sets, or one in twenty-five, each in one of the eight orientations; some in all."""
    x, y = random_pixels(SIZE, 50)
    for number, one in enumerate(sets):
        whole = (one.sector == 13 and full) or one.sip.order[0] > 5
        if not full and number % 25 and not whole:
            continue
        before = by_astropy(one, x, y)
        if whole:
            sky = astropy_wcs(sip_header(one.sip)).all_pix2world(x, y, 1)
        for k, (turn, mirror) in enumerate(TURNS):
            if not whole and k != number % len(TURNS):
                continue
            turned = rotated_sip(one.sip, turn, mirror=mirror)
            at = moved_pixels(x, y, SIZE, turn, mirror)
            expected = pixel_matrix(turn, mirror=mirror) @ before
            assert_allclose(np.stack(turned.forward(*at)), expected, atol=EXACT, rtol=0)
            if whole:
                after = astropy_wcs(sip_header(turned))
                found = after.sip_pix2foc(np.stack(at, axis=1), 1).T
                assert_allclose(found, expected, atol=EXACT, rtol=0)
                assert_allclose(after.all_pix2world(*at, 1), sky, atol=1e-13 * 360, rtol=0)


def test_no_stated_inverse_beats_a_fitted_one_of_its_order(sets, full) -> None:
    """Least squares over the same pixels; and one order more closes better."""
    x, y = detector_grid(SIZE, 65, chebyshev=True)
    for one in sets:
        if one.sector % (12 if full else 48) and one.sip.order[0] < 6:
            continue
        sip = one.sip
        order = max(sip.inverse_order)
        fits = [fit_inverse(sip.forward, sip.crpix, SIZE, n) for n in (order, min(order + 1, 9))]
        mended = [
            replace(sip, inverse_order=(n, n), ap=ap, bp=bp)
            for n, (ap, bp) in zip((order, min(order + 1, 9)), fits, strict=True)
        ]

        def rms(header) -> float:
            U, V = header.forward(x, y)
            bx, by = header.inverse(U, V)
            return float(np.sqrt(np.mean((bx - x) ** 2 + (by - y) ** 2)))

        assert rms(mended[0]) <= rms(sip) * (1 + 1e-9)
        if order < 9:
            assert worst_closure(mended[1], SIZE) < worst_closure(sip, SIZE)


def test_every_sector_knows_its_ccd(sets) -> None:
    """A CCD's curvature in one sector is nearest to that CCD's mean in the others, of 16.

    The four cameras are alike, and their CCDs stand head to head: half of the 16 share a curvature
    but for some hundredths of a pixel, and a sector must tell them apart by these.
    """
    measured = [one for one in sets if one.sector <= LAST_MEASURED]
    names = sorted({one.ccd for one in measured})
    field = np.array([[curved(one) for one in measured if one.ccd == name] for name in names])
    n = field.shape[1]
    assert n == LAST_MEASURED
    mean = field.mean(axis=1)
    right = 0
    for k in range(len(names)):
        for sector in range(n):
            others = mean.copy()
            others[k] = (n * mean[k] - field[k, sector]) / (n - 1)
            nearest = ((others - field[k, sector]) ** 2).sum(axis=(1, 2)).argmin()
            assert nearest % 2 == k % 2, (names[k], sector + 1)
            right += nearest == k
    assert stats.binomtest(right, n * len(names), 1 / 8, "greater").pvalue < 1e-9


def test_decam_s_series_holds_no_polynomial(data_dir) -> None:
    """Affine terms only, so nothing of it is SIP."""
    names = set(Table.read(data_dir / "des_affine" / "affine_41ccd.fits").colnames)
    assert names == {"x0", "y0", "mag", "e1", "e2", "rot", "sig0", "sigmag", "sigrot", "mjd",
                     "detpos"}  # fmt: skip


# -- WISE -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["hdr", "fits"])
@pytest.mark.parametrize("band", ["W1", "W2", "W3", "W4"])
def test_astropy_reads_written_wise_headers(band: str, suffix: str, tmp_path) -> None:
    """Constant and linear terms included: pixels and sky as the published model has them."""
    model, theta = wise_solution(band)
    solution = StandIn(model, theta, np.eye(theta.size) * 1e-8)
    path = tmp_path / f"{band}.{suffix}"
    scale = 5.5 if band == "W4" else 2.75
    write_sip(sip_from_solution(solution, linear="sip", scale_arcsec=scale), path)
    sip = read_sip(path)
    low = {f"{p}_{i}_{j}" for p in "AB" for i, j in ((0, 0), (1, 0), (0, 1))}
    header = sip_header(sip)
    assert all(header[keyword] != 0 for keyword in low)
    x, y = random_pixels(model.chips[0].size)
    wcs = astropy_wcs(header)
    expected = model.predict(theta, x, y) - sip.offset
    corrected = wcs.sip_pix2foc(np.stack([x, y], axis=1), 1)
    assert_allclose(corrected, expected, atol=EXACT, rtol=0)
    plane = wcs.wcs.p2s(corrected + wcs.wcs.crpix, 1)["imgcrd"] * 3600 / scale
    assert_allclose(plane, expected, atol=EXACT, rtol=0)
