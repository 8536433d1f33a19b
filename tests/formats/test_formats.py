"""What every format has to keep, and a new one that is found by its module alone."""

from __future__ import annotations

import json
import sys
import types
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist import formats
from bayesdist.calibration.calibration import Calibration, calibration_of, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.errors import BayesdistError, FormatError, InputError
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
)
from tests.app.support import good

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


# -- a format of one module -----------------------------------------------------------------------


@dataclass(frozen=True)
class Toy:
    """A scale and a bend, as JSON."""

    scale: float
    bend: float


class ToySettings(FormatSettings):
    digits: int = 17


def toy_module() -> types.ModuleType:
    def parse(content: Content) -> Toy | None:
        if not content.text.startswith('{"toy"'):
            return None
        try:
            return Toy(**json.loads(content.text)["toy"])
        except (TypeError, ValueError) as error:
            raise FormatError(f"is no toy ({error})", where=content.name, do="mend it") from error

    def lint(toy: Toy) -> list[Finding]:
        return [Finding("warning", "scale", "is negative")] if toy.scale < 0 else []

    def calibration(toy: Toy, name: str, choice: Choice) -> Calibration:
        def positions(x, y):
            dx, dy = x - 500.0, y - 400.0
            return toy.scale * (dx + toy.bend * dx**2), toy.scale * dy

        one = fitted_map(
            positions, name, order=2, size=choice.size or (1000.0, 800.0),
            reference_pixel=(500.0, 400.0), unit="arcsec", chip=1,
        )  # fmt: skip
        return calibration_of_maps({1: one}, name)

    def build(made: Calibration, settings: ToySettings, _: BuildOptions) -> tuple[Built, ...]:
        values = made.chip(origin="stated").monomials().values
        toy = {"scale": values[1, 2], "bend": values[0, 3] / values[0, 1]}
        text = json.dumps({"toy": {k: round(float(v), settings.digits) for k, v in toy.items()}})
        return (Built("toy.json", "toy", text.encode(), toy),)

    module = types.ModuleType(f"{formats.__name__}.toy")
    module.FORMAT = Format(
        "toy", "a toy", 9, parse, lambda toy: [f"toy of scale {toy.scale:g}"], lint, calibration,
        ToySettings, build,
    )  # fmt: skip
    return module


@pytest.fixture
def toy(monkeypatch, tmp_path) -> Path:
    """A file of a format that is one module more."""
    module = toy_module()
    entries = [*registry.pkgutil.iter_modules(formats.__path__)]
    extra = type(entries[0])(entries[0].module_finder, "toy", False)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(registry.pkgutil, "iter_modules", lambda path: [*entries, extra])
    registry.all_formats.cache_clear()
    path = tmp_path / "a.json"
    path.write_text('{"toy": {"scale": 0.05, "bend": 1e-6}}')
    yield path
    monkeypatch.undo()
    registry.all_formats.cache_clear()


def test_a_new_format_is_one_module(toy, tmp_path):
    """It is inspected, compared, applied and built without a change anywhere else."""
    assert good("inspect", toy).out.strip() == "toy of scale 0.05"
    other = tmp_path / "b.json"
    other.write_text('{"toy": {"scale": 0.05, "bend": 2e-6}}')
    assert good("compare", toy, other).out.startswith("The calibrations differ by")
    (tmp_path / "stars.csv").write_text("x,y,chip\n500,400,1\n600,500,1\n")
    good("apply", toy, tmp_path / "stars.csv", "-o", tmp_path / "out.csv")
    row = (tmp_path / "out.csv").read_text().splitlines()[-1].split(",")
    assert float(row[3]) == pytest.approx(100 + 1e-6 * 1e4, rel=1e-9)
    good("hst", "pam", toy, "-o", tmp_path / "pam.fits")
    settings = registry.product_settings()["toy"]()
    [one] = registry.build("toy", registry.read_calibration(toy), settings)
    again = registry.recognized(content_of(one))
    assert again.holds.scale == pytest.approx(0.05) and again.holds.bend == pytest.approx(1e-6)
    (tmp_path / "c.json").write_text('{"toy": {"scale": "x"}}')
    with pytest.raises(FormatError, match="is no toy"):
        registry.open_document(tmp_path / "c.json")
