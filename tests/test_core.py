"""The core names no observatory and none of its files, and works while all plugins are hidden."""

from __future__ import annotations

import re

import pytest

from bayesdist.app.cli import main
from bayesdist.app.config import config_of_record, installed_kinds, parse_config
from bayesdist.errors import ConfigError
from bayesdist.plugin import SELECTION
from tests.app.support import REPOSITORY
from tests.toy import forget

SHELVES = ("formats", "kinds", "missions")  # folders of bayesdist
WORDS = re.compile(r"\b(IDCTAB|VAFACTOR|hst1pass|WISE|ACS)\b")


def test_no_file_of_the_core_names_a_mission_or_its_files():
    package = REPOSITORY / "bayesdist"
    shelves = [package / name for name in SHELVES]
    found = [
        f"{path.relative_to(package)}:{number}: {line.strip()}"
        for suffix in ("py", "pyi", "jinja", "css", "js")
        for path in sorted(package.rglob(f"*.{suffix}"))
        if not any(path.is_relative_to(shelf) for shelf in shelves)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if WORDS.search(line)
    ]
    assert not found, "\n".join(found)


@pytest.fixture
def core_alone(monkeypatch):
    """All plugins are hidden."""
    monkeypatch.setenv(SELECTION, "")
    forget()
    yield
    forget()


@pytest.mark.usefixtures("core_alone")
def test_without_kinds_a_configuration_is_refused_in_a_sentence():
    assert not installed_kinds()
    with pytest.raises(ConfigError, match="no kind of run is installed") as caught:
        parse_config("[data]\nmatches = 'stars.csv'\n[model]\norder = 2\n", "c.toml")
    assert caught.value.where == "c.toml" and SELECTION in caught.value.do
    with pytest.raises(ConfigError, match="no kind of run is installed") as caught:
        config_of_record({"data": {"matches": "stars.csv"}, "model": {"order": 2}}, "run.json")
    assert caught.value.where == "run.json"


@pytest.mark.usefixtures("core_alone")
def test_without_kinds_their_commands_are_unknown(capsys):
    assert main(["--help"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert "check" in listed and not {"init", "release", "plan-dither"} & {*listed}
    assert main(["init", "c.toml", "--matches", "stars.csv"]) == 2
    assert "No such command 'init'" in capsys.readouterr().err


@pytest.mark.plugins
def test_a_section_of_no_installed_kind_is_named():
    text = "[spots]\nfile = 'spots.txt'\n[model]\norder = 2\n"
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "c.toml")
    assert caught.value.cause.startswith(
        "no installed kind of run has [spots]: a run begins with [data], matched stars, "
    )
    assert caught.value.where == "c.toml" and "install the plugin" in caught.value.do
    with pytest.raises(ConfigError, match="no installed kind of run has") as caught:
        config_of_record({"spots": {"file": "s"}, "model": {"order": 2}}, "run.json")
    assert caught.value.where == "run.json"


@pytest.mark.plugins
def test_a_section_of_all_runs_is_not_to_blame():
    with pytest.raises(ConfigError, match="a run begins with") as caught:
        parse_config("[model]\norder = 2\n", "c.toml")
    assert caught.value.do == "give one"
