"""`bayesdist convert`: files of other formats, and whether what it says of the loss is so."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.model import LookupTable
from bayesdist.products import registry
from tests.formats.support import some_solution

from .support import cli, good

SIZE, PIXEL, POINT = (300.0, 200.0), 0.26, (150.1, 2.2)


def on_sky(order: int = 4, **what) -> Calibration:
    solution = some_solution(
        order, unit="arcsec", pixel=PIXEL, angle=0.4, flip=True, size=SIZE,
        reference_pixel=(140.0, 90.0), strength=0.5, **what,
    )  # fmt: skip
    return calibration_of(solution, "made up", plane=Plane("sky", point=POINT))


def write(folder: Path, key: str, calibration: Calibration, **settings) -> Path:
    for one in registry.build(key, calibration, registry.product_settings()[key](**settings)):
        (folder / one.file_name).write_bytes(one.content)
    return folder / one.file_name


def bad(*arguments: object) -> str:
    """Sentence of a command that must fail."""
    result = cli(*arguments)
    assert result.code == 1, result.out
    return result.err


def said(out: str) -> float:
    """Largest difference that is printed, pixels."""
    found = re.search(r"positions (?:agree: |differ by )(\S+) pix at worst", out)
    assert found, out
    return float(found[1])


@pytest.mark.parametrize(
    ("to", "name", "limit"),
    [
        ("tpv", "tpv.head", 1e-9),
        ("ast", "ast.txt", 1e-9),
        ("sip", "sip.hdr", 1e-4),
        ("cpdis", "cpdis.fits", None),
        ("stdgdc", "stdgdc.fits", None),
    ],
)
def test_a_calibration_goes_into_every_format(tmp_path, to, name, limit):
    """From a TPV header, whose covariance goes along where the format can hold it."""
    path = write(tmp_path, "tpv", on_sky(4))
    folder = tmp_path / "new"
    out = good("convert", path, "--to", to, "-o", folder).out
    if limit is None:  # what the file states of its tables, over a coarser grid
        hdus = registry.open_document(folder / name).holds.content.hdus
        limit = max(float(hdu.header.get("BDWORST", 0)) for hdu in hdus) * 1.01
    assert 0 < said(out) <= limit
    back = registry.read_calibration(folder / name, size=SIZE)
    assert "lost" not in out
    assert_allclose(back.solution.cov, on_sky(4).solution.cov, atol=0)


def test_a_calibration_goes_into_files_of_pipelines(tmp_path):
    """With its covariance, and without the point of the sky where V2, V3 are stated."""
    path = write(tmp_path, "tpv", on_sky(4))
    placed = {
        "useafter": "2022-07-01T00:00:00", "pedigree": "GROUND", "author": "nobody",
        "v2ref": -453.4, "v3ref": -373.8, "v3idlyangle": 4.8, "parity": -1,
    }  # fmt: skip
    for to, settings in (
        ("jwst", placed | {"instrument": "MIRI", "detector": "MIRIMAGE"}),
        ("roman", placed | {"optical_element": "F158", "detector": "WFI04"}),
        ("siaf", {"aperture": "MADE_UP"}),
    ):
        options = [part for k, v in settings.items() for part in ("--option", f"{k}={v}")]
        out = good("convert", path, "--to", to, "-o", tmp_path / to, *options).out
        assert said(out) < 1e-6
        # the side file of a SIAF table has the plane as it was
        lost = [] if to == "siaf" else ["where the plane touches the sky"]
        assert re.findall("lost: (.*)", out) == lost
        [name] = [p for p in (tmp_path / to).iterdir() if p.suffix in {".asdf", ".txt"}]
        assert_allclose(registry.read_calibration(name).solution.cov, on_sky(4).solution.cov)


def test_the_loss_of_a_lower_order_is_as_measured_by_hand(tmp_path):
    """Over the same grid, from the files; in mas by the size of the pixel."""
    path = write(tmp_path, "tpv", on_sky(5))
    out = good("convert", path, "--to", "tpv", "-o", tmp_path / "low", "--order", 3).out
    a, b = (registry.read_calibration(p) for p in (path, tmp_path / "low" / "tpv.head"))
    assert b.model.order == 3
    x, y = detector_grid(SIZE, 65)
    far = np.hypot(*(a.forward(x, y, chip=1) - b.forward(x, y, chip=1)).T)
    pixel = np.sqrt(abs(np.linalg.det(a.chip(1).linear)))
    assert said(out) == pytest.approx(far.max() / pixel, rel=6e-3)
    mas = float(re.search(r"\((\S+) mas\)", out)[1])
    assert mas == pytest.approx(1e3 * far.max(), rel=6e-3)
    assert "its order 5 goes into a polynomial of order 3" in out
    kept = b.solution.cov.reshape(2, 10, 2, 10)
    assert_allclose(kept, a.solution.cov.reshape(2, 21, 2, 21)[:, :10, :, :10], atol=1e-18)


def test_tables_go_into_a_polynomial_with_a_statement(tmp_path):
    """A table that no polynomial follows: the loss is its scatter."""
    values = np.random.default_rng(2).normal(0, 0.05, (2, 20, 30))
    table = LookupTable(1, values, first=(5.0, 5.0), step=(10.0, 10.0))
    path = write(tmp_path, "stdgdc", replace(on_sky(3), before=(table,)), precision="double")
    out = good("convert", path, "--to", "tpv", "-o", tmp_path / "new").out
    assert "its look-up tables go into a polynomial of order 7" in out
    rms = float(re.search(r"(\S+) pix rms", out)[1])
    # bilinear means of independent nodes have 4/9 of their variance, along two axes
    assert 0.8 < rms / (0.05 * np.sqrt(2) * 2 / 3) < 1.1
    again = good("convert", path, "--to", "stdgdc", "-o", tmp_path / "again").out
    assert said(again) < 1e-3 and "go into" not in again


def test_options_of_the_format_and_a_file_name(tmp_path):
    path = write(tmp_path, "tpv", on_sky(3))
    target = tmp_path / "mine.fits"
    good("convert", path, "--to", "stdgdc", "-o", target, "--option", 'precision="double"')
    assert registry.open_document(target).holds.hdu("XGC").header["BITPIX"] == -64
    assert target.name in bad("convert", path, "--to", "stdgdc", "-o", target)
    good("convert", path, "--to", "stdgdc", "-o", target, "--force")
    assert registry.open_document(target).holds.hdu("XGC").header["BITPIX"] == -32


def test_one_chip_of_several(tmp_path, data_dir):
    """An IDCTAB of ACS, whose chips an STDGDC file cannot hold together."""
    idctab = data_dir / "hst_reference" / "0461802ej_idc.fits"
    out = good("convert", idctab, "--to", "sip", "--filter", "F606W", "-o", tmp_path / "sip").out
    assert said(out) < 1e-3 and (tmp_path / "sip" / "sip_1.hdr").is_file()
    assert "after the best shift, rotation and scale" in out
    out = good("convert", idctab, "--to", "tpv", "--filter", "F606W", "-o", tmp_path / "tpv").out
    assert said(out) < 1e-6
    two = good("convert", idctab, "--to", "ast", "--filter", "F606W", "--chip", 2,
               "-o", tmp_path / "ast").out  # fmt: skip
    assert (tmp_path / "ast" / "ast.txt").is_file() and said(two) < 1e-6


def test_meta_data_of_wise_go_into_themselves(tmp_path):
    """The band is known from the file."""
    solution = some_solution(4, size=(1016.0, 1016.0), reference_pixel=(508.5, 508.5))
    path = write(tmp_path, "wise_meta", calibration_of(solution, "made up", detector="W3"))
    out = good("convert", path, "--to", "wise_meta", "-o", tmp_path / "again").out
    assert said(out) < 1e-9 and (tmp_path / "again" / "w3.meta").is_file()


def test_bad_requests_get_a_sentence(tmp_path):
    path = write(tmp_path, "tpv", on_sky(3))
    high = write(tmp_path, "ast", on_sky(8))
    small = some_solution(3, size=SIZE, reference_pixel=(140.0, 90.0))
    pixels = write(tmp_path, "stdgdc", calibration_of(small, "made up"))
    (notes := tmp_path / "notes.txt").write_text("nothing\n")
    new = ("-o", tmp_path / "x")
    for arguments, message in (
        ((path, "--to", "fit", *new), "there is no format 'fit' that can be built"),
        (
            (path, "--to", "tpv", "--option", "colour=red", *new),
            "setting of tpv 'colour'; choose one of crval",
        ),
        ((path, "--to", "tpv", "--option", "crval", *new), "is not KEY=VALUE"),
        ((path, "--to", "jwst", *new), "needs useafter, pedigree, author, instrument"),
        ((notes, "--to", "jwst", *new), "notes.txt: has an unknown format"),
        (
            (pixels, "--to", "siaf", "--option", "aperture=A", *new),
            "give the pixel scale (scale_mas in Python, --scale of convert)",
        ),
        ((path, "--to", "siaf", *new), "(--option aperture=NIS_CEN of convert)"),
        ((path, "--to", "wise_meta", *new), "give a run whose detector.name is the band"),
        ((path, "--to", "tpv", "--order", 11, *new), "choose one from 1 to 7 for TPV headers"),
        ((high, "--to", "tpv", *new), "limited to order 7"),
        ((pixels, "--to", "tpv", *new), "is in pixels of unknown size, but writing TPV headers"),
        ((path, "--to", "tpv", "--scale", -1, *new), "give a positive number"),
        ((tmp_path / "none", "--to", "tpv", *new), "there is no such file"),
    ):
        assert message in bad("convert", *arguments)
