"""Functions that several checks of a SIP header use: coefficients by family, and detector."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from typing import Any

from bayesdist.products.formats.common.coefficients import radial_orders, sip_keyword
from bayesdist.products.formats.common.document import repeated_values
from bayesdist.products.formats.sip.header import SIP_ORDERS, SipHeader

# How far the edge of a pixel lies from its centre: some take the maximum to there.
EDGE = 0.5


def forward_is_used(sip: SipHeader) -> bool:
    """True where programs apply A and B: they ignore orders below 2."""
    return min(sip.order) >= SIP_ORDERS[0]


def inverse_is_used(sip: SipHeader) -> bool:
    """True where AP and BP are there and of an order that is not ignored."""
    return sip.inverse_order is not None and min(sip.inverse_order) >= SIP_ORDERS[0]


def families(sip: SipHeader) -> list[tuple[str, int, dict[tuple[int, int], float]]]:
    """Prefix, order and terms of A and B, and of AP and BP where they are there."""
    out = [("A", sip.order[0], dict(sip.a)), ("B", sip.order[1], dict(sip.b))]
    if sip.inverse_order is not None:
        out += [
            ("AP", sip.inverse_order[0], dict(sip.ap)),
            ("BP", sip.inverse_order[1], dict(sip.bp)),
        ]
    return out


def values_by_keyword(sip: SipHeader) -> dict[str, float]:
    """Coefficients of both pairs, by keyword."""
    return {sip_keyword(p, *k): c for p, _, terms in families(sip) for k, c in terms.items()}


def repeated_names(sip: SipHeader) -> list[tuple[str, ...]]:
    """Groups of keywords with one value, within A and B and within AP and BP.

    Values that are equal because the distortion is radial are left out.
    """
    out = []
    terms = {prefix: values for prefix, _, values in families(sip)}
    for both in (("A", "B"), ("AP", "BP")):
        radial = radial_orders(*(terms.get(prefix, {}) for prefix in both))
        groups = repeated_values(
            {k: c for k, c in values_by_keyword(sip).items() if k.split("_")[0] in both}
        )
        for group in groups:
            orders = {sum(powers_of(name)) for name in group}
            if len(orders) > 1 or not orders <= radial:
                out.append(group)
    return out


def offset_ranges(
    sip: SipHeader, size: tuple[int, int], margin: float = 0.0
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lowest and highest offset from CRPIX along each axis, for pixel centres and a margin."""
    (nx, ny), (x0, y0) = size, sip.crpix
    return (1 - margin - x0, nx + margin - x0), (1 - margin - y0, ny + margin - y0)


def half_unit(sip: SipHeader) -> float:
    """Half a unit of the last decimal of A_DMAX and B_DMAX as they are written."""
    exponents = [Decimal(repr(float(v))).as_tuple().exponent for v in sip.dmax if v is not None]
    return 0.5 * 10.0 ** min(int(e) for e in exponents)


def with_coefficient(sip: SipHeader, keyword: str, value: float) -> SipHeader:
    """Header with another value of one coefficient."""
    family = keyword.split("_")[0].lower()
    change: dict[str, Any] = {family: {**getattr(sip, family), powers_of(keyword): value}}
    return replace(sip, **change)


def powers_of(keyword: str) -> tuple[int, int]:
    """Powers of the keyword of a coefficient."""
    _, p, q = keyword.split("_")
    return int(p), int(q)
