"""What every format has to keep."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.errors import BayesdistError, InputError
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Choice,
    FormatSettings,
)

from .support import StandIn, some_solution, wfc_model

IN_V2V3 = {
    "useafter": "2022-07-01T00:00:00", "pedigree": "GROUND", "author": "nobody",
    "v2ref": -453.4, "v3ref": -373.8, "v3idlyangle": 4.8,
}  # fmt: skip
SETTINGS = {
    "ast": {},
    "cpdis": {},
    "parameters": {},
    "idctab": {"instrument": "WFC3", "detector": "IR"},
    "sip": {},
    "stdgdc": {},
    "tpv": {},
    "wise_meta": {},
    "jwst": IN_V2V3 | {"instrument": "MIRI", "detector": "MIRIMAGE"},
    "roman": IN_V2V3 | {"detector": "WFI04", "optical_element": "F158"},
    "siaf": {"aperture": "MADE_UP"},
}
# errors that a file has by itself; what more there is stands in a file beside it
HOLD_COVARIANCE = ("cpdis", "idctab", "jwst", "parameters", "roman", "stdgdc")
ALONE = dict.fromkeys(("ast", "siaf", "sip", "tpv"), "none") | dict.fromkeys(
    HOLD_COVARIANCE, "covariance"
)
SCALE = 0.11
OPTIONS = BuildOptions(scale_arcsec=SCALE)
SIZES = {
    "stdgdc": (300.0, 225.0),  # it has tables of every pixel
    "wise_meta": (1016.0, 1016.0),
    "jwst": (1032.0, 1024.0),
    "roman": (4088.0, 4088.0),
}


def calibration_for(key: str) -> Calibration:
    """One chip in pixels, as the format can hold it."""
    if key in SIZES:
        size = SIZES[key]
        reference = ((size[0] + 1) / 2, (size[1] + 1) / 2)
        solution = some_solution(4, size=size, reference_pixel=reference)
        return calibration_of(solution, "made up", detector="W1" if key == "wise_meta" else "")
    return calibration_of(some_solution(4), "made up")


@cache
def built(key: str) -> Built:
    """The file itself, which comes after those that stand beside it."""
    settings = registry.product_settings()[key](**SETTINGS[key])
    *_, one = registry.build(key, calibration_for(key), settings, OPTIONS)
    return one


def content_of(one: Built) -> Content:
    return Content(one.file_name, one.content)


def test_every_format_that_can_be_built_is_tested_here():
    assert set(registry.product_settings()) == set(SETTINGS)
    ranks = [one.rank for one in registry.all_formats()]
    assert len(set(ranks)) == len(ranks) and ranks == sorted(ranks)


@pytest.mark.parametrize("key", SETTINGS)
def test_a_built_file_is_recognized_and_sound(key):
    document = registry.recognized(content_of(built(key)))
    assert document.format.key == key
    assert not [f for f in document.lint() if f.level == "error"]
    text = document.describe()
    assert "Findings" in text and text.startswith(document.name)


@pytest.mark.parametrize("key", SETTINGS)
def test_a_built_file_holds_the_calibration(key):
    """Its distortion by Legendre coefficients without the linear terms, and its errors."""
    ours = calibration_for(key).chip(origin="stated")
    theirs = registry.recognized(content_of(built(key))).calibration().chip(origin="stated")
    scale = SCALE if theirs.unit == "arcsec" else 1.0
    # seven digits of WISE's entries, the constants aside, which lie in other places
    digits = 1e-6 if key == "wise_meta" else 1e-11
    largest = np.abs(ours.coefficients).max()
    assert_allclose(
        theirs.coefficients[:, 1:] / scale, ours.coefficients[:, 1:], atol=digits * largest, rtol=0
    )
    assert theirs.errors == ALONE.get(key, "sigma")


@pytest.mark.parametrize("key", SETTINGS)
def test_settings_refuse_what_they_do_not_know(key):
    with pytest.raises(ValueError, match="colour"):
        registry.product_settings()[key](**SETTINGS[key], colour="red")


@pytest.mark.parametrize("key", SETTINGS)
def test_broken_content_is_our_error_or_none_of_ours(key, full):
    """Bytes cut, doubled and changed end in our errors, or in another reading of the file.

    Reduced, one of each kind for each format; tests/fuzz breaks the same files in more ways.
    """
    rng = np.random.default_rng(5)
    raw = built(key).content
    for k in range(24 if full else 3):
        if k % 3 == 0:
            broken = raw[: int(rng.integers(1, len(raw)))]
        elif k % 3 == 1:
            at = int(rng.integers(0, len(raw)))
            broken = raw[:at] + bytes(rng.integers(32, 127, 8).astype(np.uint8)) + raw[at + 8 :]
        else:
            broken = raw + raw[: int(rng.integers(1, len(raw)))]
        try:
            document = registry.recognized(Content("broken", broken))
            document.describe()
            document.lint()
            document.calibration(Choice(size=(1200.0, 900.0)))
        except BayesdistError as error:
            assert "broken" in str(error) or "HDU" in str(error) or "header" in str(error)


def test_an_unknown_format_cannot_be_built():
    with pytest.raises(InputError, match="no format 'ccdmap' that can be built"):
        registry.build("ccdmap", calibration_for("sip"), FormatSettings())


def test_a_table_that_holds_no_calibration_says_so(data_dir):
    document = registry.open_document(data_dir / "hst_reference" / "02c1450oj_d2i.fits")
    assert document.format.key == "lookup"
    with pytest.raises(InputError, match="D2IMFILE or NPOLFILE, which holds no calibration"):
        document.calibration()


# -- where positions are counted from -------------------------------------------------------------


def test_origins_of_a_table_and_of_a_solution(data_dir):
    """Chips of a table one by one are about their own zero points; a solution's are as it is."""
    real = registry.read_calibration(
        data_dir / "hst_reference" / "0461802ej_idc.fits", filter="F606W"
    )
    zero = [[2048.0], [1024.0]]
    for chip in (1, 2):
        assert_allclose(real.by_chip()[chip].at(*zero), 0, atol=1e-12)
    assert np.abs(real.in_frame()[1].at(*zero)).max() > 50
    assert_allclose(real.in_frame()[2].at(*zero), 0, atol=1e-12)
    model = wfc_model(3, drift=False)
    theta = np.zeros(model.n_params)
    for chip in (1, 2):
        for axis in (0, 1):
            c = np.zeros(model.basis(chip).n_terms)
            c[0], c[1 + axis] = 7.0 + chip, 0.05
            theta[model.coefficient_slice(chip, axis)] = model.basis(chip).from_monomials(c)
    made = calibration_of(StandIn(model, theta, np.eye(theta.size)))
    first = model.chips[0].number
    assert_allclose(made.by_chip()[first].at(*zero), 7.0 + first, rtol=1e-12)
    assert_allclose(made.in_frame()[first].at(*zero), 0, atol=1e-12)
    assert_allclose(made.in_frame()[first].covariance_at(*map(np.array, zero)), 0, atol=1e-9)
