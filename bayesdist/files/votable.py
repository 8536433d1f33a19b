"""VOTables that fetch nothing, and hold no more than their file allows."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import NoReturn
from xml.parsers import expat

from bayesdist.errors import FormatError
from bayesdist.files.budget import DAMAGED, Budget

_PIECE = 2**16  # bytes that are parsed before the clock is read
_CHUNK_ROWS = 256  # for which astropy makes room before it reads any
_BYTES = {
    "boolean": 1, "unsignedByte": 1, "char": 1, "short": 2, "unicodeChar": 2, "int": 4,
    "float": 4, "long": 8, "double": 8, "floatComplex": 8, "doubleComplex": 16,
}  # fmt: skip
_WIDEN = {"char": 4, "unicodeChar": 2}  # of text in memory


def refuse_unsafe_votable(raw: bytes, budget: Budget) -> None:
    """Refuse a VOTable before astropy reads it.

    FormatError for a document type, for data that lie elsewhere (`href`), for sizes that exceed
    the budget, and for what is no XML.  The encoding and entities are those that a parser of XML
    sees, so that nothing can be hidden by them.
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
    """Name without the prefix of its namespace."""
    return name.rpartition(":")[2]


@dataclass
class _Scan:
    """Handlers of a parser, which count what has been read so far."""

    budget: Budget
    depth: int = 0
    nodes: int = 0
    rows: int = 0
    cells: int = 0
    in_stream: bool = False
    letters: int = 0  # of a stream of binary data
    fields: list[tuple[int, int]] = field(default_factory=list)  # least bytes in a stream, memory

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
                f"announces {rows[:20]} rows", where=self.budget.where, do="fetch or write it again"
            )
        self.budget.refuse_rows(int(rows))

    def _sizes(self, attributes: dict[str, str]) -> tuple[int, int]:
        """Bytes of a cell: at least in a stream, and in memory."""
        kind, sides = attributes.get("datatype", "char"), attributes.get("arraysize", "1")
        n = math.prod(int(side[:18]) for side in re.findall(r"[0-9]+", sides))
        unit = _BYTES.get(kind, 1)
        if "*" in sides:
            return 4, 8  # a length, and a reference
        return (-(-n // 8) if kind == "bit" else unit * n), unit * n * _WIDEN.get(kind, 1)

    def _refuse_stream(self) -> None:
        """Refuse rows of binary data, in base64, that are too many, or have no bytes."""
        width = sum(least for least, _ in self.fields)
        if not width:
            raise FormatError("has rows of no bytes", where=self.budget.where, do=DAMAGED)
        rows = self.letters * 3 // 4 // width
        self.budget.refuse_rows(rows, "holds")
        self.budget.refuse_cells(rows * len(self.fields))
        self.budget.refuse_content(rows * sum(room for _, room in self.fields))
