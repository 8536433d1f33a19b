"""FITS header cards of 80 characters, with numbers in full precision."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from textwrap import wrap

from astropy.io import fits

from bayesdist.errors import FormatError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import LookupTable
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of

LONGEST_KEYWORD = 8  # characters; longer keywords need ESO's HIERARCH convention
_UNPRINTABLE = re.compile(r"[^ -~]")
# Without one of these keywords, a header does not relate pixels to world coordinates.
_NEEDED = re.compile(r"(CTYPE|CRVAL)\d+[A-Z]?$|A_ORDER$|(T?CTYP|TCTY|TCRVL|TCRV)\d+[A-Z]?$")


def number_card(keyword: str, value: float | int, comment: str = "") -> str:
    """Card with a number that reads back as exactly the same number.

    astropy truncates numbers to 20 characters, which loses three digits of small coefficients. The
    standard (FITS 4.0, section 4.2) allows free format.
    """
    number = repr(int(value)) if isinstance(value, int) else repr(float(value)).upper()
    return f"{keyword:<8}= {number:>20}{' / ' + comment if comment else ''}"[:80].ljust(80)


def ascii_card(card: str) -> str:
    """Replace characters of a card that are not allowed in a header by ?; the length is kept."""
    return _UNPRINTABLE.sub("?", card)


def text_card(keyword: str, value: str, comment: str = "") -> str:
    """Card of a string, or of COMMENT or HISTORY, converted to ASCII by `ascii_of`."""
    value = ascii_of(value)
    if keyword in ("COMMENT", "HISTORY"):
        return f"{keyword:<8}{value}"[:80].ljust(80)
    return fits.Card(keyword, value, comment).image


def wrapped_cards(keyword: str, lines: Iterable[str], width: int = 70) -> list[str]:
    """Wrap lines to `width` characters and return COMMENT or HISTORY cards.

    An empty line gives one empty card.
    """
    return [text_card(keyword, part) for line in lines for part in wrap(line, width) or [""]]


def convergence_cards(solution: Solution) -> list[str]:
    """Cards that state if the posterior of a product has converged; empty for a linear fit."""
    convergence = solution.convergence
    if convergence is None:
        return []
    if convergence.converged:
        return [text_card("BDCONV", "YES", "has the sampler converged?")]
    return [
        text_card("BDCONV", "NO", "has the sampler converged?"),
        text_card("COMMENT", "NOT CONVERGED: provisional, not to be released."),
    ]


def tangent_cards(
    ctype: tuple[str, str],
    crval: tuple[float, float],
    crpix: tuple[float, float],
    cd: Float,
    comment: str = "",
) -> list[str]:
    """Cards of the WCS of a tangent plane in degrees; `comment` explains the CTYPE.

    `crval` is in degrees, `crpix` in FITS 1-based pixels, and `cd` (2, 2) in degrees per pixel.
    """
    return [
        number_card("WCSAXES", 2),
        text_card("CTYPE1", ctype[0], comment),
        text_card("CTYPE2", ctype[1]),
        text_card("CUNIT1", "deg"),
        text_card("CUNIT2", "deg"),
        text_card("RADESYS", "ICRS"),
        *(number_card(f"CRVAL{k}", float(v), "[deg]") for k, v in enumerate(crval, 1)),
        *(number_card(f"CRPIX{k}", float(v), "[pix]") for k, v in enumerate(crpix, 1)),
        *(
            number_card(f"CD{i + 1}_{j + 1}", float(cd[i, j]), "[deg/pix]")
            for i in (0, 1)
            for j in (0, 1)
        ),
        number_card("LONPOLE", 180.0, "[deg] north is up also at a pole"),
    ]


def solution_cards(
    plane: str,
    unit: str,
    arcsec: float,
    chip: int,
    size: tuple[float, float],
    epoch: float | None = None,
) -> list[str]:
    """Cards on plane, unit, chip, date and size, which a header in degrees does not state.

    `arcsec` is the size of the unit of u and v in arcsec, and `epoch` a decimal year.
    """
    dated = [] if epoch is None else [("BDEPOCH", float(epoch), "[yr] date of the coefficients")]
    return [
        text_card("BDPLANE", plane, "plane of u, v"),
        text_card("BDUNIT", unit, "unit of u, v in the solution"),
        number_card("BDARCS", float(arcsec), "[arcsec] in one of these units"),
        number_card("BDCHIP", chip, "chip number"),
        *(number_card(*card) for card in dated),
        number_card("IMAGEW", int(size[0]), "[pix] columns of the detector"),
        number_card("IMAGEH", int(size[1]), "[pix] rows of the detector"),
    ]


def node_cards(table: LookupTable) -> list[str]:
    """Cards of the linear relation between table nodes and detector pixels."""
    return [
        number_card(f"{keyword}{axis + 1}", float(value), comment)
        for axis in (0, 1)
        for keyword, value, comment in (
            ("CRPIX", 1.0, "node, from 1"),
            ("CRVAL", table.first[axis], "[pixel] of that node, from 1"),
            ("CDELT", table.step[axis], "[pixel] between nodes"),
        )
    ]


def set_text(header: fits.Header, keyword: str, value: str, comment: str = "") -> None:
    """Set a keyword to a string, converted to ASCII by `ascii_of`.

    All text must be written to headers by this function or `text_card`, because astropy rejects
    non-ASCII characters.
    """
    set_value(header, keyword, ascii_of(value), comment)


def set_value(
    header: fits.Header, keyword: str, value: str | float | bool, comment: str = ""
) -> None:
    """Set a keyword; a new one is appended at the end of the header.

    astropy itself inserts new keywords before the comments, which takes longer the more cards there
    are.
    """
    if keyword in header:
        header[keyword] = value, comment
        return
    name = keyword if len(keyword) <= LONGEST_KEYWORD else f"HIERARCH {keyword}"
    header.append(fits.Card(name, value, comment), end=True)


def append_cards(hdu: fits.hdu.base._BaseHDU, cards: Iterable[str]) -> None:
    """Append cards to a header; numbers keep all their digits."""
    for card in cards:
        hdu.header.append(fits.Card.fromstring(card), end=True)


def keyword_of(card: str) -> str:
    """Keyword of a card."""
    return card[:8].rstrip()


def named_in(header: fits.Header, keyword: str, where: str) -> str:
    """Text value of a keyword; empty if the keyword is missing.

    Raises FormatError if the value is NaN or infinite; `where` is the file, for the message.
    """
    value = header.get(keyword, "")
    if isinstance(value, float) and not math.isfinite(value):
        raise FormatError(f"is {value}", where=f"{where}, keyword {keyword}", do="give a name")
    return str(value).strip()


def header_of(cards: Iterable[str]) -> fits.Header:
    """FITS header that consists of the given cards."""
    return fits.Header.fromstring("".join(cards))


def card_images(header: fits.Header) -> tuple[str, ...]:
    """Cards of a header, verbatim; a long string spans several cards."""
    text = header.tostring(sep="", endcard=False, padding=False)
    return tuple(text[k : k + 80] for k in range(0, len(text), 80))


def holds_wcs(header: fits.Header) -> bool:
    """True if a header relates its pixels to world coordinates."""
    return any(_NEEDED.match(keyword) for keyword in header)
