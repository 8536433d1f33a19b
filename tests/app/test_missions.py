"""Missions: those of the package, and one that another package adds."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path

import click
import numpy as np
import pytest

from bayesdist.app.commands.options import LazyGroup
from bayesdist.plugin import GROUP, Plugin, load_object
from tests.app.several import encoded, results_of
from tests.app.support import REPOSITORY
from tests.reduced import only_in_full
from tests.toy import install

MEGACAM = """
import click
from bayesdist.app.commands.options import command
from bayesdist.plugin import Mission, Plugin

MEGACAM = Mission(title="MegaCam: mosaics.", commands={"ccds": "megacam:ccds"})
PLUGIN = Plugin(missions={"megacam": MEGACAM})

@command()
@click.option("--rows", type=int, default=4, help="Of the mosaic.")
def ccds(rows):
    click.echo(f"{9 * rows} CCDs")
"""


PAIRS = """
import numpy as np
from astropy.table import Table
from bayesdist.data import MatchFormat
from bayesdist.plugin import Mission, Plugin

def read(path):
    x, y, u, v = np.loadtxt(path, skiprows=1).T / 10
    table = Table({"x": x, "y": y, "u": u, "v": v})
    table["u"].unit = table["v"].unit = "arcsec"
    return table

TENTHS = MatchFormat(lambda path: path.read_text().startswith("tenths"), read)
MEGACAM = Mission(title="MegaCam.", match_formats={"tenths": "megacam:TENTHS"})
PLUGIN = Plugin(missions={"megacam": MEGACAM})
"""


def installed(folder: Path, source: str) -> None:
    """A package with one module, as an installer leaves it."""
    (folder / "megacam.py").write_text(source)
    install(folder, "megacam", "megacam:PLUGIN")


def called(
    folder: Path, *arguments: str, module: str = "bayesdist"
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", module, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(REPOSITORY)])},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_package_adds_its_mission(tmp_path):
    installed(tmp_path, MEGACAM)
    assert "megacam       MegaCam: mosaics." in called(tmp_path, "--help").stdout
    assert called(tmp_path, "megacam", "ccds", "-q").stdout == "36 CCDs\n"
    shown = called(tmp_path, "megacam", "ccds", "--help").stdout
    assert "[default: 4]" in shown and "--quiet" in shown


@pytest.mark.slow
@only_in_full("tests/test_new_instrument.py has such a package")
def test_a_package_adds_a_format_of_matches(tmp_path):
    """Of others' names, of a text that would else be a table: what it reads is a table's."""
    installed(tmp_path, PAIRS)
    values = np.random.default_rng(1).integers(10, 10_000, (50, 4))
    rows = "\n".join(" ".join(map(str, row)) for row in values)
    (tmp_path / "pairs.txt").write_text(f"tenths of a pixel\n{rows}\n")
    done = called(tmp_path, "init", "c.toml", "--matches", "pairs.txt")
    assert "for 50 matches" in done.stdout, done.stderr
    config = tomllib.loads((tmp_path / "c.toml").read_text())
    assert max(config["detector"]["size"]) <= 1024  # a tenth of the numbers in the file
    assert config["data"].get("unit", "arcsec") == "arcsec"
    text = (tmp_path / "c.toml").read_text()
    for format in ("tenths", "tents"):
        given = text.replace("[data]", f'[data]\nformat = "{format}"', 1)
        (tmp_path / f"{format}.toml").write_text(given)
    commands = encoded([("check", "tenths.toml"), ("check", "tents.toml")])
    known, unknown = results_of(called(tmp_path, *commands, module="tests.app.several"))
    for checked, refused in ((known, False), (unknown, True)):
        assert ("which is not a known format" in checked.err) is refused
        assert ("'tenths'" in checked.err) is refused


@pytest.mark.parametrize("name", ["hst", "wise"])
def test_our_missions_name_commands_that_are_there(name):
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
    target = project["project"]["entry-points"][GROUP][name]
    plugin = EntryPoint(name, target, GROUP).load()
    assert isinstance(plugin, Plugin) and list(plugin.missions) == [name]
    mission = plugin.missions[name]
    for commands in (mission.commands, mission.simulate, mission.beside_core):
        for command, where in commands.items():
            found = LazyGroup.load(where)
            assert isinstance(found, click.Command) and found.name == command
    for where in (*mission.match_formats.values(), *mission.error_terms.values()):
        assert load_object(where)
    for module in plugin.reports:
        import_module(module)
