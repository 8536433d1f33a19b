"""Checks of a SIP header against the behaviour of astropy.wcs, stwcs and gwcs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from bayesdist.formats.sip.header import (
    EDGE,
    SIDE_FILE,
    SIP_ORDERS,
    SipHeader,
    families,
    forward_is_used,
    half_unit,
    inverse_is_used,
    offset_ranges,
    repeated_names,
    values_by_keyword,
    worst_closure,
)
from bayesdist.products.common.coefficients import largest_magnitude, sip_keyword
from bayesdist.products.common.document import FAR, Finding
from bayesdist.products.common.rules import Inverse, LinearPart, above_order, copies, stated_closure

# Tolerance between a stated value and the computed one: headers print three decimals.
_DMAX_ABSOLUTE, _DMAX_RELATIVE = 1e-3, 1e-3
# No program computes with A_DMAX, so a rough value does no harm; a wrong one suggests that it
# belongs to another header.
_DMAX_ROUGH = 0.1

_LINEAR = LinearPart(
    "CD",
    "parity: the determinant is positive, so the image is a mirror image of the sky",
    singular="the matrix is singular: no pixel has a position on the sky",
)
_INVERSE = Inverse(
    "AP, BP",
    good=0.01,
    bad=0.5,
    misses="they miss the inverse of A, B",
    poor="the inverse is wrong by up to {closure:.3g} px; ",
    exchanged="index order: p and q are exchanged against A and B",
)

# ``explain(sip, size, closure)`` yields findings on the coefficient that explains a closure; pixels
Explanation = Callable[[SipHeader, tuple[int, int], float], Iterable[Finding]]


def lint_sip(
    sip: SipHeader,
    size: tuple[int, int] | None = None,
    explain: Explanation | None = None,
) -> tuple[Finding, ...]:
    """Check a SIP header against the behaviour of astropy.wcs, stwcs and gwcs.

    Parameters
    ----------
    sip : SipHeader
        Header to check.
    size : tuple of int, optional
        Columns and rows of the detector. The default is the size in the header. Without either,
        checks that need the size are left out, with a note.
    explain : callable, optional
        ``explain(sip, size, closure)`` yields findings on the coefficient that explains why AP, BP
        are not the inverse of A, B. The largest difference is `closure` in pixels.

    Returns
    -------
    tuple of Finding
        Errors, warnings and notes.
    """
    size = size or sip.size
    findings = [
        *_frame(sip),
        *_orders(sip),
        *_low_terms(sip, size),
        *copies(values_by_keyword(sip), groups=repeated_names(sip)),
        *_sigmas(sip),
    ]
    if size is None:
        findings.append(
            Finding(
                "note", "NAXIS", "the image size is not known: A_DMAX and AP, BP are not checked"
            )
        )
    elif forward_is_used(sip):
        findings += [*_dmax(sip, size), *_inverse(sip, size, explain)]
    return tuple(findings)


def _sigmas(sip: SipHeader) -> Iterator[Finding]:
    has_side_file = any(card.startswith(SIDE_FILE) for card in sip.cards)
    if sip.has_sigmas and not sip.has_linear_sigmas and not has_side_file:
        yield Finding(
            "note",
            "AE, BE",
            "are errors of the non-linear terms alone: errors of positions are not stated",
        )


def _frame(sip: SipHeader) -> Iterator[Finding]:
    ra, dec = sip.crval
    if not sip.linear_axes and not (abs(ra) <= 360 and abs(dec) <= 90):
        yield Finding(
            "error", "CRVAL1, CRVAL2", f"({ra:g}, {dec:g}) degrees are not a position on the sphere"
        )
    if not np.abs(sip.crpix).max() <= FAR:
        yield Finding(
            "error", "CRPIX1, CRPIX2", f"{sip.crpix[0]:g}, {sip.crpix[1]:g} is not a pixel"
        )
    determinant = float(np.linalg.det(sip.cd))
    yield from _LINEAR.findings(determinant, mirror=0 if sip.linear_axes else 1)
    if sip.linear_axes and determinant != 0:
        yield Finding(
            "note", "CTYPE", "positions are u, v on a plane of their own, and not the sky; astropy "
            "applies A and B, and remarks that CTYPE does not end in -SIP",
        )  # fmt: skip
        return
    if not all(c.endswith("-SIP") for c in sip.ctype):
        yield Finding(
            "warning", "CTYPE", f"{' and '.join(map(repr, sip.ctype))} do not end in -SIP: "
            "some programs leave the distortion out",
        )  # fmt: skip


def _orders(sip: SipHeader) -> Iterator[Finding]:
    low, high = SIP_ORDERS
    for prefix, order, terms in families(sip):
        keyword = f"{prefix}_ORDER"
        if order < low:
            yield Finding(
                "warning",
                keyword,
                f"is {order}: astropy ignores orders below {low}, all terms with them",
            )
        if order > high:
            yield Finding("error", keyword, f"is {order}: the convention ends at {high}")
        above = [sip_keyword(prefix, *k) for k, c in terms.items() if sum(k) > order and c != 0]
        yield from above_order(above, ", ".join(above), f"{keyword} {order}", "warning")


def _low_terms(sip: SipHeader, size: tuple[int, int] | None) -> Iterator[Finding]:
    named, worst = [], []
    for prefix, terms in (("A", sip.a), ("B", sip.b)):
        low = {k: c for k, c in terms.items() if sum(k) < 2 and c != 0}
        named += [sip_keyword(prefix, *k) for k in low]
        if size is not None and low:
            worst.append(largest_magnitude(low, *offset_ranges(sip, size)))
    if named:
        extent = f" (up to {max(worst):.4g} px)" if worst else ""
        yield Finding(
            "note", ", ".join(named),
            f"constant or linear terms{extent}: astropy applies them, stwcs and gwcs drop them",
        )  # fmt: skip


def _dmax(sip: SipHeader, size: tuple[int, int]) -> Iterator[Finding]:
    for prefix, order, terms in families(sip)[:2]:
        stated = sip.dmax["AB".index(prefix)]
        true = largest_magnitude(terms, *offset_ranges(sip, size), order)
        if stated is None:
            yield Finding("note", f"{prefix}_DMAX", f"is not stated; the maximum is {true:.4g} px")
            continue
        if abs(stated - true) <= _DMAX_ABSOLUTE + _DMAX_RELATIVE * true:
            continue
        to_edges = largest_magnitude(terms, *offset_ranges(sip, size, EDGE), order)
        if abs(stated - to_edges) <= half_unit(sip) * (1 + 1e-9):
            yield Finding(
                "note",
                f"{prefix}_DMAX",
                f"says {stated:.4g} px, which is the maximum to the edges of the outermost pixels; "
                f"over their centres it is {true:.4g} px",
            )
        else:
            high = stated - true
            yield Finding(
                "note" if abs(high) <= _DMAX_ROUGH * true else "warning",
                f"{prefix}_DMAX",
                f"says {stated:.4g} px, but the maximum is {true:.4g} px"
                + (f" ({100 * high / true:+.2g} %)" if true else ""),
            )


def _inverse(
    sip: SipHeader, size: tuple[int, int], explain: Explanation | None
) -> Iterator[Finding]:
    if sip.inverse_order is None:
        yield Finding("note", "AP_ORDER", "there is no inverse: programs must iterate")
        return
    if not inverse_is_used(sip):
        return
    closure = worst_closure(sip, size)
    if np.isnan(closure):  # the polynomials overflow: no calibration can be made of the header
        return
    advice = "raise AP_ORDER" if max(sip.inverse_order) < SIP_ORDERS[1] else "better iterate"
    yield from replace(_INVERSE, poor=_INVERSE.poor + advice).findings(
        closure,
        _exchanges(sip, size),
        lambda: () if explain is None else explain(sip, size, closure),
    )
    yield from stated_closure(sip.closure, closure, "BDCLOS", "AP, BP leave")


def _exchanges(sip: SipHeader, size: tuple[int, int]) -> Iterator[tuple[str, float]]:
    """Closure after an exchange of p and q in AP and BP."""
    mirrored = replace(
        sip,
        ap={(j, i): c for (i, j), c in sip.ap.items()},
        bp={(j, i): c for (i, j), c in sip.bp.items()},
    )
    yield _INVERSE.where, worst_closure(mirrored, size)
