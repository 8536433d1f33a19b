"""`bayesdist apply`, `pam` and `handbook`: tables, runs, and whatever is wrong with the input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from numpy.testing import assert_allclose

from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.format import idctab_calibration
from bayesdist.formats.idctab.table import read_idctab, write_idctab
from bayesdist.infer import fit_linear, save_fit
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches
from tests.app.support import begin_stagewise, cli, good, one_sentence, refused, write_job

SIZE = (512.0, 256.0)


def model_of() -> DistortionModel:
    return DistortionModel(3, tuple(Chip(n, f"WFC{n}", SIZE, (256, 128)) for n in (2, 1)), "arcsec")


def truth_of(model: DistortionModel) -> np.ndarray:
    """Two chips of 0.05 arcsec, one above the other."""
    theta = np.zeros(model.n_params)
    for number, gap in ((2, 0.0), (1, 13.5)):
        basis = model.basis(number)
        for axis, terms in enumerate(
            (
                {(1, 0): 0.05, (2, 0): 1e-6, (0, 3): 2e-9},
                {(0, 1): 0.05, (1, 0): 0.003, (1, 1): 2e-6},
            )
        ):
            c = np.array([terms.get(t, 0.0) for t in basis.terms])
            c[0] = gap * axis
            theta[model.coefficient_slice(number, axis)] = basis.from_monomials(c)
    return theta


@pytest.fixture(scope="module")
def idctab(tmp_path_factory) -> Path:
    """A fit of some thousand stars, delivered with errors and INVERSE rows."""
    model = model_of()
    rng = np.random.default_rng(3)
    matches, _ = simulate_matches(model, truth_of(model), 2000, rng=rng, sigma=5e-4, fraction=0.0)
    fit = fit_linear(matches, model=model)
    made = idctab_from_solution(
        fit, instrument="ACS", detector="WFC", scale_arcsec=0.05, inverse=True
    )
    path = tmp_path_factory.mktemp("idctab") / "made_idc.fits"
    write_idctab(made, path)
    save_fit(fit, path.parent / "fit.nc")
    return path


@pytest.fixture
def stars(tmp_path) -> Path:
    rng = np.random.default_rng(1)
    table = Table({"name": [f"s{k}" for k in range(60)]})
    table["x"], table["y"] = rng.uniform(1, 512, 60), rng.uniform(1, 256, 60)
    table["chip"] = np.repeat([1, 2], 30)
    table.write(tmp_path / "stars.ecsv")
    return tmp_path / "stars.ecsv"


def test_there_and_back_by_every_method(idctab, stars, tmp_path):
    result = good("apply", idctab, stars, "-o", tmp_path / "out.fits", "--origin", 300, 150)
    assert "60 positions" in result.out and "standard deviation" in result.out
    given, out = Table.read(stars), Table.read(tmp_path / "out.fits")
    tab = read_idctab(idctab)
    for chip in (1, 2):
        on = given["chip"] == chip
        Xc, Yc = tab.evaluate(chip, given["x"][on], given["y"][on])
        r, base = tab.rows[tab.row(chip)], tab.rows[tab.row(2)]
        assert_allclose(out["x_out"][on], (Xc + r["V2REF"] - base["V2REF"]) / 0.05 + 300, atol=1e-8)
        assert_allclose(out["y_out"][on], (Yc - r["V3REF"] + base["V3REF"]) / 0.05 + 150, atol=1e-8)
    assert (np.asarray(out["sigma_x_out"]) > 0).all()
    assert (np.abs(out["corr_x_out_y_out"]) < 1).all()
    out.remove_columns(["x", "y", "chip", "sigma_x_out", "sigma_y_out", "corr_x_out_y_out"])
    out.write(tmp_path / "sky.ecsv")
    near = {"newton": 1e-8, "polynomial": 1e-3, "table": 1e-2}
    for method, tolerance in near.items():
        back = tmp_path / f"{method}.csv"
        result = good(
            "apply", idctab, tmp_path / "sky.ecsv", "-o", back, "--inverse", "--method", method,
            "--origin", 300, 150,
        )  # fmt: skip
        found = Table.read(back, format="ascii.csv")
        assert (found["chip"] == given["chip"]).all() and "closes to" in result.out
        miss = np.hypot(found["x"] - given["x"], found["y"] - given["y"])
        assert miss.max() < tolerance and (np.asarray(found["sigma_x"]) > 0).all()
        assert list(found["name"]) == list(given["name"])


def test_a_fit_is_applied_as_the_table_that_it_became(idctab, stars, tmp_path):
    good("apply", idctab, stars, "-o", tmp_path / "a.ecsv")
    fit = idctab.parent / "fit.nc"
    good("apply", fit, stars, "-o", tmp_path / "b.ecsv", "--scale", 0.05)
    a, b = (Table.read(tmp_path / f"{n}.ecsv") for n in "ab")
    for name in ("x_out", "y_out"):
        assert_allclose(a[name], b[name], atol=1e-7)
        assert_allclose(a[f"sigma_{name}"], b[f"sigma_{name}"], rtol=1e-6)
    assert b["x_out"].unit == "pix" and b.meta["scale"] == 0.05


def test_positions_beyond_are_counted(idctab, tmp_path):
    Table({"x": [100.0, 600.0, np.nan], "y": [100.0] * 3}).write(tmp_path / "t.fits")
    result = good("apply", idctab, tmp_path / "t.fits", "-o", tmp_path / "o.ecsv", "--chip", 2)
    assert "where polynomials are extrapolated: 1\n" in result.out
    Table({"a": [0.0, 1e6], "b": [0, 0]}).write(tmp_path / "back.ecsv")
    result = good(
        "apply", idctab, tmp_path / "back.ecsv", "-o", tmp_path / "p.ecsv", "--inverse",
        "--columns", "a", "b",
    )  # fmt: skip
    assert "whose x and y are NaN: 1\n" in result.out
    found = Table.read(tmp_path / "p.ecsv")
    assert list(found["chip"]) == [2, 0] and np.isnan(found["x"][1])


def test_subarrays_by_number_and_by_image(idctab, tmp_path):
    Table({"x": [101.0], "y": [51.0], "chip": [2]}).write(tmp_path / "whole.ecsv")
    Table({"x": [1.0], "y": [1.0], "chip": [2]}).write(tmp_path / "part.ecsv")
    image = fits.ImageHDU(np.zeros((64, 128), np.float32), name="SCI")
    image.header["CCDCHIP"], image.header["LTV1"], image.header["LTV2"] = 2, -100.0, -50.0
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "flt.fits")
    found = {}
    for name, options in (
        ("whole", ()), ("ltv", ("--ltv", -100, -50)), ("corner", ("--corner", 101, 51)),
        ("image", ("--image", tmp_path / "flt.fits")),
    ):  # fmt: skip
        table = tmp_path / ("whole.ecsv" if name == "whole" else "part.ecsv")
        good("apply", idctab, table, "-o", tmp_path / f"{name}.csv", *options)
        found[name] = Table.read(tmp_path / f"{name}.csv", format="ascii.csv")["x_out"][0]
    assert len({round(v, 9) for v in found.values()}) == 1
    good("hst", "pam", idctab, "-o", tmp_path / "pam.fits", "--image", tmp_path / "flt.fits")
    good("hst", "pam", idctab, "-o", tmp_path / "all.fits")
    with fits.open(tmp_path / "pam.fits") as part, fits.open(tmp_path / "all.fits") as whole:
        assert whole[1].header["CCDCHIP"] == 2  # the reference chip first, as in exposures
        assert_allclose(part[0].data, whole["SCI", 1].data[50:114, 100:228], rtol=1e-6)
        assert_allclose(part["ERR"].data, whole["ERR", 1].data[50:114, 100:228], rtol=1e-5)


def test_area_maps_say_how_well_they_are_known(idctab, tmp_path):
    result = good("hst", "pam", idctab, "-o", tmp_path / "one.fits", "--chip", 1)
    assert "mmag at worst" in result.out and "SCALE" in result.out
    c = idctab_calibration(read_idctab(idctab)).in_frame()[1]
    by_x, by_y = (c.coefficients @ g[0] for g in c.basis.gradient([30.0], [200.0]))
    wanted = (by_x[0] * by_y[1] - by_x[1] * by_y[0]) / 0.05**2
    assert_allclose(fits.getdata(tmp_path / "one.fits")[199, 29], wanted, rtol=1e-6)


def test_figures_and_numbers_of_a_table(idctab, tmp_path):
    result = good("hst", "handbook", idctab, "-o", tmp_path / "book")
    assert {p.name for p in (tmp_path / "book").iterdir()} == {
        "handbook.json", "non_linear.png", "pixel_area.png", "numbers.ecsv"
    }  # fmt: skip
    assert "no residuals" in result.out
    numbers = Table.read(tmp_path / "book" / "numbers.ecsv")
    assert numbers["published"][0] == "82" and numbers["unit"][0] == "output pix"


def test_a_run_is_shown_with_its_residuals(idctab, tmp_path):
    run = begin_stagewise(tmp_path / "run", write_job(tmp_path / "job"), "fit")
    result = good("hst", "handbook", run, "-o", tmp_path / "book", "--detector", "hrc")
    assert (tmp_path / "book" / "residuals.png").is_file() and "4.9" in result.out
    # a product beside the run is shown without them: its unit may be another one
    table = run / "made_idc.fits"
    table.write_bytes(idctab.read_bytes())
    assert (
        "no residuals, since this is not a run"
        in good("hst", "handbook", table, "-o", tmp_path / "p").out
    )
    table.unlink()
    # without the matches all else is shown
    for path in (tmp_path / "job").glob("*.ecsv"):
        path.unlink()
    result = good("hst", "handbook", run, "-o", tmp_path / "again")
    assert "no residuals: " in result.out and not (tmp_path / "again" / "residuals.png").exists()
    good("hst", "pam", run, "-o", tmp_path / "pam.fits")
    assert fits.getdata(tmp_path / "pam.fits").shape == (800, 1000)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("apply", "no_idc.fits", "S", "-o", "o.ecsv"), ["there is no such file"]),
        (("apply", "I", "S", "-o", "o.txt"), ["extension '.txt'"]),
        (("apply", "I", "S", "-o", "S", "--origin", "0", "0"), ["exists", "--force"]),
        (("apply", "S", "S", "-o", "o.ecsv"), ["an unknown format"]),
        (("apply", "I", "no.csv", "-o", "o.ecsv"), ["no.csv", "does not exist"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--inverse"), ["no column 'x_out'", "--columns"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--columns", "name", "y"), ["contain numbers"]),
        (("apply", "I", "N", "-o", "o.ecsv"), ["no column 'chip'", "--chip"]),
        (("apply", "I", "W", "-o", "o.ecsv"), ["row 2, column 'chip'", "chip 7"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--chip", "4"), ["no chip 4"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--scale", "0"), ["the scale is 0", "--scale"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--scale", "nan"), ["the scale is nan"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--vafactor", "-1"), ["aberration factor is -1"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--ltv", "1", "1", "--corner", "2", "2"), ["--ltv"]),
        (("apply", "I", "S", "-o", "o.ecsv", "--image", "I"), ["no SCI extension"]),
        (("apply", "I", "B", "-o", "o.ecsv"), ["column 'x_out' already"]),
        (("apply", "I", "B", "-o", "o.ecsv", "--inverse", "--columns", "x_out", "y",
          "--method", "polynomial", "--order", "13"), ["order of the inverse is 13"]),
        (("hst", "pam", "I", "-o", "pam.txt"), ["extension '.txt'"]),
        (("hst", "pam", "I", "-o", "S.fits"), ["exists", "--force"]),
        (("hst", "pam", "I", "-o", "pam.fits", "--chip", "9"), ["no chip 9"]),
        (("hst", "pam", "I", "-o", "pam.fits", "--image", "I"), ["no SCI extension"]),
        (("hst", "pam", "S", "-o", "pam.fits"), ["an unknown format"]),
        (("hst", "handbook", "I", "-o", "full"), ["full"]),
        (("hst", "handbook", "I", "-o", "new", "--detector", "UVIS"), ["no detector 'UVIS'"]),
        (("hst", "handbook", "I", "-o", "new", "--magnification", "0"), ["magnification is 0"]),
        (("hst", "handbook", "T", "-o", "new"), ["T_idc.fits"]),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence(idctab, stars, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    table = Table.read(stars)
    table[["x", "y"]].write("N.ecsv")
    wrong = table.copy()
    wrong["chip"][1] = 7
    wrong.write("W.ecsv")
    both = table.copy()
    both["x_out"] = 1.0
    both.write("B.ecsv")
    fits.PrimaryHDU().writeto("S.fits")
    Path("full").mkdir()
    Path("full", "a").write_text("")
    Path("T_idc.fits").write_bytes(idctab.read_bytes()[:7000])
    names = {
        "I": idctab,
        "S": stars,
        "N": "N.ecsv",
        "W": "W.ecsv",
        "B": "B.ecsv",
        "T": "T_idc.fits",
    }
    refused(tmp_path, *(names.get(a, a) for a in arguments), words=words)


def test_options_that_are_none_are_usage(idctab, stars, tmp_path):
    result = cli("apply", idctab, stars, "-o", tmp_path / "o.ecsv", "--method", "magic")
    assert result.code == 2
    result = cli(
        "apply", idctab, stars, "-o", tmp_path / "o.ecsv", "--inverse", "--method", "table"
    )
    assert result.code == 1
    one_sentence(result.err, "x_out")
