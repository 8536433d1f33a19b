"""Rotated and mirrored pixel frames of SIP headers and WISE meta-data: `bayesdist wise rotate`.

Forward and inverse terms, CD and CRPIX change together.  With pixel offsets w = (u, v) from the
reference pixel and an orthogonal matrix M, the new offsets are w' = M w, and a distortion
f = (A, B) becomes

    f'(w') = M f(M^-1 w')

which is linear in the coefficients of both axes together. At 90, 180 and 270 degrees every
coefficient becomes another coefficient or its negative: the table of WSDC D-T033 ("WISE IOC
Distortion Calibration"), Appendix A. As in that document, a frame rotates by +90 degrees if u' = -v
and v' = u.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesdist.app.screen import number
from bayesdist.app.store.record import refuse_existing
from bayesdist.errors import InputError
from bayesdist.formats.sip.files import read_sip, write_sip
from bayesdist.formats.sip.header import SipHeader
from bayesdist.missions.wise.meta_data.meta import WiseBand, read_wise_meta, write_wise_meta
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.cards import header_of, keyword_of
from bayesdist.products.common.coefficients import substitution
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float

Terms = Mapping[tuple[int, int], float]

# Cards on the shape of an image, which after an arbitrary rotation is no longer a rectangle.
_SHAPE = ("NAXIS1", "NAXIS2", "IMAGEW", "IMAGEH")
# Exact cosines and sines, which numpy gives only to rounding.
_QUARTERS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}


def rotate(
    path: str | Path,
    output: str | Path,
    *,
    degrees: float,
    mirror: bool,
    force: bool,
) -> str:
    """Write a SIP header or WISE meta-data in a rotated pixel frame; returns text to print."""
    path, output = Path(path), Path(output)
    refuse_existing(output, force)
    key = open_document(path).format.key
    if key == "sip":
        turned = rotated_sip(read_sip(path), degrees, mirror=mirror)
        write_sip(turned, output)
        lines = [_line("", turned)]
    elif key == "wise_meta":
        bands = {
            band.band: _turned(band, degrees, mirror, str(path)) for band in read_wise_meta(path)
        }
        write_wise_meta(output, bands)
        lines = [_line(f"W{band.band}: ", band.sip) for band in read_wise_meta(output)]
    else:
        raise InputError(
            "has no SIP keywords", where=str(path), do="give a SIP header or WISE meta-data"
        )
    mirrored = "mirrored and " if mirror else ""
    return "\n".join([f"{output}: {mirrored}rotated by {degrees:g} degrees", *lines])


def _turned(band: WiseBand, degrees: float, mirror: bool, where: str) -> SipHeader:
    if degrees % 90 != 0:
        raise InputError(
            f"the angle is {degrees:g}, but arrays in WISE meta-data are aligned with the axes",
            where=where,
            do="give a multiple of 90",
        )
    if band.skew != 0:
        # the skew would become a scale of the other axis and a rotation
        raise InputError(
            f"SKEW of band {band.band} is {band.skew:g} rad, "
            "which cannot be kept in a rotated frame",
            where=where,
            do="include it in A and B",
        )
    return rotated_sip(band.sip, degrees, mirror=mirror)


def _line(name: str, sip: SipHeader) -> str:
    maxima = {"A_DMAX": sip.a_dmax, "B_DMAX": sip.b_dmax, "worst closure": sip.closure}
    parts = [
        f"{name_of_value} {number(value)} px"
        for name_of_value, value in maxima.items()
        if value is not None
    ]
    return f"  {name}{', '.join(parts) or 'no maxima and no closure stated'}"


def rotated_sip(sip: SipHeader, degrees: float, *, mirror: bool = False) -> SipHeader:
    """Header of an image in rotated or mirrored pixels.

    Forward terms, inverse terms, CD and CRPIX change together, so that every star has the same sky
    position as before at its new pixel.

    Parameters
    ----------
    sip : SipHeader
        Header in the original pixels.
    degrees : float
        Rotation of the pixel frame from u towards v.
    mirror : bool
        True to change the sign of u before the rotation.

    Returns
    -------
    SipHeader
        Header in the new pixels.

    Raises
    ------
    InputError
        If the angle is not a finite number.

    Notes
    -----
    At multiples of 90 degrees, coefficients only change places and signs, without rounding. A_DMAX,
    B_DMAX, standard deviations and size are converted, and CRPIX is that of the rotated image, with
    its first pixel at (1, 1) again. At any other angle, or without a size, the frame is rotated
    about CRPIX, which does not change. At any other angle the image is no longer a rectangle along
    the axes, so size, A_DMAX and B_DMAX are left out. Standard deviations are left out too, because
    they would require the covariance: see `coefficient_map`.
    """
    M = pixel_matrix(degrees, mirror=mirror)
    exact = is_exact(M)
    swapped = exact and M[0, 0] == 0
    order, a, b = _pair(sip.a, sip.b, sip.order, M)
    inverse_order: tuple[int, int] | None = None
    ap: Terms = {}
    bp: Terms = {}
    if sip.inverse_order is not None:
        inverse_order, ap, bp = _pair(sip.ap, sip.bp, sip.inverse_order, M)
    sigma_a: Terms = {}
    sigma_b: Terms = {}
    dmax: tuple[float | None, float | None] = (None, None)
    if exact:
        # a permutation: standard deviations change places like the coefficients, without signs
        sigma_a, sigma_b = (
            {k: abs(s) for k, s in terms.items()}
            for terms in _pair(sip.sigma_a, sip.sigma_b, sip.order, M)[1:]
        )
        dmax = sip.dmax[::-1] if swapped else sip.dmax
    size, crpix = None, sip.crpix
    if exact and sip.size is not None:
        size = sip.size[::-1] if swapped else sip.size
        arm = [ref - (n + 1) / 2 for ref, n in zip(sip.crpix, sip.size, strict=True)]
        moved = M @ arm
        crpix = (
            float((size[0] + 1) / 2 + moved[0]),
            float((size[1] + 1) / 2 + moved[1]),
        )
    return replace(
        sip,
        crpix=crpix,
        cd=sip.cd @ M.T,
        order=order,
        a=a,
        b=b,
        inverse_order=inverse_order,
        ap=ap,
        bp=bp,
        sigma_a=sigma_a,
        sigma_b=sigma_b,
        dmax=dmax,
        size=size,
        cards=_kept_cards(sip, size),
    )


def _pair(
    a: Terms, b: Terms, order: tuple[int, int], M: Float
) -> tuple[tuple[int, int], dict[tuple[int, int], float], dict[tuple[int, int], float]]:
    """Transformed orders and terms of both axes, without terms above their order."""
    low = [{k: c for k, c in t.items() if sum(k) <= n} for t, n in zip((a, b), order, strict=True)]
    terms = polynomial_terms(max(order))
    old = np.array([[t.get(k, 0.0) for k in terms] for t in low])
    R = coefficient_map(max(order), M)
    new = (R @ old.ravel()).reshape(2, -1) + 0.0
    # write a term if any original term contributes to it, even if the value is zero
    stated = np.array([[k in t for k in terms] for t in low], float).ravel()
    written = (np.abs(R) @ stated).reshape(2, -1) > 0
    out = [
        {k: float(c) for k, c, w in zip(terms, values, mask, strict=True) if w}
        for values, mask in zip(new, written, strict=True)
    ]
    if M[0, 1] == 0:
        return order, out[0], out[1]
    turned = order[::-1] if M[0, 0] == 0 else (max(order), max(order))
    return turned, out[0], out[1]


def _kept_cards(sip: SipHeader, size: tuple[int, int] | None) -> tuple[str, ...]:
    """Cards of the original header, without those on the shape if it has changed."""
    if size == sip.size:
        return sip.cards
    names = set(header_of(sip.cards)) & set(_SHAPE)
    return tuple(card for card in sip.cards if keyword_of(card) not in names)


def pixel_matrix(degrees: float, *, mirror: bool = False) -> Float:
    """Matrix M (2, 2) of pixel offsets, w' = M w: optional mirror of u, then rotation from u to v.

    Whole numbers at multiples of 90 degrees; InputError if the angle is not finite.
    """
    if not np.isfinite(degrees):
        raise InputError(f"the angle is {degrees}", where="degrees", do="give a finite number")
    turn = float(degrees) % 360.0
    angle = np.deg2rad(turn)
    c, s = _QUARTERS.get(turn, (np.cos(angle), np.sin(angle)))
    matrix = np.array([[c, -s], [s, c]])
    if mirror:
        matrix[:, 0] *= -1
    return matrix + 0.0  # avoids negative zeros


def coefficient_map(order: int, M: Float) -> Float:
    """Matrix R (2 K, 2 K) from the coefficients of (A, B) to those in another pixel frame.

    New coefficients are R c, where c holds those of A followed by those of B in the order of
    `polynomial_terms`; their covariance is R cov R^T. `M` is orthogonal, see `pixel_matrix`. At
    multiples of 90 degrees R is a signed permutation.
    """
    return np.asarray(np.kron(M, substitution(order, M.T)), float)


def is_exact(M: Float) -> bool:
    """True if the rotated axes are parallel to the original axes."""
    return bool(np.all(np.round(M) == M))
