"""Content of files compressed by gzip, bzip2 or xz, within the limits of the file."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import re
import zlib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterator

import numpy as np

from bayesdist.errors import FormatError
from bayesdist.files.budget import LIMITS, Budget, FileLimits
from bayesdist.files.fits import FITS_START
from bayesdist.files.regular import PIECE, PathLike, decoded, read_bytes
from bayesdist.utils.memory import size_text

_XZ_MEMORY = 2**28  # bytes; xz -9 needs 2**26, and a file may ask for 2**32


def _of_gzip(raw: bytes) -> Iterator[bytes]:
    with gzip.GzipFile(fileobj=io.BytesIO(raw)) as stream:
        while piece := stream.read(PIECE):
            yield piece


def _of_bzip2(raw: bytes) -> Iterator[bytes]:
    with bz2.BZ2File(io.BytesIO(raw)) as stream:
        while piece := stream.read(PIECE):
            yield piece


def _of_xz(raw: bytes) -> Iterator[bytes]:
    """Content of xz streams; `lzma.LZMAFile` has no limit for the memory of its dictionary."""
    while raw:
        stream = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
        while not stream.eof:
            if not raw and stream.needs_input:
                raise EOFError("it ends within a stream")
            piece, raw = stream.decompress(raw, PIECE), b""
            yield piece
        raw = stream.unused_data.lstrip(b"\0")  # padding between streams


# pattern at the start of the content, name of the codec, and pieces of its content
CODECS: tuple[tuple[re.Pattern[bytes], str, Callable[[bytes], Iterator[bytes]]], ...] = (
    (re.compile(rb"\x1f\x8b"), "gzip", _of_gzip),
    (re.compile(rb"BZh[1-9](1AY&SY|\x17rE8P\x90)"), "bzip2", _of_bzip2),
    (re.compile(rb"\xfd7zXZ\0"), "xz", _of_xz),
)
CODEC_SUFFIXES = (".gz", ".bz2", ".xz")
_UNKNOWN = ((b"PK\3\4", "zip"), (b"\x1f\x9d", "compress"), (b"(\xb5/\xfd", "zstd"))


def without_codec(name: str) -> str:
    """File name in lower case, without the extension of a compressed file."""
    name = name.lower()
    for suffix in CODEC_SUFFIXES:
        name = name.removesuffix(suffix)
    return name


def _codec(raw: bytes) -> tuple[str, Callable[[bytes], Iterator[bytes]]] | None:
    return next(((name, pieces) for start, name, pieces in CODECS if start.match(raw)), None)


def read_unpacked(
    path: PathLike, limits: FileLimits = LIMITS, watch: Callable[[bytes], None] | None = None
) -> tuple[bytes, Budget]:
    """Decompressed content of a file, with its limits; for `watch` and errors see `unpacked`."""
    raw = read_bytes(path)
    budget = Budget(str(path), len(raw), limits)
    return unpacked(raw, budget, watch), budget


def unpacked(raw: bytes, budget: Budget, watch: Callable[[bytes], None] | None = None) -> bytes:
    """Content of a file, decompressed if it was compressed by gzip, bzip2 or xz.

    `watch` is called once with each piece of the content, in order, and may refuse it before the
    rest is decompressed. Raises FormatError if the file is broken, exceeds its limits, or is
    compressed twice or in another way.
    """
    detected = _codec(raw)
    if detected is None:
        for start, other_codec in _UNKNOWN:
            if raw.startswith(start):
                raise FormatError(
                    f"is compressed by {other_codec}", where=budget.where, do="decompress it first"
                )
        if watch is not None:
            for at in range(0, len(raw), PIECE):
                watch(raw[at : at + PIECE])
        return raw
    codec, pieces = detected
    try:
        return _within_limits(lambda: pieces(raw), codec, budget, watch)
    except (EOFError, OSError, zlib.error, lzma.LZMAError, MemoryError) as error:
        raise FormatError(
            f"is a broken {codec} file ({error})", where=budget.where, do="fetch the file again"
        ) from error


def _within_limits(
    pieces: Callable[[], Iterator[bytes]],
    codec: str,
    budget: Budget,
    watch: Callable[[bytes], None] | None,
) -> bytes:
    """Pieces as one object.

    Content of more than `limits.held` bytes is decompressed twice, at first without keeping it, so
    that little memory is needed for content that is refused.
    """
    clock, most_held = budget.clock(), budget.limits.held
    held, total, limit = list[bytes](), 0, budget.content
    for piece in pieces():
        if not total:
            if _codec(piece) is not None:
                raise FormatError(
                    "is compressed twice", where=budget.where, do="decompress it first"
                )
            if piece.startswith((FITS_START, b"#ASDF")):
                limit = budget.arrays  # tables are checked when their headers are read
        total += len(piece)
        if total > limit:
            raise FormatError(
                f"is compressed by {codec} to {size_text(budget.size)}, and that holds more than "
                f"{size_text(limit)}",
                where=budget.where,
                do="check where it comes from, or decompress it first",
            )
        if watch is not None:
            watch(piece)
        clock()
        if total <= most_held:
            held.append(piece)
        else:
            held.clear()
    return b"".join(held if total <= most_held else pieces())


def read_lines(path: PathLike, limits: FileLimits = LIMITS) -> list[str]:
    """Lines of a text file, decompressed, with line ends and without a byte order mark.

    Raises the errors of `read_bytes` and `unpacked`, and FormatError if the text is not UTF-8 or
    contains NUL, at which readers in C end a cell, or if lines, cells or the length of a line
    exceed the limits.
    """
    raw = read_bytes(path)
    budget = Budget(str(path), len(raw), limits)
    raw = unpacked(raw, budget, TextCounts(budget, compressed=_codec(raw) is not None).add)
    nul = raw.find(b"\0")
    if nul >= 0 and not raw.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        raise FormatError(
            "has a NUL character, which is not allowed in text",
            where=f"{path}, line {len((raw[:nul] + b'.').splitlines())}",
            do="it is damaged: fetch or write it again",
        )
    text = decoded(raw, str(path)).removeprefix("\ufeff")
    del raw
    lines = io.StringIO(text, newline="").readlines()
    for number, line in enumerate(lines, start=1):
        if len(line) > budget.limits.line:
            budget.refuse_line(len(line), number)
    return lines


class TextCounts:
    """Rows and cells of a text table that is read in pieces, for any of the possible separators."""

    def __init__(self, budget: Budget, *, compressed: bool) -> None:
        self._budget = budget
        self._compressed = compressed  # other files have no more cells than bytes
        self._rows = 0
        self._cells = np.zeros(len(_SEPARATORS) + 1, int)
        self._last = b""  # byte before the next piece

    def add(self, piece: bytes) -> None:
        """Count a piece; raises FormatError if there are too many rows or cells so far."""
        text = self._last + piece
        self._last = piece[-1:]
        self._rows += piece.count(b"\n") + piece.count(b"\r") - text.count(b"\r\n")
        self._budget.refuse_rows(self._rows, "holds")
        if self._compressed:
            marks = _IS_BLANK[np.frombuffer(text, np.uint8)]
            between_blanks = int(np.count_nonzero(marks[1:] > marks[:-1]))
            self._cells += [between_blanks, *map(piece.count, _SEPARATORS)]
            self._budget.refuse_cells(self._cells.max())


_SEPARATORS = (b",", b";", b"\t")
_IS_BLANK = np.isin(np.arange(256), list(b" ,;\t\r\n"))  # by byte
