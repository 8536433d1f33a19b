"""A SIP header and a WISE meta-data file in words: what they hold, and what is wrong in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from bayesdist.products.formats.common.coefficients import sip_keyword
from bayesdist.products.formats.common.document import finding_lines
from bayesdist.products.sip import SIP_ORDERS, SipHeader
from bayesdist.products.sip_families import forward_is_used, inverse_is_used
from bayesdist.products.sip_inverse import worst_closure
from bayesdist.products.sip_lint import lint_sip
from bayesdist.products.wise_lint import lint_wise_band
from bayesdist.products.wise_meta import WiseBand

__all__ = ["coefficient_lines", "describe_sip", "describe_wise_meta", "sip_lines"]


def describe_sip(sip: SipHeader, name: str = "SIP header") -> str:
    """Text of a SIP header.

    Parameters
    ----------
    sip : SipHeader
    name : str
        What to call it.

    Returns
    -------
    str
    """
    lines = [*sip_lines(sip, name), *coefficient_lines(sip)]
    return "\n".join([*lines, "", *finding_lines(lint_sip(sip))])


def sip_lines(sip: SipHeader, name: str) -> list[str]:
    """Lines that say what a header states, but for its coefficients."""
    size = "unknown" if sip.size is None else f"{sip.size[0]} x {sip.size[1]} px"
    lines = [
        f"{name}: SIP header, A_ORDER {sip.order[0]}, B_ORDER {sip.order[1]}, image size {size}",
        f"  CTYPE     {sip.ctype[0]}, {sip.ctype[1]}",
        f"  CRPIX     {sip.crpix[0]:.10g}, {sip.crpix[1]:.10g}",
        f"  CRVAL     {sip.crval[0]:.10g}, {sip.crval[1]:.10g} deg",
        f"  scale     {3600 * np.sqrt(abs(np.linalg.det(sip.cd))):.8g} arcsec/px",
        f"  CD        {' '.join(f'{value:.10g}' for value in sip.cd.flat)}",
    ]
    if sip.offset is not None:
        lines.append(f"  offset    {sip.offset[0]:.10g}, {sip.offset[1]:.10g} {sip.unit} at CRVAL")
    for prefix, value in zip("AB", sip.dmax, strict=True):
        if value is not None:
            lines.append(f"  {prefix}_DMAX    {value:.6g} px")
    if sip.inverse_order is not None:
        lines.append(f"  inverse   AP_ORDER {sip.inverse_order[0]}, worst closure {_closure(sip)}")
    return lines


def _closure(sip: SipHeader) -> str:
    """What the header states of AP and BP, and what they leave."""
    stated = "not stated" if sip.closure is None else f"stated {sip.closure:.3g} px"
    if sip.size is None:
        return f"{stated}; not computed, for the image size is not known"
    if not (forward_is_used(sip) and inverse_is_used(sip)):
        return f"{stated}; not computed, for programs ignore orders below {SIP_ORDERS[0]}"
    return f"{stated}, computed {worst_closure(sip, sip.size):.3g} px"


def describe_wise_meta(bands: Iterable[WiseBand], name: str = "WISE meta-data") -> str:
    """Text of a WISE meta-data file: its bands, each with what contradicts what.

    Parameters
    ----------
    bands : iterable of WiseBand
    name : str
        What to call it.

    Returns
    -------
    str
    """
    bands = tuple(bands)
    lines = [f"{name}: WISE meta-data, {', '.join(f'W{one.band}' for one in bands)}"]
    for one in bands:
        sip = one.sip
        lines += ["", f"W{one.band}: {sip.size[0]} x {sip.size[1]} px, A_ORDER {sip.order[0]}, "
                  f"B_ORDER {sip.order[1]}, SKEW {one.skew:g} rad"]  # fmt: skip
        lines += [
            f"  {prefix}_DMAX    {one.printed[f'{prefix}_DMAX']} px"
            for prefix in "AB"
            if f"{prefix}_DMAX" in one.printed
        ]
        if sip.has_inverse:
            lines.append(f"  closure   {worst_closure(sip, sip.size):.2g} px at worst")
        lines += [*coefficient_lines(sip), "", *finding_lines(lint_wise_band(one))]
    return "\n".join(lines)


def coefficient_lines(sip: SipHeader) -> list[str]:
    """Lines of all coefficients, each family after an empty one."""
    lines = []
    for prefix, terms, sigma in (
        ("A", sip.a, sip.sigma_a), ("B", sip.b, sip.sigma_b), ("AP", sip.ap, {}), ("BP", sip.bp, {})
    ):  # fmt: skip
        if terms:
            lines += ["", *_term_lines(prefix, terms, sigma)]
    return lines


def _term_lines(
    prefix: str,
    terms: Mapping[tuple[int, int], float],
    sigma: Mapping[tuple[int, int], float],
) -> list[str]:
    out = []
    for powers in sorted(terms, key=lambda t: (sum(t), -t[0])):
        error = f"  +- {sigma[powers]:.3e}" if powers in sigma else ""
        out.append(f"  {sip_keyword(prefix, *powers):<7} {terms[powers]:21.13e}{error}")
    return out
