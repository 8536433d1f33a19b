"""Reading of table files into an astropy Table; any fault of a file becomes a single clear error.

VOTables are checked before they are read: they must not refer to other files, nor announce more
content than their size allows.
"""

from __future__ import annotations

import csv
import io
import math
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.table.meta import get_header_from_yaml
from astropy.utils.xml.iterparser import get_xml_iterator

from bayesdist.errors import FormatError, InputError
from bayesdist.files.budget import DAMAGED, LIMITS, Budget, FileLimits
from bayesdist.files.faults import naming_faults
from bayesdist.files.fits import (
    FITS_START,
    LDAC_IMAGE,
    MISSING_EXTENSIONS,
    ldac_image_header,
    open_fits,
    refuse_long_arrays,
    warn_of_missing_extensions,
)
from bayesdist.files.parquet import parquet_table
from bayesdist.files.regular import head_of
from bayesdist.files.text_tables import (
    MAYBE_FOREIGN,
    MAYBE_FOREIGN_BYTES,
    columns_of_numbers,
    is_text_table,
    mark_of,
    parse_text_table,
    refuse_cut_end,
    refuse_foreign_numbers,
    refuse_missing_cells,
    refuse_multiplied_header,
    refuse_numbers_as_names,
    refuse_open_quotes,
    with_decimal_points,
    without_empty_names,
)
from bayesdist.files.unpacked import read_lines, read_unpacked, without_codec
from bayesdist.utils.text import number_of

