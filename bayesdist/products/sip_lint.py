"""Checks of a SIP header against what astropy.wcs, stwcs and gwcs make of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bayesdist.products.bivariate import largest_magnitude
from bayesdist.products.indices import sip_keyword
from bayesdist.products.lint import Finding, repeated_values
from bayesdist.products.sip import SIP_ORDERS, SipHeader
from bayesdist.products.sip_inverse import worst_closure

__all__ = ["lint_sip"]

# Closure that a good inverse reaches, and one that only a wrong coefficient leaves; pixels.
_CLOSURE_GOOD, _CLOSURE_BAD = 0.01, 0.5
# How much a stated value may differ from the measured one: headers print three decimals.
_DMAX_ABSOLUTE, _DMAX_RELATIVE = 1e-3, 1e-3
_CLOSURE_RELATIVE = 1e-2


def lint_sip(sip: SipHeader, size: tuple[int, int] | None = None) -> tuple[Finding, ...]:
    """Findings in a SIP header.

    Parameters
    ----------
    sip : SipHeader
    size : tuple of int, optional
        Columns and rows of the detector; by default what the header says.  Without either, the
        checks that need a detector are left out, and a note says so.

    Returns
    -------
    tuple of Finding
    """
    size = size or sip.size
    findings = [
        *_frame(sip),
        *_orders(sip),
        *_low_terms(sip, size),
        *_repeated(sip),
    ]
    if size is None:
        findings.append(
            Finding(
                "note", "NAXIS", "the image size is not known: A_DMAX and AP, BP are not checked"
            )
        )
    elif _used(sip):
        findings += [*_dmax(sip, size), *_inverse(sip, size)]
    return tuple(findings)


def _used(sip: SipHeader) -> bool:
    return min(sip.order) >= SIP_ORDERS[0]


def _families(sip: SipHeader) -> list[tuple[str, int, dict[tuple[int, int], float]]]:
    out = [("A", sip.order[0], dict(sip.a)), ("B", sip.order[1], dict(sip.b))]
    if sip.inverse_order is not None:
        out += [
            ("AP", sip.inverse_order[0], dict(sip.ap)),
            ("BP", sip.inverse_order[1], dict(sip.bp)),
        ]
    return out


def _frame(sip: SipHeader) -> Iterator[Finding]:
    if np.linalg.det(sip.cd) == 0:
        yield Finding("error", "CD", "the matrix is singular: no pixel has a place on the sky")
    elif np.linalg.det(sip.cd) > 0:
        yield Finding(
            "note",
            "CD",
            "parity: the determinant is positive, so the image is a mirror image of the sky",
        )
    if not all(c.endswith("-SIP") for c in sip.ctype):
        yield Finding(
            "warning", "CTYPE", f"{' and '.join(map(repr, sip.ctype))} do not end in -SIP: "
            "some programs leave the distortion out",
        )  # fmt: skip


def _orders(sip: SipHeader) -> Iterator[Finding]:
    low, high = SIP_ORDERS
    for prefix, order, terms in _families(sip):
        where = f"{prefix}_ORDER"
        if order < low:
            yield Finding(
                "warning",
                where,
                f"is {order}: astropy ignores orders below {low}, all terms with them",
            )
        if order > high:
            yield Finding("error", where, f"is {order}: the convention ends at {high}")
        above = [sip_keyword(prefix, *k) for k, c in terms.items() if sum(k) > order and c != 0]
        if above:
            yield Finding("warning", ", ".join(above), f"above {where} {order}, so ignored")


def _low_terms(sip: SipHeader, size: tuple[int, int] | None) -> Iterator[Finding]:
    named, worst = [], []
    for prefix, terms in (("A", sip.a), ("B", sip.b)):
        low = {k: c for k, c in terms.items() if sum(k) < 2 and c != 0}
        named += [sip_keyword(prefix, *k) for k in low]
        if size is not None and low:
            worst.append(largest_magnitude(low, *_ranges(sip, size)))
    if named:
        extent = f" (up to {max(worst):.4g} px)" if worst else ""
        yield Finding(
            "note", ", ".join(named),
            f"constant or linear terms{extent}: astropy applies them, stwcs and gwcs drop them",
        )  # fmt: skip


def _repeated(sip: SipHeader) -> Iterator[Finding]:
    families = _families(sip)
    for both in (families[:2], families[2:]):
        values = {sip_keyword(p, *k): c for p, _, terms in both for k, c in terms.items()}
        for names in repeated_values(values):
            yield Finding(
                "warning", ", ".join(names), f"the same value, {abs(values[names[0]]):.7g}: "
                "one may have been copied over the other",
            )  # fmt: skip


def _ranges(sip: SipHeader, size: tuple[int, int]) -> list[tuple[float, float]]:
    return [(1 - ref, n - ref) for n, ref in zip(size, sip.crpix, strict=True)]


def _dmax(sip: SipHeader, size: tuple[int, int]) -> Iterator[Finding]:
    for prefix, order, terms in _families(sip)[:2]:
        stated = sip.dmax["AB".index(prefix)]
        true = largest_magnitude(terms, *_ranges(sip, size), order)
        if stated is None:
            yield Finding("note", f"{prefix}_DMAX", f"is not stated; the maximum is {true:.4g} px")
        elif abs(stated - true) > _DMAX_ABSOLUTE + _DMAX_RELATIVE * true:
            yield Finding(
                "warning",
                f"{prefix}_DMAX",
                f"says {stated:.4g} px, and the maximum is {true:.4g} px",
            )


def _inverse(sip: SipHeader, size: tuple[int, int]) -> Iterator[Finding]:
    if sip.inverse_order is None:
        yield Finding("note", "AP_ORDER", "there is no inverse: programs must iterate")
        return
    if min(sip.inverse_order) < SIP_ORDERS[0]:
        return
    closure = worst_closure(sip, size)
    mirrored = replace(
        sip,
        ap={(j, i): c for (i, j), c in sip.ap.items()},
        bp={(j, i): c for (i, j), c in sip.bp.items()},
    )
    where = "AP, BP"
    if closure > _CLOSURE_GOOD and worst_closure(mirrored, size) < closure / 10:
        yield Finding(
            "error",
            where,
            f"index order: p and q are exchanged against A and B (closure {closure:.3g} px)",
        )
    elif closure > _CLOSURE_BAD:
        yield Finding(
            "error", where, f"they miss the inverse of A, B by up to {closure:.3g} px: "
            "a coefficient of one or the other is wrong",
        )  # fmt: skip
    elif closure > _CLOSURE_GOOD:
        advice = "raise AP_ORDER" if max(sip.inverse_order) < SIP_ORDERS[1] else "better iterate"
        yield Finding("warning", where, f"they leave up to {closure:.3g} px; {advice}")
    if sip.closure is not None and closure > sip.closure * (1 + _CLOSURE_RELATIVE) + 1e-9:
        yield Finding(
            "error", "BDCLOS", f"states {sip.closure:.3g} px, and AP, BP leave {closure:.3g} px"
        )
