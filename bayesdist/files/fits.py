"""FITS files in memory, after checking that they contain the data that their headers announce."""

from __future__ import annotations

import io
import logging
import re
import warnings

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError
from bayesdist.files.budget import Budget

log = logging.getLogger("bayesdist")

FITS_START = b"SIMPLE  ="
HDU_STARTS = (FITS_START, b"XTENSION=")
RECORD = 2880  # bytes
CARD_LENGTH = 80  # characters of a FITS card
LDAC_IMAGE = "LDAC_IMHEAD"  # extension of a FITS_LDAC catalogue with the header of an image


def open_fits(raw: bytes, budget: Budget) -> fits.HDUList:
    """HDUs of a FITS file as astropy objects, with their data in memory.

    Raises FormatError if the file is truncated, its headers are inconsistent, or it exceeds its
    limits.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # caused by cards of other programs
        _refuse_unfounded(raw, budget)
    # from memory, because astropy would leave a file open after a failure; compressed images
    # remain tables, so that their tiles are not decompressed
    return fits.open(
        io.BytesIO(raw), memmap=False, lazy_load_hdus=False, disable_image_compression=True
    )


def _refuse_unfounded(raw: bytes, budget: Budget) -> None:
    """Refuse a file that ends before the data that its headers announce."""
    at, number, file_name, clock, tables = 0, 0, budget.where, budget.clock(), 0
    while raw[at : at + 9] in HDU_STARTS:
        end = raw.find(b"END" + 77 * b" ", at)
        while end >= 0 and (end - at) % 80:
            end = raw.find(b"END" + 77 * b" ", end + 1)
        if end < 0:
            raise FormatError(
                f"ends within the header of HDU {number}",
                where=file_name,
                do="it is truncated: fetch or write it again",
            )
        begin = at + padded(end + 80 - at)
        budget.refuse_nodes((end - at) // 80, "header cards")
        header = fits.Header.fromstring(raw[at:end].decode("latin-1"))
        size = data_size(header)
        if size is None or begin + size > len(raw):
            announced = "a size that is none" if size is None else f"{size} bytes"
            raise FormatError(
                f"the header of HDU {number} announces {announced}, but {max(0, len(raw) - begin)} "
                "bytes follow",
                where=file_name,
                do="it is truncated or damaged: fetch or write it again",
            )
        refuse_many_rows(header, budget)
        tables += size if _is_table(header) else 0
        budget.refuse_content(tables)
        at, number = begin + padded(size), number + 1
        budget.refuse_parts(number, "HDUs")
        clock()
    if number:
        refuse_rest(raw, at, budget)


def refuse_rest(raw: bytes, end: int, budget: Budget) -> None:
    """Raise FormatError if a file does not end where its last HDU does.

    `end`: size in bytes of the HDUs, each in whole records (FITS 4.0, section 3.1). Zeros, blanks
    and line ends after the last HDU are accepted: tapes and transfers add them.
    """
    if len(raw) < end:
        raise FormatError(
            f"has {len(raw)} bytes, but its HDUs take up {end}",
            where=budget.where,
            do="it is truncated: fetch or write it again",
        )
    rest = len(raw[end:].rstrip(b"\0 \r\n"))
    if rest:
        raise FormatError(
            f"has {rest} bytes after its last HDU that are not part of any HDU, so further HDUs "
            "may be damaged or missing",
            where=budget.where,
            do="fetch or write it again",
        )


MISSING_EXTENSIONS = "missing extensions"  # key of the warning in the header of a table


def warn_of_missing_extensions(header: fits.Header, n: int, where: str) -> str:
    """Log a warning if a FITS file has fewer extensions than its primary header states.

    A file that was cut exactly between two HDUs is valid. `header` is that of the primary HDU, with
    the number of extensions in NEXTEND as in files of the HST; `n` extensions follow. Returns the
    warning as a clause without the name of the file, or an empty string.
    """
    try:
        stated = header.get("NEXTEND", 0)
    except (ValueError, fits.VerifyError):
        return ""  # the card has no value
    if not isinstance(stated, int) or stated <= n:
        return ""
    clause = (
        f"its primary header states {stated} extensions (NEXTEND), and the file has {n}: the "
        "others are missing, or the file is truncated; fetch the whole file, or correct or remove "
        "NEXTEND"
    )
    log.warning("%s: %s", where, clause)
    return clause


def refuse_many_rows(header: fits.Header, budget: Budget) -> None:
    """Raise FormatError for a table with too many rows, which may have a width of zero bytes."""
    rows = header.get("NAXIS2", 0)
    if _is_table(header) and isinstance(rows, int):
        budget.refuse_rows(rows)


def _is_table(header: fits.Header) -> bool:
    return header.get("XTENSION", "") in ("TABLE", "BINTABLE")


def refuse_long_arrays(hdu: fits.BinTableHDU, budget: Budget) -> None:
    """Raise FormatError for columns of variable-length arrays that together exceed the limits.

    Each row points to its array in the heap, and all rows may point to the same one.
    """
    total = 0.0
    for name, form in zip(hdu.columns.names, hdu.columns.formats, strict=True):
        kind = re.match(r"\d*[PQ]([A-Z])", str(form))
        if kind is not None and hdu.data is not None:
            lengths = np.asarray(hdu.data.view(np.ndarray)[name]).reshape(-1, 2)[:, 0]
            total += float(lengths.astype(float).sum()) * _ARRAY_BYTES.get(kind[1], 8)
    budget.refuse_content(total)


_ARRAY_BYTES = {"L": 1, "X": 1, "B": 1, "A": 1, "I": 2, "J": 4, "E": 4, "M": 16}


MOST = 999  # axes, and columns of a table (FITS 4.0, sections 4.4.1 and 7.3.1)


def data_size(header: fits.Header) -> int | None:
    """Size in bytes of the data of a header (FITS 4.0, section 4.4.1); None if it is invalid."""
    try:
        axes = header.get("NAXIS", 0)
        if max(axes, header.get("TFIELDS", 0)) > MOST:
            return None
        sides = [header[f"NAXIS{k + 1}"] for k in range(axes)]
        bits, groups, parameters = (
            header["BITPIX"],
            header.get("GCOUNT", 1),
            header.get("PCOUNT", 0),
        )
    except KeyError:
        return 0  # without the mandatory cards of an HDU
    except (TypeError, ValueError, OverflowError, fits.VerifyError):
        return None
    if not all(
        isinstance(number_in_header, int) for number_in_header in (*sides, bits, groups, parameters)
    ):
        return None
    if axes < 0 or min([*sides, groups, parameters, 0]) < 0:
        return None
    if header.get("GROUPS") is True and sides and sides[0] == 0:
        sides = sides[1:]  # random groups
    n = 1 if sides else 0
    for side in sides:
        n *= side
    return abs(bits) // 8 * groups * (parameters + n)


def padded(n: int) -> int:
    """Size in bytes, rounded up to complete records."""
    return -(-n // RECORD) * RECORD


def ldac_image_header(hdu: fits.BinTableHDU) -> fits.Header:
    """Image header stored as text in an LDAC_IMHEAD, either one string or one per card.

    Strings of a FITS table lose trailing blanks when they are read, so they are padded to complete
    cards.
    """
    if hdu.data is None or not len(hdu.data):
        return fits.Header()
    texts = [str(text) for text in np.ravel(hdu.data.field(0))]
    filled = (text.ljust(-len(text) % CARD_LENGTH + len(text)) for text in texts)
    return fits.Header.fromstring("".join(filled))
