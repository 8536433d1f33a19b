"""Quoted errors that are far too small, as a user of foreign tables meets them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.table import Table

from tests.app.support import SIZE, good, write_job
from tests.reduced import only_in_full

FACTOR = 300.0


def stars(factor, n=800):
    """Positions with errors over a decade, quoted too small by a factor, without false matches."""
    rng = np.random.default_rng(17)
    x, y = (rng.uniform(1, side, n) for side in SIZE)
    X, Y = x / SIZE[0] - 0.5, y / SIZE[1] - 0.5
    sigma = 0.05 * np.exp(rng.normal(0, 0.8, n))
    u, v = x + 4 * X**2 * Y + sigma * rng.normal(size=n), y - 3 * X * Y + sigma * rng.normal(size=n)
    table = Table({"x": x, "y": y, "u": u, "v": v, "su": sigma / factor, "sv": sigma / factor})
    for name in ("u", "v", "su", "sv"):
        table[name].unit = "pix"
    return table


def job(folder, factor):
    folder.mkdir()
    return write_job(folder, stars(factor), stars="stars.parquet", model={"order": 3})


def summary_of(folder, factor):
    good("run", job(folder, factor), "-o", folder / "run", "-q")
    return json.loads((folder / "run" / "summary.json").read_text())


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quoted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesdist.app.stages.report", lambda results, pdf: [])
        return summary_of(folder / "right", 1.0), summary_of(folder / "small", FACTOR)


def test_check_says_it_in_one_sentence(tmp_path):
    out = good("check", job(tmp_path / "small", FACTOR)).out
    (line,) = (one for one in out.splitlines() if "quoted errors say" in one)
    assert line.startswith("WARNING") and "check their unit" in line
    assert float(line.split("scatter ")[1].split()[0]) == pytest.approx(FACTOR, rel=0.1)
    assert "quoted errors say" not in good("check", job(tmp_path / "right", 1.0)).out


@pytest.mark.slow
@only_in_full("test_data_of_others has such a run")
def test_the_run_goes_on_with_errors_scaled(both):
    """Nothing but the size of all errors was lost: what comes out is that of the right errors."""
    right, small = both
    assert small["sampler"]["converged"] and "error_scale" not in right["fit"]
    assert small["fit"]["error_scale"] == pytest.approx(FACTOR, rel=0.1)
    assert small["sampler"]["passes"] < 3 * right["sampler"]["passes"]
    assert small["fit"]["chi2"] / small["fit"]["dof"] == pytest.approx(1.0, abs=0.2)
    assert small["map"]["radius_max"] == pytest.approx(right["map"]["radius_max"], rel=0.2)
    assert small["outliers"]["fraction"]["mean"] < 0.01
    core = np.hypot(small["outliers"]["jitter"]["mean"], 0.05)
    assert small["outliers"]["scale"]["mean"] > core


@pytest.mark.parametrize("names", [("ERRX2WIN_IMAGE", "ERRY2WIN_IMAGE"), ("x_err", "y_err"), ()])
def test_init_drafts_centroid_errors_beside_those_of_the_catalogue(tmp_path, names):
    """Errors of ra and dec alone are the catalogue's, and then the others come by magnitude."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(1, 1000, (2, 60))
    table = Table({"x": x, "y": y, "ra": 150 + 5e-5 * x, "dec": 2 + 5e-5 * y})
    table["ra_error"] = table["dec_error"] = 0.2
    table["mag"] = rng.uniform(14, 20, 60)
    for name in names:
        table[name] = 4e-4 if name.startswith("ERR") else 0.02
    for name in ("ra_error", "dec_error"):
        table[name].unit = "mas"
    table.write(tmp_path / "stars.ecsv")
    good("init", tmp_path / "c.toml", "--matches", tmp_path / "stars.ecsv")
    text = (tmp_path / "c.toml").read_text()
    assert ('sigma = "columns"' in text) == bool(names)
    assert ("are the catalogue's alone" in text) == (not names)
    for key, name in zip(("sigma_x", "sigma_y"), names, strict=False):
        assert f'{key} = "{name}"' in text
