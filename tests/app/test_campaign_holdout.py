"""A campaign with stars and exposures held out, then confronted with exposures taken later."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.app.pipeline import diagnose, fit, match
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import read_matches
from bayesdist.files.tables import read_table
from bayesdist.infer import load_fit
from bayesdist.kinds.campaign.linear_terms import ExposuresAlone, LinearTermScatter
from tests.app.support import (
    carried_out,
    cli,
    good,
    in_memory,
    one_sentence,
    refused,
    summary_of,
)
from tests.reduced import only_in_full

N, LATER = 14, 3  # exposures, and how many of them the release does not see
HOLDOUT = "[holdout]\nfraction = 0.2\nexposures = 2\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign") / "acs"
    options = ("--exposures", N, "--stars", 2500, "--seed", 11, "--no-tables", "-q")
    good("simulate", "acs", "-o", folder, *options)
    return folder


def parts(folder) -> tuple[list[str], list[str]]:
    """Exposures of the release, and later ones: spread over the second segment of the drift."""
    log = Table.read(folder / "exposures.ecsv")
    late = np.flatnonzero(np.asarray(log["epoch"]) > 2009.4)
    chosen = set(late[:: max(1, len(late) // LATER)][:LATER].tolist())
    names = [str(name) for name in log["exposure"]]
    return (
        [n for k, n in enumerate(names) if k not in chosen],
        [n for k, n in enumerate(names) if k in chosen],
    )


def begin(folder: Path, run: Path, names: list[str], *, holdout: str = "", drift: bool = True):
    """A run's folder with a configuration of some of the exposures."""
    run.mkdir(parents=True)
    log = Table.read(folder / "exposures.ecsv")
    log = log[np.isin(np.asarray(log["exposure"], str), names)]
    log.write(run.parent / f"{run.name}.ecsv")
    text = (folder / "campaign_f606w.toml").read_text(encoding="utf-8")
    text = text.replace('method = "field"', 'method = "none"')
    text = text.replace('"exposures.ecsv"', f'"{run.parent / run.name}.ecsv"')
    for name in ("catalog.parquet", "start_idc.fits"):
        text = text.replace(f'"{name}"', f'"{folder / name}"')
    if '"lists"' in text:
        text = text.replace('"lists"', f'"{folder / "lists"}"')
    if not drift:
        start, stop = text.index("[model.tdd]"), text.index("[assess]")
        text = text[:start] + text[stop:]
        text = text[: text.index("[products.release]")]
    quick = "[sampler]\ntarget_ess = 100\ntarget_rhat = 1.05\n"
    text = text.replace("[assess]", f"{holdout}{quick}\n[assess]")
    (run / "config.toml").write_text(text, encoding="utf-8")
    return run


@pytest.fixture(scope="module")
def run(folder):
    run = begin(folder, folder.parent / "release", parts(folder)[0], holdout=HOLDOUT)
    # how linear terms went with time takes longer than all the rest, and is not asked here
    with patch("bayesdist.kinds.campaign.kind.write_series_tables"):
        return carried_out(run, "match", "fit", "sample", "diagnose")


@pytest.fixture(scope="module")
def later(folder):
    """The run of the later exposures, of which the first stage is done."""
    later = begin(folder, folder.parent / "later", parts(folder)[1], drift=False)
    good("stage", "match", later, "-q")
    return later


def test_what_is_held_out_is_no_part_of_the_fit(run) -> None:
    summary = summary_of(run)
    found, data = summary["holdout"], summary["data"]
    assert len(found["exposures"]) == 2 and data["n_exposures"] == N - LATER - 2
    pairs = read_matches(run / "pairs", unit="pix")
    assert data["rejected"]["held out"] == found["n"] + found["n_excluded"]
    assert summary["matching"]["n_pairs"] == len(pairs)
    opened = Run.of(RunDirectory.open(run))
    kept, held = opened.stars, opened.held_stars
    assert len(kept) + len(held) == len(pairs)
    assert not set(kept.exposure_names) & set(found["exposures"])
    # a star goes or stays with all of its detections
    whole = np.isin(np.array(held.exposure_names)[held.exposure], found["exposures"])
    assert not set(kept.star) & set(held.star[~whole])
    assert len(set(held.star[~whole])) == pytest.approx(0.2 * len(set(pairs.star)), rel=0.25)


@pytest.mark.slow
@only_in_full("test_pipeline has a script that does")
def test_functions_find_what_the_run_has_found(run) -> None:
    """Lists are matched and fitted without a run's folder, and are prepared as those of the run."""
    prepared, opened = fit(match(in_memory(run / "config.toml"))), Run.of(RunDirectory.open(run))
    known = load_fit(run / "fit.nc")
    np.testing.assert_array_equal(prepared.fit.mean, known.mean)
    np.testing.assert_array_equal(prepared.fit.cov, known.cov)
    for name in ("x", "u", "sigma_u", "star", "exposure"):
        for made, read in (
            (prepared.matches, opened.matches),
            (prepared.held_out, opened.held_out),
        ):
            np.testing.assert_array_equal(getattr(made, name), getattr(read, name))
    assert prepared.held_exposures == opened.held_exposures
    assert len(prepared.held_exposures) == 2
    alone, scatter = prepared.part(ExposuresAlone).series, prepared.part(LinearTermScatter)
    np.testing.assert_array_equal(alone.values, opened.part(ExposuresAlone).series.values)
    np.testing.assert_array_equal(scatter.tau, opened.part(LinearTermScatter).tau)


