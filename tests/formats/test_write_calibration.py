"""`Calibration.write` and `bd.read_calibration`: every format the same way, and nothing dropped."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

import bayesdist as bd
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.errors import BayesdistWarning
from bayesdist.formats import describe, lint, list_formats
from bayesdist.products.common.document import Choice
from bayesdist.products.registry import open_document, product_settings

from ..docs_blocks import DOCS, run_page
from .support import PIXEL, StandIn, on_sky, some_covariance, some_solution, wfc_model
from .test_formats import SETTINGS, calibration_for

pytestmark = pytest.mark.filterwarnings("ignore::bayesdist.errors.BayesdistWarning")
SCALE_MAS = 110.0
EXACT = 1e-9  # pixels
# pixels by which positions of a file may differ: seven digits of WISE's entries over 508 pixels;
# tables state their rounding and what lies between their nodes
LIMITS = {"wise_meta": 1e-4, "sip": 1e-6}
TABLES = ("cpdis", "stdgdc")
HOLD_TABLES = ("cpdis", "jwst", "roman", "stdgdc")


def pixels(size: tuple[float, float], n: int = 200) -> np.ndarray:
    """Random pixels (2, n) of a chip."""
    rng = np.random.default_rng(7)
    return np.stack([rng.uniform(1, side, n) for side in size])


def distances(calibration: Calibration, other: Calibration, **when) -> np.ndarray:
    """Distances (200,) in pixels after the best similarity, as files have planes of their own."""
    chip, size = calibration.numbers[0], calibration.model.chips[0].size
    x, y = pixels(size)
    z = calibration.forward(x, y, chip=chip, **when) @ [1, 1j]
    w = other.forward(x, y, chip=other.numbers[0]) @ [1, 1j]
    area = abs(np.linalg.det(calibration.chip(chip, when.get("epoch")).linear))
    left = []
    for v in (w, w.conj()):
        a, b = v - v.mean(), z - z.mean()
        left.append(np.abs(b - np.vdot(a, b) / np.vdot(a, a) * a) / np.sqrt(area))
    return min(left, key=np.max)


def limit_of(key: str, path: Path) -> float:
    if key not in TABLES:
        return LIMITS.get(key, EXACT)
    with fits.open(path) as file:
        return 1.01 * max(float(hdu.header.get("BDWORST", 0.0)) for hdu in file)


@pytest.mark.parametrize("key", SETTINGS)
def test_every_format_is_written_and_read_back(tmp_path, key):
    """Under a name of the caller's, by itself and as other programs have it."""
    calibration = calibration_for(key)
    target = tmp_path / "camera.file"
    paths = calibration.write(key, target, scale_mas=SCALE_MAS, **SETTINGS[key])
    assert paths[-1] == target and all(path.is_file() for path in paths)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    limit = limit_of(key, target)
    assert distances(calibration, bd.read_calibration(target)).max() < limit
    alone = open_document(target).calibration(Choice(as_used=True))
    assert distances(calibration, alone).max() < limit
    assert not [finding for finding in lint(target) if finding.level == "error"]
    assert describe(target)


@pytest.mark.parametrize("key", SETTINGS)
def test_existing_files_are_replaced_on_request_only(tmp_path, key):
    calibration = calibration_for(key)
    settings = SETTINGS[key] | {"scale_mas": SCALE_MAS * u.mas}
    paths = calibration.write(key, tmp_path, **settings)  # under the usual names
    before = [path.read_bytes() for path in paths]
    with pytest.raises(bd.InputError, match="this file exists; replace it with overwrite=True"):
        calibration.write(key, tmp_path, **settings)
    assert [path.read_bytes() for path in paths] == before
    paths[-1].write_text("other")
    assert calibration.write(key, tmp_path, overwrite=True, **settings) == paths
    assert distances(calibration, bd.read_calibration(paths[-1])).max() < 1e-3
    assert sorted(tmp_path.iterdir()) == sorted(paths)  # and no temporary file


def test_the_list_of_formats_is_what_can_be_written():
    formats = list_formats()
    assert set(formats["name"][formats["written"]]) == set(product_settings())
    assert set(formats["name"][formats["tables"]]) == set(HOLD_TABLES)
    assert list(formats["name"][formats["time"]]) == ["idctab"]
    assert "lookup" in formats["name"][~formats["read"]]


