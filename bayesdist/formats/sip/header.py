"""SIP header: a distortion as FITS keywords (Shupe et al. 2005, ASP Conf. 347, 491).

With FITS pixels (x, y):

    u = x - CRPIX1,    v = y - CRPIX2
    U = u + A(u, v),   V = v + B(u, v),   (xi, eta) = CD (U, V)
    u = U + AP(U, V),  v = V + BP(U, V)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.inverse import detector_grid
from bayesdist.errors import InputError
from bayesdist.products.common.coefficients import evaluate, radial_orders, sip_keyword
from bayesdist.products.common.rules import repeated_values
from bayesdist.utils.arrays import Float

Terms = Mapping[tuple[int, int], float]

SIDE_FILE = "BDPARAM"  # keyword with the name of the file that has the covariance
# Programs ignore lower orders, and a keyword has only one digit for each power.
SIP_ORDERS = (2, 9)
# CTYPE of a user-defined plane, which no program interprets as sky coordinates
LINEAR_AXES = ("U", "V")


@dataclass(frozen=True, eq=False)
class SipHeader:
    """Distortion of one image as stated in a header, and all other cards of the header.

    Mappings give the coefficient for powers (p, q) of u and v.

    Parameters
    ----------
    crpix : tuple of float
        Reference pixel, FITS 1-based.
    crval : tuple of float
        Sky position of the reference pixel, degrees.
    cd : ndarray, shape (2, 2)
        CD matrix, degrees per pixel.
    ctype : tuple of str
        CTYPE1 and CTYPE2.
    order : tuple of int
        A_ORDER and B_ORDER.
    a, b : mapping
        Forward coefficients, pixels.
    inverse_order : tuple of int, optional
        AP_ORDER and BP_ORDER.
    ap, bp : mapping
        Inverse coefficients; empty if the header has none.
    sigma_a, sigma_b : mapping
        Standard deviations of `a` and `b`: keywords AE_p_q and BE_p_q.
    dmax : tuple of float, optional
        A_DMAX and B_DMAX: largest ``|A|`` and ``|B|`` over the detector, pixels.
    closure : float, optional
        Largest distance between a pixel and the inverse of its forward position: keyword BDCLOS,
        pixels.
    offset : tuple of float, optional
        (u, v) of the model at CRVAL: keywords BDU0 and BDV0.
    unit : str
        Unit of `offset`: keyword BDUNIT.
    size : tuple of int, optional
        Columns and rows of the image (NAXIS1/2, or IMAGEW/H in a header without data).
    cards : tuple of str
        All cards of a header that was read, or the cards that the fields above do not cover.

    Examples
    --------
    >>> from bayesdist.formats import sip_from_solution
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> sip = sip_from_solution(fit, scale_arcsec=2.757)
    >>> sorted(sip.a)
    [(0, 2), (1, 1), (2, 0)]
    """

    crpix: tuple[float, float]
    crval: tuple[float, float]
    cd: Float
    ctype: tuple[str, str]
    order: tuple[int, int]
    a: Terms
    b: Terms
    inverse_order: tuple[int, int] | None = None
    ap: Terms = field(default_factory=dict)
    bp: Terms = field(default_factory=dict)
    sigma_a: Terms = field(default_factory=dict)
    sigma_b: Terms = field(default_factory=dict)
    dmax: tuple[float | None, float | None] = (None, None)
    closure: float | None = None
    offset: tuple[float, float] | None = None
    unit: str = ""
    size: tuple[int, int] | None = None
    cards: tuple[str, ...] = ()

    @property
    def linear_axes(self) -> bool:
        """True if (u, v) are not on the sky: `cd` is in `axes_unit` per pixel, CRVAL a (u, v)."""
        return self.ctype == LINEAR_AXES

    @property
    def axes_unit(self) -> str:
        """Unit of (u, v) in a header with linear axes: BDUNIT, or the pixel."""
        return self.unit or "pix"

    @property
    def has_sigmas(self) -> bool:
        """True if standard deviations are stated, even if only for some terms."""
        return bool(self.sigma_a or self.sigma_b)

    @property
    def has_linear_sigmas(self) -> bool:
        """True if the standard deviations include those of the constant and linear terms.

        Otherwise the errors of positions are unknown.
        """
        low = ((0, 0), (1, 0), (0, 1))
        return all(term in sigma for sigma in (self.sigma_a, self.sigma_b) for term in low)

    @property
    def a_dmax(self) -> float | None:
        """A_DMAX, pixels."""
        return self.dmax[0]

    @property
    def b_dmax(self) -> float | None:
        """B_DMAX, pixels."""
        return self.dmax[1]

    @property
    def has_inverse(self) -> bool:
        """True if the header has AP and BP."""
        return self.inverse_order is not None

    def forward(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Corrected offsets from CRPIX, computed as in astropy.wcs.

        Terms above the order are left out; constant and linear terms are applied.

        Parameters
        ----------
        x, y : array_like
            FITS 1-based pixels.

        Returns
        -------
        U, V : ndarray
            Corrected offsets from CRPIX, pixels.
        """
        u = np.asarray(x, float) - self.crpix[0]
        v = np.asarray(y, float) - self.crpix[1]
        if min(self.order) < SIP_ORDERS[0]:  # astropy.wcs then ignores both axes
            return u, v
        return (
            u + evaluate(self.a, u, v, self.order[0]),
            v + evaluate(self.b, u, v, self.order[1]),
        )

    def inverse(self, U: ArrayLike, V: ArrayLike) -> tuple[Float, Float]:
        """Pixels at corrected offsets, computed from AP and BP.

        Parameters
        ----------
        U, V : array_like
            Corrected offsets from CRPIX, pixels.

        Returns
        -------
        x, y : ndarray
            FITS 1-based pixels.

        Raises
        ------
        InputError
            If the header has no inverse.
        """
        if self.inverse_order is None:
            raise InputError(
                "the header has no AP_ORDER and BP_ORDER", do="invert the forward terms instead"
            )
        U, V = np.asarray(U, float), np.asarray(V, float)
        return (
            U + evaluate(self.ap, U, V, self.inverse_order[0]) + self.crpix[0],
            V + evaluate(self.bp, U, V, self.inverse_order[1]) + self.crpix[1],
        )

    def plane(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Coordinates relative to CRVAL, in degrees, or in `axes_unit` for linear axes.

        Parameters
        ----------
        x, y : array_like
            FITS 1-based pixels.

        Returns
        -------
        xi, eta : ndarray
            Intermediate world coordinates.
        """
        U, V = self.forward(x, y)
        return self.cd[0, 0] * U + self.cd[0, 1] * V, self.cd[1, 0] * U + self.cd[1, 1] * V


def worst_closure(sip: SipHeader, size: tuple[float, float]) -> float:
    """Largest distance between a pixel and the inverse of its forward position.

    Parameters
    ----------
    sip : SipHeader
        Header with an inverse.
    size : tuple of float
        Columns and rows of the detector.

    Returns
    -------
    float
        Largest distance in pixels, over a grid of 257 x 257 pixels from corner to corner.

    Raises
    ------
    InputError
        If the header has no inverse.
    """
    x, y = detector_grid(size)
    back_x, back_y = sip.inverse(*sip.forward(x, y))
    return float(np.hypot(back_x - x, back_y - y).max())


# -- coefficients by family, and offsets over the detector ----------------------------------------


# Distance of the edge of a pixel from its centre; some programs include it in the maximum.
EDGE = 0.5


def forward_is_used(sip: SipHeader) -> bool:
    """True if programs apply A and B: they ignore orders below 2."""
    return min(sip.order) >= SIP_ORDERS[0]


def inverse_is_used(sip: SipHeader) -> bool:
    """True if AP and BP exist and their order is not ignored."""
    return sip.inverse_order is not None and min(sip.inverse_order) >= SIP_ORDERS[0]


def families(sip: SipHeader) -> list[tuple[str, int, dict[tuple[int, int], float]]]:
    """Prefix, order and terms of A and B, and of AP and BP if they exist."""
    out = [("A", sip.order[0], dict(sip.a)), ("B", sip.order[1], dict(sip.b))]
    if sip.inverse_order is not None:
        out += [
            ("AP", sip.inverse_order[0], dict(sip.ap)),
            ("BP", sip.inverse_order[1], dict(sip.bp)),
        ]
    return out


def values_by_keyword(sip: SipHeader) -> dict[str, float]:
    """Coefficients of all families, by keyword."""
    return {sip_keyword(p, *k): c for p, _, terms in families(sip) for k, c in terms.items()}


def repeated_names(sip: SipHeader) -> list[tuple[str, ...]]:
    """Groups of keywords with equal values, within A and B and within AP and BP.

    Values that are equal because the distortion is radial are left out.
    """
    out = []
    terms = {prefix: values for prefix, _, values in families(sip)}
    for prefixes in (("A", "B"), ("AP", "BP")):
        radial = radial_orders(*(terms.get(prefix, {}) for prefix in prefixes))
        groups = repeated_values(
            {k: c for k, c in values_by_keyword(sip).items() if k.split("_")[0] in prefixes}
        )
        for group in groups:
            orders = {sum(powers_of(name)) for name in group}
            if len(orders) > 1 or not orders <= radial:
                out.append(group)
    return out


def offset_ranges(
    sip: SipHeader, size: tuple[int, int], margin: float = 0.0
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lowest and highest offset from CRPIX along each axis, for pixel centres plus a margin."""
    (nx, ny), (x0, y0) = size, sip.crpix
    return (1 - margin - x0, nx + margin - x0), (1 - margin - y0, ny + margin - y0)


def half_unit(sip: SipHeader) -> float:
    """Half a unit of the last printed decimal of A_DMAX and B_DMAX."""
    exponents = [Decimal(repr(float(v))).as_tuple().exponent for v in sip.dmax if v is not None]
    return 0.5 * 10.0 ** min(int(e) for e in exponents)


def with_coefficient(sip: SipHeader, keyword: str, value: float) -> SipHeader:
    """Header with one coefficient replaced."""
    family = keyword.split("_", maxsplit=1)[0].lower()
    change: dict[str, Any] = {family: {**getattr(sip, family), powers_of(keyword): value}}
    return replace(sip, **change)


def powers_of(keyword: str) -> tuple[int, int]:
    """Powers (p, q) of a coefficient keyword."""
    _, p, q = keyword.split("_")
    return int(p), int(q)
