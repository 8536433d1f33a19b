"""The same run in surroundings that programs often do not reckon with.

Each is a process of its own.  Where the machine cannot make such surroundings, the test says so.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesdist.infer import load_posterior
from tests.app.several import encoded, results_of
from tests.app.support import REPOSITORY, as_table, good, one_sentence, simulated, write_job
from tests.reduced import case_in_full, only_in_full

FILES = ("budget.ecsv", "margins.ecsv", "coefficients.ecsv", "sip.hdr", "summary.json")


def started(
    *arguments: object,
    python: Sequence[str] = ("-m", "tests.sketches"),
    before: Sequence[str] = (),
    environment: Mapping[str, str | None] | None = None,
    prepare: Callable[[], Any] | None = None,
    **options: Any,
) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, whose figures are sketches; None removes a variable."""
    known = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])}
    known |= {"PYTHONUTF8": "1"} | dict(environment or {})
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    return subprocess.run(
        [*before, sys.executable, *python, *map(str, arguments)],
        env={key: value for key, value in known.items() if value is not None},
        preexec_fn=prepare,
        encoding="utf-8",
        check=False,
        **given,
    )


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Path:
    """A configuration of a small run of a table in parts, more than a process may open at times."""
    folder, table = tmp_path_factory.mktemp("job"), as_table(simulated(n=200)[0])
    (folder / "parts").mkdir()
    for k in range(40):
        table[5 * k : 5 * k + 5].write(folder / "parts" / f"{k:02d}.parquet")
    return write_job(
        folder,
        table,
        data={"matches": "parts"},
        assess={"grid": (3, 3), "draws": 100},
        products={"sip": {"inverse_order": 3}},
        requirement=[{"name": "r", "statistic": "rms", "limit": 0.1}],
    )


@pytest.fixture(scope="module")
def usual(job, tmp_path_factory) -> Path:
    """The run as it is in usual surroundings."""
    run = tmp_path_factory.mktemp("usual") / "run"
    good("run", job, "-o", run)
    return run


def as_usual(run: Path, usual: Path) -> None:
    """Draws, tables and files of products are the same to the last digit."""
    np.testing.assert_array_equal(load_posterior(run).theta, load_posterior(usual).theta)
    for name in FILES[:-1]:
        assert (run / name).read_bytes() == (usual / name).read_bytes(), name
    names = {path.name for path in usual.rglob("*")}
    assert {path.name for path in run.rglob("*")} == names


def closed(*numbers: int) -> Callable[[], None]:
    def close() -> None:
        for number in numbers:
            os.close(number)

    return close


def with_few_files(n: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (n, n))


def locale_of(name: str, folder: Path) -> dict[str, str]:
    """Variables of a locale, which is made where the machine has not got it."""
    known = subprocess.run(["locale", "-a"], capture_output=True, text=True, check=False).stdout
    if name.lower().replace("-", "") in known.lower().replace("-", ""):
        return {"LC_ALL": name}
    language, _, charset = name.partition(".")
    try:
        made = subprocess.run(
            ["localedef", "-i", language, "-f", charset, str(folder / name)],
            capture_output=True,
            check=False,
        )
    except FileNotFoundError:
        made = None
    if made is None or not (folder / name / "LC_CTYPE").exists():
        pytest.skip(f"there is no locale {name} and no source of it")
    return {"LC_ALL": name, "LOCPATH": str(folder)}


SURROUNDINGS: dict[str, dict[str, Any]] = {
    "no HOME": {"environment": {"HOME": None}},
    "warnings are errors": {"environment": {"PYTHONWARNINGS": "error"}},
    "no assertions": {"python": ("-O", "-m", "tests.sketches")},
    "only ASCII": {
        "environment": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    },
    "files for me alone": {"prepare": lambda: os.umask(0o077)},
    "closed stderr": {"prepare": closed(2)},
    "closed stdout": {"prepare": closed(1)},
    "no streams": {"prepare": closed(0, 1, 2)},
    "few open files": {"prepare": with_few_files(16)},
}


def all_at_once() -> dict[str, Any]:
    """Options of a process in all of SURROUNDINGS but -O, for which all libraries are compiled."""
    environment: dict[str, str | None] = {}
    for options in SURROUNDINGS.values():
        environment |= options.get("environment", {})

    def prepare() -> None:
        os.umask(0o077)
        with_few_files(16)()
        closed(0, 1, 2)()

    return {
        "environment": environment,
        "prepare": prepare,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        pytest.param(all_at_once(), id="all at once"),
        *(
            case_in_full(options, instead="all of them at once are run", id=name)
            for name, options in SURROUNDINGS.items()
        ),
    ],
)
def test_a_run_is_the_same(job, usual, tmp_path, options):
    done = started("run", job, "-o", tmp_path / "run", **options)
    assert done.returncode == 0, done.stderr
    as_usual(tmp_path / "run", usual)


@pytest.mark.slow
@only_in_full("a run in the locale C is made")
def test_a_run_is_the_same_where_an_i_has_no_dot(job, usual, tmp_path):
    """In Turkish, lower-case letters of I and capital ones of i are others."""
    done = started(
        "run", job, "-o", tmp_path / "run", environment=locale_of("tr_TR.UTF-8", tmp_path)
    )
    assert done.returncode == 0, done.stderr
    as_usual(tmp_path / "run", usual)


