"""Tables as text, recognised by how they begin."""

from __future__ import annotations

import re
from collections.abc import Sequence

from astropy.table import Table

from bayesdist.errors import FormatError

__all__ = ["is_text_table", "parse_text_table"]

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?|nan|inf", re.IGNORECASE)
_SEXTRACTOR = re.compile(r"#\s*1\s+[A-Z]\w*")


def is_text_table(lines: Sequence[str]) -> bool:
    """True where lines of text are a table with the names of its columns."""
    return _kind(lines) is not None


def _kind(lines: Sequence[str]) -> str | None:
    """Format, as astropy names it."""
    first = next((line.strip() for line in lines if line.strip()), "")
    if first.startswith(("\\", "|")):
        return "ascii.ipac"
    if first.startswith("# %ECSV"):
        return "ascii.ecsv"
    if first.startswith(("#K ", "#N ")):
        return "ascii.daophot"
    if _SEXTRACTOR.match(first):
        return "ascii.sextractor"
    comments = [line.strip() for line in lines if line.strip().startswith("#")]
    rows = [line.strip() for line in lines if line.strip() and not line.strip().startswith("#")]
    if not rows:
        return None
    mark = "," if "," in rows[0] else "\t" if "\t" in rows[0] else None
    cells = [cell.strip() for cell in rows[0].split(mark)]
    if not any(_NUMBER.fullmatch(cell) for cell in cells):
        names = {",": "ascii.csv", "\t": "ascii.tab", None: "ascii.basic"}[mark]
        wide = len(rows) > 1 and len(rows[1].split(mark)) == len(cells)
        return names if wide and len(cells) >= 4 else None
    if comments and mark is None and len(comments[-1].lstrip("# ").split()) == len(cells):
        return "ascii.commented_header"
    return None


def parse_text_table(lines: Sequence[str], *, where: str) -> Table:
    """Table of lines of text, with their ends; a row of an IPAC table that is cut short is refused.

    Known are an IPAC table, the ASCII_HEAD catalogue of SExtractor, a table of IRAF's daophot, and
    columns under a line of names, with "#" before it or not, separated by blanks, commas or tabs.
    """
    ended = not lines or lines[-1].endswith("\n")
    lines = [line.rstrip("\r\n") for line in lines]
    kind = _kind(lines)
    if kind is None:
        raise FormatError(
            "has no line with the names of its columns",
            where=where,
            do="write one above the numbers",
        )
    options: dict[str, object] = {}
    if kind == "ascii.ipac":
        _refuse_short_rows(lines, where, ended=ended)
    elif kind == "ascii.commented_header":
        heads = [k for k, line in enumerate(lines) if line.strip().startswith("#")]
        lines = [line for k, line in enumerate(lines) if k not in heads[:-1]]
    elif kind in ("ascii.csv", "ascii.tab", "ascii.basic"):
        options["comment"] = "#"
    return Table.read(lines, format=kind, guess=False, **options)


def _refuse_short_rows(lines: Sequence[str], where: str, *, ended: bool) -> None:
    """Refuse rows that end before the last column begins: astropy drops or shortens them."""
    header = next((line.rstrip() for line in lines if line.startswith("|")), "")
    last_column = header[:-1].rfind("|")
    row = 0
    for number, line in enumerate(lines):
        if line[:1] in ("\\", "|") or not line:
            continue
        row += 1
        # without an end of line the last number may have lost its last digits
        cut = number == len(lines) - 1 and not ended and len(line) < len(header) - 1
        if cut or len(line.rstrip()) <= last_column:
            raise FormatError(
                f"ends after {len(line.rstrip())} of {len(header)} characters",
                where=f"{where}, row {row}",
                do="the table may be truncated: fetch or write it again",
            )
