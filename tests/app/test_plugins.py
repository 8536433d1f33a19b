"""Plugins of other packages: a file format, and plugins that cannot be loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.app.several import encoded, results_of
from tests.app.support import REPOSITORY, Result, as_table, simulated, summary_of, write_config
from tests.toy import install


def environment(folder: Path) -> dict[str, str]:
    """Environment of a process that finds the packages in this folder."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(REPOSITORY)])}


def several(folder: Path, *commands: tuple[object, ...]) -> list[Result]:
    """What commands did in a process that finds the packages in this folder."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.app.several", *encoded(commands)],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        check=False,
    )
    return results_of(done)


def test_a_package_adds_a_format(tmp_path):
    """Inspected, compared, applied, converted to, written by a run and named in its report."""
    install(tmp_path, "toy", "tests.toy:PLUGIN")
    for name, bend in (("a", 1e-6), ("b", 2e-6)):
        (tmp_path / f"{name}.json").write_text(f'{{"toy": {{"scale": 0.05, "bend": {bend}}}}}')
    (tmp_path / "stars.csv").write_text("x,y,chip\n500,400,1\n600,500,1\n")
    as_table(simulated()[0]).write(tmp_path / "stars.ecsv")
    write_config(tmp_path / "c.toml", products={"toy": {"digits": 12}})
    results = several(
        tmp_path,
        ("inspect", "a.json"),
        ("compare", "a.json", "b.json"),
        ("apply", "a.json", "stars.csv", "-o", "out.csv"),
        ("convert", "a.json", "--to", "toy", "-o", "again.json"),
        ("run", "c.toml", "-o", "run"),
    )
    for result in results:
        assert result.code == 0, result.err
    assert results[0].out.strip() == "toy of scale 0.05"
    assert results[1].out.startswith("The calibrations differ by")
    row = (tmp_path / "out.csv").read_text().splitlines()[-1].split(",")
    assert float(row[3]) == pytest.approx(100 + 1e-6 * 1e4, rel=1e-9)
    assert '"scale": 0.05' in (tmp_path / "again.json").read_text()
    [product] = summary_of(tmp_path / "run")["products"]
    assert product["path"] == "toy.json" and (tmp_path / "run" / "toy.json").exists()
    assert "toy.json" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("import no_such_package", "No module named 'no_such_package'"),
        ("PLUGIN = 1", "it is not a bayesdist.plugin.Plugin"),
        ("raise RuntimeError('two\\nlines')", "two lines"),
        (
            "from bayesdist.plugin import Plugin\nPLUGIN = Plugin(formats={'x': 'no_module:X'})",
            "No module named 'no_module'",
        ),
    ],
)
def test_a_plugin_that_cannot_be_loaded_is_named(tmp_path, source, cause):
    """In one sentence; all other formats and commands are there."""
    (tmp_path / "megacam.py").write_text(source + "\n")
    install(tmp_path, "megacam", "megacam:PLUGIN")
    (tmp_path / "a.txt").write_text("text")
    done = subprocess.run(
        [sys.executable, "-m", "bayesdist", "inspect", "a.txt"],
        cwd=tmp_path,
        env=environment(tmp_path),
        capture_output=True,
        text=True,
        check=False,
    )
    warning, error = done.stderr.splitlines()
    assert warning.startswith("bayesdist: WARNING: the plugin megacam")
    assert cause in warning and "install its package again" in warning
    assert done.returncode == 1 and "a.txt" in error and "a SIP header" in error
