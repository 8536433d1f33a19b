"""Content of files compressed by gzip, bzip2 or xz, within the limits of the file."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import re
import zlib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable
from typing import Any

import numpy as np

from bayesdist.errors import FormatError
from bayesdist.files.budget import LIMITS, Budget, Limits
from bayesdist.files.regular import PIECE, PathLike, decoded, read_bytes
from bayesdist.utils.memory import size_text

# pattern at the start of the content, name of the codec, and its reader of a stream
CODECS: tuple[tuple[re.Pattern[bytes], str, Callable[[io.BytesIO], Any]], ...] = (
    (re.compile(rb"\x1f\x8b"), "gzip", lambda stream: gzip.GzipFile(fileobj=stream)),
    (re.compile(rb"BZh[1-9](1AY&SY|\x17rE8P\x90)"), "bzip2", bz2.BZ2File),
    (re.compile(rb"\xfd7zXZ\0"), "xz", lzma.LZMAFile),
)
CODEC_SUFFIXES = (".gz", ".bz2", ".xz")
_UNKNOWN = ((b"PK\3\4", "zip"), (b"\x1f\x9d", "compress"), (b"(\xb5/\xfd", "zstd"))


def without_codec(name: str) -> str:
    """File name in lower case, without the extension of a compressed file."""
    name = name.lower()
    for suffix in CODEC_SUFFIXES:
        name = name.removesuffix(suffix)
    return name


def _codec(raw: bytes) -> tuple[str, Callable[[io.BytesIO], Any]] | None:
    return next(((name, reader) for start, name, reader in CODECS if start.match(raw)), None)


def read_unpacked(path: PathLike, limits: Limits = LIMITS) -> tuple[bytes, Budget]:
    """Decompressed content of a file, with its limits; for errors see `unpacked`."""
    raw = read_bytes(path)
    budget = Budget(str(path), len(raw), limits)
    return unpacked(raw, budget), budget


def unpacked(raw: bytes, budget: Budget) -> bytes:
    """Content of a file, decompressed if it was compressed by gzip, bzip2 or xz.

    Raises FormatError if the file is broken, exceeds its limits, or is compressed twice or in
    another way.
    """
    detected = _codec(raw)
    if detected is None:
        for start, other_codec in _UNKNOWN:
            if raw.startswith(start):
                raise FormatError(
                    f"is compressed by {other_codec}", where=budget.where, do="decompress it first"
                )
        return raw
    codec, reader = detected
    try:
        with reader(io.BytesIO(raw)) as stream:
            content = _read(stream, budget)
    except (EOFError, OSError, zlib.error, lzma.LZMAError, MemoryError) as error:
        raise FormatError(
            f"is a broken {codec} file ({error})", where=budget.where, do="fetch the file again"
        ) from error
    if content is None:
        raise FormatError(
            f"is compressed by {codec} to {size_text(len(raw))}, and that holds more than "
            f"{size_text(budget.content)}",
            where=budget.where,
            do="check where it comes from, or decompress it first",
        )
    if _codec(content) is not None:
        raise FormatError("is compressed twice", where=budget.where, do="decompress it first")
    return content


def _read(stream: Any, budget: Budget) -> bytes | None:
    """Bytes of a stream; None if there are more than the limit."""
    clock = budget.clock()
    parts, remaining = list[bytes](), budget.content + 1
    while remaining and (part := stream.read(min(remaining, PIECE))):
        parts.append(part)
        remaining -= len(part)
        clock()
    return b"".join(parts) if remaining else None


def read_lines(path: PathLike, limits: Limits = LIMITS) -> list[str]:
    """Lines of a text file, decompressed, with line ends and without a byte order mark.

    Raises the errors of `read_bytes` and `unpacked`, and FormatError if the text is not UTF-8 or
    contains NUL, at which readers in C end a cell, or if lines, cells or the length of a line
    exceed the limits.
    """
    raw, budget = read_unpacked(path, limits)
    nul = raw.find(b"\0")
    if nul >= 0 and not raw.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        raise FormatError(
            "has a NUL character, which no text has",
            where=f"{path}, line {len((raw[:nul] + b'.').splitlines())}",
            do="it is damaged: fetch or write it again",
        )
    ends = raw.count(b"\n") + raw.count(b"\r") - raw.count(b"\r\n")
    budget.refuse_rows(ends, "holds")
    if len(raw) > budget.size:
        budget.refuse_cells(_cells(raw))
    text = decoded(raw, str(path)).removeprefix("\ufeff")
    del raw
    lines = io.StringIO(text, newline="").readlines()
    for number, line in enumerate(lines, start=1):
        if len(line) > budget.limits.line:
            budget.refuse_line(len(line), number)
    return lines


def _cells(raw: bytes) -> int:
    """Number of cells of a text table, for any of the possible separators."""
    marks = np.isin(np.frombuffer(raw, np.uint8), np.frombuffer(b" ,;\t\r\n", np.uint8))
    between_blanks = int(np.count_nonzero(marks[1:] > marks[:-1]))
    return max(between_blanks, *(raw.count(mark) for mark in (b",", b";", b"\t")))
