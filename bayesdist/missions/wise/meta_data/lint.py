"""Checks of the distortion entries in a WISE meta-data file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator

from bayesdist.formats.sip.header import (
    SipHeader,
    families,
    forward_is_used,
    inverse_is_used,
    offset_ranges,
    powers_of,
)
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.missions.wise.meta_data.implied import (
    StatedMaxima,
    implied_values,
    wrong_coefficient,
)
from bayesdist.missions.wise.meta_data.meta import WiseBand, monomial
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.coefficients import (
    largest_magnitude,
    sip_keyword,
    sip_powers,
)
from bayesdist.products.common.document import Finding

_NUMBER = re.compile(r"([+-]?)([0-9]+)\.([0-9]+)([EeDd][+-]?[0-9]+)")
_MONOMIAL = re.compile(r"coefficient of (\S+)")
# A number farther than this from the implied value is excluded; standard deviations.
_ALLOWED_SIGMAS = 4.0


def lint_wise_band(band: WiseBand) -> tuple[Finding, ...]:
    """Check the distortion entries of one band of a WISE meta-data file.

    Parameters
    ----------
    band : WiseBand
        Entries of one band.

    Returns
    -------
    tuple of Finding
        Findings of `lint_sip`, and findings on the text: missing coefficients, numbers with an
        unusual count of digits, and comments that name a monomial other than that of the keyword.
    """
    # findings on CD would be about its nominal value, which is not in the file
    findings = [f for f in lint_sip(band.sip, explain=wrong_coefficient) if f.where != "CD"]
    return (*findings, *_absent(band.sip), *_digits(band), *_comments(band), *_skew(band))


def _absent(sip: SipHeader) -> Iterator[Finding]:
    for prefix, order, terms in families(sip):
        gone = [sip_keyword(prefix, *k) for k in polynomial_terms(order) if k not in terms]
        if gone:
            yield Finding("warning", ", ".join(gone), "not there, so taken as zero")


def _digits(band: WiseBand) -> Iterator[Finding]:
    """Findings on numbers with a digit too many or too few, and which digit that may be."""
    numbers = {
        k: m for k, v in band.printed.items() if sip_powers(k) and (m := _NUMBER.fullmatch(v))
    }
    counts = {k: len(m[2] + m[3]) for k, m in numbers.items()}
    usual = Counter(counts.values()).most_common(1)[0][0] if counts else 0
    for keyword, count in counts.items():
        if count == usual:
            continue
        message = f"is printed with {count} digits ({band.printed[keyword]}), others with {usual}"
        if count == usual + 1:
            candidates = _without_a_digit(band.sip, keyword, numbers[keyword])
            message += ": one is too many"
            if candidates:
                spread = largest_magnitude(
                    {powers_of(keyword): max(candidates.values()) - min(candidates.values())},
                    *offset_ranges(band.sip, band.sip.size or (1, 1)),
                )
                message += (
                    f"; without one, {', '.join(candidates)} agree with the other numbers"
                    f" (they differ by at most {spread:.1g} px)"
                )
        yield Finding("warning", keyword, message)


def _without_a_digit(sip: SipHeader, keyword: str, number: re.Match[str]) -> dict[str, float]:
    """Numbers with one decimal removed that agree with the closure and the stated maxima."""
    sign, integer, decimals, exponent = number.groups()
    texts = {
        f"{sign}{integer}.{decimals[:k]}{decimals[k + 1 :]}{exponent}" for k in range(len(decimals))
    }
    values = {text: float(text.upper().replace("D", "E")) for text in sorted(texts)}
    if sip.size is None or not (forward_is_used(sip) and inverse_is_used(sip)):
        return values
    [implied] = [
        value_implied for value_implied in implied_values(sip) if value_implied.keyword == keyword
    ]
    near = {
        text: value
        for text, value in values.items()
        if abs(value - implied.value) <= _ALLOWED_SIGMAS * implied.sigma
    }
    maxima = StatedMaxima.of(sip, sip.size)
    prefix = keyword.split("_", maxsplit=1)[0]
    if maxima is None or prefix not in ("A", "B"):
        return near
    return {t: v for t, v in near.items() if maxima.with_value(keyword, v).met(prefix)}


def _comments(band: WiseBand) -> Iterator[Finding]:
    wrong: dict[tuple[str, str], list[str]] = {}
    for keyword, comment in band.comments.items():
        match = _MONOMIAL.search(comment)
        if match is None or sip_powers(keyword) is None:
            continue
        right = monomial(*powers_of(keyword))
        if match[1].lower() != right:
            wrong.setdefault((match[1].lower(), right), []).append(keyword)
    for (said_there, right), keywords in wrong.items():
        yield Finding(
            "note", ", ".join(keywords), f"the comment says {said_there}, the indices say {right}"
        )


def _skew(band: WiseBand) -> Iterator[Finding]:
    if band.skew != 0:
        yield Finding(
            "warning", "SKEW", f"is {band.skew:g} rad, which SIP cannot hold: put it into CD"
        )
