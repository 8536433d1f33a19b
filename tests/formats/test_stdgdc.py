"""STDGDC files: written, read back, used by bp3m, and what is wrong in those of others."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.calibration.area import pixel_areas
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.stdgdc import EXTENSIONS, CorrectedFrame, stdgdc_of
from bayesdist.model import LookupTable
from bayesdist.products import registry
from bayesdist.products.common.content import read_content
from tests.app.support import good

from .support import build_into, some_solution, wfc_model

SIZE = (150.0, 100.0)


def some_calibration(**what) -> Calibration:
    what = {"size": SIZE, "reference_pixel": (70.0, 45.0), "strength": 0.5} | what
    return calibration_of(some_solution(3, **what), "made up")


write = partial(build_into, "stdgdc")


def plain(path: Path) -> Path:
    """The five extensions alone, as others write them."""
    with fits.open(path) as hdus:
        header = hdus[0].header.copy()
        for keyword in [k for k in header if k.startswith("BD") and k != "BDCHIP"]:
            del header[keyword]
        kept = [fits.PrimaryHDU(header=header), *(hdus[name].copy() for name in EXTENSIONS)]
        other = path.with_name("plain.fits")
        fits.HDUList(kept).writeto(other, overwrite=True)
    return other


def pixels_inside(n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    return rng.uniform(1, SIZE[0], n), rng.uniform(1, SIZE[1], n)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_bp3m_has_the_positions_of_the_calibration(tmp_path, precision):
    """At the pixels to rounding, between them to the error that the file states."""
    io = pytest.importorskip("pypass.io", reason="bp3m is not installed")
    found = some_calibration()
    path = write(tmp_path, found, precision=precision)
    gdc = io.load_stdgdc(path)
    frame = CorrectedFrame.of_header(stdgdc_of(read_content(path)).header)
    j, i = np.indices((99, 149), float)
    x, y = i.ravel() + 1, j.ravel() + 1
    ours = frame.corrected(found.forward(x, y, chip=1).T)
    theirs = np.stack(io.apply_gdc(x - 1, y - 1, gdc)[:2])
    rounding = 2e-5 if precision == "single" else 1e-10  # numbers up to 150, of 24 or 53 bits
    assert np.hypot(*(ours - theirs)).max() < rounding
    x, y = pixels_inside()
    ours = frame.corrected(found.forward(x, y, chip=1).T)
    theirs = np.stack(io.apply_gdc(x - 1, y - 1, gdc)[:2])
    stated = float(stdgdc_of(read_content(path)).header["BDWORST"])
    assert 1e-6 < np.hypot(*(ours - theirs)).max() < 1.2 * stated < 1e-3


def test_bp3m_and_our_reading_of_the_tables_agree(tmp_path):
    """Bilinear both: to 1e-6 pixels, and far below."""
    io = pytest.importorskip("pypass.io", reason="bp3m is not installed")
    path = plain(write(tmp_path, some_calibration()))
    found = registry.read_calibration(path)
    x, y = pixels_inside()
    theirs = np.stack(io.apply_gdc(x - 1, y - 1, io.load_stdgdc(path))[:2])
    assert np.hypot(*(found.forward(x, y, chip=1).T - theirs)).max() < 1e-9


@pytest.mark.parametrize("turned", [False, True])
def test_what_is_read_back_is_the_calibration_with_its_covariance(tmp_path, turned):
    what = {"unit": "arcsec", "pixel": 0.05, "angle": 2.0, "flip": True} if turned else {}
    found = some_calibration(**what)
    path = write(tmp_path, found)
    back = registry.read_calibration(path)
    assert back.errors == "covariance" and back.unit == found.unit
    assert_allclose(back.solution.mean, found.solution.mean, rtol=0, atol=0)
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)
    assert not list(registry.lint(path))


def test_the_frame_lies_along_the_detector_and_keeps_the_skew(tmp_path):
    """The corrected frame is the plane of the calibration but for a similarity."""
    found = some_calibration(unit="arcsec", pixel=0.05, angle=2.0, flip=True)
    tables = registry.read_calibration(plain(write(tmp_path, found, precision="double")))
    j, i = np.indices((100, 150), float)
    x, y = i.ravel() + 1, j.ravel() + 1
    z = found.forward(x, y, chip=1) @ [1, -1j]  # mirrored
    w = tables.forward(x, y, chip=1) @ [1, 1j]
    factor = np.vdot(w - w.mean(), z - z.mean()) / np.vdot(w - w.mean(), w - w.mean())
    assert np.abs(z - z.mean() - factor * (w - w.mean())).max() < 1e-10
    assert np.abs(tables.forward([70.0], [45.0], chip=1) - [70.0, 45.0]).max() < 1e-10


def test_sigmas_are_those_of_the_covariance(tmp_path):
    found = some_calibration()
    file = stdgdc_of(read_content(write(tmp_path, found)))
    frame = CorrectedFrame.of_header(file.header)
    turn = np.linalg.inv(frame.similarity)
    cov = (
        turn @ found.chip(origin="stated").covariance_at(np.array([31.0]), np.array([9.0])) @ turn.T
    )
    there = [file.table(name)[8, 30] for name in ("SXGC", "SYGC", "CXYGC")]
    sx, sy = np.sqrt(cov[0].diagonal())
    assert_allclose(there, [sx, sy, cov[0, 0, 1] / sx / sy], rtol=1e-6)


def test_the_magnitude_is_that_of_the_area(tmp_path):
    """By differences of corrected positions."""
    file = stdgdc_of(read_content(write(tmp_path, some_calibration(), precision="double")))
    xy, xx = np.gradient(file.table("XGC"))
    yy, yx = np.gradient(file.table("YGC"))
    area = (xx * yy - xy * yx)[20, 30]
    assert file.table("MGC")[20, 30] == pytest.approx(-2.5 * np.log10(area), abs=1e-4)


def test_areas_are_those_of_the_tables(tmp_path):
    """Of the five tables alone, whose polynomial is the identity: the file's own magnitudes."""
    path = plain(write(tmp_path, some_calibration(strength=1.5), precision="double"))
    one = registry.read_calibration(path).in_frame()[1]
    inside = slice(1, -1)  # at the edge a table ends at the centre of the pixel
    area, _ = pixel_areas(one, np.arange(2.0, 150), np.arange(2.0, 100))
    theirs = 10 ** (-0.4 * stdgdc_of(read_content(path)).table("MGC")[inside, inside])
    assert_allclose(area, theirs, rtol=2e-4)
    assert np.ptp(area) > 0.05