_COMMAS = re.compile(r"# delimiter: ['\"]?,")
# cells for missing numbers; astropy would treat any other text that is not a number as missing, too
_NO_NUMBER = {"", "null"}
_PIECE = 2**16  # bytes that are parsed between readings of the clock
_CHUNK_ROWS = 256  # rows for which astropy allocates memory before it reads any
_BYTES = {
    "boolean": 1, "unsignedByte": 1, "char": 1, "short": 2, "unicodeChar": 2, "int": 4,
    "float": 4, "long": 8, "double": 8, "floatComplex": 8, "doubleComplex": 16,
}  # fmt: skip
_WIDEN = {"char": 4, "unicodeChar": 2}  # size of text in memory relative to the file


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Context manager like `naming_faults` that also silences the warnings of readers.

    Python has only one set of warning filters for all threads, so threads must not use this
    concurrently.
    """
    with naming_faults(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # units are checked later, column by column
        warnings.filterwarnings("error", message=".*truncated.*")
        yield


def _whole_lines(lines: list[str], mark: str, path: Path) -> list[str]:
    """Lines of a file without line ends, as a list: astropy takes a single string for a file name.

    Raises FormatError if the last line is cut.
    """
    if lines and lines[0].startswith("# %ECSV"):
        mark = _mark_of_ecsv(lines)
    bare = [line.rstrip("\r\n") for line in lines]
    refuse_missing_cells(bare, mark, where=str(path))
    refuse_cut_end(lines, mark, where=str(path))
    return bare


def _is_comment(line: str) -> bool:
    return line.startswith("#")


def _mark_of_ecsv(lines: list[str]) -> str:
    """Separator of the cells of an ECSV file, which its header states."""
    return "," if any(map(_COMMAS.match, takewhile(_is_comment, lines))) else " "


def read_ecsv(path: Path, limits: FileLimits = LIMITS) -> Table:
    """Table of an ECSV file; for errors see `read_table`."""
    with _reading(path):
        lines = read_lines(path, limits)
        refuse_multiplied_header(lines, Budget.of_file(path, limits))
        mark = _mark_of_ecsv(lines)
        lines = _whole_lines(lines, mark, path)
        table = Table.read(lines, format="ascii.ecsv")
        refuse_open_quotes(lines, table, mark, where=str(path))
        if any(map(MAYBE_FOREIGN.search, lines)):  # else the header need not be parsed again
            refuse_foreign_numbers(_columns_of_ecsv(lines), lines, mark, where=str(path))
        return table


def _columns_of_ecsv(lines: list[str]) -> dict[str, bool]:
    """True for each column of numbers of an ECSV file; a SkyCoord takes up two of them."""
    header = [line[2:] for line in takewhile(_is_comment, lines)]
    described = get_header_from_yaml(header[1:])["datatype"]  # the first line is the version
    return {str(one["name"]): one["datatype"] not in ("string", "bool") for one in described}


def _read_text(path: Path, limits: FileLimits) -> Table:
    return parse_text_table(read_lines(path, limits), Budget.of_file(path, limits))


def _read_separated(path: Path, limits: FileLimits, *, mark: str) -> Table:
    """Table of a .csv or .tsv file; its separator may differ from the one its name suggests."""
    lines = read_lines(path, limits)
    rows = (line.rstrip("\r\n") for line in lines if line.strip() and not line.startswith("#"))
    names = next(rows, "")
    detected_mark = mark_of([names, next(rows, names)])
    if detected_mark is None and is_text_table(lines):
        return _read_text(path, limits)
    mark = detected_mark or mark
    whole = _whole_lines(without_empty_names(lines, mark), mark, path)
    cells = next(csv.reader([names], delimiter=mark), [])
    Budget.of_file(path, limits).refuse_columns(len(cells))
    refuse_numbers_as_names(cells, where=str(path))
    # the time astropy needs for a comment grows with the square of its length
    lines = with_decimal_points([line for line in whole if line[:1] != "#"], mark, where=str(path))
    table = Table.read(lines, format="ascii.csv", delimiter=mark, comment="#", guess=False)
    refuse_open_quotes(whole, table, mark, where=str(path))
    refuse_foreign_numbers(columns_of_numbers(table), lines, mark, where=str(path))
    return table


def _read_votable(path: Path, limits: FileLimits) -> Table:
    check = VotableCheck(Budget.of_file(path, limits))
    raw, _ = read_unpacked(path, limits, check.add)
    check.end()
    table = Table.read(io.BytesIO(raw), format="votable")
    if MAYBE_FOREIGN_BYTES.search(raw) or any(np.ma.is_masked(table[n]) for n in table.colnames):
        _refuse_unreadable_cells(raw, path)
    return table


def _refuse_unreadable_cells(raw: bytes, path: Path) -> None:
    """Refuse cells in numeric columns of a VOTable that are neither numbers nor missing."""
    fields, row, column = list[tuple[str, str]](), 0, 0
    with get_xml_iterator(io.BytesIO(raw)) as steps:
        for begins, tag, content, _ in steps:
            if begins and tag == "FIELD":
                single = "arraysize" not in content
                kind = content.get("datatype", "") if single else ""
                fields.append((content.get("name", ""), kind))
            elif begins and tag == "TABLE":
                fields, row = [], 0
            elif begins and tag == "TR":
                row, column = row + 1, 0
            elif not begins and tag == "TD" and column < len(fields):
                name, kind = fields[column]
                column += 1
                if kind in ("float", "double") and not _says_number(content):
                    raise FormatError(
                        f"{content.strip()[:40]!r} is not a number",
                        where=f"{path}, row {row}, column {name!r}",
                        do="correct the cell or leave it empty",
                    )


def _says_number(cell: str) -> bool:
    try:
        number_of(cell)
    except ValueError:
        return cell.strip().lower() in _NO_NUMBER
    return True


def _read_fits(path: Path, limits: FileLimits) -> Table:
    raw, budget = read_unpacked(path, limits)
    with open_fits(raw, budget) as hdus:
        warning = warn_of_missing_extensions(hdus[0].header, len(hdus) - 1, str(path))
        tables = [
            hdu
            for hdu in hdus
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU) and "ZIMAGE" not in hdu.header
        ]
        objects = [hdu for hdu in tables if hdu.name == "LDAC_OBJECTS"]
        for hdu in objects or tables[:1]:
            if isinstance(hdu, fits.BinTableHDU):
                refuse_long_arrays(hdu, budget)
        if objects or tables:
            # NaN stays NaN, so that errors are not reported as missing values
            table = (
                _ldac(hdus, objects)
                if objects
                else Table.read(tables[0], format="fits", mask_invalid=False)
            )
            if warning:
                table.meta[MISSING_EXTENSIONS] = warning
            return table
    raise FormatError("holds no table extension", where=str(path), do="give a FITS table")


def _ldac(hdus: fits.HDUList, objects: list[fits.BinTableHDU]) -> Table:
    """Objects of a FITS_LDAC catalogue with the date of the image; several tables are chips.

    Each table of objects follows the header of its image. If the dates of the chips differ, they
    are stored in a column.
    """
    tables = [Table.read(hdu, format="fits", mask_invalid=False) for hdu in objects]
    images = [ldac_image_header(hdu) for hdu in hdus if hdu.name == LDAC_IMAGE]
    for number, table in enumerate(tables, 1):
        if len(tables) > 1 and "EXT_NUMBER" not in table.colnames:
            table["EXT_NUMBER"] = number
        table.meta = {}  # drop the settings of SExtractor
    dates: dict[str, object] = {}
    for key in ("MJD-OBS", "DATE-OBS"):
        values = [image[key] for image in images if key in image]
        if values and len(set(values)) == 1:
            dates[key] = values[0]
        elif len(values) == len(tables):
            for table, value in zip(tables, values, strict=True):
                table[key] = value
            break
    out = vstack(tables, metadata_conflicts="silent") if len(tables) > 1 else tables[0]
    out.meta.update(dates)
    return out


TABLE_SUFFIXES: dict[str, Callable[[Path, FileLimits], Table]] = {
    ".ecsv": read_ecsv,
    ".csv": partial(_read_separated, mark=","),
    ".tsv": partial(_read_separated, mark="\t"),
    ".fits": _read_fits,
    ".fit": _read_fits,
    ".ldac": _read_fits,
    ".parquet": parquet_table,
    ".vot": _read_votable,
    ".xml": _read_votable,
    ".tbl": _read_text,
    ".ipac": _read_text,
}


def is_binary(path: Path) -> bool:
    """True if a file is not text; False if it cannot be read (its reader will report the error)."""
    head = head_of(path)
    return b"\0" in head or head.startswith(FITS_START)


def is_fits(path: Path) -> bool:
    """True if a file starts like a FITS file."""
    return head_of(path).startswith(FITS_START)


def read_table(path: Path, limits: FileLimits = LIMITS) -> Table:
    """Read the table in a file; the format is determined by its extension.

    Supported extensions are .ecsv, .csv, .tsv, .fits (first table extension, or the objects of
    FITS_LDAC; also .fits.gz), .parquet, .vot or .xml (VOTable), .tbl and .ipac. Other files are
    recognised by their content, if they are FITS or text tables as in `parse_text_table`. All but
    .parquet may be compressed by gzip, bzip2 or xz, with or without .gz, .bz2 or .xz at the end of
    the name. Raises InputError if the file does not exist or is of unknown type, FormatError if it
    is damaged.
    """
    name = without_codec(path.name)
    reader = next((r for end, r in TABLE_SUFFIXES.items() if name.endswith(end)), None)
    if reader is None and is_fits(path):
        reader = _read_fits
    if reader is None and not is_binary(path) and is_text_table(read_lines(path, limits)):
        reader = _read_text
    if reader is None:
        raise InputError(
            f"extension {path.suffix!r} is not known for tables",
            where=str(path),
            do=f"give a file that ends in {', '.join(TABLE_SUFFIXES)}, or set the format",
        )
    if path.is_file() and not path.stat().st_size:
        raise FormatError("is empty", where=str(path), do="fetch or write it again")
    with _reading(path):
        return reader(path, limits)


class VotableCheck:
    """Refuses an unsafe VOTable before astropy reads it, while its bytes are decompressed.

    Raises FormatError for a document type, data in other files (`href`), sizes that exceed the
    limits, and text that is not XML. Encoding and entities are interpreted by an XML parser, so
    they cannot hide any of these.
    """

    def __init__(self, budget: Budget) -> None:
        scan = _Scan(budget)
        self._where = budget.where
        self._clock = budget.clock()
        self._parser = expat.ParserCreate()
        self._parser.StartDoctypeDeclHandler = scan.doctype
        self._parser.StartElementHandler = scan.begin
        self._parser.EndElementHandler = scan.end
        self._parser.CharacterDataHandler = scan.text

    def add(self, raw: bytes) -> None:
        """Check the next bytes of the file; raises FormatError if they are unsafe or not XML."""
        for at in range(0, len(raw), _PIECE):
            self._parse(raw[at : at + _PIECE])
            self._clock()

    def end(self) -> None:
        """Check that the file is complete; raises FormatError if it is not."""
        self._parse(b"", last=True)

    def _parse(self, raw: bytes, *, last: bool = False) -> None:
        try:
            self._parser.Parse(raw, last)
        except (expat.ExpatError, LookupError, ValueError) as error:
            raise FormatError(
                f"is not XML that can be read ({error})",
                where=self._where,
                do="fetch or write it again",
            ) from error


def _local(name: str) -> str:
    """Name without its namespace prefix."""
    return name.rpartition(":")[2]


@dataclass
class _Scan:
    """Handlers of an XML parser that count what has been read so far."""

    budget: Budget
    depth: int = 0
    nodes: int = 0
    rows: int = 0
    cells: int = 0
    in_stream: bool = False
    letters: int = 0  # in a stream of binary data
    # for each field: least number of bytes in a stream, and bytes in memory
    fields: list[tuple[int, int]] = field(default_factory=list)

    def doctype(self, *_: object) -> NoReturn:
        raise FormatError(
            "has a document type (DOCTYPE), which is not supported",
            where=self.budget.where,
            do="remove it",
        )

    def begin(self, tag: str, attributes: dict[str, str]) -> None:
        name = _local(tag)
        if name == "TD":
            self.cells += 1
            return
        if name == "TR":
            self.rows += 1
            self.budget.refuse_rows(self.rows, "holds")
            self.budget.refuse_cells(self.cells)
            return
        self.nodes, self.depth = self.nodes + 1, self.depth + 1
        self.budget.refuse_nodes(self.nodes, "elements")
        self.budget.refuse_depth(self.depth, "elements")
        if name == "STREAM" and any(_local(key) == "href" for key in attributes):
            raise FormatError(
                "its data lie elsewhere (STREAM with href), but other files and addresses are not "
                "read",
                where=self.budget.where,
                do="write a VOTable that holds its data",
            )
        if name == "TABLE":
            self.fields, self.rows, self.cells = [], 0, 0
            self._announced(attributes.get("nrows", "0"))
        elif name == "FIELD":
            self.fields.append(self._sizes(attributes))
            self.budget.refuse_columns(len(self.fields))
            self.budget.refuse_arrays(_CHUNK_ROWS * sum(room for _, room in self.fields))
        elif name == "STREAM":
            self.in_stream, self.letters = True, 0

    def end(self, tag: str) -> None:
        name = _local(tag)
        if name in ("TD", "TR"):
            return
        self.depth -= 1
        if name == "STREAM":
            self.in_stream = False
            self._refuse_stream()
        elif name == "TABLE":
            self.budget.refuse_cells(self.cells)
            self.budget.refuse_arrays(self.rows * sum(room for _, room in self.fields))

    def text(self, content: str) -> None:
        if self.in_stream:
            self.letters += len(content)

    def _announced(self, rows: str) -> None:
        if not re.fullmatch(r"\s*[0-9]{1,18}\s*", rows):
            raise FormatError(
                f"its number of rows (nrows) is {rows[:20]!r}",
                where=self.budget.where,
                do="fetch or write it again",
            )
        self.budget.refuse_rows(int(rows))

    def _sizes(self, attributes: dict[str, str]) -> tuple[int, int]:
        """Size of a cell in bytes: at least in a stream, and in memory."""
        kind, sides = attributes.get("datatype", "char"), attributes.get("arraysize", "1")
        n = math.prod(int(side[:18]) for side in re.findall(r"[0-9]+", sides))
        unit = _BYTES.get(kind, 1)
        if "*" in sides:
            return 4, 8  # a length, and a pointer
        return (-(-n // 8) if kind == "bit" else unit * n), unit * n * _WIDEN.get(kind, 1)

    def _refuse_stream(self) -> None:
        """Refuse too many rows of base64 binary data, and rows without bytes."""
        width = sum(width_in_stream for width_in_stream, _ in self.fields)
        if not width:
            raise FormatError("has rows of zero bytes", where=self.budget.where, do=DAMAGED)
        rows = self.letters * 3 // 4 // width
        self.budget.refuse_rows(rows, "holds")
        self.budget.refuse_cells(rows * len(self.fields))
        self.budget.refuse_arrays(rows * sum(room for _, room in self.fields))
