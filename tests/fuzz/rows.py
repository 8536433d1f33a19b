"""Damage to tables as text, and to numbers in any text."""

from __future__ import annotations

import re

from hypothesis import strategies as st

from tests.fuzz import values
from tests.fuzz.mutation import KNOWABLE, OPEN, changes

CELL = re.compile(rb"[^\s,;|]+")
NUMBER = re.compile(rb"(?<![\w.+-])[+-]?\d+\.?\d*(?:[eE][+-]?\d+)?(?![\w.])")


def _is_row(line: bytes) -> bool:
    """Boolean: the line begins with a number, as rows of stars do, and not as headers do."""
    cells = CELL.findall(line)
    return bool(cells) and sum(bool(NUMBER.fullmatch(c)) for c in cells) * 2 > len(cells)


def _rows(content: bytes) -> list[int]:
    """Numbers of the lines that are rows."""
    return [k for k, line in enumerate(content.split(b"\n")) if _is_row(line)]


def _of_a_row(**more):
    def arguments(content: bytes):
        rows = _rows(content)
        if len(rows) < 3:
            return None
        return st.fixed_dictionaries({"line": st.sampled_from(rows[1:-1]), **more})

    return arguments


def _line(content: bytes, line: int, change) -> bytes:
    lines = content.split(b"\n")
    if line < len(lines):
        lines[line : line + 1] = change(lines[line])
    return b"\n".join(lines)


def _with_cell(content: bytes, line: int, cell: int, text: bytes) -> bytes:
    def change(row: bytes) -> list[bytes]:
        found = list(CELL.finditer(row))
        one = found[cell % len(found)]
        return [row[: one.start()] + text + row[one.end() :]]

    return _line(content, line, change)


cells = st.integers(0, 30)


@changes("lost fields", KNOWABLE, "rows", arguments=_of_a_row(cell=cells))
def cell_lost(content, line, cell):
    """A cell and the mark or spaces after it."""

    def change(row: bytes) -> list[bytes]:
        found = list(CELL.finditer(row))
        if len(found) < 2:
            return [row]
        one = cell % len(found)
        if one == len(found) - 1:
            return [row[: found[one - 1].end()]]
        return [row[: found[one].start()] + row[found[one + 1].start() :]]

    return _line(content, line, change)


@changes("lost fields", KNOWABLE, "rows", arguments=_of_a_row(cell=cells))
def row_cut(content, line, cell):
    """The file ends within a row."""
    head = content.split(b"\n")[: line + 1]
    found = list(CELL.finditer(head[-1]))
    if len(found) < 2:
        return content
    head[-1] = head[-1][: found[cell % (len(found) - 1)].end()]
    return b"\n".join(head)


@changes("lost fields", KNOWABLE, "rows", arguments=_of_a_row(cell=cells))
def cell_too_many(content, line, cell):
    def change(row: bytes) -> list[bytes]:
        found = list(CELL.finditer(row))
        one = found[cell % len(found)]
        mark = b"," if b"," in row else b"\t" if b"\t" in row else b" "
        return [row[: one.end()] + mark + b"1.5" + row[one.end() :]]

    return _line(content, line, change)


@changes("doubled rows", KNOWABLE, "rows", arguments=_of_a_row())
def row_twice(content, line):
    return _line(content, line, lambda row: [row, row])


def _number_from(content: bytes, line: int, cell: int) -> int:
    """Cell that is a number, from one on: any text is a name in the place of a name."""
    found = CELL.findall(content.split(b"\n")[line])
    places = [(cell + k) % len(found) for k in range(len(found))]
    return next(k for k in places if NUMBER.fullmatch(found[k]))


@changes("no number", KNOWABLE, "rows", arguments=_of_a_row(cell=cells, text=values.not_finite))
def cell_not_finite(content, line, cell, text):
    return _with_cell(content, line, _number_from(content, line, cell), text.encode())


@changes("no number", KNOWABLE, "rows", arguments=_of_a_row(cell=cells, text=values.no_number))
def cell_no_number(content, line, cell, text):
    return _with_cell(content, line, _number_from(content, line, cell), text.encode())


@changes("odd numbers", OPEN, "rows", arguments=_of_a_row(cell=cells, text=values.odd))
def cell_odd(content, line, cell, text):
    return _with_cell(content, line, cell, text.encode())


@changes(
    "odd numbers",
    OPEN,
    "rows",
    arguments=lambda c: st.fixed_dictionaries({"cell": cells, "text": values.odd}),
)
def column_odd(content, cell, text):
    """A number in place of a whole column."""
    for line in _rows(content):
        content = _with_cell(content, line, cell, text.encode())
    return content


def _names(content: bytes):
    """Words of the lines before the first row."""
    rows = _rows(content)
    head = b"\n".join(content.split(b"\n")[: rows[0]]) if rows else content[:2000]
    return [m.span() for m in re.finditer(rb"[A-Za-z_][\w.]*", head)]


def _of_a_name(**more):
    def arguments(content: bytes):
        names = _names(content)
        return (
            st.fixed_dictionaries({"name": st.integers(0, len(names) - 1), **more})
            if names
            else None
        )

    return arguments


HEADS = [
    "",
    "x",
    "y",
    "u",
    "ra",
    "dec",
    "chip",
    "arcsec",
    "furlong",
    "deg",
    "float64",
    "string",
    "a b",
    "[",
    "{",
    "null",
    ": :",
    "é",
    '"',
    "x" * 3000,
    values.nested(values.DEEP),
]


@changes("headers", OPEN, "rows", "asdf", arguments=_of_a_name(text=st.sampled_from(HEADS)))
def head_word(content, name, text):
    """Another word in the header: a name, a unit, a type or a keyword."""
    names = _names(content)
    begin, end = names[name % len(names)]
    return content[:begin] + text.encode() + content[end:]


@changes(
    "headers",
    OPEN,
    "rows",
    "text",
    arguments=lambda c: st.fixed_dictionaries({"line": st.integers(0, 12)}),
)
def line_lost(content, line):
    return _line(content, line, lambda _: [])


@changes(
    "headers",
    OPEN,
    "rows",
    "text",
    "toml",
    arguments=lambda c: st.fixed_dictionaries({"line": st.integers(0, 12)}),
)
def line_twice(content, line):
    return _line(content, line, lambda one: [one, one])


@changes("bomb", KNOWABLE, "rows", "text", arguments=_of_a_row())
def long_line(content, line):
    """A row of four megabytes."""
    return _line(content, line, lambda row: [row, row[:1] * (1 << 22), row])


# -- numbers in any text --------------------------------------------------------------------------


def _of_a_number(text):
    def arguments(content: bytes):
        n = sum(1 for _ in NUMBER.finditer(content))
        return st.fixed_dictionaries({"number": st.integers(0, n - 1), "text": text}) if n else None

    return arguments


def _with_number(content, number, text):
    found = [m.span() for m in NUMBER.finditer(content)]
    begin, end = found[number % len(found)]
    return content[:begin] + text.encode() + content[end:]


@changes("no number", KNOWABLE, "text", arguments=_of_a_number(values.not_finite))
def number_not_finite(content, number, text):
    return _with_number(content, number, text)


@changes("no number", KNOWABLE, "text", arguments=_of_a_number(values.no_number))
def number_no_number(content, number, text):
    return _with_number(content, number, text)


@changes("odd numbers", OPEN, "text", "toml", "asdf", arguments=_of_a_number(values.odd))
def number_odd(content, number, text):
    return _with_number(content, number, text)
