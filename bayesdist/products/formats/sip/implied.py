"""Value of one coefficient of a SIP header that all other numbers of the header imply."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.formats.common.coefficients import evaluate, sip_keyword
from bayesdist.products.formats.sip.families import (
    EDGE,
    families,
    forward_is_used,
    half_unit,
    inverse_is_used,
    offset_ranges,
    repeated_names,
    with_coefficient,
)
from bayesdist.products.formats.sip.header import SipHeader
from bayesdist.utils.arrays import Bool, Float

# Odds of a further, independent fault, for values that a suspect leaves unexplained.
_SECOND_FAULT = 1e-2
# Components of a closure are known to this; pixels.
_ROUNDING = 1e-12
_STEPS = 3
_TAIL = 1e-9
# Probabilities of equally probable nodes.
_MIDDLES = (np.arange(2000) + 0.5) / 2000
# Points of each axis over which stated maxima are compared, and the largest part of a maximum that
# such a sample misses.
_NODES, _SAMPLED = 129, 2e-4


@cache
def _student_nodes(dof: int) -> Float:
    """Equally probable nodes of Student's t distribution of unit scale about zero."""
    from scipy.special import stdtrit  # here, as few files need it, and all would wait for it

    return np.asarray(stdtrit(dof, _MIDDLES), float)


@dataclass(frozen=True)
class _Student:
    """Student's t distribution."""

    dof: int
    centre: float
    scale: float

    @property
    def nodes(self) -> Float:
        """Equally probable nodes."""
        return self.centre + self.scale * _student_nodes(self.dof)

    def below(self, values: ArrayLike) -> Float:
        """Probability below each of some values."""
        from scipy.special import stdtr

        return np.asarray(stdtr(self.dof, (np.asarray(values) - self.centre) / self.scale), float)

    def quantiles(self, probabilities: ArrayLike) -> Float:
        """Values with these probabilities below them."""
        from scipy.special import stdtrit

        return np.asarray(self.centre + self.scale * stdtrit(self.dof, probabilities), float)


@dataclass(frozen=True)
class Implied:
    """Value of one coefficient that all other numbers of a header imply."""

    keyword: str
    printed: float  # its value in the header
    value: float  # mean and standard deviation of the implied value
    sigma: float
    interval: tuple[float, float]  # that holds 95 % of the probability
    probability: float  # that this coefficient is the wrong one, if exactly one is and any might be
    # sources that the value agrees with: the other pair of polynomials, and A_DMAX or B_DMAX
    sources: tuple[str, ...]

    @property
    def pull(self) -> float:
        """(printed - value) / sigma."""
        return (self.printed - self.value) / self.sigma


def implied_values(sip: SipHeader, size: tuple[int, int] | None = None) -> tuple[Implied, ...]:
    """Values of each coefficient of A, B, AP and BP as if it alone were unknown.

    The closure (pixel, through A and B, back through AP and BP, minus pixel) is projected on
    orthonormal Legendre products over the detector, up to the order of the inverse; what that order
    cannot follow drops out.  A wrong coefficient moves the components along a known direction.
    Their scatter about it is the error of the printed inverse: normal, with one variance for
    even and one for odd total degree.  An inverse that was fitted to pairs of stars is biased by
    their position errors towards where stars are denser, which for a centred field is an odd
    function.  With a scale-free prior of both variances, the coefficient has a Student t
    distribution.  A_DMAX or B_DMAX restricts it to the values that its printed digits allow.

    `sip`: with an inverse. `size`: columns and rows of the detector; by default those of the
    header. Returns the most probable suspect first.  A stated maximum or a repeated value that a
    suspect leaves unexplained costs it odds of 100 to 1. InputError without a size or an inverse,
    or with orders that programs ignore.
    """
    size = size or sip.size
    if size is None or not (forward_is_used(sip) and inverse_is_used(sip)):
        raise InputError(
            "without an image size and orders of at least 2 nothing is implied",
            where="SIP header",
            do="give the size, and a header with A, B, AP and BP",
        )
    closure, maxima = _Closure.of(sip, size), StatedMaxima.of(sip, size)
    repeated = repeated_names(sip)
    unmet = {p for p in "AB" if maxima is not None and not maxima.met(p)}
    found, scores = [], []
    for family, order, terms in families(sip):
        for powers in (k for k in terms if sum(k) <= order):
            keyword = sip_keyword(family, *powers)
            posterior, score = closure.solved(sip, family, powers)
            share, sources = 1.0, ["A, B" if family in ("AP", "BP") else "AP, BP"]
            nodes = posterior.nodes
            if maxima is not None and family in ("A", "B"):
                share, cut = _cut(posterior, maxima.allowed(family, powers, posterior))
                if share > _SECOND_FAULT:
                    nodes = cut
                    sources.append(f"{family}_DMAX")
            score += np.log(max(share, _SECOND_FAULT))
            others = len(unmet - {family}) + sum(keyword not in names for names in repeated)
            scores.append(score + others * np.log(_SECOND_FAULT))
            found.append((keyword, terms[powers], nodes, tuple(sources)))
    weights = np.exp(np.array(scores) - max(scores))
    weights /= weights.sum()
    implied = [
        Implied(
            keyword,
            printed,
            float(nodes.mean()),
            float(nodes.std()),
            (float(np.quantile(nodes, 0.025)), float(np.quantile(nodes, 0.975))),
            float(p),
            sources,
        )
        for (keyword, printed, nodes, sources), p in zip(found, weights, strict=True)
    ]
    return tuple(sorted(implied, key=lambda one: -one.probability))