def test_look_up_tables_go_into_the_file(tmp_path):
    """And come back, with the covariance of the polynomial."""
    table = LookupTable(1, np.random.default_rng(1).normal(0, 0.1, (2, 10, 15)), step=(10.0, 10.0),
                        first=(5.0, 5.0))  # fmt: skip
    found = replace(some_calibration(), before=(table,))
    back = registry.read_calibration(write(tmp_path, found, precision="double"))
    x, y = (v.round() for v in pixels_inside())
    assert_allclose(back.forward(x, y, chip=1), found.forward(x, y, chip=1), atol=1e-9)
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)


def test_a_map_with_tables_is_inverted_and_has_its_slopes():
    """The inverse closes, and slopes are differences of positions."""
    table = LookupTable(1, np.random.default_rng(1).normal(0, 0.05, (2, 10, 15)),
                        step=(10.0, 10.0), first=(5.0, 5.0))  # fmt: skip
    for where in ("before", "after"):
        found = replace(some_calibration(), **{where: (table,)})
        one: ChipMap = found.in_frame()[1]
        x, y = pixels_inside(500)
        (px, py), slope = one.pixels(one.at(x, y))
        assert max(np.abs(px - x).max(), np.abs(py - y).max()) < 1e-7
        for axis, (dx, dy) in enumerate(((1e-6, 0.0), (0.0, 1e-6))):
            numeric = (one.at(x + dx, y + dy) - one.at(x - dx, y - dy)) / 2e-6
            off = np.abs(numeric - slope[:, :, axis].T).max(axis=0)
            assert np.quantile(off, 0.99) < 1e-6  # but for nodes between the two


def _edit(path: Path, change) -> Path:
    with fits.open(path) as hdus:
        change(hdus)
        other = path.with_name("edited.fits")
        hdus.writeto(other, overwrite=True)
    return other


def _scale(hdus, factor):
    for name in ("XGC", "YGC"):
        hdus[name].data = hdus[name].data * factor


