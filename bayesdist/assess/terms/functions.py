"""Errors that are smooth functions of the position, without the part that an alignment absorbs.

`Polynomials` are errors of parameters, polynomials of the pixel for each chip and epoch, and
`Functions` are sums of arbitrary functions of the position.

Observers who apply a calibration to an exposure fit its pointing: shift and rotation of the whole
detector.  The part of an error that this fit absorbs is not an error, and it depends on the gauge;
the residual is the same in every gauge.  The fit is by least squares to stars that cover all chips
evenly (`Alignment`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import BLOCK, DrawnField, Image, Pool, Row, Scale
from bayesdist.calibration.chip_map import position_moments
from bayesdist.errors import required
from bayesdist.model import DistortionModel
from bayesdist.model.alignment import mean_squares
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.utils.arrays import Float, Int

MANY = 64  # number of functions above which values are kept instead of coefficients
QUADRATURE = 24  # points along x and y of a chip in integrals over it (Gauss-Legendre)


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


@dataclass(frozen=True, eq=False)
class Alignment:
    """Best-fitting shift and rotation of the whole detector for error fields.

    Shifts along u and v and a rotation about the mean position are orthogonal functions; here they
    have unit mean square (the sum of both axes) over the detector.
    """

    model: DistortionModel
    # Legendre coefficients (2, K) of the positions (u, v) by chip number, for all chips
    positions: Mapping[int, Float]

    @classmethod
    def of(cls, model: DistortionModel, mean: Float, epoch: float | None) -> Alignment:
        """Alignment by the positions that parameters (D,) give at an epoch in decimal years."""
        return cls(
            model,
            {
                chip.number: place_of(model, epoch=epoch, chip=chip.number).polynomial(mean)
                for chip in model.chips
            },
        )

    @cached_property
    def _weight(self) -> Float:
        """Mean square (C, 2, K) of each basis function, with chips weighted by area."""
        return mean_squares(self.model).reshape(len(self.model.chips), 2, -1)

    @cached_property
    def rigid(self) -> Float:
        """Legendre coefficients (3, C, 2, K) of both shifts and the rotation on the C chips."""
        weight = self._weight
        rigid = np.zeros((3, *weight.shape))
        rigid[0, :, 0, 0] = rigid[1, :, 1, 0] = 1.0
        for c, chip in enumerate(self.model.chips):
            u, v = self.positions[chip.number]
            rigid[2, c] = -v, u
        rigid[2, ..., 0] -= np.einsum("ca,ca->a", weight[..., 0], rigid[2, ..., 0])
        rigid[2] /= np.sqrt(np.sum(weight * rigid[2] ** 2))
        return rigid

    def without(self, errors: Mapping[int, Float]) -> dict[int, Float]:
        """Subtract the best-fitting shift and rotation from errors that are polynomials.

        `errors` are Legendre coefficients (n, 2, K) by chip number, for all chips of the model. The
        result has the same form.
        """
        chips = self.model.chips
        stacked = np.stack([errors[chip.number] for chip in chips], axis=1)
        fitted = np.einsum("pcak,ncak->np", self.rigid * self._weight, stacked)
        residual = stacked - np.einsum("np,pcak->ncak", fitted, self.rigid)
        return {chip.number: residual[:, c] for c, chip in enumerate(chips)}

    def at(self, chip: int, x: Float, y: Float) -> Float:
        """Both shifts and the rotation (N, 2, 3) at pixels (N,) of a chip, along u and v."""
        phi = self.model.basis(chip).evaluate(x, y)
        rigid = self.rigid[:, self.model.chip_code(chip)]
        return np.asarray(np.moveaxis(rigid @ phi.T, 2, 0).swapaxes(1, 2))

    def fitted(
        self, chip: int, functions: Callable[[int, Float, Float], NDArray[np.floating]]
    ) -> Float:
        """Shifts and rotation (3, 2, m) fitted to each function on a chip, as an error of u or v.

        `functions(chip, x, y)` returns values (N, m) at pixels. The shifts and rotation fitted to
        an error on several chips are the sum over these.
        """
        size = self.model.chips[self.model.chip_code(chip)].size
        area = sum(c.size[0] * c.size[1] for c in self.model.chips)
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        x, y = (a.ravel() for a in np.meshgrid(*(0.5 + n * (nodes + 1.0) / 2.0 for n in size)))
        weight = np.outer(weights, weights).ravel() * (size[0] * size[1] / area / 4.0)
        return np.einsum(
            "nap,nm->pam", weight[:, None, None] * self.at(chip, x, y), functions(chip, x, y)
        )


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
