"""A whole run: every file of a run directory, read by whoever reads such files."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import shutil
import tomllib
import warnings
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import astropy.units as apu
import numpy as np
import pytest
import xarray as xr
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS, FITSFixedWarning

import bayesdist
from bayesdist.app.commands.budget import exit_code
from bayesdist.app.config import load_config, parse_config
from bayesdist.app.screen import progress_bar
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import Summary, schema_text
from bayesdist.assess.terms.correlated import STRUCTURE, STRUCTURE_IN_FIT
from bayesdist.data import read_matches
from bayesdist.errors import InputError
from bayesdist.files.documents import read_json
from bayesdist.infer import load_fit, load_posterior, memberships, residuals
from tests.app.support import (
    SIZE,
    begin_stagewise,
    cli,
    config_text,
    good,
    process,
    summary_of,
    write_config,
    write_job,
)
from tests.reduced import only_in_full

FILES = (
    "config.toml run.json bayesdist.log fit.nc posterior.nc coefficients.ecsv maps.fits "
    "budget.ecsv margins.ecsv summary.json sip.hdr report.html"
).split()


@pytest.fixture(scope="module")
def posterior(finished):
    return load_posterior(finished.path)


@pytest.fixture(scope="module")
def matches(finished):
    return read_matches(finished.config.parent / "stars.ecsv")


@pytest.fixture
def copy(finished, tmp_path):
    """The finished run, to be changed."""
    return shutil.copytree(finished.path, tmp_path / "run")


# -- files ----------------------------------------------------------------------------------------


def test_every_file_is_there(finished):
    for name in FILES:
        assert (finished.path / name).stat().st_size > 0, name
    assert len(list(finished.path.glob("chain-*.h5"))) >= 4
    figures = sorted(p.name for p in (finished.path / "figures").iterdir())
    assert figures == sorted(summary_of(finished.path)["figures"]) and len(figures) >= 16
    assert len({name.partition(".")[0] for name in figures}) == len(figures)  # each drawn once
    assert not list(finished.path.rglob(".*"))


def test_the_configuration_is_kept_verbatim(finished):
    assert (finished.path / "config.toml").read_bytes() == finished.config.read_bytes()


def test_the_record(finished):
    record = json.loads((finished.path / "run.json").read_text())
    stars = finished.config.parent / "stars.ecsv"
    digest = hashlib.sha256(stars.read_bytes()).hexdigest()
    assert record["inputs"] == {stars.name: digest}
    assert (Path(record["base"]) / stars.name).samefile(stars)
    assert record["seed"] == 1
    for package in (
        "python",
        "numpy",
        "scipy",
        "astropy",
        "emcee",
        "numba",
        "arviz-stats",
        "bayesdist",
    ):
        assert re.match(r"\d+\.\d+", record["versions"][package]), package
    assert list(record["stages"]) == ["fit", "sample", "diagnose", "evaluate", "export", "report"]
    assert all(s["wall_s"] > 0 for s in record["stages"].values())
    assert record["command"].startswith("bayesdist run")
    # resolved: what the file leaves out stands here with its default
    assert record["config"]["fit"]["clip_chi2"] == 25.0
    assert record["config"]["sampler"]["ensembles"] == 4


def test_the_log(finished):
    log = (finished.path / "bayesdist.log").read_text()
    for stage in ("fit", "sample", "diagnose", "evaluate", "export", "report"):
        assert f"{stage}: begins" in log
    # the screen says the same, and draws no bar where it is no terminal
    assert "fit: begins" in finished.result.err
    assert "\r" not in finished.result.err and "%|" not in finished.result.err


def test_a_bar_is_drawn_on_a_terminal_only(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream, drawn in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr("sys.stderr", stream)
        with progress_bar("sample") as update:
            update(50, 200)
            update(200, 200)
        assert ("sample" in stream.getvalue()) == drawn


def test_the_screen(finished):
    out = finished.result.out
    for word in ("Error budget", "coefficients", "catalogue", "Margins", "too tight", "missed"):
        assert word in out
    assert str(finished.path / "report.html") in out


# -- summary.json ---------------------------------------------------------------------------------


def _leaves(value, path=""):
    if isinstance(value, dict):
        for k, v in value.items():
            yield from _leaves(v, f"{path}.{k}")
    elif isinstance(value, list):
        for v in value:
            yield from _leaves(v, f"{path}[]")
    else:
        yield path, value


KEYS = {
    "data": ("n_rows", "n_used", "n_rejected"),
    "fit": ("order", "chi2", "dof", "rms_u", "rms_v", "unit"),
    "outliers": ("fraction", "jitter", "n_flagged"),
    "sampler": (
        "method converged rhat_max ess_bulk_min ess_tail_min passes acceptance wall_s".split()
    ),
    "map": ("unit", "sigma_u_max", "sigma_v_max", "radius_max", "position_of_max"),
}
ROWS = {
    "budget": ("name", "kind", "u", "v", "radial"),
    "margins": "name statistic limit value interval probability_met verdict".split(),
    "products": ("path",),
}


def test_the_summary_has_what_the_design_lists(finished):
    text = (finished.path / "summary.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    summary = json.loads(text)
    assert summary["schema"] == 2
    for section, keys in KEYS.items():
        assert set(keys) <= summary[section].keys(), section
    for section, keys in ROWS.items():
        assert summary[section]
        for row in summary[section]:
            assert set(keys) <= row.keys(), section
    for path, value in _leaves(summary):
        if isinstance(value, float):
            assert math.isfinite(value), path
        if isinstance(value, str):  # a number never hides in a string
            with pytest.raises(ValueError, match="could not convert"):
                float(value)
    for key in ("fraction", "jitter"):
        assert set(summary["outliers"][key]) >= {"mean", "sd"}


def _without_defaults(schema):
    """The same JSON Schema without what says nothing new, and some versions of pydantic write."""
    if isinstance(schema, list):
        return [_without_defaults(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    idle = [("additionalProperties", True), ("enum", [schema.get("const")])]
    return {k: _without_defaults(v) for k, v in schema.items() if (k, v) not in idle}


def test_the_summary_is_as_its_schema_has_it(finished):
    """The model is that of the JSON Schema in the package, and the file fits it."""
    there = Path(bayesdist.__file__).parent / "app" / "store" / "schema.json"
    stated, defined = (json.loads(text) for text in (there.read_text("utf-8"), schema_text()))
    assert _without_defaults(stated) == _without_defaults(defined)
    found = Summary.model_validate(summary_of(finished.path))
    assert (found.kind, found.detector, found.simulated) == ("data", "A", False)
    assert found.began == json.loads((finished.path / "run.json").read_text())["created"]
    assert found.misfit.power == 1.0 and found.budget[-1].name == "total"


def test_the_geometry_is_in_the_summary_the_terminal_and_the_log(finished):
    [row] = summary_of(finished.path)["fit"]["geometry"]
    x, y = np.array([600.5, 500.5, 500.5]), np.array([400.5, 500.5, 400.5])
    model = finished.truth.model
    at = model.predict(finished.truth.theta, x, y)
    along_x, along_y = at[0] - at[2], at[1] - at[2]
    scales = np.hypot(*along_x) / 100, np.hypot(*along_y) / 100
    assert (row["scale_x"], row["scale_y"]) == pytest.approx(scales, rel=1e-3)
    angle = np.degrees(np.arctan2(along_y[0], along_y[1]))
    assert row["position_angle"] == pytest.approx(angle, abs=0.1)
    assert row["parity"] == np.sign(along_x[0] * along_y[1] - along_x[1] * along_y[0])
    said = f"chip 1: {row['sentence']}"
    assert said in finished.result.out.splitlines()
    assert said in (finished.path / "bayesdist.log").read_text(encoding="utf-8")


def test_the_summary_counts_what_there_is(finished, posterior, matches):
    s = summary_of(finished.path)
    assert s["data"]["n_rows"] == 400
    assert s["data"]["n_used"] + s["data"]["n_rejected"] == 400
    assert s["data"]["n_rejected"] == sum(s["data"]["rejected"].values())
    fit = load_fit(finished.path / "fit.nc")
    used = fit.uses(matches)
    assert s["data"]["n_used"] == used.sum()
    assert s["fit"]["dof"] == 2 * used.sum() - 12
    r = residuals(fit, matches)[used, 0]
    assert s["fit"]["rms_u"] == pytest.approx(np.sqrt(np.mean(r**2)))
    assert s["outliers"]["fraction"]["mean"] == pytest.approx(posterior.hyper["f"].mean())
    flagged = memberships(posterior, matches).outlier_probability > 0.5
    assert s["outliers"]["n_flagged"] == posterior.n_flagged == flagged.sum()
    assert s["sampler"]["converged"] is True


def test_the_posterior_finds_the_truth(finished, posterior, matches):
    """12 coefficients, f, j and s_out: chi-square with 15 degrees of freedom stays below 45."""
    off = posterior.mean - finished.truth.theta
    chi2 = off @ np.linalg.solve(posterior.cov, off)
    for key, true in (("f", "fraction"), ("j", "jitter"), ("s_out", "outlier_scale")):
        values = posterior.hyper[key]
        chi2 += ((values.mean() - getattr(finished.truth, true)) / values.std()) ** 2
    assert chi2 < 45.0
    false = finished.truth.false
    flagged = memberships(posterior, matches).outlier_probability > 0.5
    assert (flagged & false).sum() > 0.7 * false.sum()  # those within 2 sigma look like true ones
    assert (flagged & ~false).sum() <= 2


# -- tables and images, read by their own readers -------------------------------------------------


def test_the_posterior_opens_in_arviz_and_xarray(finished, posterior):
    import arviz

    data = arviz.from_netcdf(finished.path / "posterior.nc")
    groups = ("posterior", "sample_stats", "observed_data", "constant_data")
    assert set(groups) <= set(data.groups())
    np.testing.assert_array_equal(data.posterior["theta"], posterior.theta)
    with xr.open_datatree(finished.path / "posterior.nc", engine="h5netcdf") as tree:
        provenance = json.loads(tree.attrs["provenance"])
    assert provenance["inputs"] == json.loads((finished.path / "run.json").read_text())["inputs"]


def test_coefficients_agree_with_the_draws(finished, posterior):
    table = Table.read(finished.path / "coefficients.ecsv")
    fit = load_fit(finished.path / "fit.nc")
    legendre = table[table["form"] == "legendre"]
    assert list(legendre["name"]) == list(posterior.model.names)
    np.testing.assert_allclose(legendre["mean"], posterior.mean, rtol=1e-12, atol=1e-12)
    # by the likelihood; the table has what the model may leave out beside
    ratio = legendre["sd"] / posterior.sigma
    assert 0.85 < np.median(ratio) < 1.5
    np.testing.assert_allclose(legendre["lsq_value"], fit.mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(legendre["lsq_sigma"], fit.sigma, rtol=1e-9)
    drawn = posterior.mean + (posterior.flat - posterior.mean) * np.asarray(ratio)
    inside = (drawn > np.asarray(legendre["lo68"])) & (drawn < np.asarray(legendre["hi68"]))
    np.testing.assert_allclose(inside.mean(axis=0), 0.68, atol=0.03)
    np.testing.assert_allclose(legendre["rhat"], posterior.convergence.rhat[:12])
    # the monomial form is the same polynomial
    basis, x, y = posterior.model.basis(), 123.0, 678.0
    monomial = table[(table["form"] == "monomial") & (table["axis"] == "v")]
    dx, dy = x - basis.reference_pixel[0], y - basis.reference_pixel[1]
    value = sum(m["mean"] * dx ** int(m["i"]) * dy ** int(m["j"]) for m in monomial)
    predicted = posterior.model.predict(posterior.mean, np.array([x]), np.array([y]))[0, 1]
    assert value == pytest.approx(predicted, abs=1e-9)


def test_the_budget_adds_up(finished):
    table = Table.read(finished.path / "budget.ecsv")
    rows = {r["name"]: r for r in table}
    # what files differ by is shown, and adds to no total
    files = [r["name"] for r in table if r["kind"] == "product"]
    assert files[:2] == ["sip.hdr, forward", "sip.hdr, inverse"]
    own = ["coefficients", STRUCTURE_IN_FIT, STRUCTURE]
    assert list(rows) == [*own, "catalogue", "centroid", *files, "total"]
    assert rows["catalogue"]["u"] == pytest.approx(0.003)
    assert rows["centroid"]["v"] == pytest.approx(0.2 / 50.0)  # 50 mas in a pixel
    for axis in ("u", "v", "radial"):
        assert table[axis].unit == "pix"
        parts = np.array([rows[n][axis] for n in list(rows)[:5]])
        # draws of the parts of the model are correlated by chance
        assert rows["total"][axis] == pytest.approx(np.sqrt((parts**2).sum()), rel=0.02)
    for row, stated in zip(table, summary_of(finished.path)["budget"], strict=True):
        assert row["radial"] == pytest.approx(stated["radial"])


def test_the_coefficient_term_is_the_spread_of_the_draws(finished, posterior):
    """rms over the grid of the posterior's own scatter at its points."""
    x, y = np.meshgrid(np.linspace(1, SIZE[0], 9), np.linspace(1, SIZE[1], 7))
    drawn = posterior.model.predict(posterior.flat, x.ravel(), y.ravel())
    rms = np.sqrt(drawn.var(axis=0).mean(axis=0))
    (row,) = [r for r in summary_of(finished.path)["budget"] if r["name"] == "coefficients"]
    # the stars' scatter stands for the quoted errors: of 400 it is known to some percent
    assert [row["u"], row["v"]] == pytest.approx(rms, rel=0.2)
    with fits.open(finished.path / "maps.fits") as hdus:
        field = drawn.std(axis=0).reshape(7, 9, 2)
        for a, axis in enumerate("UV"):
            # with what the model may leave out
            ratio = hdus[f"MIX_SIGMA_{axis}"].data / field[..., a]
            assert 0.9 < np.median(ratio) < 1.7


