"""Content of a file: its bytes, the HDUs of a FITS file with their cards, and its text.

Every reader uses this module, so that each file is opened once whatever its format. Headers are
often stored without their data, either several in a row or a single one. HDUs are therefore located
by their headers, and `Hdu.state` tells if the data are complete. The bytes are kept together with
their interpretation, which makes reading and writing lossless. `TablePlane` is an extension with a
look-up table.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import warnings
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.errors import BayesdistError, FormatError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.budget import Budget
from bayesdist.files.faults import reason_of
from bayesdist.files.fits import (
    CARD_LENGTH,
    HDU_STARTS,
    LDAC_IMAGE,
    RECORD,
    data_size,
    ldac_image_header,
    open_fits,
    padded,
    refuse_long_arrays,
    refuse_many_rows,
    refuse_rest,
    warn_of_missing_extensions,
)
from bayesdist.files.unpacked import read_unpacked
from bayesdist.products.common.cards import card_images, header_of
from bayesdist.utils.arrays import Float

_FIRST_CARDS = ("SIMPLE  ", "XTENSION")
_CARD = re.compile(r"[A-Z0-9_-]{1,8} *=|(COMMENT|HISTORY| {8})")


@dataclass(frozen=True, eq=False)
class Hdu:
    """One HDU, or the header cards of one."""

    cards: tuple[str, ...]  # header cards without END, 80 characters each
    data: bytes = b""  # as in the file, not necessarily padded to whole records
    number: int = 0  # index in the file, from 0
    state: str = "whole"  # 'whole', 'none' if the announced data are missing, 'cut' if truncated

    @property
    def header(self) -> fits.Header:
        """Header; a new one at each call."""
        return header_of(self.cards)

    @cached_property
    def name(self) -> str:
        """EXTNAME, in capitals."""
        return str(self.header.get("EXTNAME", "")).strip().upper()

    @property
    def label(self) -> str:
        """EXTNAME with EXTVER, such as 'SCI,1'; empty if there is no EXTNAME."""
        header = self.header
        name = str(header.get("EXTNAME", "")).strip()
        return f"{name},{header.get('EXTVER', 1)}" if name else ""

    def to_bytes(self) -> bytes:
        """Header and data, each padded to whole records."""
        head = "".join([*self.cards, "END".ljust(80)]).encode("latin-1")
        return head.ljust(padded(len(head)), b" ") + self.data.ljust(padded(len(self.data)), b"\0")

    @cached_property
    def rows(self) -> NDArray[np.void]:
        """Rows of a binary table with native byte order and without trailing blanks in text.

        Raises FormatError if this is not a binary table, or if its cards cannot be read.
        """
        if self.header.get("XTENSION", "").strip() != "BINTABLE":
            raise FormatError(
                f"HDU {self.name!r} is not a binary table",
                do="it is damaged: fetch or write it again",
            )
        try:
            hdu = fits.BinTableHDU.fromstring(self.to_bytes())
            refuse_long_arrays(hdu, Budget(f"HDU {self.name!r}", len(self.data)))
            table = hdu.data
        except FormatError:
            raise
        except Exception as error:  # astropy raises all kinds on cards that no file should have
            raise FormatError(
                f"HDU {self.name!r} cannot be read ({reason_of(error)})",
                do="it is damaged: fetch or write it again",
            ) from error
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

    def refuse_compressed(self, where: str = "") -> None:
        """Raise FormatError for an image that is stored as a table of compressed tiles."""
        if "ZIMAGE" in self.header:
            raise FormatError(
                f"extension {self.label or 'without a name'} is a compressed image",
                where=where,
                do="decompress the file first, for instance with funpack",
            )

    @cached_property
    def image(self) -> Float:
        """Pixels (ny, nx) of an image extension; FormatError if they are compressed in a table."""
        self.refuse_compressed()
        return np.asarray(fits.ImageHDU.fromstring(self.to_bytes()).data, float)


@dataclass(frozen=True, eq=False)
class Content:
    """Decompressed bytes of a file, and its name for messages."""

    name: str
    raw: bytes
    path: Path | None = None  # path of the file; None for content in memory
    size: int | None = None  # size in bytes before decompression; None for content in memory

    @property
    def budget(self) -> Budget:
        """Limits on what the file may contain."""
        return Budget(self.name, len(self.raw) if self.size is None else self.size)

    def beside(self, name: str) -> Content | None:
        """Content of a file in the same folder; None if there is none, or for content in memory."""
        if self.path is None or not name or Path(name).name != name:
            return None
        path = self.path.parent / name
        return read_content(path) if os.path.lexists(path) else None  # a dangling link exists

    @property
    def is_fits(self) -> bool:
        """True if the content begins like a FITS file or like one of its HDUs."""
        return self.raw[:9] in HDU_STARTS and b"\n" not in self.raw[:81]

    @cached_property
    def text(self) -> str:
        """Text with newline line ends and no byte order mark; empty for a FITS file."""
        if self.is_fits or b"\0" in self.raw[:RECORD]:
            return ""
        return self.raw.removeprefix(BOM_UTF8).decode("latin-1").replace("\r\n", "\n")

    @cached_property
    def hdus(self) -> tuple[Hdu, ...]:
        """HDUs as far as they can be found; for a text file of cards, one HDU with these cards."""
        if self.is_fits:
            return tuple(_walked(self.raw, self.budget))
        if not _CARD.match(self.text):
            return ()
        budget = self.budget
        budget.refuse_nodes(max(len(self.text) // 80, self.text.count("\n")), "header cards")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other programs' cards
            sep = "\n" if "\n" in self.text.strip() else ""
            header = fits.Header.fromstring(self.text, sep=sep)
            state = "whole" if "NAXIS" not in header else "none"
            return (Hdu(card_images(header), state=state),)

    def whole(self) -> tuple[Hdu, ...]:
        """HDUs of a complete FITS file.

        Raises FormatError if the content is not FITS, or is truncated or damaged.
        """
        hdus = self.hdus if self.is_fits else ()
        if not hdus or self.raw[:9] != HDU_STARTS[0]:
            raise FormatError("is not a FITS file", where=self.name, do="check the file")
        broken = next((hdu for hdu in hdus if hdu.state != "whole"), None)
        if broken is not None:
            raise FormatError(
                f"has {len(self.raw)} bytes, but HDU {broken.number} takes up more",
                where=self.name,
                do="it is truncated or damaged: fetch or write it again",
            )
        self.refuse_rest()
        return hdus

    def refuse_rest(self) -> None:
        """Raise FormatError for a FITS file that does not end where its last HDU does."""
        refuse_rest(self.raw, sum(len(hdu.to_bytes()) for hdu in self.hdus), self.budget)

    @cached_property
    def tables(self) -> tuple[Hdu, ...]:
        """HDUs of a complete FITS file; empty for any other content."""
        return () if self.damage is not None or not self.is_fits else self.whole()

    @cached_property
    def damage(self) -> FormatError | None:
        """Raises FormatError if the content starts like FITS but is damaged, otherwise None."""
        try:
            self.whole()
        except FormatError as error:
            return error if self.is_fits else None
        return None

    @cached_property
    def opened(self) -> fits.HDUList | None:
        """File opened by astropy, for extensions with distortion tables; None if incomplete."""
        if not self.is_fits or any(hdu.state != "whole" for hdu in self.hdus):
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return open_fits(self.raw, self.budget)
            except (FormatError, OSError, ValueError, fits.VerifyError):
                return None


@contextmanager
def readable(where: str) -> Iterator[None]:
    """Turn any exception that a library raises on a damaged file into a FormatError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other programs' cards
            yield
    except BayesdistError:
        raise
    except Exception as error:  # libraries raise all kinds on values that no file should have
        raise FormatError(
            f"is not a header that can be read ({reason_of(error)})",
            where=where,
            do="check the file",
        ) from error


