"""A folder of a run that was moved, copied, damaged, or made by somebody else."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io.fits import FITSDiff
from astropy.table import Table

from bayesdist.app.store.record import FileMark, Record
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.errors import InputError
from bayesdist.files.atomic import path_within
from bayesdist.files.hdf5 import netcdf_groups
from bayesdist.infer import load_fit
from tests.app.support import EXACT, cli, good, refused, snapshot, write_config, write_job
from tests.kills.compare import assert_same
from tests.kills.jobs import JOBS
from tests.reduced import case_in_full
from tests.sketches import quick

pytestmark = pytest.mark.usefixtures("no_report")

REQUIREMENT = "[[requirement]]\nname = 'r'\nstatistic = 'rms'\nlimit = 0.1\n"


@pytest.fixture
def project(finished, tmp_path) -> Path:
    """Input and run of a folder that lies elsewhere than where it was made."""
    return shutil.copytree(finished.path.parent, tmp_path / "project")


def altered(path: Path) -> None:
    """One bit of a file is another one; its size and its times are as they were."""
    before, content = path.stat(), bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def commands(run: Path, folder: Path) -> dict[str, tuple[object, ...]]:
    """Commands that go by the files of a run, and write nothing into it."""
    requirements = folder / "requirements.toml"
    requirements.write_text(REQUIREMENT, encoding="utf-8")
    return {
        "budget": ("budget", run, "--at", 10, 10),
        "requirements": ("requirements", run, "--requirements", requirements),
        "compare": ("compare", run, run),
        "report": ("stage", "report", run),
        "plan": ("plan", run),
        "monitor": ("monitor", run, folder / "none.ecsv"),
        "convert": ("convert", run, "--to", "sip", "-o", folder / "sip.hdr"),
    }


READ = {
    "fit.nc": ("fit", "budget", "requirements", "compare", "report", "plan", "monitor", "convert"),
    "posterior.nc": ("sample", "budget", "requirements", "compare", "report", "plan", "monitor"),
    "diagnostics.h5": ("diagnose", "budget", "requirements", "compare", "report", "plan"),
    "evaluation.h5": ("evaluate", "report"),
}


@pytest.mark.parametrize(
    "name",
    [
        *("diagnostics.h5", "evaluation.h5"),
        *(case_in_full(name, instead="others are damaged") for name in ("fit.nc", "posterior.nc")),
    ],
)
def test_no_command_goes_by_a_damaged_file(project, tmp_path, name):
    stage, *readers = READ[name]
    run = project / "run"
    every = commands(run, tmp_path)
    altered(run / name)
    for command in readers:
        words = (str(run / name), f"not as stage '{stage}' wrote it", f"bayesdist stage {stage}")
        refused(tmp_path, *every[command], words=words)
    (run / name).unlink()
    refused(tmp_path, *every[readers[0]], words=(str(run / name), "is gone"))


def test_the_page_of_many_runs_names_damage(project, tmp_path):
    run = project / "run"
    altered(run / "budget.ecsv")
    good("report", run, project / "run", "-o", tmp_path / "all.html")
    page = (tmp_path / "all.html").read_text(encoding="utf-8")
    assert page.count("budget.ecsv is not as stage &#39;evaluate&#39; wrote it") == 2
    assert page.count("FAIL") == 2


def test_a_project_that_was_moved_is_the_same(project, finished):
    """Its inputs are found from the run, and those at the old place are not looked at."""
    run, hidden = project / "run", finished.path.parent / "input"
    away = hidden.rename(hidden.with_name("away"))
    try:
        good("stage", "report", run)
        said = good("run", project / "input" / "config.toml", "-o", run, "--resume").err
        assert said.count("done before") == 6
        assert RunDirectory(run).facts["base"] == str(project / "input")
        good("budget", run, "--at", 10, 10)
        assert good("stage", "export", run).code == 0
    finally:
        away.rename(hidden)


def test_a_run_without_its_inputs_names_them(project, finished, tmp_path):
    """A run that went elsewhere alone finds them where they were, or says which ones it misses."""
    run, hidden = (project / "run").rename(tmp_path / "alone"), finished.path.parent / "input"
    good("budget", run, "--at", 10, 10)
    away = hidden.rename(hidden.with_name("away"))
    try:
        refused(tmp_path, "budget", run, "--at", 10, 10, words=(str(hidden / "stars.ecsv"),))
        good("compare", run, finished.path)  # needs none of them
    finally:
        away.rename(hidden)


def test_inputs_that_changed_are_named_where_they_are(project, tmp_path):
    altered(project / "input" / "stars.ecsv")
    words = (str(project / "input" / "stars.ecsv"), "changed since the run began")
    refused(tmp_path, "budget", project / "run", "--at", 10, 10, words=words)


def test_files_of_a_run_are_known_by_names_without_folders(finished):
    record = json.loads((finished.path / "run.json").read_text())
    assert set(record["inputs"]) == {"stars.ecsv"}
    names = {name for one in record["artefacts"].values() for name in one["files"]}
    assert names and not any(Path(name).is_absolute() for name in names)


@pytest.mark.parametrize("name", ["../outside.txt", "figures/../../outside.txt", "{absolute}"])
@pytest.mark.parametrize("where", ["artefact", "under way"])
def test_a_record_that_names_files_elsewhere_is_refused(project, finished, tmp_path, name, where):
    """Whatever a stage wrote before is removed when it is made again: never a file of others."""
    run, outside = project / "run", project / "outside.txt"
    outside.write_text("precious", encoding="utf-8")
    name = name.format(absolute=outside)
    record = Record.read(run / "run.json")
    if where == "artefact":
        record.artefacts["evaluate"].files[name] = FileMark(size=8, sha256=64 * "0")
    else:
        record.under_way = {"stage": "evaluate", "files": [name]}
    record.write(run / "run.json")
    for arguments in (
        ("stage", "evaluate", run),
        ("run", project / "input" / "config.toml", "-o", run, "--resume"),
        ("run", project / "input" / "config.toml", "-o", run, "--force"),
    ):
        refused(tmp_path, *arguments, words=("outside of its folder", str(run / "run.json")))
    assert outside.read_text(encoding="utf-8") == "precious"


def test_a_link_does_not_lead_to_files_of_others(project, tmp_path):
    """A folder within the run that is a link to another one is not emptied."""
    run, other = project / "run", tmp_path / "other"
    other.mkdir()
    (other / "x.txt").write_text("precious", encoding="utf-8")
    (run / "linked").symlink_to(other)
    record = Record.read(run / "run.json")
    record.under_way = {"stage": "evaluate", "files": ["linked/x.txt"]}
    record.write(run / "run.json")
    result = cli("stage", "export", run)
    assert result.code == 1 and "outside of its folder ('linked/x.txt')" in result.err
    with pytest.raises(InputError, match="outside of its folder"):
        path_within(run, "linked/x.txt", where="", links=True)
    assert (other / "x.txt").exists()


@pytest.mark.parametrize("name", ["bayesdist.log", ".bayesdist.lock", "figures"])
def test_nothing_is_written_through_a_link(project, tmp_path, name):
    """A run that others made may hold links in place of what is written in place."""
    run, other = project / "run", tmp_path / "precious"
    if name == "figures":
        shutil.rmtree(run / name)
        other.mkdir()
        (other / "corner.svg").write_text("precious", encoding="utf-8")
    else:
        (run / name).unlink(missing_ok=True)
        other.write_text("precious", encoding="utf-8")
    (run / name).symlink_to(other)
    before = snapshot(other) if other.is_dir() else other.read_text(encoding="utf-8")
    (run / "report.html").unlink()
    result = cli("stage", "report", run)
    assert result.code == 1, result.err
    assert "symbolic link" in result.err or "outside of its folder" in result.err
    assert "Traceback" not in result.err
    assert before == (snapshot(other) if other.is_dir() else other.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["bayesdist.log", ".bayesdist.lock"])
def test_a_pipe_in_place_of_a_file_is_not_waited_for(project, name):
    (project / "run" / name).unlink(missing_ok=True)
    os.mkfifo(project / "run" / name)
    result = cli("stage", "report", project / "run")
    assert result.code == 1 and "a pipe" in result.err


def test_matches_of_a_folder_above_are_as_the_user_wants_them(finished, tmp_path):
    """A configuration is its user's own: '../stars.ecsv' is read, and keeps its name."""
    shutil.copy(finished.config.with_name("stars.ecsv"), tmp_path / "stars.ecsv")
    (tmp_path / "job").mkdir()
    config = write_config(tmp_path / "job" / "c.toml", data={"matches": "../stars.ecsv"})
    good("run", config, "-o", tmp_path / "job" / "run")
    run = tmp_path / "job" / "run"
    assert set(RunDirectory(run).facts["inputs"]) == {"../stars.ecsv"}
    moved = tmp_path.rename(tmp_path.with_name(f"{tmp_path.name}-moved"))
    good("stage", "diagnose", moved / "job" / "run")


