"""First contact with the command line: examples, misspelt commands, a default folder for runs."""

from __future__ import annotations

import shlex

import click
import pytest

from bayesdist.app.cli import CORE, EPILOG, bayesdist, main
from bayesdist.app.config import load_requirements
from bayesdist.errors import BayesdistError

REQUIREMENT = """[[requirement]]
name = "field"
statistic = "p95"
limit = 0.02
unit = "pix"
"""


def every_command(group: click.Group, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Names that lead to each command and each group of commands, those of missions too."""
    found = []
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        found.append((*path, name))
        if isinstance(command, click.Group):
            found += every_command(command, (*path, name))
    return found


def test_every_core_command_is_looked_at():
    names = every_command(bayesdist)
    assert {(name,) for name in CORE} <= set(names)
    assert {("hst", "pam"), ("wise", "rvb", "transform"), ("simulate", "camera")} <= set(names)


@pytest.mark.parametrize("path", every_command(bayesdist), ids=" ".join)
def test_every_help_has_an_example_that_the_command_understands(path, capsys):
    assert main([*path, "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    _, example = shown.split("Example: bayesdist ")
    arguments = shlex.split(example)
    assert tuple(arguments[: len(path)]) == path
    group, name = bayesdist, ""
    while isinstance(group, click.Group):
        name, arguments = arguments[0], arguments[1:]
        group = group.get_command(click.Context(group), name)
    context = group.make_context(name, arguments)  # UsageError if it is not understood
    assert context.params


def test_a_misspelt_command_is_answered_with_the_right_one(capsys):
    assert main(["chek", "camera.toml"]) == 2
    assert "Did you mean 'check'?" in capsys.readouterr().err
    assert main(["xyzzy"]) == 2
    assert "Did you mean" not in capsys.readouterr().err


def test_a_run_without_output_is_named_after_its_configuration(tmp_path, monkeypatch):
    from bayesdist.app import stages

    asked = []

    def whole_job(config, output, **options):
        asked.append((config, output))
        raise BayesdistError("stop here")

    monkeypatch.setattr(stages, "run", whole_job)
    config = str(tmp_path / "camera.v2.toml")
    assert main(["run", config]) != 0
    assert main(["run", config, "-o", "elsewhere"]) != 0
    assert asked == [(config, str(tmp_path / "camera.v2-run")), (config, "elsewhere")]


def test_requirements_are_read_from_a_whole_configuration(tmp_path):
    alone, within = tmp_path / "limits.toml", tmp_path / "camera.toml"
    alone.write_text(REQUIREMENT)
    within.write_text('[data]\nmatches = "stars.csv"\n\n[model]\norder = 4\n\n' + REQUIREMENT)
    assert load_requirements(within) == load_requirements(alone)
    alone.write_text(REQUIREMENT + "\n[typo]\na = 1\n")
    with pytest.raises(BayesdistError, match="typo"):
        load_requirements(alone)


def test_exit_codes_are_explained_in_words():
    said = " ".join(EPILOG.split())
    for code in (0, 1, 2, 3, 4, 5, 6, 65, 70, 71, 74, 130):
        assert f" {code} " in said