def read_content(path: str | os.PathLike[str]) -> Content:
    """Read and decompress a file; raises the errors of `read_unpacked`.

    The content of a FITS_LDAC catalogue is the headers of its images, without its objects.
    """
    raw, budget = read_unpacked(path)
    content = Content(str(path), raw, Path(path), budget.size)
    with readable(content.name):
        hdus = content.tables
    if hdus:
        warn_of_missing_extensions(hdus[0].header, len(hdus) - 1, content.name)
    if content.is_fits and LDAC_IMAGE.encode() in raw:
        headers = _headers_of_images(content)
        return replace(content, raw=headers) if headers else content
    return content


def _headers_of_images(catalogue: Content) -> bytes:
    """Headers of the images of a FITS_LDAC catalogue, as HDUs without data; empty without any."""
    out = b""
    for hdu in catalogue.hdus:
        if hdu.name != LDAC_IMAGE:
            continue
        with readable(catalogue.name):
            header = ldac_image_header(fits.BinTableHDU.fromstring(hdu.to_bytes()))
        start = "XTENSION= 'IMAGE   '" if out else "SIMPLE  =                    T"
        cards = [card for card in card_images(header) if card[:8] not in _FIRST_CARDS]
        lines = [line.ljust(CARD_LENGTH) for line in (start, *cards, "END")]
        head = "".join(lines).encode("latin-1")
        out += head.ljust(padded(len(head)), b" ")
    return out


def read_hdus(path: str | os.PathLike[str]) -> tuple[Hdu, ...]:
    """Read the HDUs of a complete FITS file; raises the errors of `read_content` and `whole`."""
    return read_content(path).whole()


