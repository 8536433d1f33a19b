"""Writing of the distortion entries of WISE meta-data: WSDC D-T033, Appendix B.

The layout cannot hold uncertainties.  They stand in comment lines, which begin with a backslash:
readers of the layout skip them, and `read_wise_meta` reads them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.formats.common.coefficients import largest_magnitude, sip_keyword
from bayesdist.products.formats.sip.families import EDGE, families, offset_ranges
from bayesdist.products.formats.sip.header import SIP_ORDERS, SipHeader, worst_closure
from bayesdist.products.formats.wise.meta import ARRAYS, monomial

# How far A_DMAX and B_DMAX look beyond the centres of the outermost pixels: the printed ones do so
# in W4 alone.
_MARGIN = {1: 0.0, 2: 0.0, 3: 0.0, 4: EDGE}


def write_wise_meta(
    path: str | os.PathLike[str],
    bands: Mapping[int, SipHeader],
    *,
    skew: Mapping[int, float] | None = None,
) -> None:
    """Write the distortion entries of a WISE meta-data file, whole or not at all.

    Coefficients have the seven digits of WSDC D-T033, Appendix B, maxima its three decimals.
    Maxima and closure are those of the numbers as written: A_DMAX and B_DMAX over the centres of
    the pixels in W1 to W3 (u, v within +-507.5), to the edges of the array in W4 (+-254).  In
    comment lines stand standard deviations (AE_p_q, BE_p_q) and the worst error of AP, BP (BDCLOS).

    `bands`: by the number of the band.  CD is a pure scale and the reference pixel the middle of
    the array, as ``sip_from_solution(..., linear="sip")`` has it: the file states neither. `skew`:
    SKEW of each band, radians; zero by default. InputError for no band or an unknown one, a header
    that has no inverse, another array, a CD that holds more than a scale, a number that is not
    finite, or a file that cannot be written.
    """
    text = wise_text(bands, skew)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="ascii", newline="\n")


def wise_text(bands: Mapping[int, SipHeader], skew: Mapping[int, float] | None = None) -> str:
    """Text of the file that `write_wise_meta` writes."""
    if not bands:
        raise InputError("there is no band to write", do="give a header for each band")
    skew = {} if skew is None else skew
    lines = [
        line for band in sorted(bands) for line in _lines(band, bands[band], skew.get(band, 0.0))
    ]
    return "\n".join([*lines, "\\"]) + "\n"


def _lines(band: int, sip: SipHeader, skew: float) -> list[str]:
    """Lines of one band."""
    _check(band, sip, skew)
    written = _as_written(sip)
    size = written.size or (0, 0)
    ranges = offset_ranges(written, size, _MARGIN[band])

    def entry(keyword: str, kind: str, value: str, comment: str) -> str:
        name = f"cal:gnd:distort_{keyword.lower()}"
        return f"{name:<24} {band}    {keyword:<8} {kind} {value:>18} {comment}"

    def aside(keyword: str, value: float, comment: str) -> str:
        return f"\\ {band}    {keyword:<8} r {value:>18.3E} {comment}"

    lines = ["\\", f"\\ w{band}", "\\"]
    lines.append(
        entry("SKEW", "r", f"{skew:.6E}", "[rad] departure of the axes from a right angle")
    )
    for prefix, order, terms in families(written):
        axis = "axis 1" if prefix.startswith("A") else "axis 2"
        inverse = prefix.endswith("P")
        way = "sky to pixels" if inverse else "pixels to sky"
        lines.append(entry(f"{prefix}_ORDER", "i", str(order), f"{axis}: total order, {way}"))
        for powers, value in terms.items():
            name = monomial(*powers).upper() if inverse else monomial(*powers)
            comment = f"{axis}: coefficient of {name}"
            lines.append(entry(sip_keyword(prefix, *powers), "r", f"{value:.6E}", comment))
        if not inverse:
            largest = f"{largest_magnitude(terms, *ranges):.3f}"
            comment = f"[pixel] {axis}: largest correction on the array"
            lines.append(entry(f"{prefix}_DMAX", "r", largest, comment))
    closure = worst_closure(written, size)
    lines += ["\\", aside("BDCLOS", closure, "[pixel] largest error of AP, BP as inverse of A, B")]
    for prefix, sigma in (("A", sip.sigma_a), ("B", sip.sigma_b)):
        lines += [
            aside(sip_keyword(f"{prefix}E", *k), sigma[k], f"sigma of {sip_keyword(prefix, *k)}")
            for k in _powers(sip.order["AB".index(prefix)])
            if k in sigma
        ]
    return lines


def _as_written(sip: SipHeader) -> SipHeader:
    """Header with the digits of the file, every term of its orders there."""
    terms: dict[str, Any] = {
        prefix.lower(): {k: float(f"{values.get(k, 0.0):.6E}") for k in _powers(order)}
        for prefix, order, values in families(sip)
    }
    return replace(sip, **terms)


def _powers(order: int) -> list[tuple[int, int]]:
    """Powers of u and v in the order of the appendix: constant, linear, then by the power of u."""
    high = sorted(k for k in polynomial_terms(order) if sum(k) > 1)
    return [(0, 0), (0, 1), (1, 0), *high]


def _check(band: int, sip: SipHeader, skew: float) -> None:
    if band not in ARRAYS:
        raise InputError(f"band {band} is none of 1 to 4", where="bands", do="correct the band")
    where = f"W{band}"
    side, _ = ARRAYS[band]
    middle = (side + 1) / 2
    if sip.size != (side, side) or sip.crpix != (middle, middle):
        size = "unknown" if sip.size is None else f"{sip.size[0]} x {sip.size[1]}"
        raise InputError(
            f"the image size is {size} and CRPIX {sip.crpix[0]:g}, {sip.crpix[1]:g}, and the array "
            f"of this band has {side} x {side} pixels about {middle:g}, {middle:g}",
            where=where,
            do="give a header of that array, its reference pixel in the middle",
        )
    if not sip.has_inverse:
        raise InputError("the header has no AP and BP", where=where, do="write it with an inverse")
    orders = {f"{prefix}_ORDER": order for prefix, order, _ in families(sip)}
    for keyword, order in orders.items():
        if not SIP_ORDERS[0] <= order <= SIP_ORDERS[1]:
            raise InputError(
                f"is {order}",
                where=f"{where}, keyword {keyword}",
                do=f"choose an order from {SIP_ORDERS[0]} to {SIP_ORDERS[1]}",
            )
    gram = sip.cd.T @ sip.cd
    scale2 = float(np.trace(gram)) / 2
    along_axes = np.count_nonzero(np.abs(sip.cd) > 1e-9 * np.sqrt(scale2)) == 2
    if not along_axes or np.abs(gram - scale2 * np.eye(2)).max() > 1e-9 * scale2:
        raise InputError(
            "the CD matrix holds more than a scale, and the file cannot hold it",
            where=where,
            do='make the header with linear = "sip", whose A and B hold all linear terms',
        )
    numbers = [*(c for _, _, t in families(sip) for c in t.values()), skew]
    numbers += [*sip.sigma_a.values(), *sip.sigma_b.values()]
    if not np.isfinite(numbers).all():
        raise InputError("a number is not finite", where=where, do="check the solution")
