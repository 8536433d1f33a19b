"""What users read keeps to the words of the field: one word for one thing."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import bayesdist
from bayesdist.app.cli import bayesdist as root

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(bayesdist.__file__).parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "examples" / "README.md"])
TEMPLATES = sorted(path for folder in PACKAGE.rglob("templates") for path in folder.iterdir())

# what is not said, and what is said instead
INSTEAD = {
    r"err together": "are spatially correlated",
    r"(?:stars|detections|they) have in common": "correlated",
    r"shared errors?": "correlated errors",
    r"exposure scatter": "exposure-to-exposure variation",
    r"horizons?": "validity period",
    r"(?<!in )(?<!takes )(?<!the key )places?(?! in exposure)": "position",
    r"shares? of|(?:the|its|a|their) shares?": "fraction",
    r"error of (?:a|the) (?:product|file)s?": "file-representation error",
    r"do(?:es)? the data ask": "select the polynomial order",
    r"probability that is said": "stated probability",
    r"piece by piece|in (?:so many )?pieces": "in chunks, streamed",
    r"(?:run|runs|chains?) (?:goes|go) on|go on with": "is resumed",
    r"(?:is|are|was|were) told|told by|to be told": "is reported, is given",
    r"(?:which|what) is said|is said of|are said to|was said": "is reported, is stated",
    r"knows? of (?:false|circles?|the circle)": "accounts for",
    r"what(?: \w+){0,6} is made of": "budget",
    r"what fixes (?:it|them)": "constraints",
    r"what is free": "degeneracies",
    r"what comes in|what it is worth": "input, assessment",
    r"whatever claims": "coverage in figures",
    r"have to shrink": "must be reduced",
    r"of a campaign NEW": "for campaigns, NEW",
    r"killed run": "interrupted run",
    r"formal radius of the posterior|largest formal radius": "uncertainty",
    r"interlopers?|recoloured|stand.in model|half.turned": "a word of the glossary",
}
BANNED = {
    re.compile(rf"\b(?:{pattern})\b", re.IGNORECASE): word for pattern, word in INSTEAD.items()
}


def hits(text: str) -> list[str]:
    """What a text says that it should not, with what to say."""
    text = " ".join(text.split())
    return [
        f"...{text[max(0, m.start() - 40) : m.end() + 40]}... : say {word!r}"
        for pattern, word in BANNED.items()
        for m in pattern.finditer(text)
    ]


def sentences(page: Path) -> str:
    """A page without blocks of code, code in sentences, and targets of links."""
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(?:    .*|\| [\w, ]+ \|)", "", text, flags=re.MULTILINE)
    return re.sub(r"`[^`]*`|\]\([^)]*\)|\b\w+\.(?:ecsv|h5|nc|json|toml|fits|md)\b", "", text)


def spoken(path: Path) -> Iterator[str]:
    """Texts of two words or more in a module, without docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    silent = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in silent
            and " " in node.value.strip()
        ):
            yield node.value


def shown(template: Path) -> str:
    """Text of a template that readers see: between its tags, or in its strings."""
    text = template.read_text(encoding="utf-8")
    if template.suffix == ".js":
        return " ".join(re.findall(r'"[^"\n]*"|`[^`]*`', re.sub(r"\$\{[^}]*\}", "", text)))
    return re.sub(r"\{#.*?#\}|\{%.*?%\}|\{\{.*?\}\}|<[^>]*>", " ", text, flags=re.DOTALL)


def helps(command: click.Command, name: str = "bayesdist") -> Iterator[tuple[str, str]]:
    """Name and help of a command, of its options, and of all commands in it."""
    yield name, command.help or ""
    for option in command.params:
        yield f"{name} {option.name}", getattr(option, "help", None) or ""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for inner in command.list_commands(context):
            found = command.get_command(context, inner)
            assert found is not None
            yield from helps(found, f"{name} {inner}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_use_the_words_of_the_field(page):
    assert hits(sentences(page)) == []


def test_help_texts_use_the_words_of_the_field():
    found = list(helps(root))
    assert len(found) > 100
    assert [f"{name}: {hit}" for name, text in found for hit in hits(text)] == []


@pytest.mark.parametrize("name", bayesdist.__all__)
def test_docstrings_of_the_public_names_use_the_words_of_the_field(name):
    assert hits(getattr(bayesdist, name).__doc__ or "") == []


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda path: path.name)
def test_templates_use_the_words_of_the_field(template):
    assert hits(shown(template)) == []


@pytest.mark.parametrize("room", ["*.py", *sorted(p.name for p in PACKAGE.iterdir() if p.is_dir())])
def test_messages_and_captions_use_the_words_of_the_field(room):
    found = [
        f"{path.relative_to(PACKAGE)}: {hit}"
        for path in sorted(PACKAGE.glob(room if room == "*.py" else f"{room}/**/*.py"))
        for hit in hits(" \0 ".join(spoken(path)))  # no word goes over the end of a text
    ]
    assert found == []


def test_the_list_finds_what_it_is_for():
    for said in (
        "whether stars err together",
        "a likelihood that knows of false matches",
        "the share of false matches",
        "at the same place of the field",
        "what is free is named with what fixes it",
        "which order do the data ask for",
        "The date is told with its error",
    ):
        assert hits(said), said
    for good in ("in place of [data]", "two stars share an error", "the fraction of false matches"):
        assert not hits(good), good


ERRORS = {"FormatError", "InputError", "ConfigError", "DegenerateError", "MemoryLimitError"}
# the function `required`, whose conditions hold by construction
EXEMPT = {("errors.py", "InputError(cause)")}


def test_every_error_says_what_to_do():
    """An error for users has an argument `do`, so that its sentence ends with the next action."""
    without = [
        f"{path.relative_to(PACKAGE)}:{call.lineno}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for call in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(call, ast.Call)
        and getattr(call.func, "id", "") in ERRORS
        and not any(keyword.arg in ("do", None) for keyword in call.keywords)
        and (path.name, ast.unparse(call)) not in EXEMPT
    ]
    assert without == []
