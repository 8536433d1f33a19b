"""A pattern that the model leaves out, from the table of matches to budget and margins."""

import json
import shutil
from contextlib import closing

import numpy as np
import pytest
from astropy.table import Table
from scipy.ndimage import map_coordinates

from bayesdist.app.correlated import FILE, UNMODELLED
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.sessions import session_of
from bayesdist.assess.holdout import held_out_truth
from bayesdist.assess.holdout_predictive import predictive_of
from tests.app.support import begin_stagewise, cli, good

N, SIDE, SIGMA, RMS = 12_000, 1024, 0.02, 0.03

CONFIG = """
[data]
matches = "stars.ecsv"
unit = "pix"
[detector]
name = "chip"
size = [1024, 1024]
[model]
order = 3
reference_pixel = [512.0, 512.0]
[outliers]
model = "none"
[sampler]
target_ess = 200
[assess]
grid = [9, 9]
draws = 1000
[[requirement]]
name = "typical"
statistic = "rms"
limit = 0.1
"""


def written(folder, rms, *stages, seed=1, more=""):
    """Stars without distortion but for a pattern on nodes 64 px apart, interpolated between.

    Whole runs, or these stages of one.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, N))
    nodes = rng.standard_normal((2, 18, 18))
    at = np.stack([y, x]) / 64
    pattern = np.stack([map_coordinates(one, at, order=1) for one in nodes])
    # as many squares as RMS says; the polynomial of order 3 takes next to nothing of it
    pattern *= rms / np.sqrt(np.mean(pattern**2))
    u, v = np.stack([x - 512, y - 512]) + pattern + SIGMA * rng.standard_normal((2, N))
    sigma = np.full(N, SIGMA)
    table = Table({"x": x, "y": y, "u": u, "v": v, "sigma_u": sigma, "sigma_v": sigma})
    table.write(folder / "stars.ecsv")
    (folder / "config.toml").write_text(CONFIG + more)
    if stages:
        return begin_stagewise(folder / "run", folder / "config.toml", *stages)
    good("run", folder / "config.toml", "-o", folder / "run", "-q")
    return folder / "run"


@pytest.fixture(scope="module")
def patterned(tmp_path_factory):
    return written(tmp_path_factory.mktemp("pattern"), RMS)


@pytest.fixture(scope="module")
def another(tmp_path_factory):
    """Another detector without distortion, of another pattern, and held-out stars on it."""
    folder = tmp_path_factory.mktemp("another")
    aside = "[holdout]\nfraction = 0.25\n"
    return written(folder, RMS, "fit", "sample", "assess", seed=2, more=aside)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return written(tmp_path_factory.mktemp("plain"), 0.0, "fit", "sample", "assess")


def summary(run):
    return json.loads((run / "summary.json").read_text())


def test_the_pattern_is_measured_and_said(patterned):
    said = summary(patterned)
    found = said["shared_errors"]
    assert found["exceeds"] and not found["doubts"]
    # per node of 64 px some 47 stars have the pattern in common, beside their own noise: the
    # variance of a coefficient grows by that number times 9/4 RMS^2 / (SIGMA^2 + RMS^2) or so
    assert found["ratio"]["value"] > 30
    [left] = found["unmodelled"]
    for axis in "uv":
        assert abs(left[f"rms_{axis}"] - RMS) < 4 * left[f"error_{axis}"] < RMS
    assert any(text.startswith("Stars err together") for text in said["warnings"])
    assert "Stars err together" in (patterned / "report.html").read_text()


def test_budget_and_margins_have_the_larger_errors(patterned):
    rows = {row["name"]: row for row in summary(patterned)["budget"]}
    assert rows[UNMODELLED]["kind"] == "local"
    assert rows[UNMODELLED]["radial"] == pytest.approx(np.sqrt(2) * RMS, rel=0.2)
    ratio = summary(patterned)["shared_errors"]["ratio"]["value"]
    table = Table.read(patterned / "coefficients.ecsv")
    legendre = table[[str(name).startswith(("u_", "v_")) for name in table["name"]]]
    spread = np.median(legendre["sd"] / legendre["sigma"])
    # the fit's sigma takes the noise for SIGMA, the posterior's jitter makes it what it is
    assert spread == pytest.approx(np.sqrt(ratio * (1 + (RMS / SIGMA) ** 2)), rel=0.35)
    [margin] = summary(patterned)["margins"]
    assert margin["verdict"] == "met"  # what is left out is among the errors now
    assert margin["value"] == pytest.approx(rows["total"]["radial"], rel=0.1)


def test_commands_that_follow_use_what_was_measured(patterned):
    before = summary(patterned)["margins"][0]
    req = patterned.parent / "req.toml"
    req.write_text('[[requirement]]\nname = "typical"\nstatistic = "rms"\nlimit = 0.1\n')
    assert cli("validate", patterned, "--requirements", req, "-q").code == 0
    assert summary(patterned)["margins"][0] == before
    assert UNMODELLED in good("budget", patterned, "--at", 100, 100).out


def test_stars_that_err_independently_leave_the_posterior_as_it_is(plain):
    said = summary(plain)
    assert not said["shared_errors"]["exceeds"]
    assert (
        abs(said["shared_errors"]["ratio"]["value"] - 1)
        < 4 * said["shared_errors"]["ratio"]["error"]
    )
    assert UNMODELLED not in [row["name"] for row in said["budget"]]
    assert not any("err together" in text for text in said["warnings"])
    table = Table.read(plain / "coefficients.ecsv")
    legendre = table[[str(name).startswith(("u_", "v_")) for name in table["name"]]]
    assert np.median(legendre["sd"] / legendre["sigma"]) == pytest.approx(1, abs=0.05)


def p_value(*command, name, output):
    good(*command, "-o", output)
    return json.loads((output / name).read_text())


def bare(run, folder):
    """A run of which nothing is known but its posterior."""
    folder.mkdir()
    for name in ("run.json", "config.toml", "fit.nc", "posterior.nc"):
        shutil.copy(run / name, folder)
    return folder


def test_comparison_rests_on_the_errors_that_were_measured(patterned, another, tmp_path):
    """Neither has distortion: what they differ by is how their patterns have drawn the fits."""
    name = "comparison.json"
    signed = p_value("compare", patterned, another, name=name, output=tmp_path / "signed")
    assert signed["chips"][0]["p_value"] > 1e-3
    formal = (bare(run, tmp_path / key) for key, run in (("a", patterned), ("b", another)))
    alone = p_value("compare", *formal, name=name, output=tmp_path / "alone")
    assert alone["chips"][0]["p_value"] < 1e-12


def test_monitoring_rests_on_the_errors_that_were_measured(patterned, another, tmp_path):
    new, name = another.parent / "stars.ecsv", "monitor.json"
    signed = p_value("monitor", patterned, new, name=name, output=tmp_path / "signed")
    run = bare(patterned, tmp_path / "run")
    alone = p_value("monitor", run, new, name=name, output=tmp_path / "alone")
    assert alone["p_value"] < 1e-12 < signed["p_value"]
    # the new fit has its formal errors in both
    assert signed["size"]["noise_rms"] > 3 * alone["size"]["noise_rms"]


def test_held_out_stars_are_predicted_with_the_errors_that_were_measured(another):
    assert summary(another)["holdout"]["level"] == "pass"
    with closing(session_of(RunDirectory.open(another))) as session:
        held = session.held_matches
        assert held_out_truth(predictive_of(session.posterior), held).level == "fail"


def test_what_belongs_to_another_posterior_is_not_used(plain, patterned, tmp_path):
    kept = (patterned / FILE).read_bytes()
    own = (plain / FILE).read_bytes()
    try:
        (plain / FILE).write_bytes(kept)
        assert UNMODELLED not in good("budget", plain, "--at", 100, 100).out
    finally:
        (plain / FILE).write_bytes(own)
