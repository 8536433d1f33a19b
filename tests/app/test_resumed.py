"""What a resumed run makes anew, what it goes on from, and what it refuses."""

from __future__ import annotations

import json
import os
import shutil
import socket
from pathlib import Path

import pytest

from bayesdist.app.config import installed_kinds, load_config
from bayesdist.app.store import Made
from bayesdist.app.store.made_from import (
    LATER,
    LIMITS,
    changes,
    is_adjustable,
    made_from_of,
    settings_of,
)
from bayesdist.app.store.record import digest_of
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.store import locked
from bayesdist.infer import load_posterior
from tests.app.support import cli, good, refused, replaced, snapshot, summary_of, toml
from tests.reduced import case_in_full

pytestmark = pytest.mark.usefixtures("no_report")

NEW = {"name": "new", "statistic": "u_rms", "limit": 0.5, "probability": 0.9}
WRITTEN = ("posterior.nc", "budget.ecsv", "sip.hdr", "summary.json")
ROWS = ("budget.ecsv", "margins.ecsv", "coefficients.ecsv")


@pytest.fixture(scope="module")
def unreported(finished, tmp_path_factory) -> Path:
    """A finished run, whose report has been made as these tests make it: not at all."""
    path = shutil.copytree(finished.path, tmp_path_factory.mktemp("unreported") / "run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesdist.app.stages.report", lambda results, pdf: [])
        good("stage", "report", path)
    return path


@pytest.fixture
def run(unreported, tmp_path) -> Path:
    """A copy of it, to be changed."""
    return shutil.copytree(unreported, tmp_path / "run")


def edited(finished, *replacements: tuple[str, str], more: str = "") -> Path:
    """The configuration of the run with other settings, beside it."""
    text = replaced(finished.config.read_text(encoding="utf-8"), dict(replacements))
    path = finished.config.with_name("edited.toml")
    path.write_text(text + more, encoding="utf-8")
    return path


def rows(path: Path) -> dict[str, str]:
    return {name: (path / name).read_text(encoding="utf-8") for name in ROWS}


def test_what_comes_after_sampling_is_made_anew(finished, run, tmp_path):
    """Grid, requirements, budget and products, as if the run had begun with them."""
    block = "".join(f"{key} = {toml(value)}\n" for key, value in NEW.items())
    config = edited(
        finished,
        ("grid = [9, 7]", "grid = [5, 4]"),
        ("sigma_u = 0.003", "sigma_u = 0.03"),
        ("inverse_order = 4", "inverse_order = 5"),
        more=f"[[requirement]]\n{block}",
    )
    chains = {k: v for k, v in snapshot(run).items() if k.startswith(("chain", "posterior"))}
    said = good("run", config, "-o", run, "--resume").err
    for words in (
        "fit: done before",
        "sample: done before",
        "diagnose: done before",
        "evaluate: begins again, as assess.grid [9, 7] is now [5, 4]",
        "export: begins again",
    ):
        assert words in said
    assert chains.items() <= snapshot(run).items()
    assert (run / "config.toml").read_bytes() == config.read_bytes()
    assert [m["name"] for m in summary_of(run)["margins"]][-1] == "new"
    fresh = tmp_path / "fresh"
    good("run", config, "-o", fresh)
    assert rows(run) == rows(fresh)
    assert (run / "sip.hdr").read_bytes() == (fresh / "sip.hdr").read_bytes()
    before = (run / "run.json").read_bytes()
    assert good("run", config, "-o", run, "--resume").err.count("done before") == 6
    assert (run / "run.json").read_bytes() == before


def test_products_that_are_no_longer_asked_for_go(finished, run):
    config = edited(finished, ("[products]\nsip = {inverse_order = 4}\n", ""))
    said = good("run", config, "-o", run, "--resume").err
    assert "fit: done before" in said and not (run / "sip.hdr").exists()
    assert summary_of(run)["products"] == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("order = 2", "order = 3", ("model.order = 3", "was started with 2")),
        ("[sampler]", "[sampler]\nwalkers = 80", ("sampler.walkers = 80", "was started with none")),
        ("[sampler]", "[sampler]\nseed = 7", ("sampler.seed = 7", "was started with 1")),
        (
            "[assess]",
            "[fit]\nclip_abs = 3.0\n[assess]",
            ("fit.clip_abs = 3.0", "was started with 2.0"),
        ),
    ],
)
def test_the_solution_is_what_a_run_is(finished, run, tmp_path, old, new, words):
    """Other settings of it are refused by key and value, and --force replaces the run."""
    config = edited(finished, (old, new))
    refused(tmp_path, "run", config, "-o", run, "--resume", words=(*words, "--force"))


def test_where_the_work_is_done_is_in_no_key(finished, run):
    config = edited(finished, more="[compute]\nmemory_mb = 500\n")
    assert good("run", config, "-o", run, "--resume").err.count("done before") == 6
    assert RunDirectory(run).config.compute.memory_mb == 500


def test_higher_limits_let_the_chains_go_on(finished, run):
    config = edited(finished, ("target_ess = 100", "target_ess = 150"))
    chains = {k: v for k, v in snapshot(run).items() if k.startswith("chain")}
    said = good("run", config, "-o", run, "--resume").err
    assert "fit: done before" in said and "sampler.target_ess 100.0 is now 150.0" in said
    assert chains.items() <= snapshot(run).items()
    convergence = load_posterior(run).convergence
    assert min(convergence.ess_bulk_min, convergence.ess_tail_min) >= 150