@pytest.mark.parametrize(("key", "limit"), [("sip", 1e-4), ("tpv", 1e-8)])
def test_astropy_finds_the_same_sky(tmp_path, key, limit):
    calibration = on_sky(4)
    path = calibration.write(key, tmp_path / "camera.hdr")[-1]
    wcs = WCS(fits.Header.fromstring(path.read_text().split("\nEND")[0], sep="\n"))
    x, y = pixels(calibration.model.chips[0].size)
    theirs = wcs.pixel_to_world(x - 1, y - 1)
    ours = calibration.to_sky({"x": x, "y": y})
    far = theirs.separation(SkyCoord(ours["ra"], ours["dec"])).to_value("arcsec").max()
    assert far < limit * PIXEL


@pytest.mark.parametrize(("key", "extra"), [("tpv", {}), ("ast", {}), ("sip", {}),
                                            ("siaf", {"aperture": "MADE_UP"})])  # fmt: skip
def test_files_beside_are_named_after_the_file(tmp_path, key, extra):
    """Two calibrations in one folder keep their own covariances."""
    made = {}
    for name, strength in (("first.txt", 1.0), ("second.txt", 2.0)):
        made[name] = on_sky(3, strength=strength)
        made[name].write(key, tmp_path / name, **extra)
    assert len(list(tmp_path.iterdir())) == 4
    for name, calibration in made.items():
        again = bd.read_calibration(tmp_path / name)
        assert again.errors == "covariance"
        assert distances(calibration, again).max() < EXACT
        np.testing.assert_allclose(again.solution.cov, calibration.solution.cov, rtol=1e-9)


def test_names_that_no_header_can_state_leave_the_file_beside_its_own(tmp_path):
    calibration = on_sky(3)
    name = "Verzeichnung_für_die_Kamera.head"
    paths = calibration.write("tpv", tmp_path / name)
    assert [path.name for path in paths] == ["tpv_parameters.fits", name]
    assert bd.read_calibration(paths[-1]).errors == "covariance"


# -- what a format cannot hold --------------------------------------------------------------------


def with_tables() -> Calibration:
    """A table of pixels that is linear in position, so that polynomials hold it exactly."""
    x, y = np.meshgrid(np.arange(-300, 1501, 300), np.arange(-300, 1201, 300))
    values = np.stack([0.1 + 1e-3 * x, 0.2 - 2e-3 * y])
    table = bd.LookupTable(1, values, first=(-300.0, -300.0), step=(300.0, 300.0))
    return replace(on_sky(4), before=(table,))


@pytest.mark.parametrize("key", [key for key in SETTINGS if key not in HOLD_TABLES])
def test_look_up_tables_are_refused_or_fitted_but_not_dropped(tmp_path, key):
    calibration = replace(with_tables(), detector="W1")
    message = "has look-up tables, and .* cannot hold them; give the order of a polynomial"
    with pytest.raises(bd.InputError, match=message):
        calibration.write(key, tmp_path, **SETTINGS[key])
    assert not list(tmp_path.iterdir())
    if key in ("ast", "parameters", "siaf", "tpv"):
        path = calibration.write(key, tmp_path, order=4, **SETTINGS[key])[-1]
        assert distances(calibration, bd.read_calibration(path)).max() < 1e-8


@pytest.mark.parametrize("key", ["cpdis", "stdgdc"])
def test_formats_with_tables_hold_them(tmp_path, key):
    calibration = with_tables()
    path = calibration.write(key, tmp_path / "camera.fits")[0]
    limit = limit_of(key, path)
    assert 0 < limit < 1e-3
    assert distances(calibration, bd.read_calibration(path)).max() < limit
    assert distances(calibration, on_sky(4)).max() > 0.1


def drifting() -> Calibration:
    """Two chips whose linear terms drift."""
    model = wfc_model(3, drift=True)
    rng = np.random.default_rng(4)
    theta = np.zeros(model.n_params)
    for number in (1, 2):
        basis = model.basis(number)
        for axis in (0, 1):
            terms = np.zeros(basis.n_terms)
            terms[1 + axis] = 0.05
            terms[3:] = 1e-9 * rng.normal(size=basis.n_terms - 3)
            theta[model.coefficient_slice(number, axis)] = basis.from_monomials(terms)
        drift = model.tdd_slice(number)
        theta[drift] = 1e-3 * rng.normal(size=drift.stop - drift.start)
    cov = some_covariance(theta.size, 1e-4, rng)
    return calibration_of(StandIn(model, theta, cov), "drifting")


