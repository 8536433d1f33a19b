"""Type and default of each key in the tables of the configuration are those of the models."""

from __future__ import annotations

import re
import tomllib
import types
import typing
from pathlib import Path

import pytest
from pydantic import BaseModel

from bayesdist.app.config import installed_kinds, parse_config
from bayesdist.kinds.matches.config import data_sections
from bayesdist.kinds.selfcal.patterns.command import PlanConfig

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = ("configuration.md", "campaign.md", "self_calibration.md", "planning.md")
NAMES = {bool: "true or false", int: "integer", float: "number", str: "text", dict: "table"}
MANY = {"integer": "integers", "number": "numbers", "text": "texts"}


def spelled(annotation: object) -> str:
    """A type in words: "number", "2 integers", "list of texts", "word or number"."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return spelled(parts[0])
    if origin is typing.Literal:
        return "integer" if all(isinstance(p, int) for p in parts) else "word"
    if origin in (typing.Union, types.UnionType):
        names = [spelled(p) for p in parts if p is not type(None)]
        return " or ".join(dict.fromkeys(names))
    if origin is tuple and Ellipsis not in parts and len({spelled(p) for p in parts}) == 1:
        return f"{len(parts)} {MANY[spelled(parts[0])]}"
    if origin in (list, tuple):
        inner = spelled(parts[0])
        if inner.startswith("list of "):
            return f"list of lists{inner.removeprefix('list')}"
        return f"list of {MANY.get(inner, inner if inner[0].isdigit() else inner + 's')}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    return NAMES.get(origin or annotation, "list")


def models(annotation: object) -> list[type[BaseModel]]:
    """Models of sections inside an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for part in typing.get_args(annotation) for m in models(part)]


def fields(kind: type[BaseModel], section: str = "") -> typing.Iterator[tuple[str, str, object]]:
    """Section, key and field of all keys."""
    for key, field in kind.model_fields.items():
        path = f"{section}.{key}".strip(".")
        for inner in models(field.annotation):
            yield from fields(inner, path)
        if section:
            yield section, key, field


def known() -> dict[tuple[str, str], list[object]]:
    """Fields of each section and key, one for each kind of run that has it."""
    found: dict[tuple[str, str], list[object]] = {}
    for kind in installed_kinds().values():
        for section, key, field in fields(kind):
            found.setdefault((section, key), []).append(field)
    for kind in data_sections().values():
        for section, key, field in fields(kind, "data"):
            found.setdefault((section, key), []).append(field)
    return found


def known_on(page: str) -> dict[tuple[str, str], list[object]]:
    """Fields of the files that a page describes."""
    if page != "planning.md":
        return KNOWN
    return {(section, key): [field] for section, key, field in fields(PlanConfig)}


def rows() -> typing.Iterator[tuple[str, str, list[str], list[str]]]:
    """Page, section, keys and other cells (type, unit, default, meaning) of each row."""
    for name in PAGES:
        section = ""
        for line in (DOCS / name).read_text(encoding="utf-8").splitlines():
            cells = [c.strip() for c in line.strip().strip("|").split(" | ")]
            if head := re.match(r"\*\*\[{1,2}([\w.]+)\]{1,2}\*\*", cells[0]):
                section = head.group(1)
            elif not line.startswith("|"):
                section = ""
            elif section:
                yield name, section, [k.strip() for k in cells[0].split(",")], cells[1:]


def plain(value: object) -> object:
    """A value as TOML has it: lists for tuples."""
    return [plain(v) for v in value] if isinstance(value, tuple | list) else value


KNOWN = known()
ROWS = [
    (known_on(page)[section, key], key, position, cells)
    for page, section, keys, cells in rows()
    for position, key in enumerate(keys)
    if (section, key) in known_on(page)
]


def test_the_smallest_configuration_is_one():
    page = (DOCS / "configuration.md").read_text(encoding="utf-8")
    text = re.search(r"^```toml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert text and len(text.group(1).splitlines()) <= 10
    assert parse_config(text.group(1), "smallest.toml").model.order == 4


def test_the_tables_have_most_keys():
    assert len(ROWS) > 120


@pytest.mark.parametrize(("found", "key", "position", "cells"), ROWS)
def test_type_and_default_are_those_of_the_model(found, key, position, cells):
    kind, _, default, _ = cells
    assert {spelled(field.annotation) for field in found} & set(kind.split("; ")), kind
    if all(field.is_required() for field in found):
        assert default.startswith("required")
    elif not _in_words(default):
        values = [plain(field.get_default(call_default_factory=True)) for field in found]
        stated = tomllib.loads(f"all = [{default}]")["all"]
        assert stated[position if len(stated) > 1 else 0] in values


def _in_words(default: str) -> bool:
    """Whether a default is described, as one that depends on others, and not a value of TOML."""
    try:
        tomllib.loads(f"all = [{default}]")
    except tomllib.TOMLDecodeError:
        return True
    return default == ""
