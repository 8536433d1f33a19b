"""Read SIP headers from FITS files and text files of header cards, and write them.

Cards that were read are kept, and numbers keep all their digits.
"""

from __future__ import annotations

import os

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError, InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.formats.sip.header import SipHeader
from bayesdist.products.common.cards import (
    ascii_card,
    card_images,
    header_of,
    keyword_of,
    number_card,
    text_card,
)
from bayesdist.products.common.celestial import (
    CD_KEYWORDS,
    LINEAR_KEYWORDS,
    cd_matrix,
    finite_number,
    image_size,
    refuse_oversized,
)
from bayesdist.products.common.coefficients import sip_keyword, sip_powers
from bayesdist.products.common.content import Content, read_content, readable

# -- reading --------------------------------------------------------------------------------------


def read_sip(path: str | os.PathLike[str], *, ext: int | str | None = None) -> SipHeader:
    """Read a SIP header.

    Parameters
    ----------
    path : path-like
        FITS file, or text file of header cards (one per line, or 80 characters each).
    ext : int or str, optional
        HDU of a FITS file. The default is the first HDU with A_ORDER.

    Returns
    -------
    SipHeader
        Header with all its cards, which `write_sip` writes back unchanged.

    Raises
    ------
    FormatError
        If the file is neither, has no A_ORDER, or if a keyword is missing or not a number.
    InputError
        If the file cannot be read.

    Examples
    --------
    >>> from bayesdist.formats import read_sip, sip_from_solution, write_sip
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> write_sip(sip_from_solution(fit, scale_arcsec=2.757), "sip.hdr")
    >>> read_sip("sip.hdr").ctype
    ('RA---TAN-SIP', 'DEC--TAN-SIP')
    """
    return sip_of(read_content(path), ext=ext)


def sip_of(content: Content, *, ext: int | str | None = None) -> SipHeader:
    """SIP header in the content of a file; see `read_sip`."""
    with readable(content.name):
        header = _chosen(content, ext)
    return parsed(header, content.name)


def holds_sip(content: Content) -> bool:
    """True if there is a header with A_ORDER, valid or not."""
    return any("A_ORDER" in hdu.header for hdu in content.hdus)


# -- from content to a header --------------------------------------------------------------------


def _chosen(content: Content, ext: int | str | None) -> fits.Header:
    """Header of the selected HDU; by default the first one with A_ORDER."""
    if not content.hdus:
        raise FormatError(
            "is not a header that can be read: there is no A_ORDER",
            where=content.name,
            do="give a FITS file or cards of a header",
        )
    if ext is None:
        with_sip = [hdu for hdu in content.hdus if "A_ORDER" in hdu.header]
        return (with_sip or content.hdus)[0].header
    if not content.is_fits:
        raise InputError("is a text file and has no HDUs", where=content.name, do="leave out ext")
    key = ext.upper() if isinstance(ext, str) else ext
    for hdu in content.hdus:
        if key in (hdu.number, hdu.name):
            return hdu.header
    raise InputError(
        f"there is no HDU {ext!r}",
        where=content.name,
        do=f"choose one of 0 to {len(content.hdus) - 1}",
    )


# -- from a header to a SipHeader ----------------------------------------------------------------


def parsed(header: fits.Header, where: str) -> SipHeader:
    """SIP header from a FITS header; `where` names it in error messages."""
    with readable(where):
        return _parsed(header, where)


