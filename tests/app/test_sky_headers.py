"""Matches with RA and Dec in, a SIP header out that is right on the sky: judged by astropy.wcs.

The truth is a TAN-SIP header of astropy's: it puts stars on the sky, and the header that comes out
is compared with it there.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy import units as apu
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS, FITSFixedWarning, Sip

from tests.app.support import EXACT, begin_stagewise, summary_of, write_config, write_job

SIZE = (2000, 1500)
PIXEL = 0.4  # arcsec
NOISE = 0.02  # arcsec, each axis
N = 600


def camera(crval: tuple[float, float], parity: int, angle: float = 0.7) -> WCS:
    """A TAN-SIP header with 8 px of distortion; parity -1 as the sky is seen, +1 mirrored."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.lonpole = crval, [990.0, 760.0], 180.0
    c, s = np.cos(angle), np.sin(angle)
    wcs.wcs.cd = PIXEL / 3600 * np.array([[c, -s], [s, c]]) @ np.diag([parity, 1])
    a, b = np.zeros((4, 4)), np.zeros((4, 4))
    a[2, 0], a[1, 1], a[3, 0] = 4e-6, -3e-6, 2e-9
    b[0, 2], b[2, 0], b[2, 1] = -5e-6, 2e-6, 3e-9
    wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    return wcs


def stars_of(truth: WCS, rng: np.random.Generator) -> Table:
    x, y = rng.uniform(0.5, np.array(SIZE) + 0.5, (N, 2)).T
    at = SkyCoord(*truth.all_pix2world(x, y, 1), unit="deg")
    east, north = rng.normal(0.0, NOISE, (2, N)) * apu.arcsec
    moved = at.spherical_offsets_by(east, north)
    return Table({"x": x, "y": y, "ra": moved.ra.deg, "dec": moved.dec.deg})


def header_of(run: Path, name: str = "sip.hdr") -> WCS:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        return WCS(fits.Header.fromtextfile(run / name))


def separations(run: Path, truth: WCS, rng: np.random.Generator) -> np.ndarray:
    x, y = rng.uniform(0.5, np.array(SIZE) + 0.5, (1000, 2)).T
    found = SkyCoord(*header_of(run).all_pix2world(x, y, 1), unit="deg")
    return found.separation(SkyCoord(*truth.all_pix2world(x, y, 1), unit="deg")).arcsec


def made(folder: Path, truth: WCS, rng, **sections) -> Path:
    config = write_job(
        folder / "job",
        stars_of(truth, rng),
        **{
            "data": {"matches": "stars.ecsv", "sigma": NOISE},
            "detector": {"size": SIZE},
            "model": {"order": 3},
            "budget": [EXACT],
            "products": {"sip": {}},
        }
        | sections,
    )
    return begin_stagewise(folder / "run", config, "fit", "sample", "assess", "export")


@pytest.mark.parametrize(
    ("crval", "parity"),
    [((83.8, -5.4), -1), ((83.8, -5.4), 1), ((359.999, 41.2), -1), ((211.0, 89.8), 1)],
)
def test_positions_are_those_of_the_truth(crval, parity, tmp_path, rng) -> None:
    truth = camera(crval, parity)
    run = made(tmp_path, truth, rng)
    apart = separations(run, truth, rng)
    # ten coefficients of each axis from 600 stars: 0.02 sqrt(2 x 10 / 600) = 0.0037 arcsec rms
    expected = NOISE * np.sqrt(20 / N)
    assert np.sqrt(np.mean(apart**2)) < 2 * expected
    assert (np.linalg.det(header_of(run).wcs.cd) > 0) == (parity > 0)
    [product] = summary_of(run)["products"]
    sky = product["sky"]
    assert sky["solution_arcsec"] < 1e-5 * PIXEL
    assert sky["rms_arcsec"] == pytest.approx(np.sqrt(2) * NOISE, rel=0.1)
    # the mean of 600 stars, on each axis
    assert np.hypot(sky["mean_east_arcsec"], sky["mean_north_arcsec"]) < 5 * NOISE / np.sqrt(N)
    assert f"{sky['rms_arcsec']:.4g} arcsec rms from RA, Dec of " in (
        run / "bayesdist.log"
    ).read_text()
    assert not [f for f in product["findings"] if not f.startswith("note")]
    # as the budget has it, the file is the solution
    assert product["forward_rms"] < 1e-4 * PIXEL
