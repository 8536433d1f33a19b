"""Map of one chip at one date: a polynomial from pixels to (u, v), with its covariance.

Fits, posteriors and files of all formats are converted to such maps, so that any two of them can be
compared, applied and inverted.  Look-up tables may correct the pixels before the polynomial, or add
to the positions after it (evaluated at the corrected pixel).

The covariance is that of the parameters.  It does not include the errors of look-up tables.
Further position errors are listed as `FurtherError`, in a form that files can store.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import FormatError, InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import Chip, LookupTable, PolynomialBasis
from bayesdist.model.basis import point_blocks
from bayesdist.utils.arrays import Float

# Newton's method has converged if a step, in pixels, is below STEP, which is above rounding errors
STEP, MAX_STEPS = 1e-9, 30
_FIT_NODES = 129  # points per axis in the fit of a polynomial to a map
MOST_ORDER = 20  # highest polynomial order that is accepted from files
SINGULAR = (
    1e-12  # a linear part with a smaller determinant, over its largest entry squared, is singular
)
SHARED = "systematic"  # kind of an error that is common to all stars of an image


@dataclass(frozen=True, eq=False)
class Monomials:
    """Map in the form used in files: coefficients of (x - xref)^i (y - yref)^j."""

    basis: PolynomialBasis  # has the order, size and reference pixel
    values: Float  # (2, K), coefficients of u and v in the order of `terms`
    cov: Float | None = None  # (2 K, 2 K), u before v

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j) of the K terms."""
        return self.basis.terms

    def index(self, i: int, j: int) -> int:
        """Index of the term with exponents i and j."""
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
    """Map of one chip at one date."""

    name: str  # name of the calibration, for messages
    basis: PolynomialBasis
    unit: str  # unit of u and v
    coefficients: Float  # (2, K), Legendre coefficients of u and v
    cov: Float | None = None  # (2 K, 2 K), u before v; None without errors
    correlated: bool = True  # False if only standard deviations of monomials are known
    draws: float = np.inf  # effective number of draws for `cov`; infinite if it is analytic
    chip: int | None = None  # None if the source has no chip numbers
    epoch: float | None = None  # decimal years
    notes: tuple[str, ...] = ()  # notes for users
    before: tuple[LookupTable, ...] = ()  # pixels, applied in sequence before the polynomial
    after: tuple[LookupTable, ...] = ()  # in the unit of u and v, added to the polynomial

    def __post_init__(self) -> None:
        arrays = [self.coefficients] if self.cov is None else [self.coefficients, self.cov]
        if not all(np.isfinite(values).all() for values in arrays):
            raise InputError(
                "has coefficients or errors that are not finite",
                where=self.name,
                do="check the file",
            )

    @property
    def errors(self) -> str:
        """Kind of errors of the coefficients: 'none', 'sigma' or 'covariance'."""
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
        """Basis functions (N, K) at pixels (N,), after the tables `before` the polynomial."""
        return self.basis.evaluate(*self._corrected(x, y))

    def slope(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Derivatives d(u, v) / d(x, y) at pixels (N,), shape (N, 2, 2)."""
        x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
        out = np.empty((x.size, 2, 2))
        for rows in point_blocks(x.size):
            out[rows] = self._values_and_slopes(np.stack([x[rows], y[rows]]))[1]
        return out

    def covariance_at(self, x: Float, y: Float) -> Float | None:
        """Covariances (N, 2, 2) of the positions of pixels (N,); None without errors.

        The result is NaN for pixels that are NaN.
        """
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
        """Derivatives d(u, v) / d(x, y) at the reference pixel, shape (2, 2)."""
        x, y = self.basis.reference_pixel
        return self.slope([x], [y])[0]

    def pixels(self, w: Float) -> tuple[Float, Float]:
        """Invert the map by Newton's method.

        Parameters
        ----------
        w : ndarray, shape (2, N)
            Positions (u, v), also beyond the edges of the chip.

        Returns
        -------
        pixels : ndarray, shape (2, N)
            FITS 1-based pixels; NaN if the iteration does not converge.
        slope : ndarray, shape (N, 2, 2)
            Derivatives d(u, v) / d(x, y) at the pixels.

        Raises
        ------
        InputError
            If the linear part at the reference pixel is singular.
        """
        linear = self.linear
        if abs(np.linalg.det(linear)) <= SINGULAR * np.abs(linear).max() ** 2:
            raise InputError(
                "has a singular linear part at its reference pixel, so that it has no inverse",
                where=f"{self.name}, chip {self.chip}",
                do="check the linear coefficients",
            )
        pixels, slope = np.empty((2, w.shape[1])), np.empty((w.shape[1], 2, 2))
        for rows in point_blocks(w.shape[1]):
            pixels[:, rows], slope[rows] = self._newton(w[:, rows], linear)
        return pixels, slope

    def unfolded_pixels(self, w: Float) -> Float:
        """Pixels (2, N) at positions (2, N); see `pixels`.

        The result is also NaN if the map is folded at the pixel, that is, if the sign of its
        determinant differs from that at the reference pixel.
        """
        pixels, slope = self.pixels(w)
        det = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        pixels[:, ~(det * np.linalg.det(self.linear) > 0)] = np.nan
        return pixels

    def _newton(self, w: Float, linear: Float) -> tuple[Float, Float]:
        zero = np.array(self.basis.reference_pixel)[:, None]
        pixels = zero + np.linalg.solve(linear, w - self._values_and_slopes(zero)[0])
        moving = np.isfinite(pixels).all(axis=0)
        pixels[:, ~moving] = np.nan
        far = 3.0 * max(self.basis.size)  # a polynomial is meaningless so far outside
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
        """Positions (2, N) and their derivatives (N, 2, 2) with respect to the pixels (2, N)."""
        inner = np.eye(2)
        for table in self.before:
            inner = _slope(table, *pixels) @ inner
            pixels = pixels + _shift(table, *pixels)
        by_x, by_y = self.basis.derivatives
        C = self.coefficients.T
        # one product for values and derivatives, so that the basis functions are read only once
        all_six = self.basis.evaluate(*pixels) @ np.hstack([C, by_x @ C, by_y @ C])
        value = all_six[:, :2].T
        slope = np.stack([all_six[:, 2:4], all_six[:, 4:]], axis=-1)
        for table in self.after:
            value = value + _shift(table, *pixels)
            slope = slope + _slope(table, *pixels) - np.eye(2)
        return value, slope @ inner if self.before else slope

    def _corrected(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Apply the tables `before` the polynomial to pixels."""
        for table in self.before:
            dx, dy = _shift(table, x, y)
            x, y = x + dx, y + dy
        return x, y

    def monomials(self) -> Monomials:
        """Convert to coefficients of powers of the offsets from the reference pixel."""
        values = self.basis.to_monomials(self.coefficients)
        cov = None
        if self.cov is not None:
            change = np.kron(np.eye(2), self.basis.monomial_matrix)
            cov = change @ self.cov @ change.T
        return Monomials(self.basis, values, cov)

    def padded(self, n_terms: int) -> tuple[Float, Float | None]:
        """Coefficients (2, n) and covariance (2 n, 2 n), extended with zeros to `n_terms` terms.

        The covariance is None if it is unknown.
        """
        K = self.basis.n_terms
        coefficients = np.zeros((2, n_terms))
        coefficients[:, :K] = self.coefficients
        if self.cov is None:
            return coefficients, None
        cov = np.zeros((2, n_terms, 2, n_terms))
        cov[:, :K, :, :K] = self.cov.reshape(2, K, 2, K)
        return coefficients, cov.reshape(2 * n_terms, 2 * n_terms)

    def transformed(self, linear: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> ChipMap:
        """Map to the positions linear @ (u, v) + shift; the transformation is taken as exact."""
        L = np.asarray(linear, float)
        after = tuple(
            replace(t, values=np.einsum("ab,byx->ayx", L, t.values), sigma=None) for t in self.after
        )
        coefficients = L @ self.coefficients
        coefficients[:, 0] += np.asarray(shift, float)  # the first basis function is 1
        cov = None
        if self.cov is not None:
            change = np.kron(L, np.eye(self.basis.n_terms))
            cov = change @ self.cov @ change.T
        return replace(self, coefficients=coefficients, cov=cov, after=after)

    def polynomial(self, order: int) -> tuple[ChipMap, float, float]:
        """Approximate the map by a polynomial of the given order without look-up tables.

        The polynomial is fitted over the detector, and the covariance is that of the common terms.
        A map without look-up tables is returned unchanged if its order is not above `order`.

        Parameters
        ----------
        order : int
            Total order of the polynomial.

        Returns
        -------
        polynomial : ChipMap
            Map without look-up tables.
        worst, rms : float
            Largest and rms residual in pixels.
        """
        if not self.before and not self.after and order >= self.basis.order:
            return self, 0.0, 0.0
        basis = PolynomialBasis(order, self.basis.size, self.basis.reference_pixel)
        x, y = _even_grid(basis.size)
        design, positions = basis.evaluate(x, y), self.at(x, y)
        coefficients = np.asarray(np.linalg.lstsq(design, positions.T, rcond=None)[0].T, float)
        residual = np.hypot(*(design @ coefficients.T - positions.T).T)
        residual /= np.sqrt(abs(np.linalg.det(self.linear)))
        cov, K = None, self.basis.n_terms
        if self.cov is not None:
            n_common = min(K, basis.n_terms)
            common = np.zeros((2, basis.n_terms, 2, basis.n_terms))
            common[:, :n_common, :, :n_common] = self.cov.reshape(2, K, 2, K)[
                :, :n_common, :, :n_common
            ]
            cov = common.reshape(2 * basis.n_terms, -1)
        approximation = replace(
            self, basis=basis, coefficients=coefficients, cov=cov, before=(), after=()
        )
        return approximation, float(residual.max()), float(np.sqrt(np.mean(residual**2)))


def _shift(table: LookupTable, x: Float, y: Float) -> Float:
    """Shifts (2, N) of a table; NaN for pixels that are NaN."""
    finite = np.isfinite(x) & np.isfinite(y)
    out = np.full((2, x.size), np.nan)
    out[:, finite] = table.evaluate(x[finite], y[finite]).T
    return out


def _slope(table: LookupTable, x: Float, y: Float) -> Float:
    """Derivatives (N, 2, 2) of the corrected with respect to the original pixel; NaN for NaN."""
    finite = np.isfinite(x) & np.isfinite(y)
    out = np.full((x.size, 2, 2), np.nan)
    out[finite] = table.gradient(x[finite], y[finite])
    return out


def _even_grid(size: tuple[float, float]) -> tuple[Float, Float]:
    """Uniform grid of pixels (N,) over a detector, denser than the nodes of look-up tables."""
    x, y = np.meshgrid(*(np.linspace(0.5, n + 0.5, _FIT_NODES) for n in size))
    return x.ravel(), y.ravel()


def chip_of(maps: Mapping[int, ChipMap], number: int, where: str) -> ChipMap:
    """Map of a chip among `maps`, by chip number; raises InputError if the chip is unknown."""
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
    """Validate a chip number, which may be omitted if there is only one chip.

    Parameters
    ----------
    numbers : sequence of int
        Available chip numbers.
    chip : int or None
        Requested chip number.
    where : str
        File or name, for the error message.
    argument : str
        Name of the argument or command-line option, for the error message.

    Returns
    -------
    int

    Raises
    ------
    InputError
        If the chip does not exist, or there are several chips and none is requested.
    """
    if chip is None and len(numbers) == 1:
        return numbers[0]
    if chip is not None and chip in numbers:
        return int(chip)
    raise InputError(
        f"has {len(numbers)} chips, but none is given"
        if chip is None
        else f"there is no chip {chip!r}",
        where=where,
        do=f"give {argument}, one of {', '.join(map(str, numbers))}",
    )


def sampling_of(solution: Solution) -> tuple[float, tuple[str, ...]]:
    """Effective number of draws for the covariance of a solution, and notes on convergence."""
    convergence = solution.convergence
    if convergence is None:
        return np.inf, ()
    notes = () if convergence.converged else ("has not converged",)
    return float(convergence.ess_bulk_min), notes


def refuse_order(order: int, name: str) -> None:
    """Raise InputError if the order of a polynomial is so high that it must be a misprint."""
    if order > MOST_ORDER:  # time and memory are proportional to its fourth power
        raise InputError(
            f"the order of its polynomials is {order}, but at most {MOST_ORDER} is supported",
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
    """Map of a chip from a function that is known to be a polynomial.

    Parameters
    ----------
    positions : callable
        Function of FITS 1-based pixels x, y (N,) that returns u and v (2, N) and is a polynomial of
        total order `order`.
    name : str
        Name of the calibration.
    order, size, reference_pixel
        See `PolynomialBasis`.
    unit : str
        Unit of u and v.
    monomial_cov : ndarray, shape (2 K, 2 K), optional
        Covariance of the coefficients of (x - xref)^i (y - yref)^j, u before v.
    chip : int, optional
        Chip number.

    Returns
    -------
    ChipMap

    Raises
    ------
    InputError
        If the order is too high.
    """
    refuse_order(order, name)
    basis = PolynomialBasis(order, size, reference_pixel)
    # products of two terms have twice the order; order + 1 nodes integrate them exactly
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
    """Variance of u, variance of v, and covariance of u and v, each (N,), at pixels.

    `coefficients` (2, K, 2, K) is the covariance of the Legendre coefficients; x and y (N,) are
    FITS 1-based pixels.
    """
    out = np.empty((3, x.size))
    for rows in point_blocks(x.size):
        phi = basis.evaluate(x[rows], y[rows])
        for k, (a, b) in enumerate(((0, 0), (1, 1), (0, 1))):
            out[k, rows] = np.einsum("nk,nk->n", phi @ coefficients[a, :, b, :], phi)
    # rounding can make a variance of zero slightly negative
    return np.maximum(out[0], 0.0), np.maximum(out[1], 0.0), out[2]


def _solved(a: Float, b: Float) -> Float:
    """Solutions (2, N) of 2 x 2 systems a (N, 2, 2) x = b (2, N); infinite if singular."""
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    x = a[:, 1, 1] * b[0] - a[:, 0, 1] * b[1]
    y = a[:, 0, 0] * b[1] - a[:, 1, 0] * b[0]
    return np.stack([x, y]) / det


@dataclass(frozen=True)
class FurtherError:
    """Row of an error budget that the covariance of the parameters does not include."""

    name: str
    # 'systematic' (common to all stars of an image), 'random' (independent for each star) or
    # 'local' (common to stars that are close together)
    kind: str
    u: float  # rms over the detector of the error along u, in the unit of u and v
    v: float  # the same along v
    source: str = ""
    # for local errors: (fraction of the variance, correlation length in pixels) of each correlated
    # component; the remaining variance is independent for each star
    correlation: tuple[tuple[float, float], ...] = ()

    @property
    def shared(self) -> bool:
        """True if the error is common to all stars of an image."""
        return self.kind == SHARED


def scaled(rows: Sequence[FurtherError], factor: float) -> tuple[FurtherError, ...]:
    """Multiply u and v of error rows by `factor`, to convert them to another unit."""
    return tuple(replace(row, u=factor * row.u, v=factor * row.v) for row in rows)


def further_from(records: Sequence[Mapping[str, Any]], where: str) -> tuple[FurtherError, ...]:
    """Error rows from the records of a file; raises FormatError if a record is incomplete."""
    try:
        return tuple(
            FurtherError(
                str(record["name"]),
                str(record["kind"]),
                float(record["u"]),
                float(record["v"]),
                str(record.get("source", "")),
                tuple(
                    (float(part), float(length)) for part, length in record.get("correlation", ())
                ),
            )
            for record in records
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"has an incomplete entry for a further error ({error})",
            where=where,
            do="write the file again",
        ) from None
