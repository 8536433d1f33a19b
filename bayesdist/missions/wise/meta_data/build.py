"""Write the distortion entries of WISE meta-data: WSDC D-T033, Appendix B.

The layout cannot hold uncertainties. They are written as comment lines, which begin with a
backslash: other programs skip them, and `read_wise_meta` reads them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.formats.sip.header import (
    EDGE,
    SIP_ORDERS,
    SipHeader,
    families,
    offset_ranges,
    worst_closure,
)
from bayesdist.missions.wise.meta_data.meta import ARRAYS, monomial
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.coefficients import largest_magnitude, sip_keyword

# Distance beyond the centres of the outermost pixels to which A_DMAX and B_DMAX extend; in the
# printed tables only those of W4 extend to the edge.
_MARGIN = {1: 0.0, 2: 0.0, 3: 0.0, 4: EDGE}


def write_wise_meta(
    path: str | os.PathLike[str],
    bands: Mapping[int, SipHeader],
    *,
    skew: Mapping[int, float] | None = None,
) -> None:
    """Write the distortion entries of a WISE meta-data file atomically.

    Parameters
    ----------
    path : path-like
        Output file.
    bands : mapping of int to SipHeader
        Headers by band number. CD must be a pure scale and the reference pixel the middle of the
        array, as made by ``sip_from_solution(..., linear="sip")``, because the file states neither.
    skew : mapping of int to float, optional
        SKEW of each band, radians; zero by default.

    Raises
    ------
    InputError
        If there is no band or an unknown one, if a header has no inverse, another array size or a
        CD that is more than a scale, if a number is not finite, or if the file cannot be written.

    Notes
    -----
    Coefficients have seven digits as in WSDC D-T033, Appendix B, and maxima three decimals. Maxima
    and closure are computed from the numbers as written. A_DMAX and B_DMAX are taken over the
    centres of the pixels in W1 to W3 (u, v within +-507.5), and to the edges of the array in W4
    (+-254). Comment lines give the standard deviations (AE_p_q, BE_p_q) and the largest error of
    AP, BP (BDCLOS).
    """
    text = wise_text(bands, skew)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="ascii", newline="\n")


def wise_text(bands: Mapping[int, SipHeader], skew: Mapping[int, float] | None = None) -> str:
    """Text of the file written by `write_wise_meta`."""
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
    """Header with coefficients rounded as in the file, and with every term of its orders."""
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
    location = f"W{band}"
    side, _ = ARRAYS[band]
    middle = (side + 1) / 2
    if sip.size != (side, side) or sip.crpix != (middle, middle):
        size = "unknown" if sip.size is None else f"{sip.size[0]} x {sip.size[1]}"
        raise InputError(
            f"the image size is {size} and CRPIX {sip.crpix[0]:g}, {sip.crpix[1]:g}, but the array "
            f"of this band has {side} x {side} pixels about {middle:g}, {middle:g}",
            where=location,
            do="give a header of that array with the reference pixel in the middle",
        )
    if not sip.has_inverse:
        raise InputError(
            "the header has no AP and BP", where=location, do="write it with an inverse"
        )
    orders = {f"{prefix}_ORDER": order for prefix, order, _ in families(sip)}
    for keyword, order in orders.items():
        if not SIP_ORDERS[0] <= order <= SIP_ORDERS[1]:
            raise InputError(
                f"is {order}",
                where=f"{location}, keyword {keyword}",
                do=f"choose an order from {SIP_ORDERS[0]} to {SIP_ORDERS[1]}",
            )
    gram = sip.cd.T @ sip.cd
    scale2 = float(np.trace(gram)) / 2
    along_axes = np.count_nonzero(np.abs(sip.cd) > 1e-9 * np.sqrt(scale2)) == 2
    if not along_axes or np.abs(gram - scale2 * np.eye(2)).max() > 1e-9 * scale2:
        raise InputError(
            "the CD matrix is more than a scale, but the file can store only a scale",
            where=location,
            do='make the header with linear = "sip", whose A and B hold all linear terms',
        )
    numbers = [*(c for _, _, t in families(sip) for c in t.values()), skew]
    numbers += [*sip.sigma_a.values(), *sip.sigma_b.values()]
    if not np.isfinite(numbers).all():
        raise InputError("a number is not finite", where=location, do="check the solution")
