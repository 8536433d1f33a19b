"""Names and other short texts: allowed characters, and conversion to ASCII."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

from bayesdist.errors import InputError

_LETTER = re.compile(r"(LATIN|GREEK) (SMALL|CAPITAL) LETTER (\w+)( WITH .*)?")
_NUMBER = re.compile(
    r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|nan|inf|infinity)", re.IGNORECASE | re.ASCII
)
_PRINTABLE = re.compile(r"[ -~]*")
# control characters and the separators of lines and paragraphs
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def ascii_of(text: str) -> str:
    """Text converted to printable ASCII, which FITS headers require.

    Accents are dropped, Greek letters are spelled out, dashes become "-"; compatibility characters
    are replaced ("²" by "2"), and any other character, including control characters, becomes "?".

    Parameters
    ----------
    text : str
        Text with any characters.

    Returns
    -------
    str

    Examples
    --------
    >>> ascii_of("Détecteur, σ of Gaia")
    'Detecteur, sigma of Gaia'
    """
    if _PRINTABLE.fullmatch(text):
        return text
    whole = unicodedata.normalize("NFKC", text)
    return "".join(c if _PRINTABLE.fullmatch(c) else _substitute(c) for c in whole)


def _substitute(character: str) -> str:
    """Printable ASCII for one character."""
    if unicodedata.category(character) == "Pd":
        return "-"
    if unicodedata.combining(character):
        return ""
    letter = _LETTER.fullmatch(unicodedata.name(character, ""))
    if letter is None:
        return "?"
    script, case, name, _ = letter.groups()
    if script == "LATIN":
        name = name if len(name) <= 2 else "?"  # as AE; others have names, as ETH
    return name.lower() if case == "SMALL" else name if script == "LATIN" else name.capitalize()


def number_of(text: str) -> float:
    """Number written in a text as ASCII decimals, "nan", "inf" or "infinity".

    Blanks around the number are allowed.  Raises ValueError for any other text, including "1_00",
    digits of other scripts (both accepted by Python's `float`) and "0x64" (accepted by C), which no
    table format allows.
    """
    plain = text.strip(" \t\r\n")
    if _NUMBER.fullmatch(plain) is None:
        raise ValueError(f"{text[:40]!r} is not a number")
    return float(plain)


def refuse_control_characters(texts: Iterable[str], where: str) -> None:
    """Raise InputError if a name contains a control character, such as a line end, a tab or NUL.

    Names are written on one line in tables, headers and reports, and netCDF files end them at NUL.
    `texts` are the names, and `where` is the location for the error message.
    """
    for text in texts:
        found = _CONTROLS.search(text)
        if found is not None:
            start = text if len(text) <= 40 else f"{text[:40]}..."
            raise InputError(
                f"{start!r} holds the control character U+{ord(found[0]):04X}",
                where=where,
                do="write it in letters, digits and blanks on one line",
            )