@pytest.mark.parametrize(
    ("name", "how"),
    [
        *((name, "altered") for name in WRITTEN),
        ("sip.hdr", "removed"),
        *(
            case_in_full(name, "removed", instead="each is altered, and one is removed")
            for name in WRITTEN
            if name != "sip.hdr"
        ),
    ],
)
def test_a_file_that_is_not_as_it_was_written_is_written_again(finished, run, name, how):
    numbers, content = rows(run), (run / name).read_bytes()
    if how == "removed":
        (run / name).unlink()
    else:
        (run / name).write_bytes(content[:-9] + b"\x01\x02\x03" * 3)
    said = good("run", finished.config, "-o", run, "--resume").err
    assert name == "summary.json" or f"as {name} is not what it wrote" in said
    assert rows(run) == numbers
    if name != "posterior.nc":  # which says how long it took
        assert (run / name).read_bytes() == content


def test_a_run_that_was_moved_is_the_same(finished, run, tmp_path):
    run.rename(tmp_path / "moved")
    said = good("run", finished.config, "-o", tmp_path / "moved", "--resume").err
    assert said.count("done before") == 6


def test_two_processes_do_not_work_on_one_run(finished, run, tmp_path):
    with locked(run):
        mine = f"process {os.getpid()} on {socket.gethostname()} since "
        for arguments in (("run", finished.config, "-o", run, "--resume"), ("stage", "fit", run)):
            refused(tmp_path, *arguments, words=("another process", mine, str(run)))
    assert cli("stage", "export", run).code == 0


def test_a_run_of_an_older_schema(finished, run, tmp_path):
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | {"schema": 1}))
    words = ("schema 1", "bayesdist that made it", record["versions"]["bayesdist"], "schema 2")
    refused(tmp_path, "run", finished.config, "-o", run, "--resume", words=words)
    refused(tmp_path, "budget", run, "--at", 1, 1, words=words)


@pytest.mark.parametrize("kind", sorted(installed_kinds()))
def test_each_key_is_of_the_solution_or_of_what_comes_later(tmp_path, kind):
    """What may change on resuming is what is in no key of match, fit and chains."""
    block = {
        "data": 'matches = "a"',
        "campaign": 'lists = "a"\ncatalog = "b"\nexposures = "c"\ninitial_distortion = "d"',
        "selfcal": 'lists = "a"',
    }[kind]
    chip = "[[chip]]\nnumber = 1\nname = 'A'\nsize = [9, 9]\nreference_pixel = [5, 5]\n"
    path = tmp_path / "c.toml"
    path.write_text(f"[{kind}]\n{block}\n[model]\norder = 2\n{chip}", encoding="utf-8")
    config = load_config(path)[0]
    solution, limits, later = settings_of(config)
    assert set(later) <= set(LATER) and set(limits["sampler"]) == set(LIMITS)
    for section, value in config.model_dump().items():
        keys = value if isinstance(value, dict) else {"": None}
        for key in keys:
            name = f"{section}.{key}".strip(".")
            fixed = key in solution.get(section, {}) if key else section in solution
            assert fixed != is_adjustable(name, config), name


DIAGNOSED = "[data]\nmatches = 'a'\n[model]\norder = 2\n[detector]\nsize = [9, 9]\n"
REQUIREMENT = "[[requirement]]\nname = 'r'\nstatistic = 'rms'\nlimit = 0.1\n"
TERM = "[[budget]]\nname = 'c'\nkind = 'random'\nsigma_u = 0.1\nsigma_v = 0.1\n"


@pytest.mark.parametrize(
    ("begun", "more", "anew"),
    [
        ("", REQUIREMENT + TERM + "[assess]\ndraws = 500\n", False),
        ("", "[discrepancy]\nstructure = 5.0\n", True),
        ("[periods]\ncentres = [55212.5, 55262.5]\ndays = 5.0\n", REQUIREMENT, True),
        ("[holdout]\nfraction = 0.1\n", TERM, True),
    ],
)
def test_diagnostics_are_made_anew_by_what_they_rest_on(tmp_path, begun, more, anew):
    """The limit of a requirement is a tolerance of periods, and stars held out meet all errors."""
    before = {name: Made(name, name) for name in ("fit", "sample")}
    keys = []
    for text in (DIAGNOSED + begun, DIAGNOSED + begun + more):
        path = tmp_path / "c.toml"
        path.write_text(text, encoding="utf-8")
        facts = {"inputs": {}, "base": str(tmp_path)}
        found = made_from_of("diagnose", before, load_config(path)[0], facts)
        keys.append(digest_of([one for one in found if not isinstance(one, Made)]))
    assert (keys[0] != keys[1]) == anew


def test_changes_are_named_by_their_keys(finished):
    known = load_config(finished.config)[0]
    now = load_config(edited(finished, ("sigma_u = 0.003", "sigma_u = 0.5")))[0]
    found = {key: (old, new) for key, old, new in changes(known, now)}
    assert found == {"budget[1].sigma_u": (0.003, 0.5)}
