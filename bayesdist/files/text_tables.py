"""Text tables, recognised by their first lines."""

from __future__ import annotations

import csv
import io
import logging
import re
from collections.abc import Mapping, Sequence
from itertools import chain, takewhile

from astropy.table import Table

from bayesdist.errors import FormatError
from bayesdist.files.budget import Budget
from bayesdist.files.documents import refuse_multiplied_yaml

log = logging.getLogger("bayesdist")

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?|nan|inf", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eEdD][+-]?\d+)?")
_DECIMAL_POINT = re.compile(r"[+-]?(\d+\.\d*|\.\d+)([eEdD][+-]?\d+)?")
_MAY_BE_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
# matches cells that match `_FOREIGN`, and few others
MAYBE_FOREIGN = re.compile(r"\d_\d|0[xX][0-9a-fA-F.]|[\x0b\x0c\x1c-\x1f]|[^\x00-\x7f]")
MAYBE_FOREIGN_BYTES = re.compile(rb"\d_\d|[\x80-\xff]|&#")
_FOREIGN = re.compile(
    r"[+-]?(0[xX][0-9a-fA-F.]+([pP][+-]?\d+)?"
    r"|(?=.*(_|[^\x00-\x7f]))[\d_]*\.?[\d_]*\d([eE][+-]?[\d_]+)?\.?)"
)
_END = "\x00end\n"  # in no file of text
_BLANKS = " \t\r\n"  # around a number; Python strips those of Unicode, too
_MARKS = (",", ";", "\t", None)  # None: blanks
ROWS_ABOVE, FEWEST_ABOVE = 20, 3  # number of rows with which the last cell is compared
_DAOPHOT = "DAOPHOT"  # lists of the original program, not tables of its IRAF version
_DAOPHOT_COLUMNS = {
    9: ("id", "x", "y", "mag", "mag_err", "sky", "iterations", "chi", "sharp"),  # ALLSTAR
    7: ("id", "x", "y", "mag", "sharp", "round", "round_marginal"),  # FIND
}
_SEXTRACTOR = re.compile(r"#\s*1\s+[A-Z]\w*")


def is_text_table(lines: Sequence[str]) -> bool:
    """True if lines of text are a table with column names."""
    return _kind(lines) is not None


def _kind(lines: Sequence[str]) -> str | None:
    """Name of the format in astropy; None if it is not a table."""
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
    rows = _rows_of(lines)
    if not rows:
        return None
    mark = mark_of(rows)
    cells = [cell.strip() for cell in rows[0].split(mark)]
    if not any(_NUMBER.fullmatch(cell) for cell in cells):
        names = {",": "ascii.csv", ";": "ascii.csv", "\t": "ascii.tab", None: "ascii.basic"}[mark]
        wide = len(rows) > 1 and len(rows[1].split(mark)) == len(cells)
        return names if wide and len(cells) >= 4 else None
    if comments and mark is None and len(comments[-1].lstrip("# ").split()) == len(cells):
        return "ascii.commented_header"
    return None


def _rows_of(lines: Sequence[str]) -> list[str]:
    """Stripped lines, without empty lines and comments."""
    return [line.strip() for line in lines if line.strip() and not line.strip().startswith("#")]


def mark_of(rows: Sequence[str]) -> str | None:
    """Separator between the cells of a table in `rows`; None for blanks.

    The first row has the names. The separator is the one that divides the names and the first row
    of numbers into the same number of cells. If there is none, it is the first separator that
    occurs in the names.
    """
    names = rows[0]
    present = [mark for mark in _MARKS if mark is None or mark in names]
    for mark in present:
        width = len(names.split(mark))
        if width > 1 and all(len(row.split(mark)) == width for row in rows[1:2]):
            return mark
    return present[0]


def refuse_numbers_as_names(cells: Sequence[str], *, where: str) -> None:
    """Raise FormatError for a table without column names, whose first row would be used as names.

    Some names may be numbers, such as those of filters, but fewer than half of them, and none has a
    decimal point.
    """
    filled = [cell.strip() for cell in cells if cell.strip()]
    numbers = [cell for cell in filled if _NUMBER.fullmatch(cell) or _DECIMAL_COMMA.fullmatch(cell)]
    if 2 * len(numbers) >= max(len(filled), 1) or any(map(_DECIMAL_POINT.fullmatch, filled)):
        raise FormatError(
            f"has no line with the names of its columns: the first line has {len(numbers)} numbers "
            f"({', '.join(filled[:3])}, ...)",
            where=where,
            do="write one above the numbers without a #, as x,y,ra,dec or x,y,u,v",
        )


