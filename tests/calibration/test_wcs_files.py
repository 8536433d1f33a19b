"""The WCS of calibrations in real files, against other programs on the same file."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from bayesdist.formats.sip.files import sip_header, write_sip
from bayesdist.products import read_calibration

from ..formats.test_tpv import SCAMP_SIZE, scamp_head
from ..real.sip_sets import SIZE, read_sets
from .cameras import apart

pytestmark = pytest.mark.plugins

EXACT = 4 * 3600 * np.spacing(360.0)  # arcsec: rounding of right ascensions


def over(size, seed=1, n=300):
    """Random 0-based pixels, 5 % beyond the edges too."""
    rng = np.random.default_rng(seed)
    return tuple(rng.uniform(-0.05 * s, 1.05 * s, n) for s in size)


def test_sip_headers_of_tess_as_astropy_reads_them(data_dir, tmp_path):
    """One CCD of each order in the file, and every hundredth."""
    sets = read_sets(data_dir / "tess" / "TESS_wcs_data.json.bz2")
    orders = {entry.sip.order: entry for entry in sets}
    x, y = over(SIZE)
    for entry in [*orders.values(), *sets[::200]]:
        write_sip(entry.sip, tmp_path / "tess.hdr")
        wcs = read_calibration(tmp_path / "tess.hdr").wcs()
        at = WCS(sip_header(entry.sip)).pixel_to_world_values(x, y)
        assert wcs.pixel_shape == SIZE
        # pixels of 21 arcsec, with order 9 of some thousand pixels
        assert apart(wcs.pixel_to_world_values(x, y), at) < 1e-8 * 21
        assert_allclose(np.stack(wcs.world_to_pixel_values(*at)), [x, y], rtol=0, atol=1e-8)
        back = wcs.to_fits_sip().pixel_to_world_values(x, y)
        assert apart(back, at) < 1e-8 * 21


def test_a_tpv_mosaic_as_astropy_reads_it(tmp_path):
    path = tmp_path / "scamp.head"
    path.write_text(scamp_head())
    calibration = read_calibration(path, size=SCAMP_SIZE)
    x, y = over(SCAMP_SIZE)
    cards = [text for text in scamp_head().split("END  ") if "CRVAL1" in text]
    for number, text in zip(calibration.numbers, cards, strict=True):
        judge = WCS(fits.Header.fromstring(text[text.index("EQUINOX") :], sep="\n"))
        at = judge.pixel_to_world_values(x, y)
        wcs = calibration.wcs(number)
        assert apart(wcs.pixel_to_world_values(x, y), at) < EXACT
        assert_allclose(np.stack(wcs.world_to_pixel_values(*at)), [x, y], rtol=0, atol=1e-8)
        assert apart(wcs.to_fits_sip().pixel_to_world_values(x, y), at) < 2 * EXACT


@pytest.mark.parametrize("chip", [1, 2])
def test_an_idctab_by_its_columns(chip, data_dir):
    """Arcsec of (x - XREF)^j (y - YREF)^(i - j): CXij and CYij, to a constant for each chip."""
    path = data_dir / "hst_reference" / "0461802ej_idc.fits"
    table = fits.getdata(path, 1)
    [row] = [
        r
        for r in table
        if tuple(r[k] for k in ("DETCHIP", "FILTER1", "FILTER2", "DIRECTION"))
        == (chip, "F606W", "CLEAR2L", "FORWARD")
    ]
    wcs = read_calibration(path, filter="F606W").wcs(chip)
    assert wcs.pixel_shape == (4096, 2048)
    x, y = over(wcs.pixel_shape)
    dx, dy = x + 1 - row["XREF"], y + 1 - row["YREF"]
    order = int(fits.getheader(path)["NORDER"])
    for axis, values in zip("XY", wcs.pixel_to_world_values(x, y), strict=True):
        expected = sum(
            float(row[f"C{axis}{i}{j}"]) * dx**j * dy ** (i - j)
            for i in range(1, order + 1)
            for j in range(i + 1)
        )
        difference = values - expected
        assert_allclose(difference - difference.mean(), 0.0, atol=1e-9)
    assert_allclose(
        np.stack(wcs.world_to_pixel_values(*wcs.pixel_to_world_values(x, y))), [x, y], atol=1e-9
    )
