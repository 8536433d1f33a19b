"""One chip at one date: a polynomial from pixels to (u, v), with its covariance.

Fits, posteriors and files of every format are reduced to this, so that any two can be compared,
applied, inverted.  Look-up tables are those of pixels before the polynomial and of positions after
it, which are evaluated at the corrected pixel; they have no part in the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import Chip, LookupTable, PolynomialBasis
from bayesdist.model.basis import point_blocks
from bayesdist.utils.arrays import Float

# Newton's method has converged when a step is this short in pixels, which rounding allows.
STEP, MAX_STEPS = 1e-9, 30
_FIT_NODES = 129  # points of each axis over which a map is followed by a polynomial
MOST_ORDER = 20  # of the polynomials of any file
SINGULAR = 1e-12  # of the largest slope squared: below that a linear part has no inverse


@dataclass(frozen=True, eq=False)
class Monomials:
    """Map as files state it: coefficients of (x - xref)^i (y - yref)^j."""

    basis: PolynomialBasis  # for order, size and reference pixel
    values: Float  # (2, K), of u and v, in the order of `terms`
    cov: Float | None = None  # (2 K, 2 K), u before v

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j), length K."""
        return self.basis.terms

    def index(self, i: int, j: int) -> int:
        """Index of a term."""
        return self.terms.index((i, j))

    @property
    def constant(self) -> Float:
        """Position (u, v) at the reference pixel, shape (2,)."""
        return self.values[:, 0]

    @property
    def linear(self) -> Float:
        """Derivatives d(u, v) / d(x, y) at the reference pixel, shape (2, 2)."""
        return self.values[:, 1:3]


