"""Limits on the resources for reading one file, which every reader of files enforces."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

from bayesdist.errors import FormatError
from bayesdist.files.regular import PathLike, opened
from bayesdist.utils.memory import memory_limit, size_text


@dataclass(frozen=True)
class FileLimits:
    """Limits on the content of a file of any format.

    Quantities that may increase with the size of the file have two limits: an amount that any file
    may have, however small it is, and an amount per byte of the file on disk.
    """

    content: int = 2**25  # bytes after decompression, and bytes of columns
    content_per_byte: float = 100  # tables of stars are compressed by a factor below ten
    # bytes of images and other arrays, whatever the size of the file, because constant ones are
    # compressed a thousandfold: two planes of 4096 x 4096 pixels in single precision, and headers
    arrays: int = 2**27 + 2**20
    held: int = 2**26  # bytes that are kept before it is known whether all will be accepted
    rows: int = 2**17
    rows_per_byte: float = 0.5  # the numbers of one star need at least four bytes
    cells: int = 2**20  # of tables, or numbers in the arrays of a tree
    cells_per_byte: float = 8
    seconds: float = 5  # processor time
    seconds_per_byte: float = 5e-6
    columns: int = 10_000  # FITS has at most 999; gbdes has one per parameter
    parts: int = 1000  # HDUs
    nodes: int = 50_000  # of a tree, with aliases counted each time; header cards; blocks of ASDF
    header: int = 2**20  # characters of a YAML header; a column needs about a hundred
    line: int = 2**18  # characters: ten thousand columns take 250,000
    depth: int = 64  # nesting of groups, elements or brackets; files of bayesdist have ten


LIMITS = FileLimits()
DAMAGED = "it is damaged, or made to exhaust the memory: fetch or write it again"


@dataclass(frozen=True)
class Budget:
    """Limits for one file.

    Readers pass the numbers that they find, or that the file announces. Numbers that exceed the
    limits are refused with a FormatError.

    Parameters
    ----------
    where : str
        Name of the file, for error messages.
    size : int
        Size of the file on disk, before decompression, in bytes.
    limits : FileLimits, optional
        Limits that apply to files of any format; `LIMITS` by default.
    """

    where: str
    size: int
    limits: FileLimits = LIMITS

    @classmethod
    def of_file(cls, path: PathLike, limits: FileLimits = LIMITS) -> Budget:
        """Budget of a regular file, by its size; raises the errors of `opened`."""
        with opened(path) as stream:
            return cls(str(path), os.fstat(stream.fileno()).st_size, limits)

    @property
    def content(self) -> int:
        """Largest allowed size of the content in bytes, also limited by the available memory."""
        limit = max(self.limits.content, self.limits.content_per_byte * self.size)
        return int(min(memory_limit(), limit))

    @property
    def arrays(self) -> int:
        """Largest size in bytes of images and other arrays that are not columns of stars."""
        return max(self.content, min(memory_limit(), self.limits.arrays))

    @property
    def rows(self) -> int:
        """Largest allowed number of rows of a table."""
        return int(max(self.limits.rows, self.limits.rows_per_byte * self.size))

    def refuse_content(self, n_bytes: float) -> None:
        """Raise FormatError for too many bytes of columns or of decompressed content."""
        self._refuse_bytes(n_bytes, self.content)

    def refuse_arrays(self, n_bytes: float) -> None:
        """Raise FormatError for too many bytes of arrays; see `arrays`."""
        self._refuse_bytes(n_bytes, self.arrays)

    def _refuse_bytes(self, n_bytes: float, limit: int) -> None:
        if not n_bytes <= limit:
            raise FormatError(
                f"announces {size_text(n_bytes)} in a file of {size_text(self.size)}",
                where=self.where,
                do=DAMAGED,
            )

    def refuse_rows(self, n: float, verb: str = "announces") -> None:
        """Raise FormatError for a table with too many rows; `verb` is 'announces' or 'holds'."""
        if not n <= self.rows:
            raise FormatError(
                f"{verb} {n} rows in a file of {size_text(self.size)}",
                where=self.where,
                do=DAMAGED,
            )

    def refuse_cells(self, n: float) -> None:
        """Raise FormatError for tables with too many cells in total."""
        limit = max(self.limits.cells, self.limits.cells_per_byte * self.size)
        if not n <= limit:
            raise FormatError(
                f"holds {n:.3g} cells in a file of {size_text(self.size)}",
                where=self.where,
                do=DAMAGED,
            )

    def refuse_columns(self, n: int) -> None:
        """Raise FormatError for a table with too many columns."""
        self._refuse(n, self.limits.columns, "columns", "keep those that are needed")

    def refuse_parts(self, n: int, what: str) -> None:
        """Raise FormatError for a file with too many parts; `what` names them, as in 'HDUs'."""
        self._refuse(n, self.limits.parts, what, "divide the file")

    def refuse_nodes(self, n: int, what: str) -> None:
        """Raise FormatError for a tree with too many nodes; `what` names them, as in 'cards'."""
        self._refuse(n, self.limits.nodes, what, DAMAGED)

    def refuse_header(self, n: int) -> None:
        """Raise FormatError for a YAML header with too many characters."""
        self._refuse(n, self.limits.header, "characters in its header", DAMAGED)

    def refuse_depth(self, n: int, what: str) -> None:
        """Raise FormatError for too deep nesting; `what` names the level, as in 'groups'."""
        self._refuse(n, self.limits.depth, f"{what} within each other", DAMAGED)

    def refuse_line(self, n: int, number: int) -> None:
        """Raise FormatError for a line with too many characters; line numbers start at 1."""
        if n > self.limits.line:
            raise FormatError(
                f"has {n} characters, but at most {self.limits.line} are read",
                where=f"{self.where}, line {number}",
                do="check that it is a table, and shorten the line",
            )

    def _refuse(self, n: int, most: int, what: str, do: str) -> None:
        if n > most:
            raise FormatError(f"has more than {most} {what}", where=self.where, do=do)

    def clock(self) -> Callable[[], None]:
        """Start a timer; the returned function raises FormatError once the allowed time is over."""
        limit = max(self.limits.seconds, self.limits.seconds_per_byte * self.size)
        end = time.thread_time() + limit

        def check() -> None:
            if time.thread_time() > end:
                raise FormatError(
                    f"takes more than {limit:.3g} s to read in a file of {size_text(self.size)}",
                    where=self.where,
                    do=DAMAGED,
                )

        return check
