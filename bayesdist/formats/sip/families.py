"""Functions shared by the checks of a SIP header: coefficients by family, and detector ranges."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from typing import Any

from bayesdist.formats.sip.header import SIP_ORDERS, SipHeader
from bayesdist.products.common.coefficients import radial_orders, sip_keyword
from bayesdist.products.common.document import repeated_values

# Distance of the edge of a pixel from its centre; some programs include it in the maximum.
EDGE = 0.5


def forward_is_used(sip: SipHeader) -> bool:
    """True if programs apply A and B: they ignore orders below 2."""
    return min(sip.order) >= SIP_ORDERS[0]


def inverse_is_used(sip: SipHeader) -> bool:
    """True if AP and BP exist and their order is not ignored."""
    return sip.inverse_order is not None and min(sip.inverse_order) >= SIP_ORDERS[0]


def families(sip: SipHeader) -> list[tuple[str, int, dict[tuple[int, int], float]]]:
    """Prefix, order and terms of A and B, and of AP and BP if they exist."""
    out = [("A", sip.order[0], dict(sip.a)), ("B", sip.order[1], dict(sip.b))]
    if sip.inverse_order is not None:
        out += [
            ("AP", sip.inverse_order[0], dict(sip.ap)),
            ("BP", sip.inverse_order[1], dict(sip.bp)),
        ]
    return out


def values_by_keyword(sip: SipHeader) -> dict[str, float]:
    """Coefficients of all families, by keyword."""
    return {sip_keyword(p, *k): c for p, _, terms in families(sip) for k, c in terms.items()}


def repeated_names(sip: SipHeader) -> list[tuple[str, ...]]:
    """Groups of keywords with equal values, within A and B and within AP and BP.

    Values that are equal because the distortion is radial are left out.
    """
    out = []
    terms = {prefix: values for prefix, _, values in families(sip)}
    for prefixes in (("A", "B"), ("AP", "BP")):
        radial = radial_orders(*(terms.get(prefix, {}) for prefix in prefixes))
        groups = repeated_values(
            {k: c for k, c in values_by_keyword(sip).items() if k.split("_")[0] in prefixes}
        )
        for group in groups:
            orders = {sum(powers_of(name)) for name in group}
            if len(orders) > 1 or not orders <= radial:
                out.append(group)
    return out


def offset_ranges(
    sip: SipHeader, size: tuple[int, int], margin: float = 0.0
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lowest and highest offset from CRPIX along each axis, for pixel centres plus a margin."""
    (nx, ny), (x0, y0) = size, sip.crpix
    return (1 - margin - x0, nx + margin - x0), (1 - margin - y0, ny + margin - y0)


def half_unit(sip: SipHeader) -> float:
    """Half a unit of the last printed decimal of A_DMAX and B_DMAX."""
    exponents = [Decimal(repr(float(v))).as_tuple().exponent for v in sip.dmax if v is not None]
    return 0.5 * 10.0 ** min(int(e) for e in exponents)


def with_coefficient(sip: SipHeader, keyword: str, value: float) -> SipHeader:
    """Header with one coefficient replaced."""
    family = keyword.split("_", maxsplit=1)[0].lower()
    change: dict[str, Any] = {family: {**getattr(sip, family), powers_of(keyword): value}}
    return replace(sip, **change)


def powers_of(keyword: str) -> tuple[int, int]:
    """Powers (p, q) of a coefficient keyword."""
    _, p, q = keyword.split("_")
    return int(p), int(q)