def with_decimal_points(lines: list[str], mark: str | None, *, where: str) -> list[str]:
    """Replace decimal commas by points in lines of a table without line ends.

    `mark`: separator of cells, not a comma. Raises FormatError if some numbers have points, or if
    the commas may be thousands separators.
    """
    rows = _rows_of(lines)
    if mark == "," or not any("," in line for line in rows[1:]):
        return lines
    cells = [cell.strip() for line in rows[1:] for cell in _cells(line, mark)]
    with_comma = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)]
    if not with_comma:
        return lines
    with_point = next((cell for cell in cells if _DECIMAL_POINT.fullmatch(cell)), None)
    if with_point is not None or all(map(_MAY_BE_THOUSANDS.fullmatch, with_comma)):
        also = "they may divide thousands" if with_point is None else f"others points: {with_point}"
        raise FormatError(
            f"some numbers have commas ({with_comma[0]}), and {also}",
            where=where,
            do="write all numbers with decimal points and without thousands separators",
        )
    log.info("%s: the commas in its numbers are taken as decimal commas", where)
    return [_pointed(line, mark) if "," in line else line for line in lines]


def _cells(line: str, mark: str | None) -> list[str]:
    return line.split() if mark is None else next(csv.reader([line], delimiter=mark), [])


def _pointed(line: str, mark: str | None) -> str:
    """Line with decimal points instead of commas."""
    if line.lstrip().startswith("#"):
        return line
    cells = [
        cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell.strip()) else cell
        for cell in _cells(line, mark)
    ]
    if mark is None:
        return " ".join(cells)
    out = io.StringIO()
    csv.writer(out, delimiter=mark, lineterminator="").writerow(cells)
    return out.getvalue()


def refuse_multiplied_header(lines: Sequence[str], budget: Budget) -> None:
    """Raise FormatError for an ECSV header with too many nodes; see `refuse_multiplied_yaml`."""
    head = takewhile(lambda line: not line or line[0] == "#", map(str.strip, lines))
    text = "\n".join(re.sub(r"^# ?", "", line) for line in head)
    refuse_multiplied_yaml(text, budget)


def parse_text_table(lines: Sequence[str], budget: Budget) -> Table:
    """Parse lines of text, with their line ends, as a table.

    Supported are IPAC tables, ASCII_HEAD catalogues of SExtractor, tables of IRAF's daophot, lists
    of DAOPHOT II or ALLSTAR, and columns below a line of names, with or without a leading "#",
    separated by blanks, commas, semicolons or tabs. Raises FormatError for other text, and for
    tables with truncated rows.
    """
    file_name = budget.where
    ended = not lines or lines[-1].endswith(("\n", "\r"))
    original_lines, lines = lines, [line.rstrip("\r\n") for line in lines]
    kind = _kind(lines)
    if kind is None:
        raise FormatError(
            "has no line with the names of its columns",
            where=file_name,
            do="write one above the numbers",
        )
    ecsv = kind == "ascii.ecsv"
    if ecsv:
        refuse_multiplied_header(lines, budget)
    rows = _rows_of(lines)
    named = sum(1 for line in lines if line.startswith("#")) if kind == "ascii.sextractor" else 0
    widths = [len(row.split(mark)) for row in rows[:1] for mark in (None, ",", ";", "|")]
    budget.refuse_columns(max([named, *widths]))
    options: dict[str, object] = {}
    separated = kind in ("ascii.csv", "ascii.tab", "ascii.basic")
    mark = mark_of(rows) if separated else None
    if kind == _DAOPHOT:
        return _daophot_list(lines, file_name)
    if kind == "ascii.ipac":
        _refuse_short_rows(lines, file_name, ended=ended)
    else:
        refuse_cut_end(original_lines, mark, where=file_name)
    if kind == "ascii.commented_header":
        comments = [k for k, line in enumerate(lines) if line.strip().startswith("#")]
        above = set(comments[:-1])  # of the line of names
        # astropy takes a tab between two names for the separator of all names
        lines = ["" if k in above else line.replace("\t", " ") for k, line in enumerate(lines)]
    elif separated:
        lines = without_empty_names(lines, mark)
        lines = with_decimal_points(lines, mark, where=file_name)
        options["comment"] = "#"
        if mark is not None:
            refuse_missing_cells(lines, mark, where=file_name)
        if mark is None:
            lines = [line.replace("\t", " ") for line in lines]
        elif mark == ";":
            options["delimiter"] = mark
    table = Table.read(lines, format=kind, guess=False, **options)
    refuse_open_quotes(lines, table, mark, where=file_name)
    refuse_foreign_numbers(columns_of_numbers(table), lines, mark, where=file_name)
    return table


