"""Read SIP headers from FITS files and from text files of header cards."""

from __future__ import annotations

import os

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.sip.header import SipHeader
from bayesdist.products.common.cards import card_images
from bayesdist.products.common.celestial import refuse_oversized
from bayesdist.products.common.coefficients import sip_powers
from bayesdist.products.common.content import Content, read_content, readable
from bayesdist.utils.arrays import Float

CD_KEYWORDS = ("CD1_1", "CD1_2", "CD2_1", "CD2_2")
# Keywords that other headers have instead of a CD matrix.
LINEAR_KEYWORDS = (
    *("PC1_1", "PC1_2", "PC2_1", "PC2_2"),
    *("CDELT1", "CDELT2", "CROTA1", "CROTA2"),
)


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
            terms[powers[0]][powers[1:]] = _number(header, keyword, where)
    inverse = "AP_ORDER" in header or "BP_ORDER" in header
    offset = "BDU0" in header
    return SipHeader(
        crpix=(_number(header, "CRPIX1", where), _number(header, "CRPIX2", where)),
        crval=(_number(header, "CRVAL1", where, 0.0), _number(header, "CRVAL2", where, 0.0)),
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
        offset=(_number(header, "BDU0", where), _number(header, "BDV0", where)) if offset else None,
        unit=str(header.get("BDUNIT", "")),
        size=image_size(header),
        cards=card_images(header),
    )


def _number(header: fits.Header, keyword: str, where: str, default: float | None = None) -> float:
    value = header.get(keyword, default)
    if value is None:
        raise FormatError("is missing", where=f"{where}, keyword {keyword}", do="add the keyword")
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise FormatError(
            f"value {value!r} is no finite number",
            where=f"{where}, keyword {keyword}",
            do="correct the value",
        )
    return float(value)


def _optional(header: fits.Header, keyword: str, where: str) -> float | None:
    return _number(header, keyword, where) if keyword in header else None


def _order(header: fits.Header, keyword: str, where: str) -> int:
    value = _number(header, keyword, where)
    if value != int(value) or value < 0:
        raise FormatError(
            f"polynomial order is {value:g}",
            where=f"{where}, keyword {keyword}",
            do="give a whole number",
        )
    return int(value)


def cd_matrix(header: fits.Header, where: str) -> Float:
    """CD matrix (2, 2), also from PC and CDELT or from CROTA2 (FITS 4.0, section 8.1).

    As in wcslib, CD takes precedence over PC, and PC over CROTA2.
    """
    if any(keyword in header for keyword in CD_KEYWORDS):
        return np.array([_number(header, k, where, 0.0) for k in CD_KEYWORDS]).reshape(2, 2)
    scale = np.array([_number(header, k, where, 1.0) for k in ("CDELT1", "CDELT2")])
    if "CROTA2" in header and not any(keyword in header for keyword in LINEAR_KEYWORDS[:4]):
        angle = np.deg2rad(_number(header, "CROTA2", where))
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[scale[0] * c, -scale[1] * s], [scale[0] * s, scale[1] * c]])
    pc = [
        _number(header, k, where, d)
        for k, d in zip(LINEAR_KEYWORDS[:4], (1.0, 0.0, 0.0, 1.0), strict=True)
    ]
    return scale[:, None] * np.array(pc).reshape(2, 2)


def image_size(header: fits.Header) -> tuple[int, int] | None:
    """Columns and rows stated in a header; a side of one pixel counts as a placeholder.

    A compressed image is a table with its size in ZNAXIS. HST headers have NPIX if all pixels have
    one value and there are no data.
    """
    pairs = [("ZNAXIS1", "ZNAXIS2"), ("IMAGEW", "IMAGEH"), ("NPIX1", "NPIX2")]
    if "TABLE" not in str(header.get("XTENSION", "")):
        pairs.insert(0, ("NAXIS1", "NAXIS2"))
    for names in pairs:
        n = [header.get(name, 0) for name in names]
        if all(isinstance(k, int | float) and k > 1 for k in n):
            return int(n[0]), int(n[1])
    return None
