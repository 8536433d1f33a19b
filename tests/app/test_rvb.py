"""RvB pairs through the command line: every stage, in memory and on disk, selected and moved."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table, vstack

from bayesdist.app.store import Record
from bayesdist.data import open_matches
from bayesdist.infer import load_fit
from bayesdist.missions.wise.pairs.read import read_rvb
from bayesdist.missions.wise.rvb import RvbTransform
from tests.app.rvb_jobs import DETECTORS, rvb_job, rvb_pairs, write_rvb_table
from tests.app.support import cli, good, partly_run, refused, snapshot, summary_of
from tests.reduced import only_in_full

RVB = {"colour": (-0.4, 0.9), "accept_centre": 1.0, "accept_corner": 2.5}
STAGES = ("fit", "sample", "assess", "export")


def counted(table: Table) -> dict[str, int]:
    """What the selection RVB drops of W4, by plain numpy."""
    table = table[table["band"] == "W4"]
    colour = np.asarray(table["colour"])
    known = ~np.isnan(colour)
    blue = known & (colour >= -0.4) & (colour <= 0.9)
    r2 = ((table["x"] - 254.5) ** 2 + (table["y"] - 254.5) ** 2) / (2 * 254.0**2)
    near = np.hypot(table["u"] - table["x"], table["v"] - table["y"]) <= 1.0 + 1.5 * r2
    return {
        "no colour": int((~known).sum()),
        "colour": int((known & ~blue).sum()),
        "offset beyond the radial limit": int((blue & ~near).sum()),
    }


def test_a_run_of_one_band_out_of_two(tmp_path):
    table = vstack([rvb_pairs(), rvb_pairs(300, "W1", seed=2)])
    config = rvb_job(tmp_path / "job", table, data={"band": "W4", "rvb": RVB})
    result = good("check", config)
    assert "600 rows" in result.out
    good("run", config, "-o", tmp_path / "run")
    expected = counted(table)
    found = summary_of(tmp_path / "run")["data"]
    assert found["n_rows"] == 600 and expected.items() <= found["rejected"].items()
    assert found["n_used"] == 600 - sum(found["rejected"].values())
    html = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "offset beyond the radial limit (reading)" in html
    assert "done before" in good("run", config, "-o", tmp_path / "run", "--resume").err


@pytest.mark.usefixtures("no_report")
def test_on_disk_the_pairs_are_selected_once(tmp_path, monkeypatch):
    table = vstack([rvb_pairs(), rvb_pairs(300, "W1", seed=2)])
    data = {"band": "W4", "rvb": RVB}
    config = rvb_job(tmp_path / "job", table, ".parquet", data=data | {"rows_in_memory": 100})
    before = snapshot(tmp_path)
    good("check", config)
    assert snapshot(tmp_path) == before
    good("run", config, "-o", tmp_path / "run")
    run = tmp_path / "run"
    assert not list(tmp_path.glob(".bayesdist-*"))
    summary = summary_of(run)
    assert counted(table).items() <= summary["data"]["rejected"].items()
    assert summary["data"]["n_rows"] == 600
    kept = open_matches(run / "pairs")
    assert len(kept) == 600 - sum(counted(table).values()) and kept.has_epoch
    # the input is not selected anew by later stages, and the fit is that of the pairs in memory
    with monkeypatch.context() as patch:
        patch.setattr("bayesdist.missions.wise.pairs.run_input.stream_rvb", None)
        for stage in STAGES:
            good("stage", stage, run)
    assert summary_of(run)["data"] == summary["data"]
    memory = partly_run(tmp_path / "memory", rvb_job(tmp_path / "other", table, data=data), "fit")
    fits = [load_fit(path / "fit.nc") for path in (run, memory)]
    np.testing.assert_allclose(fits[0].mean, fits[1].mean, rtol=0, atol=1e-9)
    good("run", config, "-o", run, "--force")
    assert len(open_matches(run / "pairs")) == len(kept)


@pytest.mark.slow
@only_in_full("tests/kills kills runs")
@pytest.mark.usefixtures("no_report")
def test_half_a_set_that_a_killed_run_left_is_not_trusted(tmp_path):
    table = rvb_pairs()
    data = {"rvb": RVB, "rows_in_memory": 100}
    config = rvb_job(tmp_path / "job", table, ".parquet", data=data)
    good("run", config, "-o", tmp_path / "run")
    run = tmp_path / "run"
    whole = len(open_matches(run / "pairs"))
    record = Record.read(run / "run.json")
    assert record.facts.pop("pairs")["n_rows"] == 600
    record.artefacts = {}
    record.write(run / "run.json")
    (run / "pairs" / "part-00000.parquet").write_bytes(b"half")
    good("run", config, "-o", run, "--resume")
    assert len(open_matches(run / "pairs")) == whole
    # nor is a folder touched that holds something else
    (run / "pairs" / "mine.txt").touch()
    record.write(run / "run.json")
    result = cli("stage", "fit", run)
    assert result.code == 1 and "remove this folder" in result.err
    assert not list(tmp_path.glob(".bayesdist-*"))


@pytest.mark.usefixtures("no_report")
def test_a_set_without_selection_is_used_where_it_is(tmp_path):
    table = rvb_pairs()
    table["epoch"] = 2010.0 + (table["mjd"] - 55197.0) / 365.25
    table.remove_column("mjd")
    config = rvb_job(tmp_path / "job", table, ".parquet", data={"rows_in_memory": 100})
    good("run", config, "-o", tmp_path / "run")
    assert not (tmp_path / "run" / "pairs").exists()
    assert summary_of(tmp_path / "run")["data"]["sources"] == [
        str(tmp_path / "job" / "pairs.parquet")
    ]


@pytest.mark.parametrize("suffix", [".tbl", ".parquet"])
def test_init_recognises_pairs(tmp_path, suffix):
    path = write_rvb_table(
        vstack([rvb_pairs(), rvb_pairs(300, "W1", seed=2)]), tmp_path / f"pairs{suffix}"
    )
    config = tmp_path / "c.toml"
    assert "for 600 matches" in good("init", config, "--matches", path).out
    text = config.read_text(encoding="utf-8")
    assert "W1 (300), W4 (600)" in text and "# colour = " in text
    found = tomllib.loads(text)
    assert (found["data"]["format"], found["data"]["band"]) == ("rvb", "W4")
    detector = {"mission": "WISE", "name": "W4", "size": [508, 508], "scale_mas": 5500}
    assert found["detector"] == detector
    assert "600 of 600 rows" in good("check", config).out
    # what is commented out is as it should be
    config.write_text(
        text.replace("# [data.rvb]", "[data.rvb]").replace("# accept_", "accept_"),
        encoding="utf-8",
    )
    good("check", config)


def test_init_guesses_what_a_table_leaves_out(tmp_path):
    table = rvb_pairs()
    table.remove_columns(["band", "colour", "sigma_u", "sigma_v"])
    path = write_rvb_table(table, tmp_path / "pairs.tbl")
    good("init", tmp_path / "c.toml", "--matches", path)
    text = (tmp_path / "c.toml").read_text(encoding="utf-8")
    assert text.count("GUESSED") == 2 and "# colour" not in text
    assert tomllib.loads(text)["data"]["band"] == "W4"
    good("check", tmp_path / "c.toml")


def test_a_table_with_bands_of_others_is_no_rvb(tmp_path):
    table = rvb_pairs()
    table["band"] = "r"
    good("init", tmp_path / "c.toml", "--matches", write_rvb_table(table, tmp_path / "a.parquet"))
    assert "format" not in tomllib.loads((tmp_path / "c.toml").read_text())["data"]


# -- bayesdist wise rvb ---------------------------------------------------------------------------


def test_transform_moves_the_reference_positions(tmp_path):
    path = write_rvb_table(rvb_pairs(), tmp_path / "pairs.tbl")
    good("wise", "rvb", "transform", path, "-o", tmp_path / "out", "--dx", 0.5, "--dy", -0.25,
         "--rotation", 0.02, "--scale-x", 1e-4, "--scale-y", -2e-4)  # fmt: skip
    old, new = read_rvb(path), read_rvb(tmp_path / "out")
    turn = np.radians(0.02)
    offset = np.stack([old.matches.u - 254.5, old.matches.v - 254.5]) * [[1 + 1e-4], [1 - 2e-4]]
    matrix = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    expected = matrix @ offset + [[255.0], [254.25]]
    np.testing.assert_allclose([new.matches.u, new.matches.v], expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(new.matches.x, old.matches.x)
    np.testing.assert_array_equal(new.colour, old.colour)
    # what it writes is calibrated
    config = rvb_job(tmp_path / "job", rvb_pairs(), data={"matches": str(tmp_path / "out")})
    good("check", config)


def test_a_fitted_transformation_leaves_nothing_linear(tmp_path):
    path = write_rvb_table(rvb_pairs(false=0.0), tmp_path / "pairs.tbl")
    shown = good("wise", "rvb", "transform", path, "-o", tmp_path / "out", "--fit")
    assert "fitted: shift_u" in shown.out
    new = read_rvb(tmp_path / "out").matches
    # what is left of offsets, scales and rotation, and what pairs with such errors leave of it
    for offset in (new.u - new.x, new.v - new.y):
        slopes = np.linalg.lstsq(np.stack([np.ones(len(new)), new.x - 254.5, new.y - 254.5], 1),
                                 offset, rcond=None)[0]  # fmt: skip
        assert abs(slopes[0]) < 1e-2 and (np.abs(slopes[1:]) < 2e-4).all()
    again = tmp_path / "again"
    result = cli("wise", "rvb", "transform", path, "-o", again, "--fit", "--dx", 1)
    assert result.code == 2 and "--dx is not used with --fit" in result.err and not again.exists()


def test_rereference_undoes_what_free_solutions_took_up(tmp_path):
    table, rng = rvb_pairs(), np.random.default_rng(3)
    truth = write_rvb_table(table, tmp_path / "fixed.tbl")
    frames = sorted(set(table["frame"]))
    names = ("shift_u", "shift_v", "rotation", "scale_u", "scale_v")
    free = Table({"frame": frames, **{n: rng.normal(0, 1e-3, len(frames)) for n in names}})
    fixed = Table({"frame": frames, "shift_u": np.zeros(len(frames))})
    for row in free:
        which = table["frame"] == row["frame"]
        move = RvbTransform(*(row[n] for n in names), centre=(254.5, 254.5))
        moved = move(np.column_stack([table["u"][which], table["v"][which]]))
        table["u"][which], table["v"][which] = moved.T
    path = write_rvb_table(table, tmp_path / "free.parquet")
    for name, one in (("from", free), ("to", fixed)):
        write_rvb_table(one, tmp_path / f"{name}.tbl")
    solutions = ("--from", tmp_path / "from.tbl", "--to", tmp_path / "to.tbl")
    good("wise", "rvb", "rereference", path, *solutions, "-o", tmp_path / "out", "--band", "W4")
    found, expected = read_rvb(tmp_path / "out").matches, read_rvb(truth).matches
    np.testing.assert_allclose([found.u, found.v], [expected.u, expected.v], rtol=0, atol=1e-7)
    shutil.rmtree(tmp_path / "out")
    write_rvb_table(free[1:], tmp_path / "some.tbl")
    refused(tmp_path, "wise", "rvb", "rereference", path, "--from", tmp_path / "some.tbl",
            *solutions[2:], "-o", tmp_path / "out",
            words=["'00a'", "no solution with free scales"])  # fmt: skip


def test_wrong_commands_write_nothing(tmp_path):
    path: Path = write_rvb_table(
        vstack([rvb_pairs(), rvb_pairs(300, "W1", seed=2)]), tmp_path / "pairs.tbl"
    )
    out = ("-o", tmp_path / "out")
    begin = ("wise", "rvb", "transform", path, *out)
    refused(tmp_path, *begin, "--band", "W4", words=["no transformation is given"])
    refused(tmp_path, *begin, "--dx", 1, words=["several bands: W1 (300 pairs), W4 (600 pairs)"])
    refused(tmp_path, *begin, "--dx", 1, "--band", "W2", words=["does not contain W2"])
    refused(tmp_path, *begin, "--dx", "nan", "--band", "W4", words=["shift_u", "nan"])
    refused(tmp_path, *begin, "--dx", 1, "--columns", "u", words=["--columns", "KEY=NAME"])
    refused(tmp_path, *begin, "--dx", 1, "--columns", "w=u", words=["'w'", "not a known quantity"])
    refused(tmp_path, "wise", "rvb", "transform", tmp_path / "none.tbl", *out, "--dx", 1,
            words=["none.tbl"])  # fmt: skip
    folder = write_rvb_table(rvb_pairs(), tmp_path / "set" / "a.parquet").parent
    refused(tmp_path, "wise", "rvb", "transform", folder, "-o", folder / "out", "--dx", 1,
            words=["inside the input folder"])  # fmt: skip
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    refused(tmp_path, *begin, "--dx", 1, "--band", "W4", words=["out: is in use"])
    assert DETECTORS["W4"]["size"] == (508.0, 508.0)