def test_margins_agree_in_all_places(finished):
    table = Table.read(finished.path / "margins.ecsv")
    stated = summary_of(finished.path)["margins"]
    assert [m["verdict"] for m in stated] == ["met", "met", "missed"]
    for row, m in zip(table, stated, strict=True):
        assert row["name"] == m["name"] and row["verdict"] == m["verdict"]
        assert row["unit"] == m["unit"]
        for key in ("limit", "value", "margin", "probability", "probability_met", "mc_error"):
            assert row[key] == pytest.approx(m[key])
        assert m["interval"] == [row["lo95"], row["hi95"]]
        assert m["interval"][0] < m["value"] < m["interval"][1]
    # the error of the mean position: at most the catalogue's, the centroid's and ours in quadrature
    rms = next(m for m in stated if m["name"] == "in mas")
    total = summary_of(finished.path)["budget"][-1]["radial"] * 50.0
    assert rms["value"] == pytest.approx(total, rel=0.5)


def test_maps_say_where_their_points_lie(finished):
    with fits.open(finished.path / "maps.fits", checksum=True) as hdus:
        names = [h.name for h in hdus[1:]]
        assert names[:6] == [
            f"{kind}_{what}" for kind in ("LSQ", "MIX") for what in ("SIGMA_U", "SIGMA_V", "CORR")
        ]
        for hdu in hdus[1:]:
            assert hdu.data.shape == (7, 9) and np.isfinite(hdu.data).all()
            wcs = WCS(hdu.header)
            np.testing.assert_allclose(wcs.pixel_to_world_values(0, 0), (1, 1))
            np.testing.assert_allclose(wcs.pixel_to_world_values(8, 6), SIZE)
        sigma = hdus["MIX_SIGMA_U"].data
        stated = summary_of(finished.path)["map"]
        assert sigma.max() == pytest.approx(stated["sigma_u_max"])
        assert stated["position_of_max"][0] in np.linspace(1, SIZE[0], 9)
        assert np.abs(hdus["MIX_CORR"].data).max() <= 1