def without_empty_names(lines: list[str], mark: str | None) -> list[str]:
    """Remove separators at the end of the line of names that the first row of the table lacks."""
    rows = [k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    if mark is None or len(rows) < 2:
        return lines
    names, first = (lines[k].rstrip("\r\n") for k in rows[:2])
    surplus = names.count(mark) - first.count(mark)
    if surplus <= 0 or not names.endswith(mark * surplus):
        return lines
    end = lines[rows[0]][len(names) :]
    return [*lines[: rows[0]], names[:-surplus] + end, *lines[rows[0] + 1 :]]


def refuse_missing_cells(lines: Sequence[str], mark: str, *, where: str) -> None:
    """Raise FormatError if a row has fewer cells, separated by `mark`, than there are names.

    astropy would fill such a row without a warning.
    """
    width, row = 0, 0
    for cells in csv.reader((line for line in lines if line[:1] != "#"), delimiter=mark):
        if not cells or cells == [""]:
            continue
        if width and len(cells) < width:
            raise FormatError(
                f"has {len(cells)} of {width} cells",
                where=f"{where}, row {row}",
                do="the table may be truncated: fetch or write it again",
            )
        width, row = width or len(cells), row + 1


def refuse_open_quotes(lines: Sequence[str], table: Table, mark: str | None, *, where: str) -> None:
    """Raise FormatError if a quotation mark that is not closed has swallowed rows.

    The cell that it opens then goes on to the end of the file, or has line breaks and at least one
    number or empty cell for each column of numbers in the table. Line breaks alone are allowed.
    `mark`: separator of cells; None for blanks.
    """
    if not any('"' in line for line in lines):
        return
    fewest = max(1, sum(columns_of_numbers(table).values()))
    bare = ("\n" if line[:1] in ("#", "\\", "|") else line.rstrip("\r\n") + "\n" for line in lines)
    # an open cell takes up the line that is added
    records = csv.reader(chain(bare, [_END]), delimiter=mark or " ", skipinitialspace=True)
    first = 1  # line in which a row begins
    for cells in records:
        spanned = [cell for cell in cells if "\n" in cell] if records.line_num > first else []
        if any(_END in cell or _numbers_within(cell, mark) >= fewest for cell in spanned):
            raise FormatError(
                'a cell begins with a quotation mark (") that is not closed, so that rows are lost '
                "within it",
                where=f"{where}, line {first}",
                do="close or remove the quotation mark",
            )
        first = records.line_num + 1


def _numbers_within(cell: str, mark: str | None) -> int:
    """Number of numbers, and of empty cells between separators, in the lines of a cell."""
    lines = [line.split(mark) for line in cell.splitlines()]
    words = [word.strip(_BLANKS) for line in lines if line != [""] for word in line]
    return sum(not word or _NUMBER.fullmatch(word) is not None for word in words)


def refuse_cut_end(lines: Sequence[str], mark: str | None, *, where: str) -> None:
    """Raise FormatError if the last number of a table is truncated.

    A warning is given if the last line has no line end. `lines` include line ends; `mark` separates
    cells, None for blanks. The last cell is compared with those above it: it is truncated if it has
    fewer decimals although all others have the same number, or less than half their length.
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


def columns_of_numbers(table: Table) -> dict[str, bool]:
    """Map from the name of each column of a table to True if the column holds numbers."""
    return {name: table[name].dtype.kind in "iuf" for name in table.colnames}


def refuse_foreign_numbers(
    columns: Mapping[str, bool], lines: Sequence[str], mark: str | None, *, where: str
) -> None:
    """Raise FormatError for cells that Python or C reads as numbers but no table format allows.

    These are digits with underscores ("1_00"), hexadecimal numbers ("0x64"), digits of other
    scripts, and numbers next to blanks that are not ASCII, such as U+00A0. `columns`: True for each
    column of numbers, in the order of the file. `lines`: lines of the table, with cells separated
    by `mark`, or by blanks or the bars of an IPAC table. In text columns such cells are allowed.
    """
    names = list(columns)
    for number, line in enumerate(lines, start=1):
        if not MAYBE_FOREIGN.search(line) or line[:1] in ("#", "\\", "|"):
            continue
        divided = re.split(f"[{_BLANKS}]+", line.strip(_BLANKS)) if mark is None else None
        cells = [cell.strip(_BLANKS) for cell in divided or _cells(line, mark)]
        complete = len(cells) == len(names)
        for k, cell in enumerate(cells):
            foreign = _FOREIGN if cell == cell.strip() else _NUMBER
            if foreign.fullmatch(cell.strip()) and (not complete or columns[names[k]]):
                name = f", column {names[k]!r}" if complete else ""
                raise FormatError(
                    f"{cell[:40]!r} is not a number",
                    where=f"{where}, line {number}{name}",
                    do="write it in decimal digits without separators; only spaces may surround it",
                )


def _daophot_list(lines: Sequence[str], where: str) -> Table:
    """Table from a list of DAOPHOT II or ALLSTAR: three header lines, and one row per star."""
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
                f"has {len(row)} numbers, but the first row has {len(rows[0])}",
                where=f"{where}, row {number}",
                do="the list may be truncated: fetch or write it again",
            )
    cut = [" ".join(row[: len(names)]) for row in rows]
    return Table.read([" ".join(names), *cut], format="ascii.basic", guess=False)


def _refuse_short_rows(lines: Sequence[str], where: str, *, ended: bool) -> None:
    """Refuse rows that end before the last column begins; astropy drops or shortens them."""
    header = next((line.rstrip() for line in lines if line.startswith("|")), "")
    last_column = header[:-1].rfind("|")
    row = 0
    for number, line in enumerate(lines):
        if line[:1] in ("\\", "|") or not line:
            continue
        row += 1
        # without a line end the last number may have lost its last digits
        cut = number == len(lines) - 1 and not ended and len(line) < len(header) - 1
        if cut or len(line.rstrip()) <= last_column:
            raise FormatError(
                f"ends after {len(line.rstrip())} of {len(header)} characters",
                where=f"{where}, row {row}",
                do="the table may be truncated: fetch or write it again",
            )
