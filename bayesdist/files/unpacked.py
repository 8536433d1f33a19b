"""Sizes that the content of a file announces, held against the file's own, and gzip."""

from __future__ import annotations

import gzip
import io
import zlib

from bayesdist.errors import FormatError
from bayesdist.files.regular import read_up_to
from bayesdist.utils.memory import memory_limit, size_text

GZIP = b"\x1f\x8b"
PLAUSIBLE = 2**28  # bytes that any file may hold, however well they are compressed
RATIO = 100  # of larger content to the file: tables of stars are compressed by less than ten


def most_unpacked(size: int) -> int:
    """Bytes that a file of a size may hold."""
    return min(memory_limit(), max(PLAUSIBLE, RATIO * size))


def refuse_inflated(announced: float, size: int, where: str) -> None:
    """Refuse a file that announces more content than its size allows.

    `announced`: bytes. `size`: of the file.
    """
    if not announced <= most_unpacked(size):
        raise FormatError(
            f"announces {size_text(announced)} in a file of {size_text(size)}",
            where=where,
            do="it is damaged, or made to exhaust the memory: fetch or write it again",
        )


def unpacked(raw: bytes, where: str) -> bytes:
    """Content of a file, decompressed where gzip has compressed it.

    FormatError for a broken gzip file, or one that holds more than is plausible.
    """
    if raw[:2] != GZIP:
        return raw
    most = most_unpacked(len(raw))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(raw)) as stream:
            content = read_up_to(stream, most)
    except (EOFError, OSError, zlib.error) as error:
        raise FormatError(
            f"is a broken gzip file ({error})", where=where, do="fetch the file again"
        ) from error
    if len(content) > most:
        raise FormatError(
            f"is a gzip file of {size_text(len(raw))} that holds more than {size_text(most)}",
            where=where,
            do="check where it comes from, or decompress it first",
        )
    return content