@pytest.mark.parametrize("key", ["ast", "cpdis", "parameters", "siaf", "sip", "tpv"])
def test_the_dependence_on_time_is_refused_without_an_epoch(tmp_path, key):
    calibration = drifting()
    with pytest.raises(bd.InputError, match=r"depends on time, and .* give the epoch"):
        calibration.write(key, tmp_path, **SETTINGS[key])
    assert not list(tmp_path.iterdir())
    settings = SETTINGS[key] | ({"aperture": None} if key == "siaf" else {})
    paths = calibration.write(key, tmp_path, epoch=2019.5, **settings)
    files = [path for path in paths if "parameters" not in path.stem or key == "parameters"]
    path = next(path for path in files if path.suffix != ".json")
    back = bd.read_calibration(path)
    assert back.model.time is None
    limit = limit_of(key, path) if key == "cpdis" else 1e-6
    assert distances(calibration, back, epoch=2019.5).max() < limit
    assert distances(calibration, back, epoch=2009.5).max() > 10 * limit


def test_an_idctab_holds_the_dependence_on_time(tmp_path):
    calibration = drifting()
    settings = {"instrument": "ACS", "detector": "WFC"}
    [path] = calibration.write("idctab", tmp_path / "acs.fits", **settings)
    back = bd.read_calibration(path)
    assert back.model.time is not None
    x, y = pixels(calibration.model.chips[0].size)
    for chip in (1, 2):
        ours, theirs = (
            one.forward(x, y, chip=chip, epoch=2019.5) - one.forward(x, y, chip=chip, epoch=2009.5)
            for one in (calibration, back)
        )
        assert np.abs(ours).max() > 1e-4
        np.testing.assert_allclose(theirs, ours, atol=1e-8)
    [path] = calibration.write("idctab", tmp_path / "fixed.fits", epoch=2019.5, **settings)
    fixed = bd.read_calibration(path)
    assert distances(calibration, fixed, epoch=2019.5).max() < 1e-6
    for chip in (1, 2):
        now, then = (fixed.forward(x, y, chip=chip, epoch=t) for t in (2019.5, 2009.5))
        np.testing.assert_array_equal(now, then)


# -- wrong input ----------------------------------------------------------------------------------

IN_PIXELS = calibration_of(some_solution(4), "camera")


@pytest.mark.parametrize(
    ("format", "settings", "message"),
    [
        ("tvp", {}, r"no format 'tvp' .*; use 'tpv' if that is meant, or choose one of ast, cp"),
        ("SIP", {}, "use 'sip' if that is meant"),
        ("lookup", {}, "no format 'lookup' that can be built; choose one of ast"),
        ("sip", {"scale_mas": 50, "inverse": 3}, "unknown setting of sip 'inverse'; use 'inv"),
        ("sip", {"scale_mas": 50, "linear": "all"}, r"sip.linear: .*the settings of sip"),
        ("parameters", {"colour": 1}, "parameters has no settings"),
        ("idctab", {"scale_mas": 50}, "products.idctab: needs instrument, detector"),
        ("tpv", {}, "camera: is in pixels of unknown size, but writing TPV headers"),
        ("sip", {}, "give the pixel scale .scale_mas in Python"),
        ("ast", {}, "give the pixel scale"),
        ("cpdis", {}, "give the pixel scale"),
        ("idctab", {"instrument": "WFC3", "detector": "IR"}, "give the pixel scale"),
        ("siaf", {"aperture": "A"}, "give the pixel scale"),
        ("tpv", {"scale_mas": -1}, "scale_mas is -1.0; give a positive number"),
        ("tpv", {"scale_mas": 1 * u.s}, "scale_mas is given in s, which cannot be con"),
        ("tpv", {"scale_mas": "big"}, "scale_mas is 'big', which is not a number"),
        ("tpv", {"scale_mas": 50, "order": 9}, "order: the order is 9; choose one from 1 to 7"),
        ("tpv", {"scale_mas": 50, "epoch": np.nan}, "epoch is nan, which is not a year"),
        ("wise_meta", {}, "not a band of WISE"),
    ],
)  # fmt: skip
def test_bad_requests_get_one_sentence(tmp_path, format, settings, message):
    with pytest.raises(bd.InputError, match=message) as refused:
        IN_PIXELS.write(format, tmp_path / "camera.file", **settings)
    assert str(refused.value).endswith(".") and "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_axes_of_a_frame_need_no_scale(tmp_path):
    """SIP with linear axes has no angles."""
    _, path = IN_PIXELS.write("sip", tmp_path / "frame.hdr", axes="linear")
    assert distances(IN_PIXELS, bd.read_calibration(path)).max() < LIMITS["sip"]


