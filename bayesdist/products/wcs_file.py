"""The headers of a file with a world coordinate system: of a FITS file, whole or not, or of cards.

Headers are often kept without their data, one after the other or alone, and astropy.io.fits takes
them for damaged files.  Here a file is gone through by what its headers say of it.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from dataclasses import dataclass

from astropy.io import fits

from bayesdist.products.blocks import content_of

__all__ = ["HeaderFile", "HeaderHdu", "header_file", "holds_wcs", "wcs_cards"]

_RECORD = 2880
_WCS = re.compile(
    r"(CTYPE|CRVAL|CRPIX|CDELT|CUNIT|CROTA|LTV)\d+[A-Z]?$|(CD|PC|PV|PS|LTM)\d+_\d+[A-Z]?$|"
    r"(A|B|AP|BP)_(ORDER|\d_\d)$|(CPDIS|CPERR|D2IMDIS|D2IMERR)\d$|(DP|DQ|D2IM)\d$|(LON|LAT)POLE"
)
# Without one of these nothing ties pixels to a world.
_NEEDED = re.compile(r"(CTYPE|CRVAL)\d+[A-Z]?$|A_ORDER$|(T?CTYP|TCTY|TCRVL|TCRV)\d+[A-Z]?$")


@dataclass(frozen=True, eq=False)
class HeaderHdu:
    """One header of a file.

    Parameters
    ----------
    number : int
        Of the HDU, the first one 0.
    header : astropy.io.fits.Header
    data : str
        'whole', 'none' where there are no data though the header says some, or 'cut'.
    """

    number: int
    header: fits.Header
    data: str = "whole"

    @property
    def name(self) -> str:
        """EXTNAME with EXTVER, as 'SCI,1'; empty where there is none."""
        name = str(self.header.get("EXTNAME", "")).strip()
        return f"{name},{self.header.get('EXTVER', 1)}" if name else ""


@dataclass(frozen=True, eq=False)
class HeaderFile:
    """All headers of a file.

    Parameters
    ----------
    name : str
    hdus : tuple of HeaderHdu
    opened : astropy.io.fits.HDUList or None
        The whole file, whose extensions hold the tables of a distortion; None of headers alone.
    """

    name: str
    hdus: tuple[HeaderHdu, ...]
    opened: fits.HDUList | None = None


def header_file(path: str | os.PathLike[str]) -> HeaderFile:
    """Headers of a FITS file, or of a text file of cards, as far as they can be read.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    HeaderFile
        Without headers where it is neither.

    Raises
    ------
    InputError
        When the file cannot be read.
    """
    raw, name = content_of(path), str(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of cards that are not ours to judge
        if b"\n" in raw[:81] or raw[:10] not in (b"SIMPLE  = ", b"XTENSION= "):
            return HeaderFile(name, _of_text(raw))
        hdus = _of_fits(raw)
        opened = None
        if all(hdu.data == "whole" for hdu in hdus):
            try:
                opened = fits.open(io.BytesIO(raw), memmap=False, lazy_load_hdus=False)
            except (OSError, ValueError, fits.VerifyError):
                opened = None
    return HeaderFile(name, hdus, opened)


def _of_text(raw: bytes) -> tuple[HeaderHdu, ...]:
    """Cards, one a line or 80 characters each, without the start of a FITS file."""
    text = raw.decode("latin-1").replace("\r\n", "\n")
    if not re.match(r"[A-Z0-9_-]{1,8} *=|(COMMENT|HISTORY| {8})", text):
        return ()
    header = fits.Header.fromstring(text, sep="\n" if "\n" in text.strip() else "")
    return (HeaderHdu(0, header, "whole" if "NAXIS" not in header else "none"),)


def _of_fits(raw: bytes) -> tuple[HeaderHdu, ...]:
    """Headers one after the other, with their data between them or not."""
    out, at = list[HeaderHdu](), 0
    while raw[at : at + 10] in (b"SIMPLE  = ", b"XTENSION= "):
        cards, after = list[str](), at
        while after < len(raw):
            card = raw[after : after + 80].decode("latin-1")
            after += 80
            if card[:8].rstrip() == "END":
                break
            cards.append(card.ljust(80))
        header = fits.Header.fromstring("".join(cards))
        begin = at + -(-(after - at) // _RECORD) * _RECORD
        size = _data_size(header)
        end = begin + -(-size // _RECORD) * _RECORD
        data, at = "whole", end
        if begin + size > len(raw):
            follows = raw[begin : begin + 10] == b"XTENSION= "
            data, at = ("none", begin) if follows or len(raw) <= begin else ("cut", len(raw))
        out.append(HeaderHdu(len(out), header, data))
    return tuple(out)


def _data_size(header: fits.Header) -> int:
    """Bytes of data that a header announces (FITS 4.0, section 4.4.1)."""
    try:
        sides = [int(header[f"NAXIS{k + 1}"]) for k in range(int(header.get("NAXIS", 0)))]
        bits, groups = abs(int(header["BITPIX"])), int(header.get("GCOUNT", 1))
        more = int(header.get("PCOUNT", 0))
    except (KeyError, TypeError, ValueError, fits.VerifyError):
        return 0
    n = 1 if sides else 0
    for side in sides:
        n *= side
    return bits // 8 * groups * (more + n)


def holds_wcs(header: fits.Header) -> bool:
    """Whether a header ties its pixels to a world."""
    return any(_NEEDED.match(keyword) for keyword in header)


def wcs_cards(header: fits.Header) -> tuple[tuple[str, str], ...]:
    """What of a header its positions depend on: of two with the same, one is enough to show."""
    found = {(c.keyword, str(c.value)) for c in header.cards if _WCS.match(c.keyword)}
    return tuple(sorted(found))
