"""Read and write the distortion entries of WISE meta-data: WSDC D-T033, Appendix B.

The layout cannot hold uncertainties. They are written as comment lines, which begin with a
backslash: other programs skip them, and `read_wise_meta` reads them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import FormatError, InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.formats.sip.files import parsed
from bayesdist.formats.sip.format import sip_calibration
from bayesdist.formats.sip.header import (
    EDGE,
    SIP_ORDERS,
    SipHeader,
    families,
    offset_ranges,
    worst_closure,
)
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.coefficients import largest_magnitude, sip_keyword
from bayesdist.products.common.content import Content, read_content

_ENTRY = re.compile(r"\S*distort_(?:skew|(?:a|b|ap|bp)_)\S*")
_ENTRY_LINE = re.compile(r"\S*distort_(\S+)\s+(\d+)\s+(\S+)\s+([ir])\s+(\S+)\s*(.*)")
_KEYWORD = re.compile(r"SKEW|[AB]P?_(?:ORDER|\d_\d)|[AB]_DMAX")
# Entries that `write_wise_meta` writes as comment lines, which other programs skip.
_LIKE_ASIDE = re.compile(r"\\.*\s([AB]E_\d_\d|BDCLOS)\s+r\s.*")
_ASIDE = re.compile(r"\\\s+(\d+)\s+([AB]E_\d_\d|BDCLOS)\s+r\s+(\S+).*")
# Columns (and rows) of the arrays, and pixel scale in arcsec; W4 has pixels twice as wide.
ARRAYS = {1: (1016, 2.75), 2: (1016, 2.75), 3: (1016, 2.75), 4: (508, 5.5)}

# Distance beyond the centres of the outermost pixels to which A_DMAX and B_DMAX extend; in the
# printed tables only those of W4 extend to the edge.
_MARGIN = {1: 0.0, 2: 0.0, 3: 0.0, 4: EDGE}


@dataclass(frozen=True, eq=False)
class WiseBand:
    """Distortion entries of one band in a WISE meta-data file.

    Parameters
    ----------
    band : int
        Number of the band, 1 to 4.
    sip : SipHeader
        Distortion. The reference pixel is the middle of the array. Because the file has no sky
        position, CRVAL is zero and CD has the nominal scale.
    skew : float
        SKEW of the CD matrix, radians.
    printed : mapping of str to str
        Numbers as printed in the file, by keyword.
    comments : mapping of str to str
        Comments of the entries, by keyword.
    """

    band: int
    sip: SipHeader
    skew: float
    printed: Mapping[str, str]
    comments: Mapping[str, str]


def read_wise_meta(path: str | os.PathLike[str]) -> tuple[WiseBand, ...]:
    """Read the distortion entries of a WISE meta-data file.

    The layout is that of WSDC D-T033 ("WISE IOC Distortion Calibration"), Appendix B: name, band,
    keyword, type, value, comment. Other entries are skipped. So are comment lines, except for the
    standard deviations and the closure written by `write_wise_meta`.

    Parameters
    ----------
    path : path-like
        WISE meta-data file.

    Returns
    -------
    tuple of WiseBand
        Entries in the order of the bands.

    Raises
    ------
    FormatError
        If there are no such entries, or if an entry is malformed, inconsistent, repeated or
        missing.
    InputError
        If the file cannot be read.
    """
    return bands_of(read_content(path))


def bands_of(content: Content) -> tuple[WiseBand, ...]:
    """Bands in the content of a file; see `read_wise_meta`."""
    name, lines = content.name, content.text.splitlines()
    entries: dict[int, dict[str, tuple[str, str]]] = {}
    asides: dict[int, dict[str, str]] = {}
    for number, line in enumerate(lines, start=1):
        if _ENTRY.match(line):
            band, keyword, value, comment = _entry(line, f"{name}, line {number}")
            if keyword in entries.setdefault(band, {}):
                raise FormatError(
                    f"{keyword} of band {band} occurs a second time",
                    where=f"{name}, line {number}",
                    do="remove one",
                )
            entries[band][keyword] = value, comment
        elif aside := _ASIDE.fullmatch(line.rstrip()):
            asides.setdefault(int(aside[1]), {})[aside[2]] = aside[3]
        elif _LIKE_ASIDE.fullmatch(line.rstrip()):
            raise FormatError(
                "is not band, keyword, type, value of an error",
                where=f"{name}, line {number}",
                do="correct the line",
            )
    if not entries:
        raise FormatError(
            "there are no distortion entries", where=name, do="give a WISE meta-data file"
        )
    lost = asides.keys() - entries.keys()
    if lost:
        raise FormatError(
            f"errors are of band {min(lost)}, which has no entries", where=name, do="correct them"
        )
    return tuple(
        _wise_band(band, entries[band], asides.get(band, {}), name) for band in sorted(entries)
    )


def holds_wise_meta(content: Content) -> bool:
    """True if there are distortion entries of WISE meta-data, valid or not."""
    return any(_ENTRY.match(line) for line in content.text.splitlines())


def _entry(line: str, where: str) -> tuple[int, str, str, str]:
    """Band, keyword, value as printed and comment of one line."""
    match = _ENTRY_LINE.fullmatch(line.rstrip())
    if match is None:
        raise FormatError(
            "is not name, band, keyword, type, value, comment", where=where, do="correct the line"
        )
    name, band, keyword, _, value, comment = match.groups()
    if name.upper() != keyword:
        raise FormatError(
            f"the name says {name.upper()} and the keyword {keyword}", where=where, do="correct one"
        )
    if not _KEYWORD.fullmatch(keyword):
        raise FormatError(f"{keyword} is not a SIP keyword", where=where, do="correct the keyword")
    if int(band) not in ARRAYS:
        raise FormatError(f"band {band} is none of 1 to 4", where=where, do="correct the band")
    return int(band), keyword, value, " ".join(comment.split())


def monomial(p: int, q: int) -> str:
    """Name of u^p v^q as in the comments: u2.v, u.v, v3, and v0 for the constant."""
    if p == 0:
        return f"v{q}"
    if q == 0:
        return f"u{p}"
    return ".".join(n if k == 1 else f"{n}{k}" for n, k in (("u", p), ("v", q)))


def _wise_band(
    band: int, entries: dict[str, tuple[str, str]], asides: dict[str, str], where: str
) -> WiseBand:
    where = f"{where}, band {band}"
    header = fits.Header()
    values = {keyword: value for keyword, (value, _) in entries.items()}
    for keyword, value in (values | asides).items():
        try:
            header[keyword] = int(value) if keyword.endswith("_ORDER") else float(value)
        except ValueError:
            raise FormatError(
                f"value {value!r} is not a finite number",
                where=f"{where}, keyword {keyword}",
                do="correct the value",
            ) from None
    side, scale = ARRAYS[band]
    for axis, ctype in enumerate(("RA---TAN-SIP", "DEC--TAN-SIP"), start=1):
        header[f"CTYPE{axis}"] = ctype
        header[f"CRPIX{axis}"] = (side + 1) / 2
        header[f"CD{axis}_{axis}"] = (-1) ** axis * scale / 3600
        header[("IMAGEW", "IMAGEH")[axis - 1]] = side
    return WiseBand(
        band,
        parsed(header, where),
        float(header.get("SKEW", 0.0)),
        values,
        {keyword: comment for keyword, (_, comment) in entries.items()},
    )


def wise_calibration(bands: Sequence[WiseBand], name: str, band: str | None = None) -> Calibration:
    """Calibration of one band, such as "W2": (u, v) in corrected pixels from the array centre.

    `name` is the file, for error messages. InputError if the file does not have the band, or if it
    has several bands and none is named.
    """
    by_name = {f"W{entry.band}": entry for entry in bands}
    chosen = (band or "").upper()
    if band is not None and chosen not in by_name:
        raise InputError(
            f"there is no band {band}", where=name, do=f"choose one of {', '.join(by_name)}"
        )
    if band is None and len(by_name) > 1:
        raise InputError(
            f"holds the bands {', '.join(by_name)}",
            where=name,
            do="name one by filter (--filter W1, or W1:W2 for two files, on the command line)",
        )
    selected = by_name[chosen] if band is not None else next(iter(by_name.values()))
    notes = ("without the SKEW of its CD matrix",) if selected.skew else ()
    calibration = sip_calibration(
        selected.sip, f"{name}, W{selected.band}", pixels=True, notes=notes
    )
    return replace(calibration, detector=f"W{selected.band}")


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