def fits_bytes(made: Iterable[fits.hdu.base.ExtensionHDU | fits.PrimaryHDU]) -> bytes:
    """Bytes of a FITS file with these astropy HDUs."""
    stream = io.BytesIO()
    fits.HDUList(list(made)).writeto(stream)
    return stream.getvalue()


def hdus_of(made: Iterable[fits.hdu.base.ExtensionHDU | fits.PrimaryHDU]) -> tuple[Hdu, ...]:
    """Convert astropy HDUs to `Hdu`, with the bytes that astropy writes."""
    return Content("new file", fits_bytes(made)).whole()


def write_hdus(hdus: Iterable[Hdu], path: str | os.PathLike[str]) -> None:
    """Write a FITS file atomically; compressed if its name ends in .gz."""
    raw = b"".join(hdu.to_bytes() for hdu in hdus)
    if str(path).endswith(".gz"):
        raw = gzip.compress(raw, mtime=0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(raw)


def _walked(raw: bytes, budget: Budget) -> Iterable[Hdu]:
    """HDUs in the order of the file, with or without data between the headers."""
    number, at, clock = 0, 0, budget.clock()
    while raw[at : at + 9] in HDU_STARTS:
        clock()
        budget.refuse_parts(number + 1, "HDUs")
        cards, after, ended = list[str](), at, False
        while after < len(raw) and not ended:
            card = raw[after : after + 80].decode("latin-1")
            after += 80
            ended = card[:8].rstrip() == "END"
            if not ended:
                cards.append(card.ljust(80))
                budget.refuse_nodes(len(cards), "header cards")
        begin = at + padded(after - at)
        header = header_of(cards)
        size = data_size(header)
        refuse_many_rows(header, budget)
        state, at = "whole", begin + padded(size or 0)
        if size is None or begin + size > len(raw):
            follows = raw[begin : begin + 9] == HDU_STARTS[1]
            alone = len(raw) <= begin and (ended or not number)  # some write a header without END
            state, at = ("none", begin) if follows or alone else ("cut", len(raw))
        yield Hdu(tuple(cards), raw[begin:at], number, state)
        number += 1


@dataclass(frozen=True, eq=False)
class TablePlane:
    """Image extension with the shifts along one axis of one chip, or their standard errors."""

    hdu: Hdu
    name: str  # EXTNAME: DX, DY, SIGMA_DX or SIGMA_DY
    where: str  # name of the extension in error messages

    @cached_property
    def header(self) -> fits.Header:
        """Header of the extension."""
        return self.hdu.header

    def number(self, keyword: str, default: float) -> float:
        """Value of a keyword, `default` if it is missing.

        Raises FormatError if it is not a finite number.
        """
        value = self.header.get(keyword, default)
        a_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not a_number or not np.isfinite(value):
            raise FormatError(
                f"is {value!r}", where=f"{self.where}, keyword {keyword}", do="give a finite number"
            )
        return value

    @property
    def chip(self) -> int:
        """CCDCHIP, or 1 without it, as in stwcs."""
        return int(self.number("CCDCHIP", 1))

    @property
    def version(self) -> int:
        """EXTVER, or 1 without it, as in the FITS standard."""
        return int(self.number("EXTVER", 1))

    @property
    def values(self) -> Float:
        """Values at the nodes including padding, shape (ny, nx)."""
        return self.hdu.image

    @property
    def nodes(self) -> Float:
        """Values at the nodes without padding, shape (ny, nx)."""
        pad = int(self.number("BDPAD", 0))
        return self.values[..., :-pad] if pad > 0 else self.values

    @property
    def missing(self) -> tuple[str, ...]:
        """Registration keywords that are missing from the header."""
        names = ("CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2", "CDELT1", "CDELT2")
        return tuple(name for name in names if name not in self.header)

    @property
    def first(self) -> tuple[float, float]:
        """Pixel (x, y) of the first node, computed as in astropy.wcs."""
        x, y = (
            self.number(f"CRVAL{a}", 0.0) + (1.0 - self.number(f"CRPIX{a}", 0.0)) * step
            for a, step in zip((1, 2), self.step, strict=True)
        )
        return x, y

    @property
    def step(self) -> tuple[float, float]:
        """Pixels between nodes along x and y."""
        return float(self.number("CDELT1", 1.0)), float(self.number("CDELT2", 1.0))

    @property
    def grid(self) -> str:
        """Description of the grid in words."""
        (ny, nx), (x, y), (dx, dy) = self.nodes.shape, self.first, self.step
        return f"{nx} x {ny} nodes from pixel ({x:.10g}, {y:.10g}), {dx:.10g} x {dy:.10g} apart"
