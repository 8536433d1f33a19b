"""Numbers as a reader wants them: as many digits as they deserve, and never 'NaN'."""

from __future__ import annotations

import math
from decimal import Decimal
from typing import Any

import numpy as np

__all__ = [
    "MISSING",
    "broken_name",
    "count",
    "interval",
    "number",
    "percent",
    "probability",
    "rounded",
]

MISSING = "–"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MINUS = str.maketrans("-", "−")
_LEAST_P = 1e-300  # tails of distributions underflow not far below
_MAX_DECIMALS = 10  # beyond this a fixed-point number is harder to read than a power of ten


def _finite(value: Any) -> float | None:
    """The value as a float, or None for what is missing, masked, text or not finite."""
    if value is np.ma.masked:  # converts to NaN, with a warning
        return None
    try:
        x = float(value)
    except (TypeError, ValueError):
        return None
    return x if math.isfinite(x) else None


def _infinite(value: Any) -> str:
    """What stands for a value that is no finite number: a diagnostic may well be infinite."""
    if value is np.ma.masked:
        return MISSING
    try:
        return {math.inf: "∞", -math.inf: "−∞"}.get(float(value), MISSING)
    except (TypeError, ValueError):
        return MISSING


def _power_of_ten(x: float, decimals: int, exponent: int) -> str:
    # decimal, as 10.0**exponent would underflow for the smallest doubles
    mantissa = f"{Decimal(x).scaleb(-exponent):.{decimals}f}".translate(_MINUS)
    return f"{mantissa}\u202f×\u202f10{str(exponent).translate(_SUPERSCRIPTS)}"


def number(value: Any, digits: int = 3) -> str:
    """A number to some significant digits; powers of ten where it is very small or large.

    Parameters
    ----------
    value : float or anything
    digits : int

    Returns
    -------
    str
        `MISSING` for what is no number.
    """
    x = _finite(value)
    if x is None:
        return _infinite(value)
    if x == 0:
        return "0"
    exponent = int(f"{x:.{digits - 1}e}".split("e")[1])  # after rounding: 9.99 may become 10
    if -4 <= exponent < max(digits, 6):
        return f"{x:.{max(0, digits - 1 - exponent)}f}".translate(_MINUS)
    return _power_of_ten(x, digits - 1, exponent)


def rounded(value: Any, sigma: Any) -> str:
    """A number to the second significant digit of its standard deviation.

    Parameters
    ----------
    value, sigma : float or anything

    Returns
    -------
    str
        `MISSING` for what is not a finite number; five digits where sigma is none or zero.
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
    """An interval, each end to the second digit of a standard deviation."""
    if _finite(low) is None or _finite(high) is None:
        return MISSING
    return f"{rounded(low, sigma)} to {rounded(high, sigma)}"


def count(value: Any) -> str:
    """A whole number with its digits in groups of three."""
    x = _finite(value)
    return MISSING if x is None else f"{round(x):,}".replace(",", "\u202f").translate(_MINUS)


def percent(value: Any, digits: int = 3) -> str:
    """A fraction in percent."""
    x = _finite(value)
    return MISSING if x is None else f"{number(100 * x, digits)}\u202f%"


def probability(p: Any) -> str:
    """A probability of chance with its sign; below what a double tells from zero, a bound."""
    x = _finite(p)
    if x is not None and 0 <= x < _LEAST_P:
        return f"p < 10{str(round(math.log10(_LEAST_P))).translate(_SUPERSCRIPTS)}"
    return f"p = {number(p, 2)}"


def broken_name(name: str, width: int = 10) -> str:
    """A long name of a parameter on several lines, broken after its points."""
    lines = [""]
    for part in name.replace(".", ".\0").split("\0"):
        if lines[-1] and len(lines[-1]) + len(part) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)
