"""Protocol of error terms, and the forms in which their errors are drawn.

A term is drawn once for all chips, epochs and questions. Its draws are evaluated at the positions
of any domain. Terms are independent of each other: correlated errors must be one term with several
rows.

`draw` of a term returns one of these forms:

- `Polynomials`: errors of parameters, polynomials of the pixel for each chip and epoch;
- `Functions`: sums of arbitrary functions of the position;
- `Independent`: errors that are independent between positions;
- `Known`: displacements, which are not errors;
- `Together`: correlated rows of one term, which use the same draw number.

If the observer fits shift and rotation of an exposure, the part that this fit absorbs is subtracted
from `Polynomials` and `Functions`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.functions import Alignment
from bayesdist.calibration.chip_map import position_moments
from bayesdist.errors import required
from bayesdist.model import DistortionModel
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.utils.arrays import Float, Int

Scale = Mapping[str, float]
LOCAL, PRODUCT = "local", "product"
MEASURED, GIVEN, PUBLISHED = "measured in this run", "given by the user", "published"
BLOCK = 200_000  # number of positions times draws that are evaluated at a time
MANY = 64  # number of functions above which values are kept instead of coefficients


@dataclass(frozen=True)
class Row:
    """One row of an error budget."""

    name: str
    # 'systematic' (shared by all stars of an image), 'random' (independent for each star), 'local'
    # (shared by stars near a position) or 'product' (known deviation of a file, not an error)
    kind: str = "systematic"
    source: str = MEASURED  # begins with 'measured in this run', 'given by the user' or 'published'
    # False for a row that is only shown, because other rows already include it
    in_total: bool = True


@dataclass(frozen=True, eq=False)
class Image:
    """The image in which the position of a star is evaluated."""

    # (n,), code of the exposure in which each draw's star is observed; None for a new exposure, or
    # for a model without frames
    exposure: Int | None = None
    # (D,), parameters of the positions to which the observer has fitted shift and rotation of the
    # whole detector; None if there was no such fit
    aligned_by: Float | None = None


@dataclass(frozen=True, eq=False)
class Pool:
    """Finite set of draws from which those of a term are taken, possibly with repetitions.

    Drawing more often than this does not make a probability more precise, except for the part
    that other terms contribute.
    """

    # (n,), number within the set of each draw of the term; None if it is unknown
    rows: Int | None
    size: float  # effective number of independent draws in the set
    renewed: bool = False  # True if further draws of the term are taken from another set


class ErrorTerm(Protocol):
    """A contribution to the error of a position; every error term implements this protocol."""

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the error budget to which the term contributes, in a fixed order."""
        ...

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draw the error n times; each draw applies to all chips and epochs.

        Parameters
        ----------
        n : int
            Number of draws.
        rng : numpy.random.Generator
            Source of all random numbers of the term.

        Returns
        -------
        ErrorDraws
            Draws in the unit of u and v.
        """
        ...


@runtime_checkable
class VaryingTerm(ErrorTerm, Protocol):
    """A term of unknown extent: an error of the whole field, or one that varies over it."""

    @property
    def varies(self) -> bool | None:
        """True if the error may vary over the field; None is taken as False."""
        ...

    def treatments(
        self, model: DistortionModel, grid: tuple[int, int] | None
    ) -> tuple[ErrorTerm, ...]:
        """The error as a smooth field and as independent errors; empty if it cannot vary.

        `grid`: number of points along x and y of each chip over which the smooth field has its
        stated rms; None for the default grid.
        """
        ...


@runtime_checkable
class AmbiguousTerm(ErrorTerm, Protocol):
    """A term whose cause is unknown if the data fit two causes."""

    @property
    def alternative(self) -> ErrorTerm | None:
        """The error if it has the other cause; None if the cause is known."""
        ...


@runtime_checkable
class SizedTerm(ErrorTerm, Protocol):
    """A term whose size the user states as one number."""

    @property
    def sigma(self) -> float:
        """Standard deviation, in the unit of the term; 0 if there is no error."""
        ...


class ErrorDraws(Protocol):
    """Draws of a term; the forms of this package implement this protocol."""

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets from which the draws are taken; empty if each draw is independent."""
        ...

    def on(self, domain: EvaluationDomain, image: Image) -> ErrorField:
        """Errors at the positions of a domain, for a star in the given image."""
        ...