def test_sip_in_astropy_maps_pixels_as_the_posterior_mean(finished, posterior, rng):
    header = fits.Header.fromtextfile(finished.path / "sip.hdr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header)
    pixels = 0.5 + rng.uniform(size=(1000, 2)) * SIZE
    focal = wcs.sip_pix2foc(pixels, 1)  # counted from CRPIX
    u, v = posterior.model.predict(posterior.mean, *pixels.T).T
    (u0, v0), = posterior.model.predict(posterior.mean, *wcs.wcs.crpix[:, None])  # fmt: skip
    plane = focal @ wcs.wcs.cd.T * 3600 / 0.050  # 50 mas in a pixel
    np.testing.assert_allclose(plane, np.column_stack([u - u0, v - v0]), atol=1e-9)
    # and to the sky
    ra, dec = np.deg2rad(wcs.all_pix2world(pixels, 1)).T
    z = np.cos(dec) * np.cos(ra)
    xi, eta = np.cos(dec) * np.sin(ra) / z, np.sin(dec) / z
    scale = np.deg2rad(0.050 / 3600)
    np.testing.assert_allclose(xi / scale, u - u0, atol=1e-6)
    np.testing.assert_allclose(eta / scale, v - v0, atol=1e-6)


def test_the_inverse_closes_as_stated(finished, rng):
    """AP, BP evaluated by hand: all_world2pix does not use them."""
    header = fits.Header.fromtextfile(finished.path / "sip.hdr")
    p = 0.5 + rng.uniform(size=(2000, 2)) * SIZE - [header["CRPIX1"], header["CRPIX2"]]

    def polynomial(prefix, x, y):
        order = header[f"{prefix}_ORDER"]
        return sum(
            header.get(f"{prefix}_{i}_{j}", 0.0) * x**i * y**j
            for i in range(order + 1)
            for j in range(order + 1 - i)
        )

    forward = p + np.column_stack([polynomial(k, *p.T) for k in "AB"])
    back = forward + np.column_stack([polynomial(k, *forward.T) for k in ("AP", "BP")])
    assert header["AP_ORDER"] == 4
    worst = np.abs(back - p).max()
    _, product = summary_of(finished.path)["products"]  # after the file of parameters
    assert worst <= 1.05 * product["closure_pix"] < 1e-3
    assert np.abs(polynomial("A", *p.T)).max() <= header["A_DMAX"] * (1 + 1e-9)
    assert np.abs(polynomial("A", *p.T)).max() > 0.9 * header["A_DMAX"]


class _Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.targets = []
        self.sources = []  # that a browser loads

    def handle_starttag(self, tag, attrs):
        self.sources += [v for k, v in attrs if k == "src" or (k == "href" and tag != "a")]
        self.targets += [v for k, v in attrs if k in ("src", "href") and v]


def test_the_report_is_one_file(finished):
    text = (finished.path / "report.html").read_text(encoding="utf-8")
    links = _Links()
    links.feed(text)
    assert all(t.startswith(("data:", "#")) for t in links.targets)
    assert all(t.startswith("data:") for t in links.sources)
    for word in ("too tight", "catalogue", "u_1_0", "sip.hdr", bayesdist.__version__):
        assert word in text
    assert "NOT CONVERGED" not in text


# -- stages by themselves, seeds ------------------------------------------------------------------


def _tables(folder):
    return {
        name: (folder / name).read_text()
        for name in ("coefficients.ecsv", "budget.ecsv", "margins.ecsv", "sip.hdr")
    }


def test_a_stage_after_a_run_by_relative_paths(tmp_path, monkeypatch):
    """Inputs are the same files from wherever they are named."""
    config = write_job(tmp_path / "job")
    run = config.parent / "run"
    run.mkdir()
    text = config.read_text().replace('"stars.ecsv"', '"../stars.ecsv"')
    (run / "config.toml").write_text(text)
    monkeypatch.chdir(config.parent)
    good("stage", "fit", "run")
    monkeypatch.chdir("/")
    good("stage", "sample", run)


def test_each_stage_by_itself_gives_the_same_numbers(copy, posterior):
    before, tables = summary_of(copy), _tables(copy)
    maps = fits.getdata(copy / "maps.fits", "MIX_CORR")
    for stage in ("fit", "sample", "assess", "export"):
        good("stage", stage, copy)
        after = summary_of(copy)
        for section in ("data", "fit", "outliers", "map", "budget", "margins", "products"):
            assert after[section] == before[section], (stage, section)
        sampler = {k: v for k, v in after["sampler"].items() if k != "wall_s"}
        assert sampler.items() <= before["sampler"].items()
    assert _tables(copy) == tables
    np.testing.assert_array_equal(fits.getdata(copy / "maps.fits", "MIX_CORR"), maps)
    np.testing.assert_array_equal(load_posterior(copy).theta, posterior.theta)


@pytest.mark.slow
@only_in_full("tests/infer/sampler loses checkpoints")
def test_without_its_checkpoints_it_samples_the_same_again(copy, posterior):
    for path in copy.glob("chain-*.h5"):
        path.unlink()
    good("stage", "sample", copy)
    again = load_posterior(copy)
    np.testing.assert_array_equal(again.theta, posterior.theta)
    np.testing.assert_array_equal(again.log_prob, posterior.log_prob)
    for key, values in posterior.hyper.items():
        np.testing.assert_array_equal(again.hyper[key], values)


def test_two_runs_of_one_seed_are_identical(finished, posterior, tmp_path):
    other = begin_stagewise(tmp_path / "again", finished.config, "fit", "sample")
    np.testing.assert_array_equal(load_posterior(other).theta, posterior.theta)


@pytest.mark.slow
@only_in_full("runs of one seed are compared")
def test_another_seed_agrees_within_its_monte_carlo_error(finished, posterior, tmp_path):
    text = finished.config.read_text().replace("[sampler]", "[sampler]\nseed = 2")
    config = finished.config.with_name("seed2.toml")
    config.write_text(text)
    other = load_posterior(begin_stagewise(tmp_path / "two", config, "fit", "sample"))
    assert other.sampler.seed == 2
    assert not np.array_equal(other.theta, posterior.theta)
    mcse = np.hypot(posterior.convergence.mcse_mean[:12], other.convergence.mcse_mean[:12])
    assert (np.abs(other.mean - posterior.mean) < 5 * mcse).all()
    np.testing.assert_allclose(other.sigma, posterior.sigma, rtol=0.15)


def test_the_seed_of_the_command_line_is_recorded(finished, tmp_path):
    """... and rules: --seed 1 in place of a configured 2 gives what seed 1 gives."""
    config, text = load_config(finished.config)
    run = RunDirectory.plan(tmp_path / "r", config, text, finished.config.parent, seed=77)
    assert run.facts["seed"] == 77 and run.config.sampler.seed == 77
    assert not (tmp_path / "r").exists()


def test_resuming_a_finished_run_changes_nothing(copy, finished):
    names = set(FILES) - {"bayesdist.log", "run.json"}
    before, record = {n: (copy / n).read_bytes() for n in names}, read_json(copy / "run.json")
    good("run", finished.config, "-o", copy, "--resume", "--seed", "1")
    assert {n: (copy / n).read_bytes() for n in names} == before
    # a copy lies elsewhere as seen from its inputs, and so has another checksum
    elsewhere = Path(os.path.relpath(finished.config.parent, copy)).as_posix()
    after = read_json(copy / "run.json")
    assert after.pop("sha256") != record.pop("sha256")
    assert after == record | {"base_from_run": elsewhere}


def test_an_interrupted_run_goes_on(finished, posterior, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("bayesdist.app.stages.diagnose", interrupt)
        result = cli("run", finished.config, "-o", tmp_path / "run")
    assert result.code == 130 and "--resume" in result.err and "Traceback" not in result.err
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert list(record["stages"]) == ["fit", "sample"]
    monkeypatch.setattr("bayesdist.app.stages.report", lambda results, pdf: [])
    result = good("run", finished.config, "-o", tmp_path / "run", "--resume")
    assert "sample: done before" in result.err
    np.testing.assert_array_equal(load_posterior(tmp_path / "run").theta, posterior.theta)


# -- not converged --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unconverged(finished, tmp_path_factory):
    folder = tmp_path_factory.mktemp("strict")
    text = finished.config.read_text().replace(
        '"stars.ecsv"', f'"{finished.config.parent}/stars.ecsv"'
    )
    text = re.sub(r"target_ess = \S+", "target_ess = 1e6\nmax_steps = 20", text)
    (folder / "c.toml").write_text(text)
    return folder / "run", cli("run", folder / "c.toml", "-o", folder / "run", "--strict")


def test_strict_exits_3_with_all_outputs(unconverged):
    run, result = unconverged
    assert result.code == 3
    last = result.err.splitlines()[-1]
    assert last.startswith("bayesdist: ") and "not converged" in last and "max_steps" in last
    for name in FILES:
        assert (run / name).stat().st_size > 0, name


def test_nobody_is_left_in_doubt_about_convergence(unconverged):
    run, _ = unconverged
    summary = summary_of(run)
    assert summary["sampler"]["converged"] is False and summary["sampler"]["reasons"]
    assert summary["sampler"]["steps"] == 20
    assert {m["verdict"] for m in summary["margins"]} == {"undecided"}
    assert set(Table.read(run / "margins.ecsv")["verdict"]) == {"undecided"}
    assert "NOT CONVERGED" in (run / "report.html").read_text(encoding="utf-8")
    assert "NOT CONVERGED" in (run / "bayesdist.log").read_text()
    assert "NOT CONVERGED" in good("inspect", run).out


def test_max_steps_is_a_total(unconverged, finished):
    """A resumed run does not get another 20 steps; and it is judged again."""
    run, _ = unconverged
    config = run.parent / "c.toml"
    result = cli("run", config, "-o", run, "--resume", "--strict")
    assert result.code == 3
    assert load_posterior(run).sampler.steps == 20
    assert cli("stage", "sample", run, "--strict").code == 3
    assert cli("stage", "sample", run).code == 0
    assert load_posterior(run).sampler.steps == 20


@pytest.mark.parametrize(
    ("sections", "title"),
    [
        ({"detector": {"name": "W2", "size": SIZE}}, "W2"),
        ({"detector": {"size": SIZE}}, ""),
        (
            {
                "detector": None,
                "model": {"order": 2},
                "chip": [
                    {"number": k, "name": f"C{k}", "size": SIZE, "reference_pixel": (1.0, 1.0)}
                    for k in (1, 2)
                ],
            },
            "C1 and C2",
        ),
        (
            {
                "detector": {
                    "name": "WFC",
                    "size": SIZE,
                    "mission": "HST",
                    "instrument": "ACS",
                    "filter": "F606W",
                }
            },
            "HST ACS WFC, F606W",
        ),
    ],
)
def test_a_report_is_titled_by_what_was_calibrated(sections, title):
    assert parse_config(config_text(**sections), "c.toml").detector_title == title


def test_the_report_says_which_folder_it_is_of(finished):
    text = (finished.path / "report.html").read_text(encoding="utf-8")
    assert "<h1>A</h1>" in text and "<title>A: geometric distortion</title>" in text
    assert re.search(rf"Folder</th><td>{finished.path.name}</td>", text)


def test_figures_are_listed_once_they_are_there(copy, monkeypatch):
    def full(drawings, folder):
        raise InputError("No space left on device", where=str(folder), do="make room")

    monkeypatch.setattr("bayesdist.report.drawing.save_drawings", full)
    assert cli("stage", "report", copy).code == 1
    assert "figures" not in summary_of(copy)
    assert not (copy / "figures").exists()


def test_figures_are_drawn_as_pdf_where_that_is_asked_for(copy):
    assert not [name for name in summary_of(copy)["figures"] if name.endswith(".pdf")]
    assert cli("stage", "report", copy, "--pdf").code == 0
    written = {p.name for p in (copy / "figures").iterdir()}
    assert written == set(summary_of(copy)["figures"])
    drawn = {name.partition(".")[0] for name in written}
    assert {name.removesuffix(".pdf") for name in written if name.endswith(".pdf")} == drawn


# -- validate, check, init, inspect, demo ---------------------------------------------------------


def _requirements(path, *blocks):
    none = dict.fromkeys(("data", "detector", "model", "sampler", "assess"))
    return write_config(path, **none, requirement=list(blocks))


def test_validate_replaces_the_margins(copy, tmp_path):
    loose = {"name": "new", "statistic": "u_rms", "limit": 0.5, "probability": 0.9}
    tight = {"name": "tight", "statistic": "v_max", "limit": 1e-5}
    before = summary_of(copy)
    result = cli("requirements", copy, "--requirements", _requirements(tmp_path / "a.toml", loose))
    assert result.code == 0 and "new" in result.out
    assert [m["name"] for m in summary_of(copy)["margins"]] == ["new"]
    assert list(Table.read(copy / "margins.ecsv")["name"]) == ["new"]
    both = _requirements(tmp_path / "b.toml", loose, tight)
    result = cli("requirements", copy, "--requirements", both)
    assert result.code == 4 and "tight: missed" in result.out and result.err == ""
    after = summary_of(copy)
    assert [m["verdict"] for m in after["margins"]] == ["met", "missed"]
    assert {k: v for k, v in after.items() if k != "margins"} == {
        k: v for k, v in before.items() if k != "margins"
    }


def test_a_report_of_earlier_margins_is_told_and_renewed(copy, finished, tmp_path):
    """It is not done any more, so that --resume makes it anew as well as `report`."""
    blocks = tomllib.loads(finished.config.read_text(encoding="utf-8"))["requirement"]
    again = _requirements(tmp_path / "same.toml", *blocks)
    assert "renew it" not in cli("requirements", copy, "--requirements", again).out
    assert "report" in json.loads((copy / "run.json").read_text())["stages"]
    new = {"name": "brand new", "statistic": "u_rms", "limit": 0.5, "region": "inner 80 %"}
    path = _requirements(tmp_path / "new.toml", new)
    for _ in range(2):
        result = cli("requirements", copy, "--requirements", path)
        renew = f"renew it by 'bayesdist stage report {copy}'"
        line = f"{copy / 'report.html'} shows earlier margins; {renew}"
        assert result.code == 0 and result.out.splitlines()[-1] == line
        assert "over the inner 80 %" in result.out
    good("run", finished.config, "-o", copy, "--resume")
    assert "brand new" in (copy / "report.html").read_text(encoding="utf-8")
    assert "renew it" not in cli("requirements", copy, "--requirements", path).out


DATED = {"name": "dated", "statistic": "rms", "limit": 1.0, "epoch": 2006.5}
NOTHING = "nothing in the model depends on time, so that the dates given change nothing"


@pytest.fixture
def dated(tmp_path, finished):
    """A configuration that asks for dates, of stars that have them."""
    table = Table.read(finished.config.parent / "stars.ecsv")
    table["epoch"] = np.linspace(2004.0, 2010.0, len(table))
    assess = {"epoch": 2005.0, "grid": (9, 7), "draws": 400}
    return write_job(tmp_path / "job", table, assess=assess, requirement=[DATED])


def test_dates_that_change_nothing_are_told(dated):
    """By check; where something drifts nothing is said."""
    both = f"WARNING      {NOTHING} (assess.epoch, of requirement 'dated')"
    assert both in good("check", dated).out.splitlines()
    drift = {"epoch0": 2004.0, "terms": [["u", 1, 0]]}
    drifting = {"assess": {"epoch": 2005.0}, "requirement": [DATED], "model.tdd": drift}
    assert NOTHING not in good("check", write_config(dated, **drifting)).out


@pytest.mark.slow
@only_in_full("check tells it, and test_budget_and_validity judges at dates")
def test_dates_that_change_nothing_are_told_by_a_run(dated, tmp_path):
    """In the log of assess, and by validate."""
    run = begin_stagewise(tmp_path / "run", dated, "fit", "sample", "assess")
    assert (run / "bayesdist.log").read_text().count(NOTHING) == 1
    req = _requirements(tmp_path / "req.toml", DATED)
    out = good("requirements", run, "--requirements", req).out
    assert f"WARNING: {req}: {NOTHING} (of requirement 'dated')" in out.splitlines()
    undated = {key: value for key, value in DATED.items() if key != "epoch"}
    out = good(
        "requirements", run, "--requirements", _requirements(tmp_path / "b.toml", undated)
    ).out
    assert NOTHING not in out


def test_validate_of_an_unconverged_run_is_not_met(unconverged, tmp_path):
    loose = {"name": "new", "statistic": "rms", "limit": 100.0}
    run = shutil.copytree(unconverged[0], tmp_path / "run")
    path = _requirements(tmp_path / "a.toml", loose)
    result = cli("requirements", run, "--requirements", path)
    assert result.code == 6 and "undecided: the posterior is not converged" in result.out


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        ((), 0),
        (("met", "met"), 0),
        (("met", "not shown"), 5),
        (("not shown", "undecided", "met"), 6),
        (("undecided", "missed", "not shown"), 4),
    ],
)
def test_the_exit_code_of_requirements_tells_the_verdicts_apart(verdicts, code):
    assert exit_code([SimpleNamespace(verdict=verdict) for verdict in verdicts]) == code


