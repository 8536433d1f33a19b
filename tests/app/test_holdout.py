"""Held-out stars in a run: set aside, judged, written, shown, and what they change."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table
from pyarrow.parquet import read_metadata
from scipy.stats import binom

from bayesdist.simulate import simulate_matches
from tests.app.support import (
    SIGMA,
    as_table,
    begin_stagewise,
    good,
    model_of,
    partly_run,
    refused,
    simulated,
    summary_of,
    truth_of,
    write_job,
)
from tests.reduced import only_in_full

LOOSE = [{"name": "loose", "statistic": "p95", "limit": 1.0}]


def job(folder, n=1500, holdout=None, **options):
    sections = {k: options.pop(k) for k in ("outliers", "model", "data") if k in options}
    mag = np.random.default_rng(1).uniform(12.0, 18.0, n)
    matches, _ = simulated(n, mag=mag, **options)
    holdout = {"fraction": 0.3} if holdout is None else holdout
    return write_job(folder, as_table(matches), holdout=holdout, requirement=LOOSE, **sections)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("held")
    config = job(folder / "input")
    good("run", config, "-o", folder / "run")
    return config, folder / "run"


def test_held_out_stars_are_no_part_of_the_fit(run):
    summary = summary_of(run[1])
    data, found = summary["data"], summary["holdout"]
    assert data["rejected"]["held out"] == found["n"] and found["n_excluded"] == 0
    assert data["n_used"] + sum(data["rejected"].values()) == data["n_rows"] == 1500
    stars = read_metadata(run[1] / "stars" / "part-00000.parquet")
    assert stars.num_rows == 1500 - found["n"]


def test_verdict_and_tests_are_written_and_shown(run):
    found, table = summary_of(run[1])["holdout"], Table.read(run[1] / "holdout.ecsv")
    assert found["level"] == "pass"
    assert found["verdict"].startswith("held-out stars agree with the prediction (p = ")
    assert len(table) == len(found["tests"])
    assert table.meta["verdict"] == found["verdict"]
    assert set(table["part"]) == {"all", "axis", "region", "magnitude"}
    assert (np.diff(table["p_value"]) >= 0).all()
    assert found["p_value"] == pytest.approx(min(1.0, len(table) * table["p_value"][0]))
    assert [(c["axis"], c["sigma"]) for c in found["coverage"]] == [
        (axis, sigma) for axis in "uv" for sigma in (1, 2)
    ]
    for one in found["coverage"]:
        low, high = binom.ppf([1e-4, 1 - 1e-4], found["n"], one["expected"]) / found["n"]
        assert low <= one["value"] <= high and one["n"] == found["n"]
    html = (run[1] / "report.html").read_text(encoding="utf-8")
    assert "Coverage of the held-out stars" in html
    status = html.index("Held-out truth")
    assert status < html.index(">Sampling ") and 'id="holdout"' in html
    assert list((run[1] / "figures").glob("holdout.*"))
    assert summary_of(run[1])["margins"][0]["verdict"] == "met"


@pytest.mark.slow
@only_in_full("a resumed run sets them aside")
def test_stages_by_themselves_set_the_same_stars_aside(run, tmp_path):
    config, whole = run
    folder = begin_stagewise(tmp_path / "run", config, "fit", "sample", "assess")
    assert (folder / "holdout.ecsv").read_bytes() == (whole / "holdout.ecsv").read_bytes()


def test_a_resumed_run_sets_the_same_stars_aside(run, tmp_path):
    config, whole = run
    folder = partly_run(tmp_path / "run", config, "fit")
    # what a run that was interrupted after the fit goes on with
    good("run", folder / "config.toml", "-o", folder, "--resume")
    assert (folder / "holdout.ecsv").read_bytes() == (whole / "holdout.ecsv").read_bytes()


@pytest.mark.slow
@only_in_full("test_at_scale has a run on disk")
def test_data_on_disk_give_the_same_answer(run, tmp_path):
    config, whole = run
    folder = tmp_path / "input"
    folder.mkdir()
    Table.read(config.parent / "stars.ecsv").write(folder / "stars.parquet")
    text = config.read_text(encoding="utf-8").replace(
        'matches = "stars.ecsv"', 'matches = "stars.parquet"\nrows_in_memory = 1000'
    )
    assert "rows_in_memory" in text
    (folder / "config.toml").write_text(text, encoding="utf-8")
    there = partly_run(tmp_path / "run", folder / "config.toml", "fit", "sample", "assess")
    mine, theirs = (Table.read(path / "holdout.ecsv") for path in (whole, there))
    assert list(mine["where"]) == list(theirs["where"])
    np.testing.assert_allclose(mine["p_value"], theirs["p_value"], rtol=1e-6)


def test_too_small_errors_leave_requirements_undecided(tmp_path):
    """Errors are 1.5 times as large as quoted, and the jitter that would tell is held at zero."""
    table = {"sigma": SIGMA, "jitter": SIGMA * np.sqrt(1.5**2 - 1), "fraction": 0.0}
    config = job(tmp_path / "input", **table, outliers={"model": "none", "jitter": 0.0})
    good("run", config, "-o", tmp_path / "run")
    summary = summary_of(tmp_path / "run")
    found = summary["holdout"]
    assert found["level"] == "fail" and "times as large as predicted" in found["verdict"]
    assert summary["warnings"][0].lower() == found["verdict"].lower()
    (margin,) = summary["margins"]
    assert margin["verdict"] == "undecided" and margin["reason"].startswith(found["verdict"])
    html = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "times as large as predicted" in html[: html.index("Held-out truth")]


@pytest.mark.slow
@only_in_full("test_campaign_holdout holds out whole exposures")
def test_whole_exposures_are_drawn_and_predicted(tmp_path):
    names = tuple(f"e{k}" for k in range(8))
    model = model_of(frames="shift_rotation", exposures=names)
    theta, rng = truth_of(model), np.random.default_rng(2)
    for block in model.local_blocks:
        theta[block] = rng.normal(0, 1, 3) * (3, 3, 1e-3)
    matches, _ = simulate_matches(model, theta, 1600, rng=rng, sigma=SIGMA, fraction=0.03)
    config = write_job(
        tmp_path / "input",
        as_table(matches),
        holdout={"exposures": 2},
        model={"order": 2, "frames": "shift_rotation"},
    )
    folder = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    summary = summary_of(folder)
    found = summary["holdout"]
    assert len(found["exposures"]) == 2 and found["n"] == 400 and found["level"] == "pass"
    assert summary["data"]["n_exposures"] == 6
    assert {t["where"] for t in found["tests"] if t["part"] == "exposure"} == {
        f"in exposure {name}, held out whole" for name in found["exposures"]
    }


@pytest.mark.parametrize(
    ("holdout", "words"),
    [
        ({}, ("holds nothing out",)),
        ({"fraction": 0.01}, ("too few to judge", "holdout.fraction")),
        ({"exposures": ["nobody"]}, ("nobody",)),
        ({"exposures": 3}, ("there are only 1",)),
        ({"fraction": 0.95}, ("holdout.fraction",)),
        ({"fractoin": 0.1}, ("fractoin", "fraction")),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_written(tmp_path, holdout, words):
    config = job(tmp_path, holdout=holdout)
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)
