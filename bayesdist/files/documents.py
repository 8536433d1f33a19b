"""JSON, TOML and YAML documents: trees of limited depth and size."""

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

DEEPEST = LIMITS.depth  # nesting of brackets


def json_of(text: str, where: str, *, do: str = "restore it, or write it again") -> Any:
    """Parse a JSON text; raises FormatError if it is invalid or nested too deeply."""
    try:
        return _not_too_deep(json.loads(text), where, do)
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"is not JSON that can be read ({_reason(error)})", where=where, do=do
        ) from error


def toml_of(text: str, where: str) -> dict[str, Any]:
    """Parse a TOML text; raises FormatError if it is invalid or nested too deeply."""
    do = "correct it there"
    if _longest_key(text) > DEEPEST:  # time and memory of tomllib grow with the square of the parts
        raise FormatError(f"has a key of more than {DEEPEST} parts", where=where, do=do)
    try:
        return _not_too_deep(tomllib.loads(text), where, do)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not valid TOML ({_reason(error)})", where=where, do=do) from error


_KEY_PART = re.compile(r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+(\.[ \t]*+)?""")


def _longest_key(text: str) -> int:
    """Number of parts of the longest dotted key, or of text that resembles one."""
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
    """Parse a JSON file; raises the errors of `read_text` and `json_of`."""
    return json_of(read_text(path, most=MOST_TEXT), str(path), do=do)


def read_json_as(kind: TypeAdapter[T], path: Path, *, do: str) -> T:
    """Content of a JSON file as a type; raises the errors of `read_json` and `model_of`."""
    return model_of(kind, read_json(path, do=do), str(path), do=do)


def model_of(kind: TypeAdapter[T], tree: Any, where: str, *, do: str) -> T:
    """Convert a tree, as parsed from JSON or TOML, to the type `kind`.

    `where` is the file and `do` the advice, for the error message.  Raises FormatError with the
    first key that is invalid.
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
    """Return the tree, or raise FormatError if it is nested too deeply for recursive functions."""
    level, depth = [tree], 1
    while level := [node for node in level if isinstance(node, dict | list)]:
        if depth > DEEPEST:
            raise FormatError(
                f"has more than {DEEPEST} brackets within each other", where=where, do=do
            )
        level = [
            inner for node in level for inner in (node.values() if isinstance(node, dict) else node)
        ]
        depth += 1
    return tree


def refuse_multiplied_yaml(text: str, budget: Budget) -> None:
    """Raise FormatError for YAML that is nested too deeply or has aliases of implausible size.

    An alias counts with all nodes of its target, because programs that traverse the tree visit them
    each time. Raises FormatError also if the text is not YAML.
    """
    import yaml

    text = re.sub(r"\A%ECSV.*", "", text)  # not a YAML directive
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    budget.refuse_header(len(text))
    clock = budget.clock()
    sizes = dict[str, int]()  # number of nodes by anchor
    open_nodes = list[tuple[str | None, int]]()  # anchor, and number of nodes before it
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