def _parsed(header: fits.Header, where: str) -> SipHeader:
    refuse_oversized(header, where)
    if "A_ORDER" not in header:
        raise FormatError(
            "there is no A_ORDER", where=where, do="give a header with SIP keywords, or its HDU"
        )
    terms: dict[str, dict[tuple[int, int], float]] = {
        prefix: {} for prefix in ("A", "B", "AP", "BP", "AE", "BE")
    }
    for keyword in header:
        powers = sip_powers(keyword)
        if powers is not None:
            terms[powers[0]][powers[1:]] = finite_number(header, keyword, where)
    inverse = "AP_ORDER" in header or "BP_ORDER" in header
    offset = "BDU0" in header
    return SipHeader(
        crpix=_two_numbers(header, "CRPIX1", "CRPIX2", where),
        crval=(
            finite_number(header, "CRVAL1", where, 0.0),
            finite_number(header, "CRVAL2", where, 0.0),
        ),
        cd=cd_matrix(header, where),
        ctype=(str(header.get("CTYPE1", "")), str(header.get("CTYPE2", ""))),
        order=(_order(header, "A_ORDER", where), _order(header, "B_ORDER", where)),
        a=terms["A"],
        b=terms["B"],
        inverse_order=(_order(header, "AP_ORDER", where), _order(header, "BP_ORDER", where))
        if inverse
        else None,
        ap=terms["AP"],
        bp=terms["BP"],
        sigma_a=terms["AE"],
        sigma_b=terms["BE"],
        dmax=(_optional(header, "A_DMAX", where), _optional(header, "B_DMAX", where)),
        closure=_optional(header, "BDCLOS", where),
        offset=(finite_number(header, "BDU0", where), finite_number(header, "BDV0", where))
        if offset
        else None,
        unit=str(header.get("BDUNIT", "")),
        size=image_size(header),
        cards=card_images(header),
    )


def _two_numbers(
    header: fits.Header, first: str, second: str, where: str, default: float | None = None
) -> tuple[float, float]:
    """Values of two keywords."""
    return (
        finite_number(header, first, where, default),
        finite_number(header, second, where, default),
    )


def _optional(header: fits.Header, keyword: str, where: str) -> float | None:
    return finite_number(header, keyword, where) if keyword in header else None


def _order(header: fits.Header, keyword: str, where: str) -> int:
    value = finite_number(header, keyword, where)
    if value != int(value) or value < 0:
        raise FormatError(
            f"polynomial order is {value:g}",
            where=f"{where}, keyword {keyword}",
            do="give a whole number",
        )
    return int(value)


# -- writing --------------------------------------------------------------------------------------


_FITS_SUFFIXES = (".fits", ".fit", ".fts", ".fits.gz")
_STRUCTURE = (
    *("SIMPLE", "XTENSION", "BITPIX", "NAXIS", "NAXIS1", "NAXIS2"),
    *("EXTEND", "PCOUNT", "GCOUNT"),
)
# Keywords that are removed if the corresponding field of the header is empty.
_OWNED = ("AP_ORDER", "BP_ORDER", "A_DMAX", "B_DMAX", "BDCLOS", "BDU0", "BDV0", "BDUNIT")
# Values that programs assume for missing keywords.
_DEFAULTS: dict[str, float | str] = {
    **dict.fromkeys(("CRVAL1", "CRVAL2", *CD_KEYWORDS), 0.0),
    **dict.fromkeys(("CTYPE1", "CTYPE2", "BDUNIT"), ""),
}


def write_sip(sip: SipHeader, path: str | os.PathLike[str]) -> None:
    """Write a SIP header atomically.

    A path that ends in .fits gives a FITS file without data; its structural keywords are those of
    the new file, and the image size is written to IMAGEW and IMAGEH. Any other path gives a text
    file with one card per line, which ``astropy.io.fits.Header.fromtextfile`` can read. A header
    that was read is written back card by card.

    Parameters
    ----------
    sip : SipHeader
        Header to write.
    path : path-like
        Output file.

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> from bayesdist.formats import read_sip, sip_from_solution, write_sip
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> write_sip(sip_from_solution(fit, scale_arcsec=2.757), "sip.hdr")
    >>> read_sip("sip.hdr").ctype
    ('RA---TAN-SIP', 'DEC--TAN-SIP')
    """
    with atomic_path(path) as temporary:
        if str(path).lower().endswith(_FITS_SUFFIXES):
            header = sip_header(sip)
            for keyword in _STRUCTURE:
                header.remove(keyword, ignore_missing=True)
            if sip.size is not None and "IMAGEW" not in header:
                header["IMAGEW"], header["IMAGEH"] = sip.size
            fits.PrimaryHDU(header=header).writeto(temporary)
        else:
            temporary.write_text(sip_text(sip), encoding="ascii", newline="\n")


def sip_text(sip: SipHeader) -> str:
    """Header as text with one card per line."""
    return "\n".join(map(ascii_card, _cards(sip))) + "\n"