def _shift(hdus, names, by):
    for name in names:
        hdus[name].data = hdus[name].data + by


def _exchange(hdus):
    hdus["XGC"].data, hdus["YGC"].data = hdus["YGC"].data.copy(), hdus["XGC"].data.copy()


def _order(hdus):
    hdus[1], hdus[2] = hdus[2].copy(), hdus[1].copy()


FAULTS = {
    "missing extension": (lambda h: h.pop(3), "MGC", "missing"),
    "missing inverse": (lambda h: (h.pop(5), h.pop(4)), "XCG", "missing"),
    "order of extensions": (_order, "YGC, XGC, MGC, XCG, YCG", "by their position"),
    "x and y exchanged": (_exchange, "XGC, YGC", "exchanged"),
    "parity": (lambda h: _scale(h, -1.0), "XGC", "parity"),
    "arcsec": (lambda h: _scale(h, 0.05), "XGC", "unit is the pixel"),
    "counted from 0": (lambda h: _shift(h, ("XGC", "YGC"), -1.0), "XCG, YCG", "another pixel"),
    "inverse off by one": (lambda h: _shift(h, ("XCG", "YCG"), 1.0), "XCG, YCG", "another pixel"),
    "sign of MGC": (lambda h: setattr(h["MGC"], "data", -h["MGC"].data), "MGC", "opposite"),
    "not finite": (lambda h: h["YGC"].data.__setitem__((3, 4), np.nan), "YGC", "not finite"),
    "dimension": (lambda h: h[0].header.__setitem__("NDIM_XGC", 151), "NDIM_XGC", "is 151"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(tmp_path, fault):
    change, where, message = FAULTS[fault]
    right = plain(write(tmp_path, some_calibration(strength=1.5)))
    assert not registry.lint(right)
    found = [
        f for f in registry.lint(_edit(right, change)) if f.where == where and message in f.message
    ]
    assert len(found) == 1


def test_changed_tables_do_not_take_the_errors_in_the_file(tmp_path):
    path = _edit(write(tmp_path, some_calibration()), lambda h: _shift(h, ("XGC",), 0.3))
    with pytest.raises(FormatError, match=r"off by 0\.3 pixels from its parameters"):
        registry.read_calibration(path)
    assert "from its parameters" in str(registry.lint(path))


def test_bad_files_get_a_sentence(tmp_path):
    right = plain(write(tmp_path, some_calibration()))
    gone = _edit(right, lambda h: h.pop(1))
    with pytest.raises(FormatError, match="no extension XGC"):
        registry.read_calibration(gone)
    assert "missing" in registry.describe(gone)
    infinite = _edit(right, lambda h: h["XGC"].data.__setitem__((0, 0), np.inf))
    with pytest.raises(FormatError, match="not finite"):
        registry.read_calibration(infinite)


def test_several_chips_are_refused(tmp_path):
    model = wfc_model(2, drift=False)
    from .support import StandIn

    two = calibration_of(StandIn(model, np.ones(model.n_params), np.eye(model.n_params)))
    with pytest.raises(InputError, match="of one detector"):
        write(tmp_path, two)


def test_commands_take_the_tables_of_others(tmp_path):
    path = plain(write(tmp_path, some_calibration()))
    (tmp_path / "stars.csv").write_text("x,y\n31,9\n")
    good("apply", path, tmp_path / "stars.csv", "-o", tmp_path / "out.csv")
    last = (tmp_path / "out.csv").read_text().splitlines()[-1].split(",")
    file = stdgdc_of(read_content(path))
    there = np.array([file.table("XGC")[8, 30], file.table("YGC")[8, 30]])
    assert_allclose([float(last[2]), float(last[3])], there, rtol=1e-9)
    (tmp_path / "back.csv").write_text(f"x_out,y_out\n{there[0]},{there[1]}\n")
    good("apply", path, tmp_path / "back.csv", "-o", tmp_path / "b.csv", "--inverse")
    back = (tmp_path / "b.csv").read_text().splitlines()[-1].split(",")
    assert_allclose([float(v) for v in back[2:4]], [31, 9], atol=1e-7)
    out = good("compare", path, tmp_path / "stdgdc.fits").out
    assert "approximated by a polynomial of order 9" in out