@dataclass(frozen=True, eq=False)
class ChipMap:
    """Map of one chip at one date by one calibration."""

    name: str  # of the calibration, for messages
    basis: PolynomialBasis
    unit: str  # of u and v
    coefficients: Float  # (2, K), Legendre, of u and v
    cov: Float | None = None  # (2 K, 2 K), u before v; None without errors
    correlated: bool = True  # False where monomials have sigmas alone
    draws: float = np.inf  # effective number behind `cov`; infinite if computed
    chip: int | None = None  # None where the source numbers no chips
    epoch: float | None = None  # decimal years
    notes: tuple[str, ...] = ()  # notes for the reader
    before: tuple[LookupTable, ...] = ()  # in pixels, one after the other, before the polynomial
    after: tuple[LookupTable, ...] = ()  # in the unit of u and v, added to the polynomial

    def __post_init__(self) -> None:
        known = [self.coefficients] if self.cov is None else [self.coefficients, self.cov]
        if not all(np.isfinite(values).all() for values in known):
            raise InputError(
                "holds coefficients or errors that are not finite",
                where=self.name,
                do="check the file",
            )

    @property
    def errors(self) -> str:
        """Kind of its errors: 'none', 'sigma' or 'covariance'."""
        if self.cov is None:
            return "none"
        return "covariance" if self.correlated else "sigma"

    def at(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Positions (2, N) of pixels (N,), FITS 1-based."""
        x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
        out = np.empty((2, x.size))
        for rows in point_blocks(x.size):
            px, py = self._corrected(x[rows], y[rows])
            out[:, rows] = self.coefficients @ self.basis.evaluate(px, py).T
            for table in self.after:
                out[:, rows] += _shift(table, px, py)
        return out

    def design(self, x: Float, y: Float) -> Float:
        """Basis functions (N, K) at pixels (N,), tables before the polynomial included."""
        return self.basis.evaluate(*self._corrected(x, y))

    def slope(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Derivatives d(u, v) / d(x, y) at pixels (N,), shape (N, 2, 2)."""
        x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
        out = np.empty((x.size, 2, 2))
        for rows in point_blocks(x.size):
            out[rows] = self._values_and_slopes(np.stack([x[rows], y[rows]]))[1]
        return out

    def covariance_at(self, x: Float, y: Float) -> Float | None:
        """Covariances (N, 2, 2) of positions at pixels (N,); NaN stays NaN, None without errors."""
        if self.cov is None:
            return None
        K = self.basis.n_terms
        x, y = self._corrected(x, y)
        uu, vv, uv = position_moments(self.cov.reshape(2, K, 2, K), self.basis, x, y)
        out = np.empty((x.size, 2, 2))
        out[:, 0, 0], out[:, 1, 1], out[:, 0, 1], out[:, 1, 0] = uu, vv, uv, uv
        return out

    @property
    def linear(self) -> Float:
        """Derivatives (2, 2) at the reference pixel."""
        x, y = self.basis.reference_pixel
        return self.slope([x], [y])[0]

    def pixels(self, w: Float) -> tuple[Float, Float]:
        """Pixels (2, N) at positions (2, N) by Newton's method, and derivatives (N, 2, 2) there.

        The derivatives are d(u, v) / d(x, y).  Also beyond the edges of the chip; NaN where the
        iteration does not converge.  InputError when the linear part at the reference pixel is
        singular.
        """
        linear = self.linear
        if abs(np.linalg.det(linear)) <= SINGULAR * np.abs(linear).max() ** 2:
            raise InputError(
                "maps its zero point to a line, so that it has no inverse",
                where=f"{self.name}, chip {self.chip}",
                do="check the linear coefficients",
            )
        found, slope = np.empty((2, w.shape[1])), np.empty((w.shape[1], 2, 2))
        for rows in point_blocks(w.shape[1]):
            found[:, rows], slope[rows] = self._newton(w[:, rows], linear)
        return found, slope

    def unfolded_pixels(self, w: Float) -> Float:
        """Pixels (2, N) at positions (2, N), as `pixels`; NaN beyond a fold of the map."""
        found, slope = self.pixels(w)
        det = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        found[:, ~(det * np.linalg.det(self.linear) > 0)] = np.nan
        return found

    def _newton(self, w: Float, linear: Float) -> tuple[Float, Float]:
        zero = np.array(self.basis.reference_pixel)[:, None]
        pixels = zero + np.linalg.solve(linear, w - self._values_and_slopes(zero)[0])
        moving = np.isfinite(pixels).all(axis=0)
        pixels[:, ~moving] = np.nan
        far = 3.0 * max(self.basis.size)  # where a polynomial means nothing any more
        for _ in range(MAX_STEPS):
            if not moving.any():
                break
            value, slope = self._values_and_slopes(pixels[:, moving])
            with np.errstate(all="ignore"):
                step = _solved(slope, w[:, moving] - value)
            at = pixels[:, moving] + step
            lost = ~np.isfinite(at).all(axis=0) | (np.abs(at - zero).max(axis=0) > far)
            at[:, lost] = np.nan
            pixels[:, moving] = at
            moving[moving] = ~lost & (np.hypot(*step) > STEP)
        pixels[:, moving] = np.nan
        slope = np.full((w.shape[1], 2, 2), np.nan)
        good = np.isfinite(pixels[0])
        if good.any():
            slope[good] = self._values_and_slopes(pixels[:, good])[1]
        return pixels, slope

    def _values_and_slopes(self, pixels: Float) -> tuple[Float, Float]:
        """Values (2, N) and derivatives (N, 2, 2) by the pixel."""
        inner = np.eye(2)
        for table in self.before:
            inner = _slope(table, *pixels) @ inner
            pixels = pixels + _shift(table, *pixels)
        by_x, by_y = self.basis.derivatives
        C = self.coefficients.T
        # in one pass over the basis functions, which are far more numbers than the results
        all_six = self.basis.evaluate(*pixels) @ np.hstack([C, by_x @ C, by_y @ C])
        value = all_six[:, :2].T
        slope = np.stack([all_six[:, 2:4], all_six[:, 4:]], axis=-1)
        for table in self.after:
            value = value + _shift(table, *pixels)
            slope = slope + _slope(table, *pixels) - np.eye(2)
        return value, slope @ inner if self.before else slope

    def _corrected(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Pixels after the tables before the polynomial."""
        for table in self.before:
            dx, dy = _shift(table, x, y)
            x, y = x + dx, y + dy
        return x, y

    def monomials(self) -> Monomials:
        """Map in powers of offsets from the reference pixel."""
        values = self.basis.to_monomials(self.coefficients)
        cov = None
        if self.cov is not None:
            change = np.kron(np.eye(2), self.basis.monomial_matrix)
            cov = change @ self.cov @ change.T
        return Monomials(self.basis, values, cov)

    def padded(self, n_terms: int) -> tuple[Float, Float | None]:
        """Coefficients (2, n) and covariance (2 n, 2 n), zero for terms that are missing."""
        K = self.basis.n_terms
        coefficients = np.zeros((2, n_terms))
        coefficients[:, :K] = self.coefficients
        if self.cov is None:
            return coefficients, None
        cov = np.zeros((2, n_terms, 2, n_terms))
        cov[:, :K, :, :K] = self.cov.reshape(2, K, 2, K)
        return coefficients, cov.reshape(2 * n_terms, 2 * n_terms)

    def transformed(self, linear: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> ChipMap:
        """Map to linear (u, v) + shift, both taken as exact."""
        L = np.asarray(linear, float)
        after = tuple(
            replace(t, values=np.einsum("ab,byx->ayx", L, t.values), sigma=None) for t in self.after
        )
        coefficients = L @ self.coefficients
        coefficients[:, 0] += np.asarray(shift, float)  # the first basis function is 1
        cov = None
        if self.cov is not None:
            by = np.kron(L, np.eye(self.basis.n_terms))
            cov = by @ self.cov @ by.T
        return replace(self, coefficients=coefficients, cov=cov, after=after)

    def polynomial(self, order: int) -> tuple[ChipMap, float, float]:
        """Map without tables, of an order, and how far it is off: largest and rms, pixels.

        The polynomial is fitted over the detector; where there are no tables and the order is not
        below that of the map, the map stays as it is.  The errors are those of the terms that both
        have.
        """
        if not self.before and not self.after and order >= self.basis.order:
            return self, 0.0, 0.0
        basis = PolynomialBasis(order, self.basis.size, self.basis.reference_pixel)
        x, y = _even_grid(basis.size)
        design, wanted = basis.evaluate(x, y), self.at(x, y)
        coefficients = np.asarray(np.linalg.lstsq(design, wanted.T, rcond=None)[0].T, float)
        left = np.hypot(*(design @ coefficients.T - wanted.T).T)
        left /= np.sqrt(abs(np.linalg.det(self.linear)))
        cov, K = None, self.basis.n_terms
        if self.cov is not None:
            same = min(K, basis.n_terms)
            both = np.zeros((2, basis.n_terms, 2, basis.n_terms))
            both[:, :same, :, :same] = self.cov.reshape(2, K, 2, K)[:, :same, :, :same]
            cov = both.reshape(2 * basis.n_terms, -1)
        made = replace(self, basis=basis, coefficients=coefficients, cov=cov, before=(), after=())
        return made, float(left.max()), float(np.sqrt(np.mean(left**2)))


def _shift(table: LookupTable, x: Float, y: Float) -> Float:
    """Values (2, N) of a table; NaN where a pixel is."""
    known = np.isfinite(x) & np.isfinite(y)
    out = np.full((2, x.size), np.nan)
    out[:, known] = table.evaluate(x[known], y[known]).T
    return out


def _slope(table: LookupTable, x: Float, y: Float) -> Float:
    """Derivatives (N, 2, 2) of the corrected pixel by the pixel; NaN where a pixel is."""
    known = np.isfinite(x) & np.isfinite(y)
    out = np.full((x.size, 2, 2), np.nan)
    out[known] = table.gradient(x[known], y[known])
    return out


def _even_grid(size: tuple[float, float]) -> tuple[Float, Float]:
    """Points (N,) over a detector, denser than any table that a polynomial could follow."""
    x, y = np.meshgrid(*(np.linspace(0.5, n + 0.5, _FIT_NODES) for n in size))
    return x.ravel(), y.ravel()


def chip_of(maps: Mapping[int, ChipMap], number: int, where: str) -> ChipMap:
    """Map of a chip; InputError for an unknown one."""
    if number not in maps:
        raise InputError(
            f"there is no chip {number}",
            where=where,
            do=f"choose one of {', '.join(map(str, maps))}",
        )
    return maps[number]


def chosen_chip(
    numbers: Sequence[int], chip: int | None, *, where: str, argument: str = "chip"
) -> int:
    """Number of the chip that is asked for; it may be omitted if there is only one.

    `argument` is what the user gives it by: an argument in Python, or an option of a command.
    InputError if there is no such chip, or there are several and none is given.
    """
    if chip is None and len(numbers) == 1:
        return numbers[0]
    if chip is not None and chip in numbers:
        return int(chip)
    raise InputError(
        f"has {len(numbers)} chips, and none is named"
        if chip is None
        else f"there is no chip {chip!r}",
        where=where,
        do=f"give {argument}, one of {', '.join(map(str, numbers))}",
    )


def sampling_of(solution: Solution) -> tuple[float, tuple[str, ...]]:
    """Effective number of draws behind a solution's covariance, and notes on these."""
    convergence = solution.convergence
    if convergence is None:
        return np.inf, ()
    notes = () if convergence.converged else ("has not converged",)
    return float(convergence.ess_bulk_min), notes


def refuse_order(order: int, name: str) -> None:
    """Raise InputError for a polynomial of an order that only a misprint has."""
    if order > MOST_ORDER:  # time and memory go with its fourth power
        raise InputError(
            f"the order of its polynomials is {order}, and at most {MOST_ORDER} is read",
            where=name,
            do="correct the file",
        )


def fitted_map(
    positions: Callable[[Float, Float], Float | tuple[Float, Float]],
    name: str,
    *,
    order: int,
    size: tuple[float, float],
    reference_pixel: tuple[float, float],
    unit: str,
    monomial_cov: Float | None = None,
    chip: int | None = None,
) -> ChipMap:
    """Map with the values of a function from pixels to (u, v) that is a polynomial.

    `positions` takes FITS 1-based pixels x, y (N,) to u and v (2, N), a polynomial of total order
    `order`; `monomial_cov` (2 K, 2 K) is of the coefficients of (x - xref)^i (y - yref)^j, u before
    v; other arguments as in `PolynomialBasis` and `ChipMap`.
    """
    refuse_order(order, name)
    basis = PolynomialBasis(order, size, reference_pixel)
    # products of two terms have twice the order, for which so many nodes are exact
    x, y, weight = Chip(1, "", size, reference_pixel).quadrature(order + 1)
    norm = basis.mean_squares * weight.sum()
    coefficients = (np.asarray(positions(x, y)) * weight) @ basis.evaluate(x, y) / norm
    cov = None
    if monomial_cov is not None:
        back = np.kron(np.eye(2), basis.from_monomials(np.eye(basis.n_terms)).T)
        cov = back @ monomial_cov @ back.T
        cov = (cov + cov.T) / 2
    return ChipMap(name, basis, unit, coefficients, cov, chip=chip)


def position_moments(
    coefficients: Float, basis: PolynomialBasis, x: Float, y: Float
) -> tuple[Float, Float, Float]:
    """Variances and covariance (N,) of u, v at pixels, from second moments (2, K, 2, K)."""
    out = np.empty((3, x.size))
    for rows in point_blocks(x.size):
        phi = basis.evaluate(x[rows], y[rows])
        for k, (a, b) in enumerate(((0, 0), (1, 1), (0, 1))):
            out[k, rows] = np.einsum("nk,nk->n", phi @ coefficients[a, :, b, :], phi)
    # rounding may leave a variance of zero slightly below it
    return np.maximum(out[0], 0.0), np.maximum(out[1], 0.0), out[2]


def _solved(a: Float, b: Float) -> Float:
    """Solutions (2, N) of 2 x 2 systems (N, 2, 2) for (2, N); infinite where one is singular."""
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    x = a[:, 1, 1] * b[0] - a[:, 0, 1] * b[1]
    y = a[:, 0, 0] * b[1] - a[:, 1, 0] * b[0]
    return np.stack([x, y]) / det