def sip_header(sip: SipHeader) -> fits.Header:
    """Complete header, as accepted by astropy.wcs.WCS.

    Parameters
    ----------
    sip : SipHeader
        Distortion and other cards.

    Returns
    -------
    astropy.io.fits.Header
        Cards that were read, updated where fields differ from them.
    """
    return header_of(list(map(ascii_card, _cards(sip))))


def _cards(sip: SipHeader) -> list[str]:
    """Cards of the header; those that were read are unchanged unless a field differs."""
    header = header_of(sip.cards)
    stated = _keywords(sip)
    drop = {
        keyword
        for keyword in header
        if keyword not in stated and (sip_powers(keyword) or keyword in _OWNED)
    }
    if np.array_equal(cd_matrix(header, "header"), sip.cd):  # in any form: CD, PC or CROTA2
        stated = {k: v for k, v in stated.items() if k not in CD_KEYWORDS}
    else:
        drop |= set(LINEAR_KEYWORDS)
    if sip.size is not None and image_size(header) != sip.size:
        stated["IMAGEW"] = sip.size[0], "[pix] columns of the detector"
        stated["IMAGEH"] = sip.size[1], "[pix] rows of the detector"
    fresh = {
        keyword: text_card(keyword, value, comment)
        if isinstance(value, str)
        else number_card(keyword, value, comment)
        for keyword, (value, comment) in stated.items()
        if header.get(keyword, _DEFAULTS.get(keyword)) != value
    }
    out = []
    for card in sip.cards:
        keyword = keyword_of(card)
        if keyword not in drop:
            out.append(fresh.pop(keyword, card))
    return out + list(fresh.values())


def _keywords(sip: SipHeader) -> dict[str, tuple[float | int | str, str]]:
    """Keywords that represent the fields, with value and comment, in the usual order."""
    out: dict[str, tuple[float | int | str, str]] = {}
    unit, axes = "deg", "tangent plane with SIP"
    if sip.linear_axes:
        unit, axes = sip.axes_unit, "plane of u and v, with SIP"
    for axis in (1, 2):
        out[f"CTYPE{axis}"] = sip.ctype[axis - 1], axes
    for axis in (1, 2):
        out[f"CRPIX{axis}"] = sip.crpix[axis - 1], "[pix] reference pixel"
    for axis in (1, 2):
        out[f"CRVAL{axis}"] = sip.crval[axis - 1], f"[{unit}] position at the reference pixel"
    for k, keyword in enumerate(CD_KEYWORDS):
        out[keyword] = float(sip.cd.flat[k]), f"[{unit}/pix]"
    if sip.offset is not None:
        for keyword, value in zip(("BDU0", "BDV0"), sip.offset, strict=True):
            out[keyword] = value, "(u, v) of the model that CRVAL stands for"
        out["BDUNIT"] = sip.unit, "unit of BDU0, BDV0"
    families = (
        ("A", sip.order[0], sip.a, "AE", sip.sigma_a, sip.dmax[0]),
        ("B", sip.order[1], sip.b, "BE", sip.sigma_b, sip.dmax[1]),
    )
    for prefix, order, terms, sigma_prefix, sigma, dmax in families:
        out[f"{prefix}_ORDER"] = order, "polynomial order, detector to sky"
        for (i, j), value in terms.items():
            out[sip_keyword(prefix, i, j)] = value, f"{_monomial(i, j)}"
        if dmax is not None:
            out[f"{prefix}_DMAX"] = dmax, "[pix] largest correction on the detector"
        for (i, j), value in sigma.items():
            out[sip_keyword(sigma_prefix, i, j)] = value, f"sigma of {prefix}_{i}_{j}"
    if sip.inverse_order is not None:
        for prefix, order, terms in zip(
            ("AP", "BP"), sip.inverse_order, (sip.ap, sip.bp), strict=True
        ):
            out[f"{prefix}_ORDER"] = order, "polynomial order, sky to detector"
            for (i, j), value in terms.items():
                out[sip_keyword(prefix, i, j)] = value, f"{_monomial(i, j).upper()}"
    if sip.closure is not None:
        out["BDCLOS"] = sip.closure, "[pix] worst error of AP, BP after A, B"
    return out


def _monomial(i: int, j: int) -> str:
    powers = [name if p == 1 else f"{name}^{p}" for name, p in (("u", i), ("v", j)) if p]
    return " ".join(powers) or "constant"
