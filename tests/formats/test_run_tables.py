"""Look-up tables of a run in the files of formats that hold them, and what the others say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import bayesdist as bd
from bayesdist.app.products import ProductInput, _left_out
from bayesdist.calibration.calibration import calibration_of
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.products.common.document import PARAMETERS, BuildOptions
from bayesdist.products.registry import (
    all_formats,
    build,
    product_settings,
    read_back,
    read_calibration,
)

SIZE = (256.0, 192.0)
PLACED = {
    "useafter": "2022-07-01T00:00:00", "pedigree": "GROUND", "author": "A",
    "v2ref": 10.0, "v3ref": -20.0, "v3idlyangle": 0.5,
}  # fmt: skip
GIVEN = {
    "jwst": {"instrument": "NIRISS", "detector": "NIS", "filter": "CLEAR", "pupil": "F200W"}
    | PLACED,
    "roman": {"detector": "WFI01", "optical_element": "F158"} | PLACED,
    "cpdis": {"step": 1},
    "stdgdc": {"precision": "double"},
}


@pytest.fixture(scope="module")
def product():
    """A run with tables of the detector and of its filter, of 0.3 px."""
    rng = np.random.default_rng(1)
    model = bd.DistortionModel(2, (bd.Chip(1, "chip 1", SIZE, (128.5, 96.5)),), "arcsec")
    theta = 0.02 * rng.normal(size=model.n_params)
    for axis in (0, 1):
        theta[model.coefficient_slice(1, axis).start + 1 + axis] = 0.1 * (128, 96)[axis]
    tables = tuple(
        bd.LookupTable(1, 0.3 * rng.normal(size=(2, 4, 5)), name, (1.0, 1.0), (63.75, 63.7))
        for name in ("", "F606W")
    )
    solution = GaussianSolution(model, theta, 1e-8 * np.eye(model.n_params))
    calibration = calibration_of(solution, "run", detector="camera", filter="F606W")
    return ProductInput(solution, calibration, BuildOptions(tables=tables))


@pytest.mark.parametrize("key", GIVEN)
def test_a_file_has_the_tables_of_the_run(product, tmp_path, key):
    """As other programs have it: tables of both kinds, one after the other, and the polynomials."""
    if key in ("jwst", "roman"):
        pytest.importorskip("asdf")
    calibration, options = product.calibration, product.options
    assert {one.key: one.holds_tables for one in all_formats()}[key]
    files = build(key, calibration, product_settings()[key](**GIVEN[key]), options)
    for one in files:
        (tmp_path / one.file_name).write_bytes(one.content)
    rng = np.random.default_rng(2)
    x, y = np.round(rng.uniform(2, 255, 400)), np.round(rng.uniform(2, 191, 400))
    expected = replace(calibration, before=product.options.tables).forward(x, y, chip=1)
    plain = calibration.forward(x, y, chip=1)
    effect = np.hypot(*(expected - plain).T).max()
    assert effect > 0.02  # arcsec: they are no trifle
    [back] = read_back(key, files, calibration, options)
    found = back.forward(x, y, 1, None)
    # on axes of its own: the best similarity, within which the file's frame lies
    z, w = (at @ [1, 1j] for at in (expected, found))
    left = []
    for v in (w, w.conj()):
        design = np.stack([np.ones_like(v), v], axis=1)
        left.append(np.abs(design @ np.linalg.lstsq(design, z, rcond=None)[0] - z).max())
    limit = 1e-6  # these pixels are nodes of STDGDC
    if key == "cpdis":  # whose nodes lie between pixels: as the file states, on other pixels
        limit = 0.1 * fits.getheader(tmp_path / "cpdis.fits", 1)["BDWORST"]
        assert limit < effect / 10
    assert min(left) < limit
    if key != "stdgdc":
        name = next(f.file_name for f in files if f.kind != PARAMETERS)
        assert read_calibration(tmp_path / name).filter == "F606W"


@pytest.mark.parametrize("key", ["sip", "tpv", "siaf", "idctab", "ast"])
def test_a_file_without_tables_says_so(product, key):
    [warning] = _left_out(key, product)
    assert "look-up tables of the run are not in this file" in warning
    assert _left_out(key, replace(product, options=BuildOptions())) == ()
    assert _left_out("jwst", product) == ()
