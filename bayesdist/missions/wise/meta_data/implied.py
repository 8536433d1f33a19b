"""Value of one coefficient of a SIP header that is implied by all other numbers of the header."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.formats.sip.header import (
    EDGE,
    SipHeader,
    families,
    forward_is_used,
    half_unit,
    inverse_is_used,
    offset_ranges,
    repeated_names,
    with_coefficient,
    worst_closure,
)
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.coefficients import evaluate, sip_keyword
from bayesdist.products.common.document import Finding
from bayesdist.utils.arrays import Bool, Float

# A single coefficient is blamed if its correct value reduces the closure to this fraction.
_EXPLAINED = 0.2
# Smallest probability of further suspects that are named after the first one.
_WORTH_NAMING = 0.05
# Relative tolerance at which two numbers count as equal except for a mistyped sign.
_SAME_SIZE = 0.05
# Odds of a second, independent error, for inconsistencies that a suspect does not explain.
_SECOND_FAULT = 1e-2
# Rounding error of the components of a closure; pixels.
_ROUNDING = 1e-12
_STEPS = 3
_TAIL = 1e-9
# Probabilities at which equally probable nodes are placed.
_MIDDLES = (np.arange(2000) + 0.5) / 2000
# Points per axis at which stated maxima are compared, and the largest relative error of a maximum
# that is found by such sampling.
_NODES, _SAMPLED = 129, 2e-4


@dataclass(frozen=True)
class Implied:
    """Value of one coefficient that is implied by all other numbers of a header.

    Parameters
    ----------
    keyword : str
        Keyword of the coefficient.
    printed : float
        Value in the header.
    value, sigma : float
        Mean and standard deviation of the implied value.
    interval : tuple of float
        Central interval that contains 95 % of the probability.
    probability : float
        Probability that this coefficient is wrong, if exactly one is and each may be.
    sources : tuple of str
        Sources of the implied value: the other pair of polynomials, and A_DMAX or B_DMAX.
    """

    keyword: str
    printed: float
    value: float
    sigma: float
    interval: tuple[float, float]
    probability: float
    sources: tuple[str, ...]

    @property
    def pull(self) -> float:
        """(printed - value) / sigma."""
        return (self.printed - self.value) / self.sigma


def implied_values(sip: SipHeader, size: tuple[int, int] | None = None) -> tuple[Implied, ...]:
    """Implied value of each coefficient of A, B, AP and BP, each treated as the only unknown.

    Parameters
    ----------
    sip : SipHeader
        Header with an inverse.
    size : tuple of int, optional
        Columns and rows of the detector. The default is the size in the header.

    Returns
    -------
    tuple of Implied
        Implied values of all coefficients, the most probable suspect first.

    Raises
    ------
    InputError
        If there is no size or no inverse, or if programs ignore the orders.

    Notes
    -----
    The closure (a pixel after A and B and back through AP and BP, minus the pixel) is projected on
    orthonormal Legendre products over the detector, up to the order of the inverse, which removes
    what that order cannot represent. A wrong coefficient changes the components along a known
    direction. The scatter of the components around it is the error of the printed inverse, modelled
    as normal with one variance for even and one for odd total degree: an inverse fitted to pairs of
    stars is biased by their position errors towards regions with more stars, which is an odd
    function for a centred field. With a scale-free prior on both variances, the coefficient has a
    Student t distribution. A_DMAX or B_DMAX restricts it to values that agree with the printed
    digits. A suspect that leaves a stated maximum or a repeated value unexplained is penalised by
    odds of 100 to 1.
    """
    size = size or sip.size
    if size is None or not (forward_is_used(sip) and inverse_is_used(sip)):
        raise InputError(
            "an implied coefficient requires an image size and orders of at least 2",
            where="SIP header",
            do="give the size, and a header with A, B, AP and BP",
        )
    closure, maxima = _Closure.of(sip, size), StatedMaxima.of(sip, size)
    repeated = repeated_names(sip)
    unmet = {p for p in "AB" if maxima is not None and not maxima.met(p)}
    coefficients, scores = [], []
    for family, order, terms in families(sip):
        used = [powers for powers in terms if sum(powers) <= order]
        for powers, (posterior, score) in zip(used, closure.solved(family, used), strict=True):
            keyword = sip_keyword(family, *powers)
            share, sources = 1.0, ["A, B" if family in ("AP", "BP") else "AP, BP"]
            nodes = posterior.nodes
            if maxima is not None and family in ("A", "B"):
                share, cut = _cut(posterior, maxima.allowed(family, powers, posterior))
                if share > _SECOND_FAULT:
                    nodes = cut
                    sources.append(f"{family}_DMAX")
            score += np.log(max(share, _SECOND_FAULT))
            unexplained = len(unmet - {family}) + sum(keyword not in names for names in repeated)
            scores.append(score + unexplained * np.log(_SECOND_FAULT))
            coefficients.append((keyword, terms[powers], nodes, tuple(sources)))
    weights = np.exp(np.array(scores) - max(scores))
    weights /= weights.sum()
    implied = [
        Implied(
            keyword,
            printed,
            float(nodes.mean()),
            float(nodes.std()),
            tuple(np.quantile(nodes, (0.025, 0.975)).tolist()),
            float(p),
            sources,
        )
        for (keyword, printed, nodes, sources), p in zip(coefficients, weights, strict=True)
    ]
    return tuple(sorted(implied, key=lambda value: -value.probability))


def wrong_coefficient(sip: SipHeader, size: tuple[int, int], closure: float) -> Iterator[Finding]:
    """Finding on a wrong coefficient whose correct value alone makes A, B and AP, BP agree.

    The command `inspect` adds it to the checks of SIP headers (`bayesdist.plugin.Mission.checks`).

    Parameters
    ----------
    sip : SipHeader
        Header with an inverse.
    size : tuple of int
        Columns and rows of the detector.
    closure : float
        Largest distance between a pixel and the inverse of its forward position, pixels.

    Yields
    ------
    Finding
        Error that names the keyword and the implied value; nothing if no single coefficient
        explains the closure.
    """
    suspects = implied_values(sip, size)
    first = suspects[0]
    remaining = worst_closure(with_coefficient(sip, first.keyword, first.value), size)
    if remaining > _EXPLAINED * closure:
        return
    low, high = first.interval
    message = (
        f"is {first.printed:.7g}, and {' and '.join(first.sources)} imply {_with_error(first)} "
        f"(95 %: {low:.7g} to {high:.7g}; closure then {remaining:.2g} px)"
    )
    if abs(first.printed + first.value) < _SAME_SIZE * abs(first.value):
        message += "; the sign is wrong"
    for names in repeated_names(sip):
        if first.keyword in names:
            repeated = " and ".join(n for n in names if n != first.keyword)
            message += f"; what stands there is the value of {repeated}"
    rivals = [suspect for suspect in suspects[1:] if suspect.probability > _WORTH_NAMING]
    for rival in rivals:
        message += f"; or {rival.keyword} should be {_with_error(rival)}"
    if rivals:
        message += "; these numbers alone do not tell which"
    yield Finding("error", first.keyword, message)


def _with_error(one: Implied) -> str:
    """Text of value and standard deviation, with two digits of the latter."""
    largest = max(abs(one.value), one.sigma)
    digits = int(np.floor(np.log10(largest)) - np.floor(np.log10(one.sigma))) + 1
    return f"{one.value:+.{min(digits, 15)}e} +- {one.sigma:.1e}"


@cache
def _student_nodes(dof: int) -> Float:
    """Equally probable nodes of Student's t distribution with unit scale, centred on zero."""
    # imported here because few files need it and it slows down the import
    from scipy.special import stdtrit

    return np.asarray(stdtrit(dof, _MIDDLES), float)


