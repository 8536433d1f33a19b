"""A FITS file as its blocks stand in it: the cards and the bytes of every HDU.

Parsing is astropy's; keeping the bytes beside it is what makes reading and writing lossless.
"""

from __future__ import annotations

import gzip
import io
import os
import warnings
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.data.files import atomic_path
from bayesdist.errors import FormatError, InputError
from bayesdist.products.cards import header_of

__all__ = ["Block", "blocks_of", "content_of", "parse_blocks", "read_blocks", "write_blocks"]

_RECORD = 2880


@dataclass(frozen=True, eq=False)
class Block:
    """One HDU.

    Parameters
    ----------
    cards : tuple of str
        Header cards without END, 80 characters each.
    data : bytes
        As in the file, whether padded to whole records or not.
    """

    cards: tuple[str, ...]
    data: bytes = b""

    @property
    def header(self) -> fits.Header:
        """The header; a new one at each call."""
        return header_of(self.cards)

    @property
    def name(self) -> str:
        """EXTNAME, in capitals."""
        return str(self.header.get("EXTNAME", "")).strip().upper()

    def to_bytes(self) -> bytes:
        """Header and data, each padded to whole records."""
        head = "".join([*self.cards, "END".ljust(80)]).encode("ascii")
        return head.ljust(_padded(len(head)), b" ") + self.data.ljust(
            _padded(len(self.data)), b"\0"
        )

    @cached_property
    def rows(self) -> NDArray[np.void]:
        """Rows of a binary table: native numbers, and text without trailing blanks.

        Raises
        ------
        FormatError
            When this is no binary table.
        """
        if self.header.get("XTENSION", "").strip() != "BINTABLE":
            raise FormatError(f"HDU {self.name!r} is no binary table")
        table = fits.BinTableHDU.fromstring(self.to_bytes()).data
        columns = {name: np.asarray(table[name]) for name in table.names}
        columns = {
            n: np.strings.rstrip(c) if c.dtype.kind == "U" else c for n, c in columns.items()
        }
        layout = [(n, c.dtype.newbyteorder("="), c.shape[1:]) for n, c in columns.items()]
        out = np.empty(len(table), dtype=layout)
        for name, column in columns.items():
            out[name] = column
        out.flags.writeable = False
        return out


def _padded(n: int) -> int:
    return -(-n // _RECORD) * _RECORD


def content_of(path: str | os.PathLike[str]) -> bytes:
    """Bytes of a file, decompressed where gzip has compressed it.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is a broken gzip file.
    """
    where = str(path)
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror or error})", where=where, do="check the path"
        ) from error
    if raw[:2] != b"\x1f\x8b":
        return raw
    try:
        return gzip.decompress(raw)
    except (EOFError, OSError, zlib.error) as error:
        raise FormatError(
            f"is a broken gzip file ({error})", where=where, do="fetch the file again"
        ) from error


def read_blocks(path: str | os.PathLike[str]) -> tuple[Block, ...]:
    """All HDUs of a FITS file, also of one compressed by gzip.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no FITS file, or is truncated.
    """
    return parse_blocks(content_of(path), str(path))


def parse_blocks(raw: bytes, where: str) -> tuple[Block, ...]:
    """All HDUs of the content of a FITS file; `where` names it in errors."""
    out, end = [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what astropy warns of is judged below
        try:
            with fits.open(
                io.BytesIO(raw), memmap=False, lazy_load_hdus=False, disable_image_compression=True
            ) as hdus:
                places = [hdu.fileinfo() for hdu in hdus]
        except (OSError, ValueError, AttributeError, fits.VerifyError) as error:
            # the AttributeError is of an HDU that does not conform to the standard
            raise FormatError(
                f"is no FITS file ({error})", where=where, do="check the file"
            ) from error
    for place in places:
        end = place["datLoc"] + place["datSpan"]
        text = raw[place["hdrLoc"] : place["datLoc"]].decode("ascii")
        cards = [text[k : k + 80] for k in range(0, len(text), 80)]
        stop = next(k for k, card in enumerate(cards) if card[:8].rstrip() == "END")
        out.append(Block(tuple(cards[:stop]), raw[place["datLoc"] : end]))
    if end > len(raw) or raw[end:].strip(b"\0 "):
        raise FormatError(
            f"is truncated or damaged: {len(raw)} bytes, and {len(places)} HDUs end at {end}",
            where=where,
            do="fetch the file again",
        )
    return tuple(out)


def blocks_of(hdus: Iterable[fits.hdu.base.ExtensionHDU | fits.PrimaryHDU]) -> tuple[Block, ...]:
    """Blocks of HDUs that astropy made."""
    stream = io.BytesIO()
    fits.HDUList(list(hdus)).writeto(stream)
    return parse_blocks(stream.getvalue(), "new file")


def write_blocks(blocks: Iterable[Block], path: str | os.PathLike[str]) -> None:
    """Write a FITS file, whole or not at all; compressed when its name ends in .gz.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    raw = b"".join(block.to_bytes() for block in blocks)
    if str(path).endswith(".gz"):
        raw = gzip.compress(raw, mtime=0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(raw)
