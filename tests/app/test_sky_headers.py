"""Matches with RA and Dec in, a SIP header out that is right on the sky: judged by astropy.wcs.

The truth is a TAN-SIP header of astropy's: it puts stars on the sky, and the header that comes out
is compared with it there.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as apu
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.wcs import WCS, FITSFixedWarning, Sip
from astropy.wcs.utils import fit_wcs_from_points

from bayesdist.formats.tpv import tpv_of
from bayesdist.products import read_calibration
from bayesdist.products.common.content import read_content
from tests.app.support import EXACT, good, partly_run, summary_of, write_config, write_job
from tests.reduced import case_in_full, only_in_full

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


def headers_of(run: Path) -> list[dict]:
    """Entries of summary.json on the SIP headers of a run."""
    return [p for p in summary_of(run)["products"] if p["path"].endswith(".hdr")]


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
    return partly_run(folder / "run", config, "fit", "sample", "assess", "export")


@pytest.mark.parametrize(
    ("crval", "parity"),
    [
        case_in_full((83.8, -5.4), -1, instead="harder places are run"),
        case_in_full((83.8, -5.4), 1, instead="harder places are run"),
        case_in_full((359.999, 41.2), -1, instead="a harder place is run"),
        ((211.0, 89.8), 1),
    ],
)
def test_positions_are_those_of_the_truth(crval, parity, tmp_path, rng) -> None:
    truth = camera(crval, parity)
    run = made(tmp_path, truth, rng)
    apart = separations(run, truth, rng)
    # ten coefficients of each axis from 600 stars: 0.02 sqrt(2 x 10 / 600) = 0.0037 arcsec rms
    expected = NOISE * np.sqrt(20 / N)
    assert np.sqrt(np.mean(apart**2)) < 2 * expected
    assert (np.linalg.det(header_of(run).wcs.cd) > 0) == (parity > 0)
    [product] = headers_of(run)
    sky = product["sky"]
    assert sky["solution_arcsec"] < 1e-5 * PIXEL
    assert sky["rms_arcsec"] == pytest.approx(np.sqrt(2) * NOISE, rel=0.1)
    # the mean of 600 stars, on each axis
    assert np.hypot(sky["mean_east_arcsec"], sky["mean_north_arcsec"]) < 5 * NOISE / np.sqrt(N)
    assert (
        f"{sky['rms_arcsec']:.4g} arcsec rms from RA, Dec of "
        in (run / "bayesdist.log").read_text()
    )
    assert not [f for f in product["findings"] if not f.startswith("note")]
    # as the budget has it, the file is the solution
    assert product["forward_rms"] < 1e-4 * PIXEL


@pytest.mark.slow
@only_in_full("tests/formats/test_write_calibration compares them with astropy")
def test_headers_of_other_kinds_are_on_the_sky_of_the_truth(tmp_path, rng) -> None:
    """TPV and CPDIS by astropy.wcs; each has its own error, and the total with it."""
    truth = camera((83.8, -5.4), -1)
    run = made(tmp_path, truth, rng, products={"tpv": {}, "ast": {}, "cpdis": {"step": 50.0}})
    x, y = rng.uniform(0.5, np.array(SIZE) + 0.5, (1000, 2)).T
    true = SkyCoord(*truth.all_pix2world(x, y, 1), unit="deg")
    [head] = tpv_of(read_content(run / "tpv.head")).heads
    with fits.open(run / "cpdis.fits") as hdus, warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        by_file = {"tpv": WCS(head.header), "cpdis": WCS(hdus["SCI"].header, hdus)}
    for wcs in by_file.values():
        apart = SkyCoord(*wcs.all_pix2world(x, y, 1), unit="deg").separation(true).arcsec
        assert np.sqrt(np.mean(apart**2)) < 2 * NOISE * np.sqrt(20 / N)
    entries = {p["path"]: p for p in summary_of(run)["products"]}
    assert set(entries) == {
        "tpv.head", "tpv_parameters.fits", "ast.txt", "ast_parameters.fits", "cpdis.fits"
    }  # fmt: skip
    assert not any(p["findings"] for p in entries.values())
    assert entries["tpv.head"]["forward_rms"] == entries["ast.txt"]["forward_rms"] == 0.0
    assert 1e-7 < entries["cpdis.fits"]["forward_rms"] < PIXEL * entries["cpdis.fits"]["tables_pix"]
    good("convert", run, "--to", "tpv", "-o", tmp_path / "same")
    assert (tmp_path / "same" / "tpv.head").read_text() == (run / "tpv.head").read_text()
    back = read_calibration(run / "tpv.head")
    assert back.errors == "covariance" and back.plane.kind == "sky"


@pytest.mark.slow
@only_in_full("test_sky_positions applies such headers")
def test_a_given_crval_keeps_the_sky_right(tmp_path, rng) -> None:
    """That of the tangent point, as once had to be given: the constants are folded in."""
    truth = camera((83.8, -5.4), -1)
    given = (83.81, -5.39)
    run = made(tmp_path, truth, rng, products={"sip": {"crval": given}})
    np.testing.assert_array_equal(header_of(run).wcs.crval, given)
    assert np.sqrt(np.mean(separations(run, truth, rng) ** 2)) < 2 * NOISE * np.sqrt(20 / N)
    assert headers_of(run)[0]["sky"]["solution_arcsec"] < 1e-5 * PIXEL


@pytest.mark.slow
@only_in_full("one exposure, and two chips are run")
def test_of_several_exposures_it_is_the_first_one(tmp_path, rng) -> None:
    """Dithered and rotated exposures: the header says whose sky it is, and has it."""
    first, second = camera((83.8, -5.4), -1), camera((83.83, -5.38), -1, angle=0.8)
    tables = []
    for name, truth in (("a", first), ("b", second)):
        tables.append(stars_of(truth, rng))
        tables[-1]["exposure"] = name
    both = vstack(tables)
    config = write_job(
        tmp_path / "job",
        both,
        data={"matches": "stars.ecsv", "sigma": NOISE},
        detector={"size": SIZE},
        model={"order": 3, "frames": "shift_rotation_scale"},
        products={"sip": {}},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess", "export")
    assert np.sqrt(np.mean(separations(run, first, rng) ** 2)) < 2 * NOISE * np.sqrt(20 / N)
    sky = headers_of(run)[0]["sky"]
    assert sky["n"] <= N and sky["solution_arcsec"] < 1e-5 * PIXEL
    assert "On the sky it is exposure a" in (run / "sip.hdr").read_text()


def test_two_chips_have_a_header_each(tmp_path, rng) -> None:
    """One plane, two chips: each header has its own CRVAL, and both are right."""
    chips = {1: camera((83.8, -5.4), -1), 2: camera((83.8, -5.145), -1, angle=0.71)}
    tables = []
    for number, truth in chips.items():
        tables.append(stars_of(truth, rng))
        tables[-1]["chip"] = number
    config = write_job(
        tmp_path / "job",
        vstack(tables),
        data={"matches": "stars.ecsv", "sigma": NOISE},
        detector=None,
        chip=[
            {"number": n, "name": f"c{n}", "size": SIZE, "reference_pixel": (1000.5, 750.5)}
            for n in chips
        ],
        model={"order": 3},
        products={"sip": {}},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess", "export")
    x, y = rng.uniform(0.5, np.array(SIZE) + 0.5, (1000, 2)).T
    for product, (number, truth) in zip(headers_of(run), chips.items(), strict=True):
        found = SkyCoord(*header_of(run, product["path"]).all_pix2world(x, y, 1), unit="deg")
        true = SkyCoord(*truth.all_pix2world(x, y, 1), unit="deg")
        apart = found.separation(true).arcsec
        assert np.sqrt(np.mean(apart**2)) < 2 * NOISE * np.sqrt(20 / N), number
        assert product["sky"]["n"] <= N and product["sky"]["solution_arcsec"] < 1e-5 * PIXEL


def test_a_header_that_is_off_is_called_wrong(tmp_path, rng, monkeypatch) -> None:
    """CRVAL moved by ten pixels on its way to the file."""
    from bayesdist.formats.sip import files, format

    def moved(sip):
        off = replace(sip, crval=(sip.crval[0], sip.crval[1] + 10 * PIXEL / 3600))
        return files.sip_text(off)

    monkeypatch.setattr(format, "sip_text", moved)
    run = made(tmp_path, camera((83.8, -5.4), -1), rng)
    [product] = headers_of(run)
    assert any(f.startswith("error: sky: astropy.wcs puts pixels up to 4 arcsec") for f in
               product["findings"])  # fmt: skip


@pytest.mark.parametrize(
    ("file", "order", "terms"),
    [
        case_in_full("AstroTomii_corr.fits", 3, 10, instead="another field is run"),
        ("Harry695_corr.fits", 2, 6),
    ],
)
def test_fields_of_astrometry_net(file, order, terms, data_dir, tmp_path) -> None:
    """Real stars: as astropy's own fit of a TAN-SIP header to the same ones has them."""
    path = data_dir / "anet_pairs" / file
    table = fits.getdata(path)
    x, y = np.array(table["field_x"]), np.array(table["field_y"])
    stars = SkyCoord(table["index_ra"], table["index_dec"], unit="deg")
    config = write_config(
        tmp_path / "config.toml",
        data={"matches": str(path), "sigma": 0.5},
        detector={"size": tuple(2 * int(np.ceil(v.max() / 2)) for v in (x, y))},
        model={"order": order},
        budget=[EXACT],
        products={"sip": {}},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess", "export")
    ours = SkyCoord(*header_of(run).all_pix2world(x, y, 1), unit="deg")
    # this fit counts pixels from 0
    fitted = fit_wcs_from_points((x - 1, y - 1), stars, projection="TAN", sip_degree=order)
    theirs = SkyCoord(*fitted.all_pix2world(x, y, 1), unit="deg")
    sky = headers_of(run)[0]["sky"]
    # they keep the false matches, so that the two differ by a part of the error of a fit
    error = sky["rms_arcsec"] * np.sqrt(terms / len(x))
    assert np.median(ours.separation(theirs).arcsec) < error
    assert np.median(ours.separation(stars)) < 1.1 * np.median(theirs.separation(stars))
    assert np.hypot(sky["mean_east_arcsec"], sky["mean_north_arcsec"]) < 3 * error
    assert sky["solution_arcsec"] < 1e-6
