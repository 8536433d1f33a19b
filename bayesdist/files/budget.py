"""What the reading of one file may take; every reader of files holds what it finds against it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from bayesdist.errors import FormatError
from bayesdist.utils.memory import memory_limit, size_text


@dataclass(frozen=True)
class Limits:
    """Limits of what a file of any format may hold.

    What may grow with the file has two values: what any file may hold, however small it is, and
    what is allowed for each byte of a larger file, as it lies on the disk.
    """

    content: int = 2**25  # bytes after decompression, and of arrays
    content_per_byte: float = 100  # tables of stars are compressed by less than ten
    rows: int = 2**17
    rows_per_byte: float = 0.5  # the numbers of one star take four bytes at least
    cells: int = 2**20  # of tables, or numbers in arrays of a tree
    cells_per_byte: float = 8
    seconds: float = 5  # of processor time
    seconds_per_byte: float = 5e-6
    columns: int = 10_000  # FITS has 999; gbdes has one for each parameter
    parts: int = 1000  # HDUs, or blocks of ASDF
    nodes: int = 50_000  # of a tree, each as often as it is referred to; cards of a header
    header: int = 2**20  # characters of YAML: a column takes a hundred
    line: int = 2**16  # characters: a thousand columns take 25,000
    depth: int = 64  # of groups, elements or brackets within each other; our own have ten


LIMITS = Limits()
DAMAGED = "it is damaged, or made to exhaust the memory: fetch or write it again"


@dataclass(frozen=True)
class Budget:
    """What one file may hold.

    Readers pass numbers that they find, or that the file announces: what exceeds the budget is
    refused with a FormatError.

    Parameters
    ----------
    where : str
        Name of the file, for messages.
    size : int
        Bytes of the file on the disk, before decompression.
    limits : Limits, optional
    """

    where: str
    size: int
    limits: Limits = LIMITS

    @property
    def content(self) -> int:
        """Bytes that the file may hold, which is never more than fits in memory."""
        most = max(self.limits.content, self.limits.content_per_byte * self.size)
        return int(min(memory_limit(), most))

    @property
    def rows(self) -> int:
        """Rows that its tables may have."""
        return int(max(self.limits.rows, self.limits.rows_per_byte * self.size))

    def refuse_content(self, n_bytes: float) -> None:
        """Refuse arrays or decompressed content of so many bytes, as the file announces them."""
        if not n_bytes <= self.content:
            raise FormatError(
                f"announces {size_text(n_bytes)} in a file of {size_text(self.size)}",
                where=self.where,
                do=DAMAGED,
            )

    def refuse_rows(self, n: float, verb: str = "announces") -> None:
        """Refuse a table of so many rows, which the file announces or, by `verb`, holds."""
        if not n <= self.rows:
            raise FormatError(
                f"{verb} {n} rows in a file of {size_text(self.size)}",
                where=self.where,
                do=DAMAGED,
            )

    def refuse_cells(self, n: float) -> None:
        """Refuse tables of so many cells together."""
        most = max(self.limits.cells, self.limits.cells_per_byte * self.size)
        if not n <= most:
            raise FormatError(
                f"holds {n:.3g} cells in a file of {size_text(self.size)}",
                where=self.where,
                do=DAMAGED,
            )

    def refuse_columns(self, n: int) -> None:
        """Refuse a table of so many columns."""
        self._refuse(n, self.limits.columns, "columns", "keep those that are needed")

    def refuse_parts(self, n: int, what: str) -> None:
        """Refuse a file of so many parts; `what` names them, as in 'HDUs'."""
        self._refuse(n, self.limits.parts, what, "divide the file")

    def refuse_nodes(self, n: int, what: str) -> None:
        """Refuse a tree of so many nodes; `what` names them, as in 'header cards'."""
        self._refuse(n, self.limits.nodes, what, DAMAGED)

    def refuse_header(self, n: int) -> None:
        """Refuse a header of YAML of so many characters."""
        self._refuse(n, self.limits.header, "characters in its header", DAMAGED)

    def refuse_depth(self, n: int, what: str) -> None:
        """Refuse parts within each other; `what` names them, as in 'groups'."""
        self._refuse(n, self.limits.depth, f"{what} within each other", DAMAGED)

    def refuse_line(self, n: int, number: int) -> None:
        """Refuse a line of so many characters; `number` counts from 1."""
        if n > self.limits.line:
            raise FormatError(
                f"has {n} characters, and at most {self.limits.line} are read",
                where=f"{self.where}, line {number}",
                do="check that it is a table, and shorten the line",
            )

    def _refuse(self, n: int, most: int, what: str, do: str) -> None:
        if n > most:
            raise FormatError(f"has more than {most} {what}", where=self.where, do=do)

    def clock(self) -> Callable[[], None]:
        """Function to call while the file is read; it refuses what takes too long from now on."""
        most = max(self.limits.seconds, self.limits.seconds_per_byte * self.size)
        end = time.thread_time() + most

        def check() -> None:
            if time.thread_time() > end:
                raise FormatError(
                    f"takes more than {most:.3g} s to read in a file of {size_text(self.size)}",
                    where=self.where,
                    do=DAMAGED,
                )

        return check