def test_files_of_a_run_are_for_its_user_alone_if_that_is_wanted(usual, tmp_path):
    """And for others to read where that is: temporary files are made for their owner only."""
    run = shutil.copytree(usual, tmp_path / "run")
    for mask in (0o077, 0o022):
        before = os.umask(mask)
        try:
            good("stage", "export", run)
        finally:
            os.umask(before)
        for name in ("sip.hdr", "run.json", "summary.json"):
            assert (run / name).stat().st_mode & 0o777 == 0o666 & ~mask, name


def test_a_full_stdout_is_an_error_and_no_traceback(usual):
    """What was to be read is not there."""
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    with Path("/dev/full").open("w") as full:
        done = started("inspect", usual / "sip.hdr", python=("-m", "bayesdist"), stdout=full)
    assert done.returncode == 74
    assert done.stderr.startswith("bayesdist: ") and "No space left on device" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_errors_of_libraries_do_not_end_in_files(job, tmp_path):
    """Without stderr the next file that is opened would have its number."""
    script = (
        "import os, sys\n"
        "from bayesdist.app.cli import main\n"
        "code = main(['--version'])\n"
        "numbers = [os.open(sys.argv[1], os.O_RDWR | os.O_CREAT) for _ in range(2)]\n"
        "os.write(2, b'words of a library in C')\n"
        "sys.exit(code if min(numbers) > 2 else 9)\n"
    )
    path = tmp_path / "file"
    done = started(path, python=("-c", script), prepare=closed(0, 1, 2))
    assert done.returncode == 0
    assert path.read_bytes() == b""


class ReadOnly:
    """Commands that see a folder as one that nobody may write into."""

    def __init__(self, *folders: Path) -> None:
        bind = " && ".join(
            f"mount --bind '{one}' '{one}' && mount -o remount,ro,bind '{one}'" for one in folders
        )
        root = [] if os.geteuid() == 0 else ["-r"]
        self.before = ["unshare", *root, "-m", "sh", "-c", f'{bind} && exec "$@"', "sh"]
        try:
            tried = subprocess.run(
                [*self.before, "test", "!", "-w", str(folders[0])],
                capture_output=True,
                text=True,
                check=False,
            )
        except FileNotFoundError:
            pytest.skip("there is no unshare command, so no folder can be made read-only")
        if tried.returncode:
            pytest.skip(f"no folder can be mounted read-only here ({tried.stderr.strip()})")


def test_a_run_in_a_read_only_folder_can_be_read(job, usual, tmp_path):
    """What only reads works; what would write says so and does nothing."""
    run = shutil.copytree(usual, tmp_path / "run")
    commands = [
        ("budget", run, "--at", 10, 10),
        ("stage", "export", run),
        ("run", job, "-o", run, "--resume"),
        ("run", job, "-o", tmp_path / "new"),
        ("requirements", run, "--requirements", job),
    ]
    python, before = ("-m", "tests.app.several"), ReadOnly(tmp_path).before
    reading, *writing, judging = results_of(
        started(*encoded(commands), python=python, before=before)
    )
    assert reading.code == 0 and "total" in reading.out
    for result in writing:
        assert result.code == 1, result.err
        one_sentence(result.err, str(tmp_path), "Read-only file system", "may write")
    assert judging.code == 1


def test_without_a_place_for_compiled_code_it_is_compiled_anew(tmp_path):
    """A package that is read-only, of a user whose home is none; in a home it has its place."""
    package = REPOSITORY / "bayesdist"
    sealed = ReadOnly(package)
    (tmp_path / "file").touch()
    code = "import bayesdist.infer.kernel, numba; print(numba.config.CACHE_DIR)"
    imported = ("-c", f"import logging; logging.basicConfig(); {code}")
    nowhere = {"HOME": str(tmp_path / "file" / "home"), "NUMBA_CACHE_DIR": None}
    nowhere |= {"XDG_CACHE_HOME": None, "TMPDIR": str(tmp_path)}
    done = started(python=imported, before=sealed.before, environment=nowhere)
    assert done.returncode == 0, done.stderr
    assert "compiles it again" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]  # nothing stays behind
    home = {**nowhere, "HOME": str(tmp_path / "home")}
    done = started(python=imported, before=sealed.before, environment=home)
    assert done.returncode == 0 and done.stderr == ""
    assert (tmp_path / "home" / ".cache" / "bayesdist").is_dir()


@pytest.mark.slow
def test_reports_are_drawn_without_a_home(usual, tmp_path, full):
    """Libraries that keep things there: fonts of matplotlib, and what arviz has said today."""
    if not full:
        pytest.skip("figures are drawn with BAYESDIST_FULL=1")
    run = shutil.copytree(usual, tmp_path / "run")
    (tmp_path / "file").touch()
    home = {"HOME": str(tmp_path / "file" / "home"), "MPLCONFIGDIR": None}
    home |= {"XDG_CACHE_HOME": None, "XDG_CONFIG_HOME": None}
    done = started("stage", "report", run, python=("-m", "bayesdist"), environment=home)
    assert done.returncode == 0, done.stderr
    for variable in ({"PYTHONWARNINGS": "error"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}):
        done = started("stage", "report", run, python=("-m", "bayesdist"), environment=variable)
        assert done.returncode == 0, done.stderr