@dataclass(frozen=True)
class _Student:
    """Student's t distribution."""

    dof: int
    centre: float
    scale: float

    @property
    def nodes(self) -> Float:
        """Equally probable nodes of the distribution."""
        return self.centre + self.scale * _student_nodes(self.dof)

    def below(self, values: ArrayLike) -> Float:
        """Cumulative probability at the given values."""
        from scipy.special import stdtr

        return np.asarray(stdtr(self.dof, (np.asarray(values) - self.centre) / self.scale), float)

    def quantiles(self, probabilities: ArrayLike) -> Float:
        """Values with the given cumulative probabilities."""
        from scipy.special import stdtrit

        return np.asarray(self.centre + self.scale * stdtrit(self.dof, probabilities), float)


def _cut(t: _Student, intervals: list[tuple[float, float]]) -> tuple[float, Float]:
    """Total probability of the intervals, and equally probable nodes within them."""
    limits = t.below(np.reshape(intervals, (-1, 2)))
    below = np.concatenate([[0.0], np.cumsum(limits[:, 1] - limits[:, 0])])
    share = float(below[-1])
    at = share * _MIDDLES
    interval = np.clip(np.searchsorted(below, at) - 1, 0, None)
    return share, t.quantiles(limits[interval, 0] + at - below[interval]) if share > 0 else _MIDDLES