def _cut(t: _Student, intervals: list[tuple[float, float]]) -> tuple[float, Float]:
    """Probability of the intervals, and equally probable nodes within them."""
    limits = t.below(np.reshape(intervals, (-1, 2)))
    below = np.concatenate([[0.0], np.cumsum(limits[:, 1] - limits[:, 0])])
    share = float(below[-1])
    at = share * _MIDDLES
    which = np.clip(np.searchsorted(below, at) - 1, 0, None)
    return share, t.quantiles(limits[which, 0] + at - below[which]) if share > 0 else _MIDDLES


@dataclass(frozen=True, eq=False)
class _Closure:
    """Projection of closures on orthonormal Legendre products, by Gauss-Legendre quadrature."""

    x: Float
    y: Float
    projector: Float  # (K, N)
    odd: Bool  # (2 K,): components of odd total degree

    @classmethod
    def of(cls, sip: SipHeader, size: tuple[int, int]) -> _Closure:
        order = max(sip.inverse_order or (0,))
        # exact for a product of the closure's leading terms and a basis function
        t, w = legendre.leggauss(2 * order + 4)
        X, Y = (g.ravel() for g in np.meshgrid(t, t))
        i, j = np.array(polynomial_terms(order)).T
        values = legendre.legvander(X, order)[:, i] * legendre.legvander(Y, order)[:, j]
        values *= np.sqrt((2 * i + 1) * (2 * j + 1))
        x, y = ((n + 1) / 2 + n / 2 * T for n, T in zip(size, (X, Y), strict=True))
        return cls(
            x, y, (values * np.outer(w, w).ravel()[:, None] / 4).T, np.tile(i + j, 2) % 2 > 0
        )

    def components(self, sip: SipHeader, there: tuple[Float, Float]) -> Float:
        """Components (2 K,) of the closure along x, then y, with the pixels `there`; pixels."""
        back_x, back_y = sip.inverse(*there)
        return np.concatenate(
            [self.projector @ (back_x - self.x), self.projector @ (back_y - self.y)]
        )

    def solved(
        self, sip: SipHeader, family: str, powers: tuple[int, int]
    ) -> tuple[_Student, float]:
        """Distribution of one coefficient, and the logarithm of its evidence."""
        keyword = sip_keyword(family, *powers)
        there = sip.forward(self.x, self.y)

        def components(value: float) -> Float:
            changed = with_coefficient(sip, keyword, value)
            moved = changed.forward(self.x, self.y) if family in ("A", "B") else there
            return self.components(changed, moved)

        reach = np.ptp(self.x) / 2, np.ptp(self.y) / 2
        step = 0.1 / (reach[0] ** powers[0] * reach[1] ** powers[1])  # a tenth of a pixel
        value = getattr(sip, family.lower())[powers]
        rest = components(value)
        mask = self.odd if sum(powers) % 2 else ~self.odd
        d = ((components(value + step) - rest) / step)[mask]
        for _ in range(_STEPS):  # with one slope: a distortion is nearly linear in its coefficients
            value -= (d @ rest[mask]) / (d @ d)
            rest = components(value)
        from scipy.special import betaln

        dof = int(mask.sum()) - 1
        inside, outside = (float(r @ r) + r.size * _ROUNDING**2 for r in (rest[mask], rest[~mask]))
        score = betaln(0.5, dof / 2) - dof / 2 * np.log(inside)
        score -= (~mask).sum() / 2 * np.log(outside)
        return _Student(dof, float(value), float(np.sqrt(inside / dof / (d @ d)))), float(score)