@pytest.mark.slow
@only_in_full("test_run has stages by themselves")
def test_stages_can_be_run_again(later, tmp_path) -> None:
    again = shutil.copytree(later, tmp_path / "again")
    found = []
    for _ in range(2):
        for stage in ("match", "fit"):
            good("stage", stage, again, "-q")
        summary = summary_of(again)
        found.append([summary[section] for section in ("matching", "scatter", "fit")])
    assert found[0] == found[1] and found[0][0] == summary_of(later)["matching"]


def test_what_is_held_out_agrees_with_the_prediction(run) -> None:
    found, table = summary_of(run)["holdout"], Table.read(run / "holdout.ecsv")
    assert found["level"] != "fail", found["verdict"]
    assert set(table["part"]) >= {"all", "region", "magnitude", "epoch", "exposure"}
    deviations = table[table["name"] == "deviation"]
    assert {w.split(" of exposure ")[1] for w in deviations["where"]} <= {
        f"{name}, held out whole" for name in found["exposures"]
    }


@pytest.mark.slow
@only_in_full("tests/diagnose/test_holdout_campaign names such")
def test_an_exposure_that_went_wrong_is_named(run, folder, tmp_path, monkeypatch) -> None:
    """One of the two exposures, bent by 0.3 pixels of the second order before it is matched."""
    name = summary_of(run)["holdout"]["exposures"][0]
    bent = tmp_path / "acs"
    shutil.copytree(folder, bent)
    path = bent / "lists" / f"{name}.parquet"
    stars = read_table(path)
    stars["x"] = stars["x"] + 0.3 * ((stars["x"] - 2048) / 2048) ** 2
    stars.write(path, overwrite=True)
    new = begin(bent, tmp_path / "run", parts(folder)[0], holdout=HOLDOUT)
    good("stage", "match", new, "-q")
    # the fit has not seen it: it is that of the good run, whose record says so
    monkeypatch.setattr(RunDirectory, "refuse_damaged", lambda run, stage: None)
    shutil.copytree(new / "pairs", tmp_path / "other" / "pairs")
    for one in run.iterdir():
        if one.is_file():
            shutil.copy(one, tmp_path / "other" / one.name)
    other = Run.of(RunDirectory.open(tmp_path / "other"))
    found = diagnose(other).diagnostics.holdout
    assert found.level == "fail" and f"exposure {name}, held out whole" in found.verdict


def test_later_exposures_confirm_the_release(run, later, tmp_path) -> None:
    result = good("monitor", run, later, "-o", tmp_path / "out")
    assert result.out.startswith("The released solution still describes the new matches")
    assert "exposures deviate as those of the release scatter" in result.out
    found = json.loads((tmp_path / "out" / "monitor.json").read_text())
    assert found["p_value"] > 0.01 and found["new"]["n_exposures"] == LATER
    # two chips, two axes, 21 terms of the fifth order, three parameters of a frame
    assert found["mean_change"]["dof"] == 84 - 3
    assert (tmp_path / "out" / "figures" / "change.png").exists()


@pytest.mark.slow
@only_in_full("tests/infer/compare finds such a change")
def test_a_detector_that_changed_is_told_with_its_size_and_date(run, later, tmp_path) -> None:
    """Pairs as a run keeps them, from the second later date on bent by 0.1 pixels at the edges."""
    pairs = read_table(next((later / "pairs").glob("*.parquet")))
    dates = np.unique(np.asarray(pairs["epoch"]))  # one for each exposure
    late = np.asarray(pairs["epoch"]) > dates[0]
    pairs["x"] = pairs["x"] + 0.1 * ((pairs["x"] - 2048) / 2048) ** 2 * late
    pairs.write(tmp_path / "new.ecsv")
    result = good("monitor", run, tmp_path / "new.ecsv")
    assert result.out.startswith("The released solution no longer describes the new matches")
    assert f"since a date between {dates[0]:.3f} and {dates[1]:.3f}" in result.out
    largest, _, sigma = result.out.split("at most ")[1].split()[:3]
    assert float(largest) == pytest.approx(0.1, abs=4 * float(sigma))


@pytest.mark.slow
@only_in_full("later exposures confirm the release")
def test_exposures_that_the_release_has_seen_are_left_out(run) -> None:
    seen = summary_of(run)["data"]["n_exposures"]
    # those that were held out whole are new to it
    result = good("monitor", run, run)
    assert f"left out: {seen} exposure(s) that the release has seen" in result.out
    assert "in 2 exposure(s)" in result.out


def test_what_cannot_be_held_out_or_monitored_is_refused(run, folder, tmp_path) -> None:
    names = parts(folder)[0]
    for holdout, word in (
        ('exposures = ["nobody"]', "nobody"),
        ("exposures = 50", "holdout.exposures"),
        ("fraction = 0.001", "holdout.fraction"),
    ):
        bad = begin(folder, tmp_path / word, names, holdout=f"[holdout]\n{holdout}\n")
        result = cli("stage", "match", bad, "-q")
        assert result.code == 1
        one_sentence(result.err, word)
    alone = tmp_path / "alone"
    alone.mkdir()
    first = folder / "campaign_f606w.toml"
    refused(alone, "monitor", run, first, words=["matched first"])
    refused(alone, "monitor", run, folder / "nothing.ecsv", words=["no such file"])