def test_bad_places_get_one_sentence(tmp_path):
    calibration = on_sky(3)
    gone = tmp_path / "gone"
    with pytest.raises(bd.InputError, match="gone: the folder does not exist; make it"):
        calibration.write("tpv", gone / "camera.head")
    two = drifting()
    with pytest.raises(
        bd.InputError, match=r"2 files would be written \(sip_2.hdr, sip_1.hdr\); name an"
    ):
        two.write("sip", tmp_path / "camera.hdr", epoch=2009.5)
    assert not list(tmp_path.iterdir())
    for name in ("camera_parameters.fits", "camera.head"):  # either of the two files
        (tmp_path / name).write_text("mine")
        with pytest.raises(bd.InputError, match=f"{name}: this file exists"):
            calibration.write("tpv", tmp_path / "camera.head")
        assert [path.name for path in tmp_path.iterdir()] == [name]
        (tmp_path / name).unlink()


def test_a_header_without_its_size_asks_for_it(tmp_path):
    [path] = on_sky(4).write("sip", tmp_path / "camera.hdr", parameters=False)
    lines = path.read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("NAXIS", "IMAGE"))]
    path.write_text("\n".join(kept) + "\n")
    with pytest.raises(bd.InputError, match=r"the size of the image; give it \(size=\(NX, NY\)"):
        bd.read_calibration(path)
    assert bd.read_calibration(path, size=(1200, 900)).plane.point is not None
    assert distances(on_sky(4), bd.read_calibration(path, size=(1200, 900))).max() < 1e-4


@pytest.mark.parametrize(
    ("calibration", "text"),
    [
        (on_sky(4), "'made up': chip 1, order 4, u and v in arcsec on the sky at (150.1, 2.2),"),
        (drifting(), "'drifting': chips 2, 1, order 3, u and v in arcsec, depends on time, cov"),
        (with_tables(), "(150.1, 2.2), look-up tables, covariance"),
        (replace(IN_PIXELS, errors="none"), "'camera': chip 1, order 4, u and v in pix, no errors"),
    ],
)  # fmt: skip
def test_a_calibration_is_shown_in_one_line(calibration, text):
    shown = repr(calibration)
    assert text in shown and shown.startswith("<Calibration '") and "\n" not in shown


def test_what_other_programs_will_make_of_a_file_is_warned_of_once(tmp_path):
    """The warning is that of the caller's line."""
    with pytest.warns(BayesdistWarning) as caught:
        IN_PIXELS.write("sip", tmp_path / "camera.hdr", scale_mas=50, crval=(10.0, 20.0))
    texts = [str(one.message) for one in caught]
    assert len(texts) == len(set(texts)) and all("camera.hdr: " in text for text in texts)
    assert any("u is taken for east" in text for text in texts)
    assert {one.filename for one in caught} == {__file__}


def test_a_placeholder_of_the_sky_position_is_a_note_and_no_warning(tmp_path, caplog):
    with warnings.catch_warnings(), caplog.at_level("INFO", logger="bayesdist"):
        warnings.simplefilter("error")
        IN_PIXELS.write("sip", tmp_path / "camera.hdr", scale_mas=50)
    assert any("CRVAL is a placeholder" in text for text in caplog.messages)
    assert "CRVAL is a placeholder" in (tmp_path / "camera.hdr").read_text()


def test_the_lines_of_the_quickstart_read_the_sky_from_a_header(tmp_path, monkeypatch):
    calibration = on_sky(4)
    (tmp_path / "camera-run").mkdir()
    calibration.write("sip", tmp_path / "camera-run" / "sip.hdr")
    monkeypatch.chdir(tmp_path)
    found = run_page(DOCS / "quickstart.md", languages={"python"})["wcs"].pixel_to_world(99, 99)
    ours = calibration.to_sky({"x": np.array([100.0]), "y": np.array([100.0])})
    apart = found.separation(SkyCoord(ours["ra"], ours["dec"])).to_value("arcsec").max()
    assert apart < 1e-4
