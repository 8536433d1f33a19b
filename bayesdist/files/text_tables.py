"""Tables as text, recognised by how they begin."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence

from astropy.table import Table

from bayesdist.errors import FormatError

log = logging.getLogger("bayesdist")

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?|nan|inf", re.IGNORECASE)
MARKS = {"ascii.csv": ",", "ascii.tab": "\t"}
ROWS_ABOVE, FEWEST_ABOVE = 20, 3  # that the last cell is held against
_DAOPHOT = "DAOPHOT"  # the program's own lists, not the tables of IRAF's version
_DAOPHOT_COLUMNS = {
    9: ("id", "x", "y", "mag", "mag_err", "sky", "iterations", "chi", "sharp"),  # ALLSTAR
    7: ("id", "x", "y", "mag", "sharp", "round", "round_marginal"),  # FIND
}
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
    if first.split()[:3] == ["NL", "NX", "NY"]:
        return _DAOPHOT
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

    Known are an IPAC table, the ASCII_HEAD catalogue of SExtractor, a table of IRAF's daophot, a
    list of DAOPHOT II or ALLSTAR, and columns under a line of names, with "#" before it or not,
    separated by blanks, commas or tabs.
    """
    ended = not lines or lines[-1].endswith(("\n", "\r"))
    whole, lines = lines, [line.rstrip("\r\n") for line in lines]
    kind = _kind(lines)
    if kind is None:
        raise FormatError(
            "has no line with the names of its columns",
            where=where,
            do="write one above the numbers",
        )
    options: dict[str, object] = {}
    if kind == _DAOPHOT:
        return _daophot_list(lines, where)
    if kind == "ascii.ipac":
        _refuse_short_rows(lines, where, ended=ended)
    else:
        refuse_cut_end(whole, MARKS.get(kind), where=where)
    if kind == "ascii.commented_header":
        heads = [k for k, line in enumerate(lines) if line.strip().startswith("#")]
        lines = [line for k, line in enumerate(lines) if k not in heads[:-1]]
    elif kind in ("ascii.csv", "ascii.tab", "ascii.basic"):
        options["comment"] = "#"
    return Table.read(lines, format=kind, guess=False, **options)


def refuse_cut_end(lines: Sequence[str], mark: str | None, *, where: str) -> None:
    """Refuse a table whose last number has lost digits; warn of one that ends within a line.

    `lines` have their ends; `mark` separates cells, None where blanks do.  The last cell is held
    against those above it: fewer decimals where all have as many, or less than half their length.
    """
    if not lines or lines[-1].endswith(("\n", "\r")):
        return
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    cells = [line.rstrip("\r\n").split(mark)[-1].strip() for line in rows[-1 - ROWS_ABOVE :]]
    if not cells:
        return
    *above, last = cells
    above = [cell for cell in above if _NUMBER.fullmatch(cell)]
    decimals = {len(cell.partition(".")[2]) for cell in above}
    short = len(decimals) == 1 and len(last.partition(".")[2]) < min(decimals)
    tiny = bool(above) and 2 * len(last) < sorted(map(len, above))[len(above) // 2]
    if len(above) >= FEWEST_ABOVE and (short or tiny):
        raise FormatError(
            f"ends within its last number ({last!r})",
            where=where,
            do="the table may be truncated: fetch or write it again",
        )
    log.warning("%s: its last line has no end, so that the file may be truncated", where)


def _daophot_list(lines: Sequence[str], where: str) -> Table:
    """List of DAOPHOT II or ALLSTAR, three lines above the stars; one row for each star."""
    if len(lines) < 2 or lines[1].split()[:1] == ["2"]:
        raise FormatError(
            "is a list of aperture photometry, with several lines for each star",
            where=where,
            do="give the list of ALLSTAR (.als) or of FIND (.coo)",
        )
    rows = [line.split() for line in lines[3:] if line.strip()]
    names = _DAOPHOT_COLUMNS.get(len(rows[0]) if rows else 0, ("id", "x", "y", "mag"))
    for number, row in enumerate(rows, start=1):
        if len(row) < len(names) or len(row) != len(rows[0]):
            raise FormatError(
                f"has {len(row)} numbers, and the first row {len(rows[0])}",
                where=f"{where}, row {number}",
                do="the list may be truncated: fetch or write it again",
            )
    cut = [" ".join(row[: len(names)]) for row in rows]
    return Table.read([" ".join(names), *cut], format="ascii.basic", guess=False)


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
