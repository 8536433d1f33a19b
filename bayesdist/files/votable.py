"""Check that a VOTable refers to no other files and holds no more than its size allows."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import NoReturn
from xml.parsers import expat

from bayesdist.errors import FormatError
from bayesdist.files.budget import DAMAGED, Budget

_PIECE = 2**16  # bytes that are parsed between readings of the clock
_CHUNK_ROWS = 256  # rows for which astropy allocates memory before it reads any
_BYTES = {
    "boolean": 1, "unsignedByte": 1, "char": 1, "short": 2, "unicodeChar": 2, "int": 4,
    "float": 4, "long": 8, "double": 8, "floatComplex": 8, "doubleComplex": 16,
}  # fmt: skip
_WIDEN = {"char": 4, "unicodeChar": 2}  # size of text in memory relative to the file


def refuse_unsafe_votable(raw: bytes, budget: Budget) -> None:
    """Refuse an unsafe VOTable before astropy reads it.

    Raises FormatError for a document type, data in other files (`href`), sizes that exceed the
    limits, and text that is not XML. Encoding and entities are interpreted by an XML parser, so
    they cannot hide any of these.
    """
    scan = _Scan(budget)
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = scan.doctype
    parser.StartElementHandler = scan.begin
    parser.EndElementHandler = scan.end
    parser.CharacterDataHandler = scan.text
    clock = budget.clock()
    try:
        for at in range(0, len(raw), _PIECE):
            parser.Parse(raw[at : at + _PIECE])
            clock()
        parser.Parse(b"", True)
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise FormatError(
            f"is not XML that can be read ({error})",
            where=budget.where,
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
            "has a document type (DOCTYPE), which is not read",
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
                "its data lie elsewhere (STREAM with href), and nothing is fetched",
                where=self.budget.where,
                do="write a VOTable that holds its data",
            )
        if name == "TABLE":
            self.fields, self.rows, self.cells = [], 0, 0
            self._announced(attributes.get("nrows", "0"))
        elif name == "FIELD":
            self.fields.append(self._sizes(attributes))
            self.budget.refuse_columns(len(self.fields))
            self.budget.refuse_content(_CHUNK_ROWS * sum(room for _, room in self.fields))
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
            self.budget.refuse_content(self.rows * sum(room for _, room in self.fields))

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
            raise FormatError("has rows of no bytes", where=self.budget.where, do=DAMAGED)
        rows = self.letters * 3 // 4 // width
        self.budget.refuse_rows(rows, "holds")
        self.budget.refuse_cells(rows * len(self.fields))
        self.budget.refuse_content(rows * sum(room for _, room in self.fields))
