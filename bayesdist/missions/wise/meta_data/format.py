"""Format of WISE meta-data files: description, checks, and building."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.format import coefficient_lines, headers_read_back
from bayesdist.formats.sip.header import (
    SIP_ORDERS,
    SipHeader,
    families,
    forward_is_used,
    inverse_is_used,
    offset_ranges,
    powers_of,
    worst_closure,
)
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.missions.wise.meta_data.implied import (
    StatedMaxima,
    implied_values,
    wrong_coefficient,
)
from bayesdist.missions.wise.meta_data.meta import (
    ARRAYS,
    WiseBand,
    bands_of,
    holds_wise_meta,
    monomial,
    wise_calibration,
    wise_text,
)
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.coefficients import (
    largest_magnitude,
    sip_keyword,
    sip_powers,
)
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Finding,
    Format,
    FormatSettings,
    ReadBack,
    finding_lines,
)

Bands = tuple[WiseBand, ...]


class MetaDataSettings(FormatSettings):
    """Configuration of the entries of the band that the detector is named after."""

    def check(
        self,
        detector: str,
        size: tuple[float, float] | None,
        reference_pixel: tuple[float, float] | None,
    ) -> None:
        """Raise ValueError unless the chip is a full array with its middle as reference pixel."""
        band = _band(detector)
        if band is None:
            raise ValueError(
                "products.wise_meta needs a run of WISE W1, W2, W3 or W4, but detector.name is "
                f"{detector!r}; name the band there, or leave out wise_meta"
            )
        side, _ = ARRAYS[band]
        if size != (side, side) or reference_pixel not in (None, ((side + 1) / 2,) * 2):
            raise ValueError(
                f"products.wise_meta describes the whole array of W{band}, {side} x {side} pixels "
                f"about {(side + 1) / 2:g}, {(side + 1) / 2:g}; correct detector.size and "
                "model.reference_pixel, or leave out wise_meta"
            )


def _band(detector: str) -> int | None:
    """Number of the band that a detector is named after; None for other names."""
    return next((band for band in ARRAYS if detector == f"W{band}"), None)


def _parse(content: Content) -> tuple[str, Bands] | None:
    return (content.name, bands_of(content)) if holds_wise_meta(content) else None


def _describe(named: tuple[str, Bands]) -> list[str]:
    """Lines of text on the bands, each with its findings."""
    name, bands = named
    lines = [f"{name}: WISE meta-data, {', '.join(f'W{band.band}' for band in bands)}"]
    for band in bands:
        sip, (side, _) = band.sip, ARRAYS[band.band]
        size = sip.size or (side, side)
        lines += ["", f"W{band.band}: {size[0]} x {size[1]} px, A_ORDER {sip.order[0]}, "
                  f"B_ORDER {sip.order[1]}, SKEW {band.skew:g} rad"]  # fmt: skip
        lines += [
            f"  {prefix}_DMAX    {band.printed[f'{prefix}_DMAX']} px"
            for prefix in "AB"
            if f"{prefix}_DMAX" in band.printed
        ]
        if sip.has_inverse:
            lines.append(f"  closure   {worst_closure(sip, size):.2g} px at worst")
        lines += [*coefficient_lines(sip), "", *finding_lines(lint_wise_band(band))]
    return lines


def _lint(named: tuple[str, Bands]) -> list[Finding]:
    return [finding for band in named[1] for finding in lint_wise_band(band)]


def _read_back(
    files: Sequence[Built], calibration: Calibration, options: BuildOptions
) -> list[ReadBack]:
    """Positions from the entries, with the CD and zero point of the original header."""
    out = []
    for built in files:
        [band] = bands_of(Content(built.file_name, built.content))
        headers = {calibration.numbers[0]: band.sip}
        out.append(
            headers_read_back(built.file_name, headers, calibration, options, like=built.made)
        )
    return out


def _build(
    calibration: Calibration, _: MetaDataSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build entries in WISE's form: linear terms in A and B, and an inverse of the same order."""
    band = _band(calibration.detector)
    if band is None:
        raise InputError(
            f"the detector is {calibration.detector!r}, not a band of WISE",
            where="products.wise_meta",
            do="give a run whose detector.name is the band (W1, W2, W3, W4), or a file of WISE",
        )
    sip = sip_from_solution(
        replace(calibration, plane=Plane("free")),  # the entries cannot state a sky position
        epoch=options.epoch,
        inverse_order=max(calibration.model.order, SIP_ORDERS[0]),
        linear="sip",
        scale_arcsec=options.scale_arcsec,
    )
    name, content = f"w{band}.meta", wise_text({band: sip}).encode("ascii")
    [written] = bands_of(Content(name, content))  # the summary describes the rounded numbers
    summary = {
        "closure_pix": written.sip.closure,
        "a_dmax": written.sip.a_dmax,
        "b_dmax": written.sip.b_dmax,
    }
    return (Built(name, "WISE meta-data", content, sip, None, summary),)


# -- checks ---------------------------------------------------------------------------------------


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
            "warning", "SKEW", f"is {band.skew:g} rad, which SIP cannot represent: include it in CD"
        )


FORMAT = Format(
    "wise_meta",
    "WISE meta-data",
    5,
    _parse,
    _describe,
    _lint,
    lambda named, name, choice: wise_calibration(named[1], name, choice.filter),
    MetaDataSettings,
    _build,
    _read_back,
    highest_order=SIP_ORDERS[1],
    asks=("filter",),
)
