"""Text dumps of AST objects: blocks of attributes that may hold further blocks.

Lines are ``Begin CLASS``, ``Name = value``, ``IsA CLASS`` (what follows belongs to the class that
is named next) and ``End CLASS``; what stands after a # is a comment, and an attribute whose value
is an object has nothing behind its equals sign.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from bayesdist.errors import FormatError

__all__ = ["AstObject", "parse_dump"]

_BEGIN = re.compile(r"\s*Begin\s+(\w+)\s*(#.*)?$")
_END = re.compile(r"\s*End\s+(\w+)\s*(#.*)?$")
_VALUE = re.compile(r"\s*(\w+)\s*=\s*(\"(?:[^\"]|\"\")*\"|[^#\s]*)\s*(#.*)?$")


@dataclass
class AstObject:
    """One object of a dump."""

    kind: str
    values: dict[str, str] = field(default_factory=dict)
    parts: dict[str, AstObject] = field(default_factory=dict)

    def number(self, name: str, default: float | None = None) -> float:
        """Number of an attribute; FormatError where it is missing or none."""
        text = self.values.get(name)
        if text is None and default is not None:
            return default
        try:
            return float(str(text).strip('"'))
        except ValueError:
            what = "is missing" if text is None else f"is {text}, no number"
            raise FormatError(f"{name} of the {self.kind} {what}", do="write it again") from None


def parse_dump(text: str, where: str) -> AstObject:
    """First object of a dump; FormatError where it is broken."""
    lines = iter(enumerate(text.splitlines(), start=1))
    for _, line in lines:
        if (match := _BEGIN.match(line)) is not None:
            return _object(match[1], lines, where)
    raise FormatError("holds no AST object", where=where, do="give a dump of a mapping")


def _object(kind: str, lines: Iterator[tuple[int, str]], where: str) -> AstObject:
    found, waiting = AstObject(kind), ""
    for number, line in lines:
        at = f"{where}, line {number}"
        text = line.strip()
        if not text or text.startswith(("#", "!", "IsA ")):
            continue
        if (match := _BEGIN.match(line)) is not None:
            if not waiting:
                raise FormatError(f"a {match[1]} belongs to nothing", where=at, do="write it again")
            found.parts[waiting], waiting = _object(match[1], lines, where), ""
        elif (match := _END.match(line)) is not None:
            if match[1] != kind:
                raise FormatError(f"ends a {match[1]} and not the {kind}", where=at, do="check it")
            return found
        elif (match := _VALUE.match(line)) is not None:
            waiting = match[1] if not match[2] else ""
            if match[2]:
                found.values[match[1]] = match[2]
        else:
            raise FormatError("is no line of a dump", where=at, do="write it again")
    raise FormatError(f"the {kind} does not end: the file is cut", where=where, do="fetch it again")
