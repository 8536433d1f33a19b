"""Errors of parameters: polynomials of the pixel position, for each chip and epoch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms.rows import DrawnField, Image, Pool, Row, Scale
from bayesdist.calibration.chip_map import position_moments
from bayesdist.infer.compare.frame_fields import mean_squares
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int


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


def without_rigid(
    errors: Mapping[int, Float], positions: Mapping[int, Float], model: DistortionModel
) -> dict[int, Float]:
    """Subtract the best-fitting shift and rotation of the whole detector from error fields.

    Observers who apply a calibration to an exposure fit its pointing. The part of an error that
    this fit absorbs is not an error, and it depends on the gauge; the residual is the same in every
    gauge.

    `errors`: Legendre coefficients (n, 2, K) of each error by chip number, for all chips of the
    model. `positions`: coefficients (2, K) of the positions (u, v) in the same orientation. Returns
    the residual errors (n, 2, K) of a least-squares fit to stars that cover all chips evenly.
    """
    chips = model.chips
    weight = mean_squares(model).reshape(len(chips), 2, -1)
    rigid = np.zeros((3, *weight.shape))
    rigid[0, :, 0, 0] = rigid[1, :, 1, 0] = 1.0
    for c, chip in enumerate(chips):
        u, v = positions[chip.number]
        rigid[2, c] = -v, u
    # shift the origin to the mean position, so that rotation and shifts are orthogonal
    rigid[2, ..., 0] -= np.einsum("ca,ca->a", weight[..., 0], rigid[2, ..., 0])
    stacked = np.stack([errors[chip.number] for chip in chips], axis=1)
    normal = np.einsum("pcak,cak,qcak->pq", rigid, weight, rigid)
    projected = np.einsum("pcak,ncak->np", rigid * weight, stacked)
    residual = stacked - np.einsum("np,pcak->ncak", np.linalg.solve(normal, projected.T).T, rigid)
    return {chip.number: residual[:, c] for c, chip in enumerate(chips)}


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
        positions = {
            chip: place_of(model, epoch=domain.epoch, chip=chip).polynomial(mean)
            for chip in all_coefficients
        }
        return cls(rows, domain, without_rigid(all_coefficients, positions, model))

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(next(iter(self.coefficients.values())))

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of the draws in a slice."""
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
