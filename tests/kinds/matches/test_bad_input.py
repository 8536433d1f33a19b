"""Whatever is wrong with the input: exit code 1, one sentence, and nothing half-written."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from astropy.table import MaskedColumn, Table, vstack

from bayesdist.infer import load_posterior
from tests.app.support import (
    CENTRE,
    SIGMA,
    as_table,
    begin_stagewise,
    cli,
    good,
    one_sentence,
    process,
    refused,
    simulated,
    write_config,
    write_job,
)
from tests.diagnose.test_frame_choice import exposures


@pytest.fixture
def stars() -> Table:
    return as_table(simulated()[0])


@pytest.fixture
def job(tmp_path, stars) -> Path:
    return write_job(tmp_path / "job", stars)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """A run after its first stage, beside its input."""
    folder = tmp_path_factory.mktemp("fitted")
    begin_stagewise(folder / "run", write_job(folder / "job"), "fit")
    return folder


@pytest.fixture
def begun(tmp_path, fitted) -> Path:
    """A copy of it that may be changed, with an input of its own."""
    shutil.copytree(fitted / "job", tmp_path / "job")
    return begin_stagewise(tmp_path / "run", tmp_path / "job" / "config.toml", "fit")


# -- the table of matches -------------------------------------------------------------------------


def _set(column: str, row: int, value: object) -> Callable[[Table], Table]:
    def change(table: Table) -> Table:
        table[column][row - 1] = value
        return table

    return change


def _renamed(old: str, new: str) -> Callable[[Table], Table]:
    def change(table: Table) -> Table:
        table.rename_column(old, new)
        return table

    return change


def _unit(value: str | None, *columns: str) -> Callable[[Table], Table]:
    def change(table: Table) -> Table:
        for column in columns:
            table[column].unit = value
        return table

    return change


def _text(table: Table) -> Table:
    column = table["x"].astype(str)
    column[10] = "n/a"
    table["x"] = column
    return table


def _masked(table: Table) -> Table:
    table["v"] = MaskedColumn(table["v"], mask=True)
    return table


def _on_a_line(table: Table) -> Table:
    table["y"] = 100.0 + 0.5 * table["x"]
    return table


def _in_a_corner(table: Table) -> Table:
    table["x"] = 1 + (table["x"] - 1) / 8
    table["y"] = 1 + (table["y"] - 1) / 8
    return table


BAD_TABLES: dict[str, tuple[Callable[[Table], Table], list[str]]] = {
    "missing column": (_renamed("u", "uu"), ["'u'", "uu"]),
    "missing errors": (_renamed("sigma_u", "qq"), ["sigma_u", "stars.ecsv"]),
    "nan": (_set("x", 7, np.nan), ["stars.ecsv, row 7, column 'x'", "nan"]),
    "infinite": (_set("v", 12, np.inf), ["stars.ecsv, row 12, column 'v'", "inf"]),
    "minus infinite": (_set("u", 400, -np.inf), ["stars.ecsv, row 400, column 'u'"]),
    "negative sigma": (_set("sigma_u", 3, -0.1), ["row 3, column 'sigma_u'", "-0.1", "positive"]),
    "zero sigma": (_set("sigma_v", 3, 0.0), ["row 3, column 'sigma_v'", "positive"]),
    "nan sigma": (_set("sigma_v", 9, np.nan), ["row 9, column 'sigma_v'"]),
    "all masked": (_masked, ["stars.ecsv", "no value in column 'v' (400 rows)"]),
    "text": (_text, ["row 11, column 'x'", "'n/a'", "number"]),
    "empty": (lambda t: t[:0], ["stars.ecsv", "no rows"]),
    "fewer stars than parameters": (lambda t: t[:5], ["5", "12 parameters"]),
    "on a line": (_on_a_line, ["line"]),
    "in a corner": (_in_a_corner, ["detector", "extrapolated"]),
    "duplicate": (lambda t: vstack([t, t[30:31]]), ["row 401", "row 31"]),
    "no unit": (_unit(None, "u", "v", "sigma_u", "sigma_v"), ["column 'u'", "unit", "arcsec"]),
    "two units": (_unit("arcsec", "v"), ["'v'", "arcsec", "pix"]),
    "unit of another kind": (_unit("arcsec", "sigma_u"), ["'sigma_u'", "arcsec", "pix"]),
    "unit that nobody knows": (_unit("furlong", "u", "v"), ["'u'", "furlong"]),
    "positions in arcsec": (_unit("arcsec", "x"), ["'x'", "arcsec"]),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_wrong_table(tmp_path, stars, case):
    change, words = BAD_TABLES[case]
    config = write_job(tmp_path / "job", change(stars.copy()))
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)
    assert not (tmp_path / "run").exists()
    refused(tmp_path, "check", config, words=words)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"matches": "stras.ecsv"}, ["stras.ecsv", "check the path"]),
        ({"matches": "stras*.ecsv"}, ["stras*.ecsv", "pattern"]),
        ({"matches": ["stars.ecsv", "more.ecsv"]}, ["more.ecsv"]),
        ({"matches": ["stars.ecsv", "stars.ecsv"]}, ["stars.ecsv", "twice"]),
        ({"matches": []}, ["data.matches"]),
        ({"matches": "."}, ["Parquet"]),
        ({"columns": {"sigma_u": "sigma_a"}}, ["'sigma_a'", "'sigma_"]),
        ({"columns": {"uu": "u"}}, ["'uu'", "'u'"]),
        ({"unit": "mas"}, ["mas", "pix", "'u'"]),
        ({"sigma": "by_magnitude"}, ["magnitude"]),
        ({"format": "hst1pass"}, ["stars.ecsv"]),
        ({"format": "astrometry.net"}, ["stars.ecsv"]),
    ],
)
def test_wrong_options_of_the_data(tmp_path, stars, data, words):
    config = write_job(tmp_path / "job", stars, data={"matches": "stars.ecsv"} | data)
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("suffix", [".ecsv", ".csv", ".fits", ".parquet", ".fits.gz"])
@pytest.mark.parametrize("damage", ["truncated", "garbage", "empty"])
def test_a_damaged_file(tmp_path, stars, suffix, damage):
    path = tmp_path / f"stars{suffix}"
    table = stars.copy()
    if suffix == ".csv":
        for name in table.colnames:
            table[name].unit = None
    kind = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".parquet": "parquet"}.get(suffix, "fits")
    table.write(path, format=kind)
    whole = path.read_bytes()
    path.write_bytes(
        {
            "truncated": whole[: int(0.6 * len(whole)) + 3],
            "garbage": bytes(range(256)) * 20,
            "empty": b"",
        }[damage]
    )
    config = write_config(
        tmp_path / "c.toml",
        data={"matches": path.name} | ({"unit": "pix"} if suffix == ".csv" else {}),
    )
    if suffix in (".csv", ".ecsv") and damage == "truncated":
        # a text file that ends at the end of a row is a shorter table: cut within the last row
        path.write_bytes(whole[: whole.rindex(b"," if suffix == ".csv" else b" ")])
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=[path.name])
    assert not (tmp_path / "run").exists()


def test_a_fits_file_without_a_table(tmp_path):
    from astropy.io import fits

    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    config = write_config(tmp_path / "c.toml", data={"matches": "image.fits"})
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=["image.fits", "table"])


# -- the configuration ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"model": {"odrer": 2}}, ["'odrer'", "'order'"]),
        ({"model": {"order": 13}}, ["model.order", "12"]),
        ({"model": {"order": "two"}}, ["model.order", "'two'"]),
        ({"requirement": [{"name": "r", "statistic": "p96", "limit": 1}]}, ["'p96'", "'p9"]),
        ({"outliers": {"model": "uniform"}}, ["match_radius"]),
        # what can only be judged beside the data
        ({"requirement": [{"name": "r", "statistic": "p95", "limit": 1, "unit": "mas"}]},
         ["'r'", "detector.scale_mas"]),
        ({"budget": [{"name": "b", "kind": "random", "sigma_u": 1, "sigma_v": 1, "unit": "mas"}]},
         ["'b'", "detector.scale_mas"]),
        ({"prior": [{"parameter": "u_9_9", "mean": 0, "sigma": 1}]}, ["u_9_9"]),
        ({"model.tdd": {"epoch0": 2004.5, "terms": [["u", 1, 0]]}}, ["epoch"]),
        ({"products": {"sip": {"linear": "sip"}}, "data": {"matches": "flipped.ecsv"}}, ["linear"]),
        ({"products": {"idctab": {"instrument": "ACS", "detector": "WFC"}}}, ["scale"]),
        ({"detector": {"size": [100, 100]}}, ["size"]),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else None,
)  # fmt: skip
def test_a_wrong_configuration(tmp_path, stars, sections, words):
    config = write_job(tmp_path / "job", stars, **sections)
    stars["u"] = -stars["u"]  # a mirrored detector is far from the identity
    stars.write(config.with_name("flipped.ecsv"))
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)
    assert not (tmp_path / "run").exists()
    refused(tmp_path, "check", config, words=words)


def test_no_toml_and_no_file(tmp_path):
    (tmp_path / "c.toml").write_text("[data\n")
    words = ["c.toml", "line 1"]
    refused(tmp_path, "run", tmp_path / "c.toml", "-o", tmp_path / "run", words=words)
    refused(tmp_path, "run", tmp_path / "none.toml", "-o", tmp_path / "r", words=["none.toml"])
    refused(tmp_path, "check", tmp_path / "none.toml", words=["none.toml"])


# -- the run directory ----------------------------------------------------------------------------


def test_a_folder_that_holds_another_run(finished):
    words = [str(finished.path), "--resume", "--force"]
    refused(finished.path, "run", finished.config, "-o", finished.path, words=words)


def test_a_folder_that_holds_foreign_files(job, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("precious")
    for option in ([], ["--force"], ["--resume"]):
        arguments = ("run", job, "-o", tmp_path / "thesis", *option)
        refused(tmp_path, *arguments, words=["chapter1.tex", "empty folder"])


def test_a_folder_that_holds_another_configuration(job, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "config.toml").write_text("# not yet finished\n")
    for option in ([], ["--force"]):
        refused(tmp_path, "run", job, "-o", other, *option, words=["config.toml"])


def test_a_file_in_place_of_the_folder(job, tmp_path):
    (tmp_path / "run").write_text("a file")
    refused(tmp_path, "run", job, "-o", tmp_path / "run", words=["run", "not a folder"])
    refused(tmp_path, "run", job, "-o", tmp_path / "run" / "deeper", words=["deeper"])


def test_force_replaces_a_run_and_leaves_foreign_files(finished, tmp_path, no_report):
    path = tmp_path / "run"
    shutil.copytree(finished.path, path)
    foreign = ["notes.txt", "0461802ej_idc.fits", "sip_by_hand.hdr", "figures/mine.png", ".hidden"]
    for name in foreign:
        (path / name).write_text("precious")
    (path / ".bayesdist-0a1b2c3d-posterior.nc").write_text("left by a killed run")
    config = write_config(
        finished.config.with_name("other.toml"), sampler={"seed": 5, "target_ess": 50}
    )
    good("run", config, "-o", path, "--force")
    assert all((path / name).read_text() == "precious" for name in foreign)
    assert not (path / ".bayesdist-0a1b2c3d-posterior.nc").exists()
    assert not (path / "report.html").exists()
    assert not (path / "sip.hdr").exists()  # the new configuration asks for no product
    assert [p.name for p in (path / "figures").iterdir()] == ["mine.png"]
    assert load_posterior(path).sampler.seed == 5


def test_force_with_wrong_input_leaves_the_old_run(finished, tmp_path, stars):
    table = stars.copy()
    table["x"][0] = np.nan
    config = write_job(tmp_path / "job", table)
    refused(finished.path, "run", config, "-o", finished.path, "--force", words=["row 1"])


def test_resume_with_another_configuration(begun, tmp_path):
    config = tmp_path / "job" / "other.toml"
    config.write_text((begun / "config.toml").read_text() + "\n[fit]\nclip_abs = 3.0\n")
    words = ["configuration", "--force"]
    refused(tmp_path, "run", config, "-o", begun, "--resume", words=words)


def test_resume_with_another_seed(begun, tmp_path):
    words = ["seed 1", "--seed"]
    arguments = ("run", begun / "config.toml", "-o", begun, "--resume", "--seed", 2)
    refused(tmp_path, *arguments, words=words)


def test_input_that_changed_since_the_run_began(begun, tmp_path, stars):
    table = stars.copy()
    table["x"][17] += 0.001
    table.write(tmp_path / "job" / "stars.ecsv", overwrite=True)
    words = ["stars.ecsv", "changed", "restore it"]
    refused(tmp_path, "run", begun / "config.toml", "-o", begun, "--resume", words=words)
    for stage in ("sample", "assess", "report"):
        refused(tmp_path, "stage", stage, begun, words=words)
    (tmp_path / "job" / "stars.ecsv").unlink()
    refused(tmp_path, "stage", "sample", begun, words=["stars.ecsv", "does not exist"])


def test_a_configuration_that_was_edited_in_the_run(begun, tmp_path):
    """It would have no effect, and nobody would notice."""
    path = begun / "config.toml"
    text = path.read_text()
    path.write_text(text + "# a comment is no change\n")
    good("stage", "fit", begun)
    for old, new in (("[9, 7]", "[33, 17]"), ("target_ess = 100", "target_ess = 400")):
        assert old in text
        path.write_text(text.replace(old, new))
        refused(tmp_path, "stage", "sample", begun, words=["config.toml", "edited", "restore it"])


def test_stages_out_of_order(begun, tmp_path):
    (tmp_path / "req.toml").write_text('[[requirement]]\nname="r"\nstatistic="p95"\nlimit=1\n')
    for stage in ("assess", "export", "report"):
        refused(
            tmp_path,
            "stage",
            stage,
            begun,
            words=["needs stage 'sample'", "bayesdist stage sample"],
        )
    # neither of these is a stage itself
    refused(tmp_path, "plan", begun, words=[": 'plan' needs stage 'sample'"])
    refused(tmp_path, "budget", begun, "--at", 1, 1, words=[": 'budget' needs stage 'sample'"])
    refused(
        tmp_path, "requirements", begun, "--requirements", tmp_path / "req.toml", words=["'sample'"]
    )


def test_a_stage_before_the_first(job, tmp_path):
    """A folder with a configuration only becomes a run by its first stage, and by no other."""
    folder = tmp_path / "run"
    folder.mkdir()
    text = job.read_text().replace('"stars.ecsv"', f'"{job.parent / "stars.ecsv"}"')
    (folder / "config.toml").write_text(text)
    for stage in ("sample", "assess", "export", "report"):
        refused(tmp_path, "stage", stage, folder, words=["needs stage 'fit'"])
    (folder / "config.toml").write_text(text.replace("order = 2", "order = 9"))
    stars = Table.read(job.parent / "stars.ecsv")[:50]
    stars.write(job.parent / "stars.ecsv", overwrite=True)
    refused(tmp_path, "stage", "fit", folder, words=["110 parameters"])


@pytest.mark.parametrize("stage", ["fit", "sample", "assess", "export", "report"])
def test_a_stage_of_what_is_no_run(tmp_path, stage):
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "none"):
        refused(tmp_path, "stage", stage, path, words=[path.name, "bayesdist run"])


def test_damaged_files_of_a_run(begun, tmp_path):
    (begun / "run.json").write_text('{"schema": 2, "config"')
    refused(tmp_path, "stage", "sample", begun, words=["run.json"])
    refused(tmp_path, "run", begun / "config.toml", "-o", begun, "--resume", words=["run.json"])


def test_a_damaged_fit(begun, tmp_path):
    (begun / "fit.nc").write_bytes(b"no netCDF" * 100)
    result = cli("stage", "sample", begun, "-q")
    assert result.code == 1
    assert result.err.count("\n") == 1 and "fit.nc" in result.err
    (begun / "fit.nc").unlink()
    result = cli("stage", "sample", begun, "-q")
    assert result.code == 1
    one_sentence(result.err, "fit.nc", "bayesdist stage fit")


# -- requirements and inspection ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, ["req.toml", "does not exist"]),
        ("", ["req.toml: holds no settings; give it [[requirement]] blocks"]),
        ("# later\n", ["req.toml: holds no settings"]),
        ("requirement = []", ["requirement"]),
        ("[[requirement]", ["req.toml", "TOML"]),
        ('[[requirement]]\nname = "r"\nstatistic = "p95"\n', ["requirement[1].limit"]),
        ('[[requirement]]\nname = "r"\nstatistic = "q95"\nlimit = 1\n', ["'q95'"]),
        ('[[requirment]]\nname = "r"\nstatistic = "p95"\nlimit = 1\n', ["'requirement'"]),
        (b"\x89PNG\r\n\x1a\n\x00\xff", ["req.toml", "UTF-8"]),
    ],
)
def test_validate_with_a_wrong_file(finished, tmp_path, text, words):
    path = tmp_path / "req.toml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(finished.path, "requirements", finished.path, "--requirements", path, words=words)


@pytest.mark.parametrize("text", ["", "\n# nothing yet\n", "\ufeff"])
def test_an_empty_configuration(tmp_path, text):
    (tmp_path / "c.toml").write_text(text, encoding="utf-8")
    words = ["c.toml: holds no settings", "bayesdist init"]
    refused(tmp_path, "run", tmp_path / "c.toml", "-o", tmp_path / "run", words=words)


def test_what_is_no_run_points_to_the_run_within(tmp_path):
    """As of `bayesdist demo`, whose run lies beside its input."""
    (tmp_path / "demo" / "run").mkdir(parents=True)
    (tmp_path / "demo" / "run" / "run.json").write_text("{}")
    (tmp_path / "file").touch()
    at = ("--at", 1, 1)
    within = str(tmp_path / "demo" / "run")
    refused(tmp_path, "budget", tmp_path / "demo", *at, words=["is not a run", f"give {within}"])
    refused(tmp_path, "monitor", tmp_path / "demo", "x", words=["is not a run", f"give {within}"])
    refused(tmp_path, "plan", tmp_path / "none", words=["none: there is no such folder"])
    refused(tmp_path, "plan", tmp_path / "file", words=["file: is a file, not the folder of a run"])
    refused(tmp_path, "plan", tmp_path, words=["is not a run", "bayesdist run"])


def test_validate_of_what_is_no_run(tmp_path):
    path = tmp_path / "req.toml"
    path.write_text('[[requirement]]\nname = "r"\nstatistic = "p95"\nlimit = 1\n')
    refused(tmp_path, "requirements", tmp_path, "--requirements", path, words=["is not a run"])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("garbage.fits", b"garbage" * 1000),
        ("cut_idc.fits", b"SIMPLE  =                    T" + b" " * 500),
        ("garbage.hdr", bytes(range(256))),
        ("text.txt", b"Dear all,\nthe flight software is fine.\n"),
        ("empty.hdr", b""),
    ],
)
def test_inspect_of_garbage(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    refused(tmp_path, "inspect", tmp_path / name, words=[name])


def test_inspect_of_what_is_not_there(tmp_path):
    refused(tmp_path, "inspect", tmp_path / "none.fits", words=["none.fits"])
    refused(tmp_path, "inspect", tmp_path / "none.nc", words=["none.nc"])
    refused(tmp_path, "inspect", tmp_path, words=["posterior.nc"])


def test_inspect_of_a_netcdf_file_of_somebody_else(tmp_path):
    xr.Dataset({"x": ("t", np.zeros(3))}).to_netcdf(tmp_path / "theirs.nc", engine="h5netcdf")
    (tmp_path / "garbage.nc").write_bytes(b"garbage" * 100)
    (tmp_path / "empty.nc").write_bytes(b"")
    for name in ("theirs.nc", "garbage.nc", "empty.nc"):
        result = cli("inspect", tmp_path / name)
        assert (result.code, result.out, result.err.count("\n")) == (1, "", 1)
        assert name in result.err and "not a posterior" in result.err


# -- other commands -------------------------------------------------------------------------------


def test_init_says_what_to_give(tmp_path):
    """Whoever names the table alone is shown the command that has it."""
    for given, example in (("stars.csv", "stars.toml --matches stars.csv"), ("my.toml", "my.toml")):
        result = cli("init", tmp_path / given)
        assert result.code == 2 and not any(tmp_path.iterdir())
        text = " ".join(result.err.replace(str(tmp_path) + "/", "").split())
        assert f"bayesdist init {example}" in text
        assert "its reference position" in text and "draft" in text


def test_init_warns_of_pixels_before_the_first(tmp_path, stars):
    table = stars.copy()
    table["x"] -= CENTRE[0]
    table.write(tmp_path / "middle.ecsv")
    made = good("init", tmp_path / "c.toml", "--matches", tmp_path / "middle.ecsv")
    err = made.err
    n = int(((table["x"] < 0.5) | (table["y"] < 0.5)).sum())
    said = f"{n} of {len(table)} positions lie outside these pixels"
    assert said in (tmp_path / "c.toml").read_text()
    assert f"{len(table)} matches, of which {n} lie outside the detector" in made.out
    assert "outside the" in cli("check", tmp_path / "c.toml").err
    assert f"middle.ecsv: {n} of {len(table)} positions lie before the first pixel" in err
    assert f"x from {table['x'].min():.1f}" in err


def test_a_draft_says_how_many_stars_are_outside_the_size_that_was_given(tmp_path, stars):
    stars.write(tmp_path / "stars.ecsv")
    common = "init", tmp_path / "c.toml", "--matches", tmp_path / "stars.ecsv", "--force"
    assert "outside" not in good(*common).out + (tmp_path / "c.toml").read_text()
    n = int(((stars["x"] > 500.5) | (stars["y"] > 600.5)).sum())
    out = good(*common, "--size", "500", "600").out
    assert f"{len(stars)} matches, of which {n} lie outside the detector" in out


def test_init_refuses(tmp_path, stars):
    stars.write(tmp_path / "stars.ecsv")
    (tmp_path / "mine.toml").write_text("# mine\n")
    words = ["mine.toml", "--force"]
    matches = ("--matches", tmp_path / "stars.ecsv")
    refused(tmp_path, "init", tmp_path / "mine.toml", *matches, words=words)
    matches = ("--matches", tmp_path / "none.ecsv")
    refused(tmp_path, "init", tmp_path / "new.toml", *matches, words=["none.ecsv"])
    matches = ("--matches", tmp_path / "bad.ecsv")
    stars["sigma_u"][3] = -1.0  # errors that are wrong are not errors that are missing
    stars.write(tmp_path / "bad.ecsv", overwrite=True)
    refused(tmp_path, "init", tmp_path / "new.toml", *matches, words=["row 4", "sigma_u"])


def test_simulate_and_demo_refuse(tmp_path):
    out = tmp_path / "sim"
    words = ["--stars"]
    refused(tmp_path, "simulate", "wise", "-o", out, "--stars", "0", words=words)
    refused(tmp_path, "simulate", "wise", "-o", out, "--fraction", "2", words=["--fraction"])
    refused(tmp_path, "simulate", "wise", "-o", out, "--band", "W9", words=["W9", "W2"])
    good("simulate", "wise", "-o", out, "--stars", "50")
    refused(tmp_path, "simulate", "wise", "-o", out, words=["sim", "--force"])
    refused(tmp_path, "demo", "-o", out, words=["sim"])
    (tmp_path / "file").write_text("")
    refused(tmp_path, "simulate", "wise", "-o", tmp_path / "file", words=["file"])


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["rnu", "c.toml"],
        ["run", "c.toml", "-o", "r", "--resume", "--force"],
        ["run", "c.toml", "-o", "r", "--seed", "-1"],
        ["run", "c.toml", "-o", "r", "--seed", "one"],
        ["stage", "sample", "r", "--force"],
        ["stage", "fit", "r", "--strict"],
        ["stage", "fit", "r", "--pdf"],
        ["stage", "fitt", "r"],
        ["requirements", "r"],
        ["simulate", "galaxy", "-o", "d"],
        ["inspect"],
    ],
)
def test_usage_errors_exit_2(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    result = cli(*arguments)
    assert result.code == 2
    assert result.err.startswith("Usage: bayesdist") and "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [("validate", "requirements"), ("order", "select-order"), ("fit", "stage fit"),
     ("bands", "wise bands"), ("pam", "hst pam")],
)  # fmt: skip
def test_an_old_name_is_refused_with_the_new_one(old, new):
    result = cli(old, "x")
    assert result.code == 2
    one_sentence(result.err, repr(old), f"bayesdist {new}")


# -- names and a process of its own ---------------------------------------------------------------


def test_paths_with_spaces_and_other_letters(tmp_path, stars, no_report):
    folder = tmp_path / "Größe & \"π\" 恒星 'été'"
    folder.mkdir()
    stars.write(folder / "étoiles n°1 [a].ecsv")
    good("init", folder / "mon réglage.toml", "--matches", folder / "étoiles n°1 [a].ecsv")
    good("check", folder / "mon réglage.toml")
    name = "étoiles n°1 [a].ecsv"
    config = write_config(folder / "c é.toml", data={"matches": name}, products={"sip": {}})
    good("run", config, "-o", folder / "le résultat")
    good("inspect", folder / "le résultat" / "sip.hdr")
    good("inspect", folder / "le résultat")


def test_the_same_from_a_shell(tmp_path, stars):
    config = write_job(tmp_path / "job", stars, model={"odrer": 2})
    done = process("run", config, "-o", "run", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    one_sentence(done.stderr, "'odrer'", "'order'")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["job"]

    usage = cli("run")
    assert usage.code == 2 and usage.err.startswith("Usage")


# -- frames of the exposures ----------------------------------------------------------------------


def of_exposures(*kinds, sigma=SIGMA):
    """Exposures that differ by these, as a table with errors."""
    m = exposures(np.random.default_rng(4), *kinds)
    names = np.array(m.exposure_names)[m.exposure]
    table = Table({"x": m.x, "y": m.y, "u": m.u, "v": m.v, "exp": names})
    table["su"] = table["sv"] = np.full(len(m), sigma)
    for name in ("u", "v", "su", "sv"):
        table[name].unit = "pix"
    return table


@pytest.mark.parametrize(
    ("kinds", "needed"),
    [(("shift",), "shift"), (("shift", "rotation", "scale"), "shift_rotation_scale")],
)
def test_exposures_that_lie_differently_are_refused_with_the_key_that_helps(
    tmp_path, kinds, needed
):
    """With that key the same run goes through."""
    job = write_job(tmp_path / "job", of_exposures(*kinds))
    text = refused(tmp_path, "check", job, words=["rejection limits", "model.frames"])
    said = re.search(r"set (model)\.frames = '(\w+)'", text)
    assert said.group(2) == needed
    model = {"order": 2, "reference_pixel": CENTRE, "frames": needed}
    good_job = write_job(tmp_path / "other", of_exposures(*kinds), model=model)
    assert "model.frames" not in good("check", good_job).out


def test_exposures_that_differ_by_little_are_said_with_the_key(tmp_path):
    """Errors are not said to be too small without it."""
    job = write_job(tmp_path / "job", of_exposures("rotation"))
    text = good("check", job).out
    assert "set model.frames = 'shift_rotation'" in text
    alike = good("check", write_job(tmp_path / "alike", of_exposures(sigma=SIGMA / 3))).out
    assert "model.frames" not in alike
