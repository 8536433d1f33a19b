"""JSON, TOML and YAML: trees of a plausible depth and size, with numbers that are numbers."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from bayesdist.errors import FormatError
from bayesdist.files.budget import LIMITS, Budget
from bayesdist.files.regular import MOST_TEXT, read_text

T = TypeVar("T")

DEEPEST = LIMITS.depth  # brackets within each other


def json_of(text: str, where: str, *, do: str = "restore it, or write it again") -> Any:
    """Tree of a JSON text."""
    try:
        return _not_too_deep(json.loads(text), where, do)
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"is not JSON that can be read ({_reason(error)})", where=where, do=do
        ) from error


def toml_of(text: str, where: str) -> dict[str, Any]:
    """Tree of a TOML text."""
    do = "correct it there"
    if _longest_key(text) > DEEPEST:  # tomllib takes time and memory by the square of its parts
        raise FormatError(f"has a key of more than {DEEPEST} parts", where=where, do=do)
    try:
        return _not_too_deep(tomllib.loads(text), where, do)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not valid TOML ({_reason(error)})", where=where, do=do) from error


_KEY_PART = re.compile(r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+(\.[ \t]*+)?""")


def _longest_key(text: str) -> int:
    """Parts of the longest dotted key, or of what looks like one, on lines with many points."""
    longest = 0
    for line in text.splitlines():
        if line.count(".") < DEEPEST:
            continue
        end, n = -1, 0
        for part in _KEY_PART.finditer(line):
            n = n + 1 if part.start() == end else 1
            end = part.end() if part[1] else -1
            longest = max(longest, n)
    return longest


def read_json(path: Path, *, do: str = "restore it, or write it again") -> Any:
    """Tree of a JSON file; errors as of `read_text` and `json_of`."""
    return json_of(read_text(path, most=MOST_TEXT), str(path), do=do)


def read_json_as(kind: TypeAdapter[T], path: Path, *, do: str) -> T:
    """Content of a JSON file as a type; errors as of `read_json` and `model_of`."""
    return model_of(kind, read_json(path, do=do), str(path), do=do)


def model_of(kind: TypeAdapter[T], tree: Any, where: str, *, do: str) -> T:
    """A tree as a type.

    FormatError with the key that does not fit.
    """
    try:
        return kind.validate_python(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        reason = re.sub(r" or instance of \w+", "", first["msg"]).rstrip(".")
        raise FormatError(
            f"is not as bayesdist wrote it ({f'{key}: ' if key else ''}{reason})",
            where=where,
            do=do,
        ) from error


def _not_too_deep(tree: Any, where: str, do: str) -> Any:
    """The tree, unless its brackets are nested too deep for whoever goes through it."""
    level, depth = [tree], 1
    while level := [one for one in level if isinstance(one, dict | list)]:
        if depth > DEEPEST:
            raise FormatError(
                f"has more than {DEEPEST} brackets within each other", where=where, do=do
            )
        level = [
            inner for one in level for inner in (one.values() if isinstance(one, dict) else one)
        ]
        depth += 1
    return tree


def refuse_multiplied_yaml(text: str, budget: Budget) -> None:
    """Refuse YAML that is too deep, or whose aliases make a larger tree than is plausible.

    An alias counts as many nodes as what it stands for, since programs that go through the tree
    visit these each time.  FormatError also for a text that is no YAML.
    """
    import yaml

    text = re.sub(r"\A%ECSV.*", "", text)  # unknown to YAML
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    budget.refuse_header(len(text))
    clock = budget.clock()
    sizes = dict[str, int]()  # nodes, by anchor
    open_nodes = list[tuple[str | None, int]]()  # anchor, and nodes before it
    n = 0
    try:
        for k, event in enumerate(yaml.parse(text, Loader=loader)):
            if isinstance(event, yaml.AliasEvent):
                if event.anchor in (anchor for anchor, _ in open_nodes):
                    raise FormatError(
                        "has YAML that refers to itself",
                        where=budget.where,
                        do="fetch or write it again",
                    )
                n += sizes.get(event.anchor, 1)
            elif isinstance(event, yaml.CollectionStartEvent):
                open_nodes.append((event.anchor, n))
                n += 1
                budget.refuse_depth(len(open_nodes), "brackets")
            elif isinstance(event, yaml.CollectionEndEvent):
                anchor, before = open_nodes.pop()
                if anchor is not None:
                    sizes[anchor] = n - before
            elif isinstance(event, yaml.ScalarEvent):
                n += 1
            budget.refuse_nodes(n, "nodes in its YAML, with aliases")
            if not k % 1000:
                clock()
    except yaml.YAMLError as error:
        raise FormatError(
            f"is not YAML that can be read ({_first_line(error)})",
            where=budget.where,
            do="fetch or write it again",
        ) from error


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def _reason(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return "brackets are nested too deep"
    if "integer string conversion" in str(error):
        return "a whole number has thousands of digits"
    return str(error)