@dataclass(frozen=True, eq=False)
class _Closure:
    """Projection of closures on orthonormal Legendre products by Gauss-Legendre quadrature."""

    sip: SipHeader
    pixels: tuple[Float, Float]  # (N,), quadrature points
    forth: tuple[Float, Float]  # corrected offsets (N,) of these pixels from A and B
    projector: Float  # (N, K)
    odd: Bool  # (2 K,), True for components of odd total degree

    @classmethod
    def of(cls, sip: SipHeader, size: tuple[int, int]) -> _Closure:
        order = max(sip.inverse_order or (0,))
        # exact for the product of the closure's leading terms and a basis function
        t, w = legendre.leggauss(2 * order + 4)
        X, Y = (g.ravel() for g in np.meshgrid(t, t))
        i, j = np.array(polynomial_terms(order)).T
        values = legendre.legvander(X, order)[:, i] * legendre.legvander(Y, order)[:, j]
        values *= np.sqrt((2 * i + 1) * (2 * j + 1))
        values *= np.outer(w, w).ravel()[:, None] / 4
        x, y = ((n + 1) / 2 + n / 2 * T for n, T in zip(size, (X, Y), strict=True))
        return cls(sip, (x, y), sip.forward(x, y), values, np.tile(i + j, 2) % 2 > 0)

    def components(self, family: str, moves: Float) -> Float:
        """Components (n, 2 K) of closures along x, then y, in pixels.

        `moves` (n, N) are values that are added to the polynomial of one family.
        """
        added: dict[str, Float | float] = dict.fromkeys(("A", "B", "AP", "BP"), 0.0)
        added[family] = moves
        x, y = self.sip.inverse(self.forth[0] + added["A"], self.forth[1] + added["B"])
        backs = (x + added["AP"] - self.pixels[0], y + added["BP"] - self.pixels[1])
        return np.concatenate(
            [np.broadcast_to(back, moves.shape) @ self.projector for back in backs], axis=1
        )

    def solved(self, family: str, powers: list[tuple[int, int]]) -> list[tuple[_Student, float]]:
        """Distribution of each coefficient of a family, and its log-evidence."""
        from scipy.special import betaln

        pixels = [
            coordinate - middle
            for coordinate, middle in zip(self.pixels, self.sip.crpix, strict=True)
        ]
        i, j = np.reshape(powers, (-1, 2)).T
        u, v = self.forth if family in ("AP", "BP") else pixels
        monomials = u ** i[:, None] * v ** j[:, None]

        def components(changes: Float) -> Float:
            return self.components(family, changes[:, None] * monomials)

        width, height = (np.ptp(coordinate) / 2 for coordinate in self.pixels)
        step = 0.1 / (width**i * height**j)  # a tenth of a pixel
        mask = self.odd == ((i + j) % 2 > 0)[:, None]
        changes = np.zeros(len(powers))
        residual = components(changes)
        d = np.where(mask, components(step) - residual, 0.0) / step[:, None]
        norm = (d**2).sum(axis=1)
        # with a constant slope: the closure is nearly linear in the coefficients
        for _ in range(_STEPS):
            changes -= (d * residual).sum(axis=1) / norm
            residual = components(changes)
        n_inside, n_outside = mask.sum(axis=1), (~mask).sum(axis=1)
        dof = n_inside - 1
        inside = np.where(mask, residual**2, 0.0).sum(axis=1) + n_inside * _ROUNDING**2
        outside = np.where(mask, 0.0, residual**2).sum(axis=1) + n_outside * _ROUNDING**2
        score = betaln(0.5, dof / 2) - dof / 2 * np.log(inside) - n_outside / 2 * np.log(outside)
        printed = getattr(self.sip, family.lower())
        return [
            (_Student(int(n), printed[k] + float(change), float(scale)), float(log_evidence))
            for k, n, change, scale, log_evidence in zip(
                powers, dof, changes, np.sqrt(inside / dof / norm), score, strict=True
            )
        ]


@dataclass(frozen=True, eq=False)
class StatedMaxima:
    """A_DMAX and B_DMAX, and the detector points over which the maxima are taken."""

    sip: SipHeader
    u: Float
    v: Float

    @classmethod
    def of(cls, sip: SipHeader, size: tuple[int, int]) -> StatedMaxima | None:
        """Stated maxima of a header; None if none are stated, or if no set of points fits them."""
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
        """Stated maxima with one coefficient replaced."""
        return replace(self, sip=with_coefficient(self.sip, keyword, value))

    def met(self, prefix: str) -> bool:
        """True if the printed coefficients of an axis reproduce the stated maximum."""
        low, high = self._limits(prefix)
        return bool(low <= np.abs(self._values(prefix)).max() <= high)

    def allowed(
        self, prefix: str, powers: tuple[int, int], t: _Student
    ) -> list[tuple[float, float]]:
        """Intervals of a coefficient in which the stated maximum is reproduced."""
        base, monomial = self._values(prefix), self.u ** powers[0] * self.v ** powers[1]
        printed = getattr(self.sip, prefix.lower())[powers]

        ends = t.quantiles([_TAIL / 2, 1 - _TAIL / 2])
        centre, half = ends.mean(), np.ptp(ends) / 2

        def beyond(z: float, limit: float) -> float:
            changed = base + (centre + z * half - printed) * monomial
            return float(np.abs(changed).max()) - limit

        from scipy.optimize import minimize_scalar

        # the maximum of |p| is a convex function of each coefficient
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
    """Point where a function that rises from `start` to `end` equals `limit`, or the nearer end."""
    if beyond(start, limit) >= 0:
        return start
    if beyond(end, limit) <= 0:
        return end
    from scipy.optimize import brentq

    return float(brentq(beyond, start, end, args=(limit,)))