def test_products_have_names_and_no_folders(tmp_path, finished):
    """What a release is called becomes the names of its files."""
    from bayesdist.app.config.results import ReleaseBlock

    period = {"name": "pre", "years": (2002.0, 2009.0)}
    for given in ({"name": "../x"}, {"name": "a/b"}, {"name": ""}, {"name": "/x"}):
        with pytest.raises(ValueError, match="name"):
            ReleaseBlock(reference="r", period=[period], **given)
        with pytest.raises(ValueError, match="name"):
            ReleaseBlock(reference="r", name="x", period=[period | given])
    assert ReleaseBlock(reference="r", name="v1.0-b", period=[period]).name == "v1.0-b"


TIMED = {"bayesdist.log", "run.json", "summary.json"}  # with dates and durations
# these, hashes of files that have them, and where the input was
TIMES = re.compile(
    r'\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d[^ "]*|"(wall_s|size|mtime_ns?|base)": [^,}\n]+'
    r"|\d+(\.\d+)? s\b|[0-9a-f]{64}"
)


def test_runs_in_two_folders_are_the_same_but_for_dates_and_durations(tmp_path, monkeypatch):
    runs = []
    for name in ("one", "two/deeper"):
        folder = write_job(tmp_path / name, budget=[EXACT], products={"sip": {}, "parameters": {}})
        monkeypatch.chdir(folder.parent)
        good("run", "config.toml", "-o", "run", "-q")
        runs.append(folder.parent / "run")
    first, second = (snapshot(run) for run in runs)
    assert first.keys() == second.keys()
    other = {name for name in first if first[name] != second[name]}
    # h5py before 3.14 writes the time into the headers of groups
    assert other <= TIMED | {"fit.nc", "posterior.nc", "maps.fits"}
    for name in TIMED:
        texts = [TIMES.sub("", (run / name).read_text(encoding="utf-8")) for run in runs]
        assert str(tmp_path) not in texts[0] and texts[0] == texts[1], name
    for file in ("fit.nc", "posterior.nc"):
        groups = [netcdf_groups(run / file) for run in runs]
        assert groups[0].keys() == groups[1].keys()
        for name, group in groups[0].items():
            same = groups[1][name]
            assert group.arrays.keys() == same.arrays.keys()
            assert all(np.array_equal(group.arrays[k], same.arrays[k]) for k in group.arrays)
            texts = [{k: TIMES.sub("", str(v)) for k, v in g.attrs.items()} for g in (group, same)]
            differ = {k for k in texts[0] if texts[0][k] != texts[1][k]}
            assert differ <= {"wall_s"}, (file, name)
    maps = [str(run / "maps.fits") for run in runs]
    diff = FITSDiff(*maps, ignore_keywords=["CHECKSUM"], ignore_comments=["DATASUM"])
    assert diff.identical, diff.report()