def test_check_samples_nothing(finished):
    before = sorted(finished.config.parent.iterdir())
    out = good("check", finished.config).out
    assert "12 of 12" in out and "cost" in out and "400 of 400 rows" in out and "pix" in out
    assert sorted(finished.config.parent.iterdir()) == before


def test_check_names_what_is_degenerate(tmp_path):
    """Two exposures of one epoch: a drift cannot be told from the constant part."""
    table = Table.read(write_job(tmp_path / "job").with_name("stars.ecsv"))
    table["epoch"] = 2010.0
    table.write(tmp_path / "job" / "stars.ecsv", overwrite=True)
    config = write_config(
        tmp_path / "job" / "c.toml", **{"model.tdd": {"epoch0": 2004.0, "terms": [["u", 1, 0]]}}
    )
    result = cli("check", config)
    assert result.code == 1 and "u_1_0" in result.err and "rate" in result.err


@pytest.mark.parametrize("suffix", ["ecsv", "csv", "fits", "parquet"])
@pytest.mark.parametrize("errors", ["columns", "by_magnitude", "none"])
def test_init_writes_what_check_accepts(tmp_path, finished, suffix, errors):
    table = Table.read(finished.config.parent / "stars.ecsv")
    if errors != "columns":
        table.remove_columns(["sigma_u", "sigma_v"])
    if errors == "none":
        table.remove_column("mag")
    if suffix == "csv":
        table = Table({name: np.asarray(table[name]) for name in table.colnames})
    table.write(tmp_path / f"stars.{suffix}")
    good("init", tmp_path / "c.toml", "--matches", tmp_path / f"stars.{suffix}")
    out = good("check", tmp_path / "c.toml").out
    assert ("by magnitude" in out) == (errors == "by_magnitude")
    text = (tmp_path / "c.toml").read_text()
    nx, ny = map(int, re.search(r"size = \[(\d+), (\d+)\]", text).groups())
    for size, axis in ((nx, "x"), (ny, "y")):  # from the outermost stars
        assert table[axis].max() <= size + 0.5 < 1.05 * table[axis].max()
    assert ("GUESSED: the table does not say" in text) == (suffix == "csv")
    # the catalogue's row is there to be filled in, and states nothing until it is
    config = load_config(tmp_path / "c.toml")[0]
    assert [row.name for row in config.budget] == ["reference catalogue"]
    assert not config.states_catalogue and config.user_terms() == ()
    filled = text.replace("sigma_u = 0.0 ", "sigma_u = 0.01 ")
    assert parse_config(filled, "c.toml").states_catalogue


