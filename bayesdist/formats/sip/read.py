"""Read SIP headers from FITS files and from text files of header cards."""

from __future__ import annotations

import os

from astropy.io import fits

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.sip.header import SipHeader
from bayesdist.products.common.cards import card_images
from bayesdist.products.common.celestial import refuse_oversized
from bayesdist.products.common.coefficients import sip_powers
from bayesdist.products.common.content import Content, read_content, readable
from bayesdist.products.common.linear_wcs import cd_matrix, finite_number, image_size


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
        crpix=_pair(header, "CRPIX1", "CRPIX2", where),
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


def _pair(
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
