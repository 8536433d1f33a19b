"""SIP header in rotated or mirrored pixels: forward and inverse terms, CD and CRPIX together.

With pixel offsets w = (u, v) from the reference pixel and an orthogonal matrix M, the new offsets
are w' = M w, and a distortion f = (A, B) becomes

    f'(w') = M f(M^-1 w')

which is linear in the coefficients of both axes together.  At 90, 180 and 270 degrees every
coefficient becomes one other one or its negative: the table of WSDC D-T033 ("WISE IOC Distortion
Calibration"), Appendix A. As there, a frame rotates by +90 degrees when u' = -v and v' = u.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bayesdist.errors import InputError
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.formats.common.cards import header_of, keyword_of
from bayesdist.products.formats.common.coefficients import substitution
from bayesdist.products.formats.sip.header import SipHeader
from bayesdist.utils.arrays import Float

Terms = Mapping[tuple[int, int], float]

# Cards that describe the shape of an image, which after a rotation by any angle is no rectangle.
_SHAPE = ("NAXIS1", "NAXIS2", "IMAGEW", "IMAGEH")
# Exact, as cosines and sines are not.
_QUARTERS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}


def rotated_sip(sip: SipHeader, degrees: float, *, mirror: bool = False) -> SipHeader:
    """Header of an image in rotated or mirrored pixels.

    The sky stays where it is: forward terms, inverse terms, CD and CRPIX change together, so that
    every star has the same position as before at its new pixel.

    `degrees`: rotation of the pixel frame from u towards v.  At multiples of 90 degrees
    coefficients only change places and signs, to the last bit. `mirror`: change the sign of u
    first. The result is at multiples of 90 degrees A_DMAX, B_DMAX, the standard deviations and the
    size follow, and CRPIX is that of the rotated image, whose first pixel is (1, 1) again.  Without
    a size, and at any other angle, CRPIX stays, about which the frame is rotated.  At any other
    angle the image is no rectangle along the axes, so that size, A_DMAX and B_DMAX are left out;
    standard deviations are too, because they then need the covariance: see `coefficient_map`.
    InputError when the angle is no finite number.
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
        # a permutation: the same one for standard deviations, without its signs
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
    """Orders and terms of both axes after the change, without terms above their order."""
    low = [{k: c for k, c in t.items() if sum(k) <= n} for t, n in zip((a, b), order, strict=True)]
    terms = polynomial_terms(max(order))
    old = np.array([[t.get(k, 0.0) for k in terms] for t in low])
    R = coefficient_map(max(order), M)
    new = (R @ old.ravel()).reshape(2, -1) + 0.0
    # a term is written where any old one goes to it, be its value zero or not
    there = np.array([[k in t for k in terms] for t in low], float).ravel()
    written = (np.abs(R) @ there).reshape(2, -1) > 0
    out = [
        {k: float(c) for k, c, w in zip(terms, values, mask, strict=True) if w}
        for values, mask in zip(new, written, strict=True)
    ]
    if M[0, 1] == 0:
        return order, out[0], out[1]
    turned = order[::-1] if M[0, 0] == 0 else (max(order), max(order))
    return turned, out[0], out[1]


def _kept_cards(sip: SipHeader, size: tuple[int, int] | None) -> tuple[str, ...]:
    """Cards of the old header but for its shape, where that has changed."""
    if size == sip.size:
        return sip.cards
    names = set(header_of(sip.cards)) & set(_SHAPE)
    return tuple(card for card in sip.cards if keyword_of(card) not in names)


def pixel_matrix(degrees: float, *, mirror: bool = False) -> Float:
    """Matrix M (2, 2) of pixel offsets, w' = M w: a rotation from u towards v, after a mirror of u.

    Whole numbers at multiples of 90 degrees; InputError when the angle is no finite number.
    """
    if not np.isfinite(degrees):
        raise InputError(f"the angle is {degrees}", where="degrees", do="give a finite number")
    turn = float(degrees) % 360.0
    angle = np.deg2rad(turn)
    c, s = _QUARTERS.get(turn, (np.cos(angle), np.sin(angle)))
    matrix = np.array([[c, -s], [s, c]])
    if mirror:
        matrix[:, 0] *= -1
    return matrix + 0.0  # no negative zeros


def coefficient_map(order: int, M: Float) -> Float:
    """Matrix R (2 K, 2 K) from the coefficients of (A, B) to those in a changed pixel frame.

    New coefficients are R c, with c those of A followed by those of B in the order of
    `polynomial_terms`; their covariance is R cov R^T.  `M` is orthogonal, as of `pixel_matrix`: at
    multiples of 90 degrees R is a signed permutation.
    """
    return np.asarray(np.kron(M, substitution(order, M.T)), float)


def is_exact(M: Float) -> bool:
    """True where the rotated axes lie along axes again."""
    return bool(np.all(np.round(M) == M))
