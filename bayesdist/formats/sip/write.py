"""Write SIP headers: cards that were read are kept, and numbers keep all their digits."""

from __future__ import annotations

import os

import numpy as np
from astropy.io import fits

from bayesdist.files.atomic import atomic_path
from bayesdist.formats.sip.header import SipHeader
from bayesdist.products.common.cards import (
    ascii_card,
    header_of,
    keyword_of,
    number_card,
    text_card,
)
from bayesdist.products.common.coefficients import sip_keyword, sip_powers
from bayesdist.products.common.linear_wcs import CD_KEYWORDS, LINEAR_KEYWORDS, cd_matrix, image_size

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
