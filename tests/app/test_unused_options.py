"""An option that is given is used, or refused in one sentence: for all commands."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from importlib import import_module

import click
import pytest

from bayesdist.app.cli import bayesdist
from bayesdist.plugin import load_object
from tests.app.support import cli

APPLY, SKY = "apply a.hdr t.csv -o o.ecsv", "apply a.hdr t.csv -o o.ecsv --sky"
CAMPAIGN, PAIRS = "simulate acs -o d", "simulate wise -o d"
BANDS, PAIRING = "wise bands r -o d", "wise bring-up a b -o d --band W1"
TRANSFORM = "wise rvb transform f -o d --fit"

# command in its mode, option that this mode does not use
UNUSED = [
    ("budget r --at-table t.csv", "--to 1 1"),
    ("budget r --at 1 1", "--columns a b"),
    (SKY, "--inverse"),
    (SKY, "--method newton"),
    (SKY, "--order 3"),
    (SKY, "--scale 0"),  # also a value that is false
    (SKY, "--origin 0 0"),
    (SKY, "--vafactor 1"),  # also the default
    (SKY, "--image f.fits"),
    (SKY, "--ltv 0 0"),
    (SKY, "--corner 1 1"),
    (APPLY, "--point 1 1"),
    (APPLY, "--centroids a b"),
    (APPLY, "--joint"),
    (APPLY, "--method table"),
    (APPLY, "--order 3"),
    (f"{APPLY} --inverse", "--pixel-origin 0"),
    (f"{APPLY} --inverse", "--order 3"),
    (f"{APPLY} --inverse --method table", "--order 3"),
    *((f"stage {name} r", "--strict") for name in ("match", "fit", "diagnose", "export", "report")),
    *((f"stage {name} r", "--pdf") for name in ("match", "sample", "assess", "evaluate")),
    ("select-order c.toml", "--force"),
    (CAMPAIGN, "--secondary-exposures 4"),
    (BANDS, "--rotation 3"),
    (PAIRING, "--rotation 3"),
    *((TRANSFORM, f"--{name} 0") for name in ("dx", "dy", "rotation", "scale-x", "scale-y")),
    (f"{PAIRS} --stars 9", "--bands W1"),
    (f"{PAIRS} --band W1", "--pairs 9"),
    (f"{PAIRS} --fraction 0", "--false-fraction 0"),
    (f"{PAIRS} --stars 9", "--partition-pattern"),
]


HEADER = """\
CTYPE1  = 'RA---TAN-SIP'
CTYPE2  = 'DEC--TAN-SIP'
CRPIX1  =                512.5
CRPIX2  =                512.5
CRVAL1  =                150.0
CRVAL2  =                  2.0
CD1_1   =              -1.4E-5
CD2_2   =               1.4E-5
A_ORDER =                    2
B_ORDER =                    2
A_2_0   =               1.0E-6
B_0_2   =               1.0E-6
IMAGEW  =                 1024
IMAGEH  =                 1024
END
"""
# command on a SIP header that states its size, option for which this file has no use
OF_FILES = [
    (f"{command} {option}", sentence)
    for command in (
        "apply a.hdr t.csv -o o.ecsv",
        "apply a.hdr t.csv -o o.ecsv --sky",
        "convert a.hdr --to tpv -o b.hdr",
        "compare a.hdr a.hdr",
        "hst pam a.hdr -o o.fits",
        "hst handbook a.hdr -o d",
    )
    for option, sentence in (
        ("--epoch 2020", "does not depend on time"),
        ("--filter F606W", "whose filter is not chosen"),
        ("--size 9 9", "states a size of 1024 x 1024 pixels, but 9 x 9 are given"),
    )
    if not (command.startswith("hst") and "size" in option)
]


@pytest.fixture(scope="module")
def header_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("header")
    (folder / "a.hdr").write_text(HEADER, encoding="ascii")
    (folder / "t.csv").write_text("x,y\n1,1\n500,500\n", encoding="ascii")
    return folder


@pytest.mark.parametrize(("words", "sentence"), OF_FILES)
def test_an_option_that_the_file_has_no_use_for_is_refused(
    words, sentence, header_folder, monkeypatch
):
    monkeypatch.chdir(header_folder)
    before = sorted(header_folder.iterdir())
    result = cli(*words.split())
    assert result.code == 1 and "a.hdr" in result.err
    assert sentence in result.err and "on the command line)" in result.err
    assert sorted(header_folder.iterdir()) == before


def leaves(group: click.Group, words: str = "") -> Iterator[tuple[str, click.Command]]:
    """Words and command of every command of a group."""
    context = click.Context(group)
    for name in group.list_commands(context):
        found = group.get_command(context, name)
        assert found is not None
        if isinstance(found, click.Group):
            yield from leaves(found, f"{words}{name} ")
        else:
            yield f"{words}{name}", found


COMMANDS = dict(leaves(bayesdist))


@pytest.mark.parametrize(("command", "option"), UNUSED)
def test_an_option_that_the_mode_does_not_use_is_refused(command, option):
    result = cli(*command.split(), *option.split())
    assert result.code == 2 and not result.out
    sentence = " ".join(result.err.partition("Error: ")[2].replace("│", " ").split())
    assert sentence.startswith(f"{option.split()[0]} is not used ") and "leave it out" in sentence


def test_all_refusals_are_tried():
    """Each option that a command says not to use in a mode is in the list above."""
    tried = {(words.split()[0], option.split()[0]) for words, option in UNUSED}
    for words, found in COMMANDS.items():
        names = [name for one in getattr(found, "unused", ()) for name in one.names.split()]
        by_name = {p.name: p.opts[-1] for p in found.params}
        for name in names:
            assert (words.split()[0], by_name[name]) in tried, (words, name)


def read_names(function: object) -> set[str]:
    """Names whose values the body of a function reads."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    nodes = [node for part in tree.body[0].body for node in ast.walk(part)]
    read = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}
    # constants are keys: of subscripts, and of calls of pop
    return read | {n.value for n in nodes if isinstance(n, ast.Constant) and type(n.value) is str}


def called_functions(command: click.Command) -> list[object]:
    """The function of a command, and those that it hands its options to."""
    if getattr(command, "calls", ""):
        return [load_object(command.calls)]
    body = inspect.unwrap(command.callback)
    tree = ast.parse(textwrap.dedent(inspect.getsource(body)))
    imported = [
        getattr(import_module(node.module), name.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    ]
    return [body, *(one for one in imported if inspect.isfunction(one))]


def unread(command: click.Command) -> list[str]:
    """Parameters of a command that its functions do not read."""
    read = {name for function in called_functions(command) for name in read_names(function)}
    return [p.name for p in command.params if p.expose_value and p.name not in read]


@pytest.mark.parametrize("words", COMMANDS)
def test_every_option_is_read_by_the_code_of_its_command(words):
    assert unread(COMMANDS[words]) == []


def test_an_option_that_is_not_read_is_seen():
    """The test above can fail."""

    @click.command()
    @click.option("--size")
    @click.option("--order")
    def forgetful(size: float, order: int) -> None:
        click.echo(size)

    assert unread(forgetful) == ["order"]
