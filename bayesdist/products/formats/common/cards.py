"""FITS header cards as they stand in a file: 80 characters each, with numbers in full precision."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from textwrap import wrap

from astropy.io import fits

from bayesdist.errors import FormatError
from bayesdist.infer.solution import Solution

_UNPRINTABLE = re.compile(r"[^ -~]")  # a header has printable ASCII alone
# Without one of these nothing ties pixels to a world.
_NEEDED = re.compile(r"(CTYPE|CRVAL)\d+[A-Z]?$|A_ORDER$|(T?CTYP|TCTY|TCRVL|TCRV)\d+[A-Z]?$")


def number_card(keyword: str, value: float | int, comment: str = "") -> str:
    """Card of a number that reads back as the same number.

    astropy cuts numbers to 20 characters, which costs small coefficients three digits; the standard
    (FITS 4.0, section 4.2) allows free format.
    """
    number = repr(int(value)) if isinstance(value, int) else repr(float(value)).upper()
    return f"{keyword:<8}= {number:>20}{' / ' + comment if comment else ''}"[:80].ljust(80)


def printable(text: str) -> str:
    """Text with ? for characters that no header has."""
    return _UNPRINTABLE.sub("?", text)


def text_card(keyword: str, value: str, comment: str = "") -> str:
    """Card of a string, or of a COMMENT or HISTORY, with ? for characters that no header has."""
    value = printable(value)
    if keyword in ("COMMENT", "HISTORY"):
        return f"{keyword:<8}{value}"[:80].ljust(80)
    return fits.Card(keyword, value, comment).image


def wrapped_cards(keyword: str, lines: Iterable[str], width: int = 70) -> list[str]:
    """Cards of a COMMENT or HISTORY, as many as each line takes; an empty line is one card."""
    return [text_card(keyword, part) for line in lines for part in wrap(line, width) or [""]]


def convergence_cards(solution: Solution) -> list[str]:
    """Cards that tell if the posterior behind a product has converged; none for a linear fit."""
    convergence = solution.convergence
    if convergence is None:
        return []
    approximation = solution.approximation
    notes = wrapped_cards("COMMENT", [approximation] if approximation else [])
    if convergence.converged:
        return [text_card("BDCONV", "YES", "has the sampler converged?"), *notes]
    return [
        *notes,
        text_card("BDCONV", "NO", "has the sampler converged?"),
        text_card("COMMENT", "NOT CONVERGED: provisional, not to be released."),
    ]


def keyword_of(card: str) -> str:
    """Keyword of a card."""
    return card[:8].rstrip()


def named_in(header: fits.Header, keyword: str, where: str) -> str:
    """Name that a keyword of a file gives, empty where it is missing; FormatError if it is none."""
    value = header.get(keyword, "")
    if isinstance(value, float) and not math.isfinite(value):
        raise FormatError(f"is {value}", where=f"{where}, keyword {keyword}", do="give a name")
    return str(value).strip()


def header_of(cards: Iterable[str]) -> fits.Header:
    """Header of these cards."""
    return fits.Header.fromstring("".join(cards))


def card_images(header: fits.Header) -> tuple[str, ...]:
    """Cards of a header, verbatim; a long string takes several."""
    text = header.tostring(sep="", endcard=False, padding=False)
    return tuple(text[k : k + 80] for k in range(0, len(text), 80))


def holds_wcs(header: fits.Header) -> bool:
    """True where a header ties its pixels to a world."""
    return any(_NEEDED.match(keyword) for keyword in header)