@pytest.mark.parametrize(
    ("epoch", "dated", "name"),
    [
        (2016.0, True, "Gaia DR3"),
        (2015.5, True, "Gaia DR2"),
        (2000.0, True, ""),
        (2016.0, False, ""),
    ],
)
def test_init_names_the_release_of_gaia_if_motions_can_be_applied(tmp_path, epoch, dated, name):
    table = gaia_stars(200, epoch)
    if not dated:
        table.remove_column("epoch")
    table.write(tmp_path / "stars.ecsv")
    good("init", tmp_path / "c.toml", "--matches", tmp_path / "stars.ecsv")
    out = good("check", tmp_path / "c.toml").out
    config = load_config(tmp_path / "c.toml")[0]
    assert (config.catalogue.name if config.catalogue else "") == name
    assert [row.name for row in config.budget] == ([] if name else ["reference catalogue"])
    assert config.states_catalogue == bool(name)
    assert ("No error of the reference catalogue is stated" in out) == (not name)
    text = (tmp_path / "c.toml").read_text()
    lines = '# [catalogue]\n# name = "Gaia DR3"\n'
    assert (lines in text) == (epoch == 2016.0 and not dated)
    if lines in text:  # with the date they take the place of the row
        text = text.replace(lines, lines.replace("# ", ""))
        text = text.replace("# epoch = 2012.5", "epoch = 2012.5")
        head, tail = text.split("\n[[budget]]")
        (tmp_path / "c.toml").write_text(head + tail[tail.index("# [[requirement]]") :])
        good("check", tmp_path / "c.toml")
        assert load_config(tmp_path / "c.toml")[0].catalogue.name == "Gaia DR3"