@dataclass(frozen=True, eq=False)
class ErrorField(ABC):
    """Errors of a term at the N positions of a domain.

    Mean squares have shape (P, 2), for u and v.  P is N for errors of positions, and the number of
    pairs if the domain is for differences between positions.
    """

    rows: tuple[Row, ...]
    domain: EvaluationDomain

    of_parameters: ClassVar[bool] = False  # True for errors of parameters

    @property
    def uniform(self) -> bool:
        """True if the error is the same at all positions."""
        return False

    def squares(self) -> dict[str, Float]:
        """Mean squares (P, 2) of each row, at positions or of the differences of pairs."""
        (row,) = self.rows
        return {row.name: self.total()}

    @abstractmethod
    def total(self) -> Float:
        """Mean squares (P, 2) of the sum of all rows."""

    @property
    def parts(self) -> tuple[ErrorField, ...]:
        """Fields of the single rows."""
        return (self,)

    @property
    def summed(self) -> tuple[ErrorField, ...]:
        """Fields that sum to the error."""
        return (self,)

    def by_row(self) -> Iterator[tuple[Row, ErrorField, Float]]:
        """Each row with its field and its mean squares (P, 2)."""
        squares = self.squares()
        for part in self.parts:
            for row in part.rows:
                yield row, part, squares[row.name]

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Relative uncertainty of the size of a single row on a chip; None if it is unknown.

        `monte_carlo` is that of a standard deviation from the draws, because their number is
        finite.
        """
        return monte_carlo


class DrawnField(ErrorField):
    """Errors that can be evaluated for every draw at the positions of a domain."""

    @property
    @abstractmethod
    def n_draws(self) -> int:
        """Number of draws, including repeated ones."""

    @property
    def n_different(self) -> int:
        """Number of different draws; further ones repeat them in order."""
        return self.n_draws

    @abstractmethod
    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of the d draws in a slice.

        `scale` has factors by which rows are multiplied, by name of the row; missing rows have the
        factor 1.
        """

    def total(self) -> Float:
        """Mean squares (P, 2) of the sum of all rows."""
        return self.by_draws(slice(0, self.n_different))

    def by_draws(self, draws: slice) -> Float:
        """Mean squares (P, 2) over the draws in a slice.

        The errors are evaluated in blocks of draws, to limit memory.
        """
        pairs, total, n = self.domain.pairs(), 0.0, draws.stop - draws.start
        step = max(1, BLOCK // max(self.domain.size, 1))
        for start in range(draws.start, draws.stop, step):
            errors = self.errors(slice(start, min(start + step, draws.stop)), {})
            if pairs is not None:
                errors = errors[:, pairs[1]] - errors[:, pairs[0]]
            total = total + np.einsum("dna,dna->na", errors, errors)
        return np.asarray(total / n)


def polynomial_errors(
    model: DistortionModel,
    mean: Float,
    theta: Float,
    *,
    epoch: float | None,
    chip: int,
    exposure: Int | int | None = None,
    rows: Int | None = None,
) -> Float:
    """Legendre coefficients (n, 2, K) of errors of parameters, along the axes of the gauge.

    `mean`: parameters without error, shape (D,). `theta`: parameters with errors, shape (n, D);
    without an exposure the first `n_global` columns are sufficient. `rows`: row of `theta` for each
    draw, shape (n,); all rows in order by default. `epoch`: decimal years. `chip`: chip number.
    `exposure`: code of the exposure with errors in its frame, either for all draws or for each,
    shape (n,); None for errors of the polynomials and their drift only.
    """
    if isinstance(exposure, np.ndarray):
        rows = np.arange(len(theta)) if rows is None else rows
        out = np.empty((len(rows), 2, model.n_terms))
        for e in np.unique(exposure):
            draws = exposure == e
            out[draws] = polynomial_errors(
                model, mean, theta[rows[draws]], epoch=epoch, chip=chip, exposure=int(e)
            )
        return out
    place = place_of(model, epoch=epoch, exposure=exposure, chip=chip)
    error = place.polynomial(theta) - place.polynomial(mean)
    error = error if rows is None else error[rows]
    if exposure is None:
        return error
    return np.asarray(np.linalg.solve(model.frame(mean, exposure)[0], error), float)


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Errors of parameters, which are polynomials for each chip and epoch."""

    row: Row
    model: DistortionModel
    mean: Float  # parameters without error, (D,)
    theta: Float  # (n, D), or (n, n_global) if no frame of an exposure has errors
    # code of an exposure with errors in its frame, which represents any new exposure
    exposure: int | None = None
    frames: bool = False  # True if the frame of the exposure of each draw's star has errors
    # more(epoch, chip_number) returns coefficients (n, 2, K) that are added to these polynomials
    more: Callable[[float | None, int], Float] | None = None
    pools: tuple[Pool, ...] = ()  # finite sets from which the parameters are taken

    def on(self, domain: EvaluationDomain, image: Image) -> PolynomialField:
        """Errors at the positions of a domain, without the part that an alignment absorbs."""

        def coefficients(chip: int) -> Float:
            exposure = image.exposure if self.frames else self.exposure
            out = polynomial_errors(
                self.model, self.mean, self.theta, epoch=domain.epoch, chip=chip, exposure=exposure
            )
            return out if self.more is None else out + self.more(domain.epoch, chip)

        return PolynomialField.of((self.row,), domain, image, coefficients)


@dataclass(frozen=True, eq=False)
class PolynomialField(DrawnField):
    """Errors that are polynomials of the pixel: a single row, or no row for a sum of rows."""

    coefficients: dict[int, Float]  # (n, 2, K), by chip number

    of_parameters = True

    @classmethod
    def of(
        cls,
        rows: tuple[Row, ...],
        domain: EvaluationDomain,
        image: Image,
        coefficients: Callable[[int], Float],
    ) -> PolynomialField:
        """Field from coefficients by chip, without the part that an alignment absorbs."""
        model, mean = domain.model, image.aligned_by
        if mean is None:
            return cls(rows, domain, {chip: coefficients(chip) for chip in domain.chips})
        all_coefficients = {chip.number: coefficients(chip.number) for chip in model.chips}
        return cls(rows, domain, Alignment.of(model, mean, domain.epoch).without(all_coefficients))

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(next(iter(self.coefficients.values())))

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of a slice of the draws; `scale` has factors for rows, by name."""
        size = scale.get(self.rows[0].name, 1.0) if self.rows else 1.0
        parts = []
        for chip, phi in self.domain.basis.items():
            coefficients = self.coefficients[chip][draws]
            # a single matrix product is faster than many with two rows each
            errors = coefficients.reshape(-1, coefficients.shape[2]) @ phi.T
            parts.append(np.swapaxes(errors.reshape(-1, 2, len(phi)), 1, 2))
        out = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return out if size == 1.0 else size * out

    def total(self) -> Float:
        """Mean squares (P, 2); for positions they are computed from second moments."""
        if self.domain.relative:
            return self.by_draws(slice(0, self.n_draws))
        at, out = self.domain, []
        for chip, rows in at.by_chip():
            e = self.coefficients[chip]
            flat = e.reshape(len(e), -1)
            second = (flat.T @ flat / len(e)).reshape(*e.shape[1:], *e.shape[1:])
            uu, vv, _ = position_moments(second, at.model.basis(chip), at.x[rows], at.y[rows])
            out.append(np.stack([uu, vv], axis=1))
        return np.concatenate(out)


@dataclass(frozen=True, eq=False)
class Functions:
    """Sums of functions of the position; draw k uses row k mod n' of the coefficients."""

    row: Row
    # (n', 2, m) by chip number; a chip that is missing has no such error. The key None is for all
    # chips
    coefficients: Mapping[int | None, NDArray[np.floating]]
    # functions(chip_number, x, y) with pixels x, y (N,) returns values (N, m)
    functions: Callable[[int, Float, Float], NDArray[np.floating]]
    n_draws: int
    uniform: bool = False  # True if the error is the same at all positions
    # covariance (2, m, m) of the coefficients, if it is stated; mean squares are then exact, and
    # the uncertainty of their size is unknown
    covariance: Mapping[int | None, Float] | None = None
    pools: tuple[Pool, ...] = ()  # finite sets from which the coefficients are taken
    _cache: dict[tuple[EvaluationDomain, bytes], FunctionField] = field(
        default_factory=dict, repr=False
    )
    # apart from the fields, because it is the same for all domains and takes longest
    _absorbed: dict[tuple[int, bytes], AbsorbedPart] = field(default_factory=dict, repr=False)

    def on(self, domain: EvaluationDomain, image: Image) -> FunctionField:
        """Errors at the positions of a domain, without the part that an alignment absorbs.

        The most recent ones are cached, and so is the part that the alignment absorbs.
        """
        mean = image.aligned_by
        key = domain.at(None), b"" if mean is None else mean.tobytes()
        if key not in self._cache:
            self._cache.clear()
            self._cache[key] = self._aligned(key[0], mean)
        return self._cache[key]

    def _aligned(self, domain: EvaluationDomain, mean: Float | None) -> FunctionField:
        """Errors at the positions of a domain; `mean` are the `aligned_by` of the image."""
        # without the caches, since a reference cycle would keep large arrays in memory
        of = replace(self, _cache={}, _absorbed={})
        if mean is None:
            return FunctionField((self.row,), domain, of)
        if self.uniform:  # a shift is absorbed exactly
            chips = {k: 0.0 * c for k, c in self.coefficients.items()}
            covariance = self.covariance and {k: 0.0 * c for k, c in self.covariance.items()}
            of = replace(of, coefficients=chips, covariance=covariance)
            return FunctionField((self.row,), domain, of)
        key = id(domain.model), mean.tobytes()  # the cached part keeps the model alive
        if key not in self._absorbed:
            self._absorbed.clear()
            # drifts change positions too little to matter for the rotation
            epoch = None if domain.model.time is None else domain.model.time.epoch0[0]
            self._absorbed[key] = AbsorbedPart(of, Alignment.of(domain.model, mean, epoch))
        return FunctionField((self.row,), domain, of, self._absorbed[key])

    def of(self, chip: int) -> NDArray[np.floating] | None:
        """Coefficients (n', 2, m) on a chip; None if there is no error."""
        return self.coefficients.get(chip, self.coefficients.get(None))

    def values(self, chip: int, x: Float, y: Float) -> NDArray[np.floating]:
        """Errors (n', N, 2) of all rows of coefficients, at pixels of a chip."""
        coefficients = self.of(chip)
        if coefficients is None:
            return np.zeros((1, len(x), 2))
        phi = self.functions(chip, x, y).astype(coefficients.dtype)
        # a single matrix product: 2000 products with two rows each take seven times as long
        errors = coefficients.reshape(-1, coefficients.shape[2]) @ phi.T
        return np.swapaxes(errors.reshape(-1, 2, len(phi)), 1, 2)


@dataclass(frozen=True, eq=False)
class AbsorbedPart:
    """Shift and rotation of the whole detector that an alignment fits to sums of functions."""

    of: Functions
    alignment: Alignment

    @cached_property
    def by_function(self) -> dict[int, Float]:
        """Shifts and rotation (3, 2, m) fitted to each function, by number of chips with errors."""
        chips = (chip.number for chip in self.alignment.model.chips)
        fit = partial(self.alignment.fitted, functions=self.of.functions)
        return {chip: fit(chip) for chip in chips if self.of.of(chip) is not None}

    @cached_property
    def by_row(self) -> Float:
        """Shifts and rotation (n', 3) fitted to the errors of each row of coefficients."""
        by_chip = [
            np.tensordot(required(self.of.of(chip), "the chip has errors"), fit, ((1, 2), (1, 2)))
            for chip, fit in self.by_function.items()
        ]
        every = slice(0, max((len(fitted) for fitted in by_chip), default=1))
        total = np.zeros((1, 3))
        for fitted in by_chip:
            total = total + _of_draws(fitted, every)
        return total


@dataclass(frozen=True, eq=False)
class FunctionField(DrawnField):
    """Sums of functions at the positions of a domain."""

    of: Functions
    absorbed: AbsorbedPart | None = None  # shift and rotation that are subtracted

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return self.of.n_draws

    @property
    def n_different(self) -> int:
        """Number of rows of coefficients."""
        return max(len(values) for values, _ in self._parts)

    @property
    def uniform(self) -> bool:
        """True if the error is the same at all positions."""
        return self.of.uniform

    @cached_property
    def _parts(self) -> list[tuple[NDArray[np.floating], NDArray[np.floating] | None]]:
        """For each chip: coefficients and functions (N, m), or values if there are many."""
        at = self.domain
        out: list[tuple[NDArray[np.floating], NDArray[np.floating] | None]] = []
        for chip, rows in at.by_chip():
            x, y = at.x[rows], at.y[rows]
            coefficients = self.of.of(chip)
            if coefficients is None or coefficients.shape[2] > MANY:
                out.append((self.of.values(chip, x, y), None))
            else:
                out.append((coefficients, self.of.functions(chip, x, y)))
        return out

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of a slice of the draws; `scale` has factors for rows, by name."""
        parts = []
        for values, phi in self._parts:
            drawn = _of_draws(values, draws)
            parts.append(drawn if phi is None else np.swapaxes(drawn @ phi.T, 1, 2))
        out = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        if self.absorbed is not None:
            out = out - _displacements(_of_draws(self.absorbed.by_row, draws), self._rigid)
        size = scale.get(self.of.row.name, 1.0)
        return np.asarray(out if size == 1.0 else size * out, float)

    @cached_property
    def _rigid(self) -> Float:
        """Both shifts and the rotation (N, 2, 3) at the positions of the domain."""
        at, absorbed = self.domain, required(self.absorbed, "there is no alignment")
        return np.concatenate(
            [absorbed.alignment.at(chip, at.x[rows], at.y[rows]) for chip, rows in at.by_chip()]
        )

    def total(self) -> Float:
        """Mean squares (P, 2), from the covariance or over all rows of coefficients."""
        if self.of.covariance is not None:
            return self._stated(self.of.covariance)
        return super().total()

    def _stated(self, covariance: Mapping[int | None, Float]) -> Float:
        """Mean squares (P, 2) from the covariance of the coefficients."""
        at, pairs = self.domain, self.domain.pairs()
        root = {chip: _roots(of_chip) for chip, of_chip in covariance.items()}
        # along u and v: functions (2, N, m) whose coefficients are independent, of unit variance
        functions = np.concatenate(
            [
                np.asarray(self.of.functions(chip, at.x[rows], at.y[rows]), float)
                @ root[chip if chip in covariance else None]
                for chip, rows in at.by_chip()
            ],
            axis=1,
        )
        crossed = np.zeros(0)
        if self.absorbed is not None:
            functions, crossed = self._without_rigid(functions, root)
        squares = np.square(functions).sum(axis=2).T
        if pairs is None:
            return np.asarray(squares)
        first, second = pairs
        out = squares[first] + squares[second]  # of chips whose coefficients are independent
        alike = (at.chip[first] == at.chip[second]) | (None in covariance)
        if self.absorbed is not None:  # the shift and rotation of both chips are common
            apart = np.flatnonzero(~alike)
            to_first, to_second = (
                np.einsum("nap,nap->na", self._rigid[i[apart]], crossed[j[apart]])
                for i, j in ((first, second), (second, first))
            )
            rigid = [self._rigid[i[apart]] for i in (first, second)]
            joint = np.einsum("nap,pq,naq->na", rigid[0], self._shared(root), rigid[1])
            out[apart] += 2.0 * (to_first + to_second - joint)
        common = np.flatnonzero(alike)
        step = max(1, BLOCK // functions.shape[2])
        for start in range(0, len(common), step):
            rows = common[start : start + step]
            differences = functions[:, second[rows]] - functions[:, first[rows]]
            out[rows] = np.square(differences).sum(axis=2).T
        return np.asarray(out)

    def _unit_fits(self, root: Mapping[int | None, Float]) -> dict[int | None, Float]:
        """Shifts and rotation (2, 3, m) of unit functions of each axis, by key of the covariance.

        `root` has the matrices that `_roots` returns.
        """
        out: dict[int | None, Float] = {}
        absorbed = required(self.absorbed, "there is no alignment")
        for chip, fit in absorbed.by_function.items():
            key = chip if chip in root else None
            out[key] = out.get(key, 0.0) + np.einsum("pam,amk->apk", fit, root[key])
        return out

    def _shared(self, root: Mapping[int | None, Float]) -> Float:
        """Covariance (3, 3) of the fitted shifts and rotation."""
        fits = self._unit_fits(root).values()
        return np.asarray(sum(np.einsum("apk,aqk->pq", fit, fit) for fit in fits))

    def _without_rigid(
        self, functions: Float, root: Mapping[int | None, Float]
    ) -> tuple[Float, Float]:
        """Functions (2, N, m + 3) of the errors after alignment, for unit coefficients.

        The last three are the part of the fit that is due to the other axis and to other chips.
        The second result is the covariance (N, 2, 3) of errors with the fitted shifts and rotation.
        """
        at, fits = self.domain, self._unit_fits(root)
        squares = {key: np.einsum("apk,aqk->apq", fit, fit) for key, fit in fits.items()}
        aligned, crossed = [], []
        for chip, rows in at.by_chip():
            key = chip if chip in root else None
            rigid = np.swapaxes(self._rigid[rows], 0, 1)  # (2, n, 3)
            fit = fits.get(key, np.zeros((2, 3, functions.shape[2])))
            of_others = sum((sq for k, sq in squares.items() if k != key), np.zeros((2, 3, 3)))
            rest = of_others.sum(axis=0) + squares.get(key, np.zeros((2, 3, 3)))[::-1]
            aligned.append(
                np.concatenate([functions[:, rows] - rigid @ fit, rigid @ _roots(rest)], axis=2)
            )
            crossed.append(functions[:, rows] @ np.swapaxes(fit, 1, 2))
        return np.concatenate(aligned, axis=1), np.swapaxes(np.concatenate(crossed, axis=1), 0, 1)

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Relative scatter of the rms of each draw over the chip; None if the size is stated."""
        if self.of.covariance is not None:
            return None
        model = self.domain.model
        size = model.chips[model.chip_code(chip)].size
        x, y = mesh(*grid_pixels(size, DEFAULT_GRID))
        values = self.of.values(chip, x, y)
        if self.absorbed is not None:
            rigid = self.absorbed.alignment.at(chip, x, y)
            values = values - _displacements(self.absorbed.by_row, rigid)
        by_draw = np.sqrt(np.mean(np.square(values, dtype=float), axis=(1, 2)))
        mean = float(by_draw.mean())
        return float(by_draw.std()) / mean if mean > 0 else 0.0


def _displacements(fitted: NDArray[np.floating], rigid: Float) -> Float:
    """Displacements (n, N, 2) by fitted shifts and rotations (n, 3) of which `rigid` (N, 2, 3)."""
    return np.asarray(fitted @ rigid.reshape(-1, 3).T).reshape(len(fitted), -1, 2)


def _roots(covariance: Float) -> Float:
    """Matrices R (2, m, m) with R R^T equal to the covariances (2, m, m), which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None])


def _of_draws(values: NDArray[np.floating], draws: slice) -> NDArray[np.floating]:
    """Rows (d, ...) of the draws in a slice: draw k is row k mod n'. A view if possible."""
    if draws.stop <= len(values):
        return values[draws]
    if len(values) == 1:
        return np.broadcast_to(values, (draws.stop - draws.start, *values.shape[1:]))
    return values[np.arange(draws.start, draws.stop) % len(values)]


@dataclass(frozen=True, eq=False)
class Independent:
    """Errors that are independent between positions."""

    pools: ClassVar[tuple[Pool, ...]] = ()

    row: Row
    # standard deviations (N, 2) at the positions of a domain; None if there is no such error, for
    # example for stars without a magnitude
    sigma: Callable[[EvaluationDomain], Float | None]
    # factors (n, 2) of the variances of each draw, by chip number; 1 for a chip that is missing
    sizes: Mapping[int, Float] = field(default_factory=dict)
    # relative uncertainty of the size, by chip number
    known: Mapping[int, float | None] = field(default_factory=dict)

    def on(self, domain: EvaluationDomain, image: Image) -> NoiseField:
        """Errors at the positions of a domain."""
        sigma = self.sigma(domain)
        return NoiseField(() if sigma is None else (self.row,), domain, self, sigma)


@dataclass(frozen=True, eq=False)
class NoiseField(ErrorField):
    """Independent errors at the positions of a domain; without a row if there are none."""

    of: Independent
    sigma: Float | None

    def squares(self) -> dict[str, Float]:
        """Mean squares (P, 2) of the row by its name; empty if there is no row."""
        return super().squares() if self.rows else {}

    def total(self) -> Float:
        """Variances (P, 2); for differences, the sum of the variances of both positions."""
        pairs = self.domain.pairs()
        if self.sigma is None:
            return np.zeros((self.domain.size if pairs is None else pairs.shape[1], 2))
        square = self.sigma**2
        return square if pairs is None else square[pairs[0]] + square[pairs[1]]

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Stated relative error; None if it is unknown."""
        return self.of.known.get(chip)


@dataclass(frozen=True, eq=False)
class Known:
    """Known displacements, which are not errors."""

    pools: ClassVar[tuple[Pool, ...]] = ()

    row: Row  # not included in any total
    # shift(x, y, chip_number, epoch) with pixels x, y (N,) and epoch or None returns (N, 2)
    shift: Callable[[Float, Float, int, float | None], Float]

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the displacements."""
        return (self.row,)

    def draw(self, n: int, rng: np.random.Generator) -> Known:
        """Return this object: displacements are the same in every draw."""
        return self

    def on(self, domain: EvaluationDomain, image: Image) -> KnownField:
        """Displacements at the positions of a domain."""
        parts = [
            self.shift(domain.x[rows], domain.y[rows], chip, domain.epoch)
            for chip, rows in domain.by_chip()
        ]
        return KnownField((self.row,), domain, np.concatenate(parts))


@dataclass(frozen=True, eq=False)
class KnownField(ErrorField):
    """Displacements (N, 2) at the positions of a domain."""

    shift: Float

    def squares(self) -> dict[str, Float]:
        """Squares (P, 2) of the displacements, or of their differences, by name of the row."""
        pairs = self.domain.pairs()
        moved = self.shift if pairs is None else self.shift[pairs[1]] - self.shift[pairs[0]]
        return {self.rows[0].name: moved**2}

    def total(self) -> Float:
        """Zeros (P, 2), because displacements are not errors."""
        return np.zeros_like(self.squares()[self.rows[0].name])

    def relative_error(self, chip: int, monte_carlo: float) -> float | None:
        """Zero, because displacements are exact."""
        return 0.0


@dataclass(frozen=True, eq=False)
class Together:
    """Correlated rows of one term, which use the same draw number.

    The joint error is the sum of the rows that are in the total. It already includes the rows that
    are not: if one of these is reduced, the variance of the joint error decreases at each position
    by the variance that the row loses.
    """

    draws: tuple[Polynomials | Functions, ...]  # one for each row
    # True if the last row is the excess of the joint error over the other rows
    remainder: bool = False

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets from which the draws of the rows are taken."""
        return tuple(pool for draws in self.draws for pool in draws.pools)

    def on(self, domain: EvaluationDomain, image: Image) -> TogetherField:
        """Errors at the positions of a domain."""
        parts = tuple(draws.on(domain, image) for draws in self.draws)
        return TogetherField.of(domain, parts, remainder=self.remainder)


@dataclass(frozen=True, eq=False)
class TogetherField(DrawnField):
    """Rows of one term at the positions of a domain."""

    members: tuple[DrawnField, ...]
    whole: DrawnField | None = None  # the joint error, if it is more than the sum of the rows
    remainder: bool = False  # see `Together`

    @classmethod
    def of(
        cls,
        domain: EvaluationDomain,
        parts: tuple[DrawnField, ...],
        whole: DrawnField | None = None,
        *,
        remainder: bool = False,
    ) -> TogetherField:
        """Field with the rows of all parts.

        `whole` is the joint error, if it is not the sum of the rows, and `remainder` is explained
        in `Together`.
        """
        rows = tuple(row for part in parts for row in part.rows)
        return cls(rows, domain, parts, whole, remainder)

    @property
    def parts(self) -> tuple[DrawnField, ...]:
        """A field for each row."""
        return self.members

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return self.members[0].n_draws

    @cached_property
    def summed(self) -> tuple[DrawnField, ...]:
        """Fields that sum to the joint error."""
        return self._added if self.whole is None else (self.whole,)

    @cached_property
    def _added(self) -> tuple[DrawnField, ...]:
        """Parts that are in the total."""
        return tuple(p for p in self.members if all(row.in_total for row in p.rows))

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Joint errors (d, N, 2) of a slice of the draws; `scale` has factors for rows, by name."""
        if self.whole is None:
            out = reduce(np.add, (part.errors(draws, scale) for part in self._added))
        else:
            out = self.whole.errors(draws, {})
            for part in self._added:
                sizes = [scale[row.name] for row in part.rows if row.name in scale]
                if sizes:
                    out = out - (1.0 - sizes[0]) * part.errors(draws, {})
        factor = self._factor(scale)
        return out if factor is None else factor * out

    def _factor(self, scale: Scale) -> Float | None:
        """Factor (N, 2) of the joint error if rows that it includes are reduced."""
        held = [r.name for r in self.rows if not r.in_total and r.name in scale]
        if not held:
            return None
        assert not self.domain.relative
        total, by_row = self.total(), self.squares()
        remaining = total - sum(
            (1.0 - scale[name] ** 2) * np.minimum(by_row[name], total) for name in held
        )
        return np.sqrt(np.maximum(remaining, 0.0) / np.where(total > 0, total, 1.0))

    def squares(self) -> dict[str, Float]:
        """Mean squares (P, 2) of each row."""
        return self._squares

    @cached_property
    def _squares(self) -> dict[str, Float]:
        out: dict[str, Float] = {}
        for part in self.members:
            out |= part.squares()
        if self.remainder:
            last = self.rows[-1].name
            other_rows = sum(square for name, square in out.items() if name != last)
            out[last] = np.maximum(self.total() - other_rows, 0.0)
        return out

    @cached_property
    def _total(self) -> Float:
        if self.whole is not None:
            return self.whole.total()
        if len(self._added) == 1:
            return self._added[0].total()
        return self.by_draws(slice(0, min(part.n_different for part in self._added)))

    def total(self) -> Float:
        """Mean squares (P, 2) of the joint error."""
        return self._total