@dataclass(frozen=True, eq=False)
class StatedMaxima:
    """A_DMAX and B_DMAX, and the points of the detector over which they were taken."""

    sip: SipHeader
    u: Float
    v: Float

    @classmethod
    def of(cls, sip: SipHeader, size: tuple[int, int]) -> StatedMaxima | None:
        """Stated maxima of a header; None where none are stated, or they fit no set of points."""
        if None in sip.dmax:
            return None
        for margin in (0.0, EDGE):
            u, v = (np.linspace(*ends, _NODES) for ends in offset_ranges(sip, size, margin))
            u, v = np.meshgrid(u, v)
            maxima = cls(sip, u.ravel(), v.ravel())
            if maxima.met("A") or maxima.met("B"):
                return maxima
        return None

    def with_value(self, keyword: str, value: float) -> StatedMaxima:
        """Stated maxima with another coefficient."""
        return replace(self, sip=with_coefficient(self.sip, keyword, value))

    def met(self, prefix: str) -> bool:
        """True where the printed coefficients of an axis reach the stated maximum."""
        low, high = self._limits(prefix)
        return bool(low <= np.abs(self._values(prefix)).max() <= high)

    def allowed(
        self, prefix: str, powers: tuple[int, int], t: _Student
    ) -> list[tuple[float, float]]:
        """Intervals of a coefficient within which the stated maximum is reached."""
        base, monomial = self._values(prefix), self.u ** powers[0] * self.v ** powers[1]
        printed = getattr(self.sip, prefix.lower())[powers]

        ends = t.quantiles([_TAIL / 2, 1 - _TAIL / 2])
        centre, half = ends.mean(), np.ptp(ends) / 2

        def beyond(z: float, limit: float) -> float:
            changed = base + (centre + z * half - printed) * monomial
            return float(np.abs(changed).max()) - limit

        from scipy.optimize import minimize_scalar

        # the largest |p| is a convex function of each coefficient
        lowest, highest = self._limits(prefix)
        bottom = float(minimize_scalar(beyond, bounds=(-1, 1), args=(0.0,), method="bounded").x)
        out = []
        for end in (-1.0, 1.0):
            near, far = (_crossing(beyond, bottom, end, limit) for limit in (lowest, highest))
            middle = (near + far) / 2
            if beyond(middle, lowest) >= 0 >= beyond(middle, highest):
                low, high = sorted((near, far))
                out.append((centre + low * half, centre + high * half))
        return out

    def _values(self, prefix: str) -> Float:
        terms = getattr(self.sip, prefix.lower())
        return evaluate(terms, self.u, self.v, self.sip.order["AB".index(prefix)])

    def _limits(self, prefix: str) -> tuple[float, float]:
        stated = self.sip.dmax["AB".index(prefix)] or 0.0
        tolerance = max(half_unit(self.sip), _SAMPLED * stated)
        return stated - tolerance, stated + tolerance


def _crossing(
    beyond: Callable[[float, float], float], start: float, end: float, limit: float
) -> float:
    """Point where a function that rises from `start` to `end` meets a limit, or the nearer end."""
    if beyond(start, limit) >= 0:
        return start
    if beyond(end, limit) <= 0:
        return end
    from scipy.optimize import brentq

    return float(brentq(beyond, start, end, args=(limit,)))


def with_error(one: Implied) -> str:
    """Value and standard deviation, to two digits of the latter."""
    largest = max(abs(one.value), one.sigma)
    digits = int(np.floor(np.log10(largest)) - np.floor(np.log10(one.sigma))) + 1
    return f"{one.value:+.{min(digits, 15)}e} +- {one.sigma:.1e}"