def gaia_stars(n, ref_epoch, seed=3):
    """Pixels of 50 mas in 2012, beside columns of Gaia at the epoch of its positions."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(1, 1000, (2, n))
    pm = rng.normal(0, 5, (2, n))
    moved = (ref_epoch - 2012.0) * pm / 3.6e6
    u, v = np.stack([500.5 - x, y - 500.5]) * 50 / 3.6e6 + rng.normal(0, 0.5, (2, n)) / 3.6e6
    table = Table({"x": x, "y": y, "phot_g_mean_mag": rng.uniform(14, 19, n)})
    table["ra"], table["dec"] = (150.0 + u + moved[0]) * apu.deg, (v + moved[1]) * apu.deg
    table["pmra"], table["pmdec"] = pm * apu.mas / apu.yr
    for name in ("ra_error", "dec_error"):
        table[name] = np.full(n, 0.1) * apu.mas
    for name in ("pmra_error", "pmdec_error"):
        table[name] = np.full(n, 0.1) * apu.mas / apu.yr
    table["ref_epoch"], table["epoch"] = np.full(n, ref_epoch), np.full(n, 2012.0)
    return table


def test_inspect(finished, posterior):
    out = good("inspect", finished.path / "posterior.nc").out
    for name in posterior.model.names:
        assert name in out
    assert "converged" in out and "NOT CONVERGED" not in out
    flagged = summary_of(finished.path)["outliers"]["n_flagged"]
    assert f"{flagged} of 400 stars flagged" in out
    assert good("inspect", finished.path).out == out
    out = good("inspect", finished.path / "sip.hdr").out
    assert "A_ORDER 2" in out and "Findings" in out and "A_2_0" in out


def test_simulate_gives_a_job_that_check_accepts(tmp_path):
    good("simulate", "wise", "-o", tmp_path / "sim", "--stars", 900, "--seed", 3)
    truth = Table.read(tmp_path / "sim" / "truth.ecsv")
    assert len(truth) == 30 and truth.meta["fraction"] == 0.03
    assert "30 of 30" in good("check", tmp_path / "sim" / "config.toml").out
    stars = (tmp_path / "sim" / "stars.ecsv").read_bytes()
    good("simulate", "wise", "-o", tmp_path / "sim", "--stars", 900, "--seed", 3, "--force")
    assert (tmp_path / "sim" / "stars.ecsv").read_bytes() == stars


def test_demo(tmp_path, full, monkeypatch):
    """As a user sees it, in full in a process of its own; without a bar where there is no terminal.

    Reduced, its figures are sketches; tests/report draws figures.
    """
    monkeypatch.chdir(tmp_path)
    if full:
        done = process("demo", "-o", "demo", cwd=tmp_path)
        code, out, err = done.returncode, done.stdout, done.stderr
    else:
        done = cli("demo", "-o", "demo")
        code, out, err = done.code, done.out, done.err
    assert code == 0, err
    assert "\r" not in err and "Traceback" not in err
    header, _, *rows = out.splitlines()[1:]
    assert header.split()[:2] == ["coefficient", "truth"]
    offsets = [float(r.split()[-1]) for r in rows if re.match(r"[uv]_\d_\d|j |f |s_out", r)]
    assert len(offsets) == 33
    # 33 numbers of unit variance: all within 4.5, sum of squares within 33 +- 5 sqrt(66)
    assert max(map(abs, offsets)) < 4.5 and sum(o**2 for o in offsets) < 74
    for word in ("Error budget", "Margins", "report.html", "converged"):
        assert word in out
    run = tmp_path / "demo" / "run"
    # u, v count from the middle of the detector, and the header gives them without a placeholder
    assert "CRVAL" not in err + out and "stwcs" not in err + out
    header = WCS(fits.Header.fromtextfile(run / "sip.hdr"))
    pixels = np.array([[508.5, 508.5], [1.0, 1016.0], [700.0, 20.0]])
    posterior = load_posterior(run)
    there = posterior.model.predict(posterior.mean, *pixels.T)
    np.testing.assert_allclose(header.all_pix2world(pixels, 1), there, atol=1e-6)
    assert np.abs(there[0]).max() < 1
    summary = summary_of(run)
    # a default run of good data is green
    assert "WARNING" not in out + err + (run / "bayesdist.log").read_text()
    assert [one["verdict"] for one in summary["margins"]] == ["met", "met"]
    assert not summary["warnings"]
    assert summary["sampler"]["converged"] is True
    assert min(summary["sampler"]["ess_bulk_min"], summary["sampler"]["ess_tail_min"]) >= 400
    assert summary["sampler"]["rhat_max"] < 1.01
    stages = json.loads((run / "run.json").read_text())["stages"]
    assert sum(s["wall_s"] for s in stages.values()) < 60
    # band and size of a pixel are those of the run
    converted = good("convert", run, "--to", "wise_meta", "-o", tmp_path / "wise").out
    assert "w2.meta" in converted and " mas)" in converted
    again = cli("demo", "-o", tmp_path / "demo")
    assert again.code == 1 and "--force" in again.err


def test_the_version(tmp_path):
    done = process("--version", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, f"bayesdist {bayesdist.__version__}\n")
    assert cli("--help").code == 0
