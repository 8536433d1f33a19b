"""`bayesdist monitor`: a released run and new matches."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.app.store import Record
from tests.app.support import as_table, good, refused, simulated, write_config

DATES = np.linspace(2016.0, 2017.1, 12)


def new_matches(bend: float = 0.0, seed: int = 77):
    """Stars of the finished run's truth, in twelve nights; the last six bent by x^2 in u."""
    matches, _ = simulated(1200, mag=np.linspace(12.0, 18.0, 1200), seed=seed)
    epoch = np.repeat(DATES, 100)
    X = (matches.x - 500.5) / 500
    return replace(matches, epoch=epoch, u=matches.u + bend * X**2 * (epoch >= DATES[6] - 1e-9))


@pytest.fixture(scope="module")
def moved(finished, tmp_path_factory):
    """Output for matches that a change of 0.06 px from the seventh night on has moved."""
    folder = tmp_path_factory.mktemp("moved")
    as_table(new_matches(0.06)).write(folder / "new.ecsv")
    result = good("monitor", finished.path, folder / "new.ecsv", "-o", folder / "out")
    return result, folder / "out"


def test_a_release_that_still_holds(finished, tmp_path) -> None:
    as_table(new_matches()).write(tmp_path / "new.ecsv")
    result = good("monitor", finished.path, tmp_path / "new.ecsv", "-o", tmp_path / "out")
    assert result.out.startswith("The released solution still describes the new matches")
    found = json.loads((tmp_path / "out" / "monitor.json").read_text())
    assert found["changed"] is False and found["p_value"] > 0.01
    assert found["mean_change"]["dof"] == 12
    # 5 % false, 0.01 px beyond the quoted errors
    assert found["new"]["n_flagged"] == pytest.approx(60, abs=25)
    assert found["new"]["mixture"]["j"] == pytest.approx(0.01, abs=0.004)


def test_a_change_its_size_and_its_date(moved) -> None:
    result, out = moved
    assert result.out.startswith("The released solution no longer describes the new matches")
    assert sorted(p.name for p in out.iterdir()) == [
        "change.ecsv", "dates.ecsv", "difference.ecsv", "figures", "monitor.json"
    ]  # fmt: skip
    assert sorted(p.name for p in (out / "figures").iterdir()) == ["change.png", "dates.png"]
    found = json.loads((out / "monitor.json").read_text())
    assert found["changed"] is True and found["p_value"] < 1e-6
    since = found["since"]
    assert since["after"] == pytest.approx(DATES[5]) and since["before"] == pytest.approx(DATES[6])
    size = found["size"]
    assert size["max"] == pytest.approx(0.06, abs=4 * size["sigma_of_max"])
    assert size["max_mas"] == pytest.approx(50 * size["max"])  # detector.scale_mas
    dates = Table.read(out / "dates.ecsv")
    assert int(np.argmax(dates["gain"])) == 6 and dates["n"].sum() == 1200
    rows = Table.read(out / "change.ecsv")
    row = rows[(rows["form"] == "legendre") & (rows["axis"] == "u") & (rows["i"] == 2)][0]
    assert row["difference"] == pytest.approx(0.06 * 2 / 3, abs=4 * row["sigma"])


def test_new_matches_may_have_a_configuration(finished, tmp_path) -> None:
    table = as_table(new_matches())
    for name in ("x", "u"):
        table.rename_column(name, f"my_{name}")
    table.remove_column("epoch")
    table.write(tmp_path / "other.ecsv")
    config = write_config(
        tmp_path / "new.toml",
        data={"matches": "other.ecsv", "columns": {"x": "my_x", "u": "my_u"}},
    )
    result = good("monitor", finished.path, config)
    assert "still describes" in result.out and "dates" not in result.out


def test_the_old_matches_are_not_needed(finished, tmp_path) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished.path, run)
    record = Record.read(run / "run.json")
    record.facts["base"] = str(tmp_path / "gone")
    record.write(run / "run.json")
    as_table(new_matches()).write(tmp_path / "new.ecsv")
    said = good("monitor", run, tmp_path / "new.ecsv").out
    assert said == good("monitor", finished.path, tmp_path / "new.ecsv").out


def test_what_does_not_go_is_refused(finished, tmp_path) -> None:
    few = new_matches().select(np.arange(1200) < 4)
    as_table(few).write(tmp_path / "few.ecsv")
    as_table(new_matches(), unit="arcsec").write(tmp_path / "unit.ecsv")
    empty = tmp_path / "empty"
    empty.mkdir()
    run = finished.path
    refused(tmp_path, "monitor", empty, tmp_path / "few.ecsv", words=["is not a run"])
    refused(tmp_path, "monitor", run, tmp_path / "none.ecsv", words=["no such file"])
    refused(tmp_path, "monitor", run, tmp_path / "unit.ecsv", words=["arcsec", "pix"])
    refused(tmp_path, "monitor", run, tmp_path / "few.ecsv", words=["few"])


def test_the_matches_of_the_release_cannot_test_it(finished, tmp_path) -> None:
    """Under their own name, as a copy, by a configuration, and among others."""
    old = finished.config.parent / "stars.ecsv"
    words = ["the release was made from these matches"]
    refused(tmp_path, "monitor", finished.path, old, words=["stars.ecsv", *words])
    shutil.copy(old, tmp_path / "copy.ecsv")
    refused(tmp_path, "monitor", finished.path, tmp_path / "copy.ecsv", words=["copy.ecsv", *words])
    run, other = finished.path, tmp_path / "other"
    shutil.copytree(run, other)
    refused(tmp_path, "monitor", run, run, words=["is the released run itself", "new matches"])
    refused(tmp_path, "monitor", run, other, words=words)


@pytest.mark.parametrize("is_folder", [True, False])
def test_matches_of_the_release_are_left_out_where_there_are_others(finished, tmp_path, is_folder):
    new = as_table(new_matches())
    new.remove_column("epoch")  # as the release's own
    new.write(tmp_path / "new.ecsv")
    alone = good("monitor", finished.path, tmp_path / "new.ecsv").out
    shutil.copy(finished.config.parent / "stars.ecsv", tmp_path / "copy.ecsv")
    names = ["new.ecsv", "copy.ecsv"]
    config = write_config(tmp_path / "config.toml", data={"matches": names})
    said = good("monitor", finished.path, tmp_path if is_folder else config).out
    assert "left out: 1 exposure(s) or file(s) that the release was made from (" in said
    assert "copy.ecsv)" in said
    assert said.splitlines()[0] == alone.splitlines()[0]
    assert "new matches: 1200, of which" in said
