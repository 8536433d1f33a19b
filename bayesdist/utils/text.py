"""Numbers, names and other short texts: significant digits, readable units, allowed characters.

Values that are missing or not a number are shown as a dash (`MISSING`), never as 'NaN'.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError

MISSING = "–"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MINUS = str.maketrans("-", "−")
_LEAST_P = 1e-300  # smaller probabilities are shown as a bound, since doubles soon underflow
NAME_WIDTH = 10  # maximum characters per line in `broken_name`
_MAX_DECIMALS = 10  # beyond this a fixed-point number is harder to read than a power of ten


def _finite(value: Any) -> float | None:
    """Value as a float, or None if missing, masked, text or not finite."""
    if value is np.ma.masked:  # converts to NaN, with a warning
        return None
    try:
        x = float(value)
    except (TypeError, ValueError):
        return None
    return x if math.isfinite(x) else None


def _infinite(value: Any) -> str:
    """Text for a value that is not a finite number; diagnostics can be infinite."""
    if value is np.ma.masked:
        return MISSING
    try:
        return {math.inf: "∞", -math.inf: "−∞"}.get(float(value), MISSING)
    except (TypeError, ValueError):
        return MISSING


def _power_of_ten(x: float, decimals: int, exponent: int) -> str:
    # Decimal is used because 10.0**exponent would underflow for the smallest doubles
    mantissa = f"{Decimal(x).scaleb(-exponent):.{decimals}f}".translate(_MINUS)
    return f"{mantissa}\u202f×\u202f10{str(exponent).translate(_SUPERSCRIPTS)}"


def number(value: Any, digits: int = 3) -> str:
    """Number with `digits` significant digits, with a power of ten if it is very small or large.

    `MISSING` if the value is missing or not a number.
    """
    x = _finite(value)
    if x is None:
        return _infinite(value)
    if x == 0:
        return "0"
    exponent = int(f"{x:.{digits - 1}e}".split("e")[1])  # after rounding, as 9.99 may become 10
    if -4 <= exponent < max(digits, 6):
        return f"{x:.{max(0, digits - 1 - exponent)}f}".translate(_MINUS)
    return _power_of_ten(x, digits - 1, exponent)


def rounded(value: Any, sigma: Any) -> str:
    """Number rounded to the second significant digit of its standard deviation.

    `MISSING` if the value is not a finite number; five digits if sigma is missing or zero.
    """
    x, s = _finite(value), _finite(sigma)
    if x is None:
        return MISSING
    if s is None or s <= 0:
        return number(x, 5)
    last = int(f"{s:.1e}".split("e")[1]) - 1
    exponent = int(f"{max(abs(x), s):.6e}".split("e")[1])
    if -4 <= exponent < 7 and -last <= _MAX_DECIMALS:
        text = f"{round(x, -last):.{max(0, -last)}f}"
        return (text[1:] if float(text) == 0 and text[0] == "-" else text).translate(_MINUS)
    return _power_of_ten(x, max(0, exponent - last), exponent)


def interval(low: Any, high: Any, sigma: Any) -> str:
    """Text 'low to high', with both ends rounded to the second significant digit of `sigma`.

    `MISSING` is returned if an end is not finite.
    """
    if _finite(low) is None or _finite(high) is None:
        return MISSING
    return f"{rounded(low, sigma)} to {rounded(high, sigma)}"


def count(value: Any) -> str:
    """Integer with its digits in groups of three; `MISSING` if the value is not finite."""
    x = _finite(value)
    return MISSING if x is None else f"{round(x):,}".replace(",", "\u202f").translate(_MINUS)


def percent(value: Any, digits: int = 3) -> str:
    """Fraction as a percentage with `digits` significant digits; `MISSING` if it is not finite."""
    x = _finite(value)
    return MISSING if x is None else f"{number(100 * x, digits)}\u202f%"


def probability(p: Any) -> str:
    """p-value such as 'p = 0.02', or an upper bound if it is close to underflow."""
    x = _finite(p)
    if x is not None and 0 <= x < _LEAST_P:
        return f"p < 10{str(round(math.log10(_LEAST_P))).translate(_SUPERSCRIPTS)}"
    return f"p = {number(p, 2)}"


def p_words(p: float, digits: int = 1, least: float = 1e-300) -> str:
    """p-value in ASCII, such as 'p = 0.02'; 'p < least' if it is below `least`.

    `digits` is the number of significant digits.
    """
    return f"p < {least:g}" if p < least else f"p = {p:.{digits}g}"


def broken_name(name: str) -> str:
    """Long parameter name on several lines, broken after its dots."""
    lines = [""]
    for part in name.replace(".", ".\0").split("\0"):
        if lines[-1] and len(lines[-1]) + len(part) > NAME_WIDTH:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def counted(fraction: Any, error: Any, n: Any) -> str:
    """Probability estimated from n draws, as text, rounded to its standard error.

    If all or none of the draws are counted, the text is a bound such as '> 0.9993'.
    """
    p, draws = _finite(fraction), _finite(n)
    if p is None or draws is None or draws <= 0:
        return MISSING
    decimals = max(1, math.ceil(math.log10(draws)))
    lowest = math.ceil(10**decimals / draws) / 10**decimals  # probability of one draw, rounded up
    if p * draws < 0.5:
        return f"< {lowest:.{decimals}f}"
    if (1 - p) * draws < 0.5:
        return f"> {1 - lowest:.{decimals}f}"
    return rounded(p, error)


def probability_words(fraction: Any, error: Any, n: Any) -> str:
    """Probability estimated from n draws, in ASCII: 'P = 0.953 +- 0.004' or 'P > 0.9993'."""
    text = counted(fraction, error, n)
    return f"P {text}" if text[0] in "<>" else f"P = {text} +- {error:.1g}"


# -- lengths and their units ----------------------------------------------------------------------

# units for display, largest first: (factor from the native unit, name)
_LADDERS: dict[str, tuple[tuple[float, str], ...]] = {
    "pix": ((1.0, "pix"), (1e3, "10⁻³ pix"), (1e6, "10⁻⁶ pix")),
    "deg": ((1.0, "deg"), (3.6e3, "arcsec"), (3.6e6, "mas"), (3.6e9, "µas")),
    "arcsec": ((1.0, "arcsec"), (1e3, "mas"), (1e6, "µas")),
    "mas": ((1e-3, "arcsec"), (1.0, "mas"), (1e3, "µas")),
}


@dataclass(frozen=True)
class Scale:
    """Unit for display, and the factor that converts from the native unit."""

    factor: float
    unit: str

    def text(self, value: float, digits: int = 3) -> str:
        """Text of a value, converted from the native unit to this one, with `digits` digits."""
        times = "\u202f×\u202f" if self.unit.startswith("10") else "\u202f"
        return f"{value * self.factor:.{digits}g}{times}{self.unit}".replace("-", "−")


def display_scale(unit: str, values: ArrayLike) -> Scale:
    """Unit in which the largest of the finite values is written with few zeros.

    Parameters
    ----------
    unit : str
        Native unit; a rate such as "pix/yr" is allowed.  Unknown units are kept.
    values : array_like
        Values in the native unit.

    Returns
    -------
    Scale
    """
    base, _, rate = unit.partition("/")
    steps = ladder(base)
    if rate:
        steps = tuple((factor, f"{name}/{rate}") for factor, name in steps)
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size)]
    largest = float(size.max()) if size.size else 0.0
    if largest == 0.0:
        return Scale(*next(step for step in steps if step[0] == 1.0))
    # a thousandth of a pixel has no name, so 0.0266 pix is easier to read than 26.6 × 10⁻³ pix
    readable = 0.000999 if base == "pix" else 0.0999
    for factor, name in steps:
        if largest * factor >= readable:
            return Scale(factor, name)
    return Scale(*steps[-1])


def ladder(unit: str) -> tuple[tuple[float, str], ...]:
    """Display units for lengths in a native unit: (factor, name), largest first."""
    return _LADDERS.get(unit, ((1.0, unit),))


def length_scale(unit: str, like: float) -> Scale:
    """Display unit of lengths as large as `like`: pixels, or an angular unit that avoids zeros."""
    return Scale(1.0, "pix") if unit == "pix" else display_scale(unit, like)


def with_mas(
    value: float,
    unit: str,
    scale_mas: float | None,
    digits: int = 3,
    *,
    like: float | None = None,
) -> str:
    """Length with its unit, followed by its value in mas if the pixel scale is known.

    An example is ``"0.00930 pix (25.6 mas)"``.

    Parameters
    ----------
    value : float
        Length in `unit`; a dash is returned if it is not finite.
    unit : str
        Unit of `value`: 'pix', 'arcsec', 'mas' or 'deg'.
    scale_mas : float or None
        Pixel scale in mas per pixel.
    digits : int
        Significant digits.
    like : float, optional
        Length that determines the display unit (default: `value`), so that lengths shown side by
        side have the same unit.

    Returns
    -------
    str
    """
    if not np.isfinite(value):
        return MISSING
    like = value if like is None else like
    scale = length_scale(unit, like)
    text = f"{number(value * scale.factor, digits)}\u202f{scale.unit}"
    if unit != "pix" or scale_mas is None:
        return text
    return f"{text} ({with_mas(value * scale_mas, 'mas', None, digits, like=like * scale_mas)})"


def size_of(value: float, unit: str = "pix", digits: int = 3) -> str:
    """Text of a length, in a unit in which it has no leading zeros; pixels stay plain numbers.

    `unit` is that of `value`, and `digits` is the number of significant digits.
    """
    if unit == "pix":
        return with_mas(value, unit, None, digits)
    return display_scale(unit, value).text(value, digits)


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