def test_inspect_describes_the_fit_of_a_run(finished):
    text = good("inspect", finished.path / "fit.nc").out
    fit = load_fit(finished.path / "fit.nc")
    assert "linear fit" in text and f"{fit.n_used} stars" in text
    assert all(name in text for name in fit.model.names)


def _without_an_exposure_time(folder) -> None:
    """Remove one, of which a warning names the file."""
    path = folder / "exposures.ecsv"
    exposures = Table.read(path)
    exposures["exptime"][1] = float("nan")
    exposures.write(path, overwrite=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "job", ["matches", "campaign", case_in_full("selfcal", instead="two other kinds")]
)
def test_run_in_two_folders(job, tmp_path):
    first, second = tmp_path / "one", tmp_path / "another" / "and_longer"
    config = JOBS[job](first).relative_to(first)
    if job == "campaign":
        _without_an_exposure_time(first)
    shutil.copytree(first, second)
    for folder in (first, second):
        with quick():
            good("run", folder / config, "-o", folder / "run", "-q")
    assert_same(first / "run", second / "run")
    for path in (first / "run").rglob("*"):
        if path.is_file() and not re.fullmatch(r"bayesdist\.log|run\.json", path.name):
            assert str(tmp_path).encode() not in path.read_bytes(), path
    if job == "campaign":
        summary = (first / "run" / "summary.json").read_text(encoding="utf-8")
        assert "exptime is missing of 1 of 6 exposures in exposures.ecsv" in summary
