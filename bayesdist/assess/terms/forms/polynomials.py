"""Errors of parameters: on any chip at any epoch a polynomial of the pixel."""

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

    `mean`: (D,), where there is no error. `theta`: (n, D); without an exposure its first `n_global`
    columns are enough. `rows`: (n,), of those in `theta`, where these are others. `epoch`: decimal
    years. `chip`: chip number. `exposure`: (n,), code of the exposure, of all draws or of each,
    whose frame is among the parameters that err; None for errors of the polynomials and their drift
    alone.
    """
    if isinstance(exposure, np.ndarray):
        rows = np.arange(len(theta)) if rows is None else rows
        out = np.empty((len(rows), 2, model.n_terms))
        for e in np.unique(exposure):
            own = exposure == e
            out[own] = polynomial_errors(
                model, mean, theta[rows[own]], epoch=epoch, chip=chip, exposure=int(e)
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
    """Take the best shift and rotation of the whole detector out of error fields.

    Whoever uses a calibration on an exposure fits where the telescope pointed.  What this takes up
    is no error, and depends on the gauge: without it, a field is the same in every gauge.

    `errors`: (n, 2, K), by chip number, for all chips of the model: Legendre coefficients of each
    error. `positions`: (2, K), those of the positions (u, v), in the same orientation. Returns (n,
    2, K), the residual errors: least squares over stars that cover all chips evenly.
    """
    chips = model.chips
    weight = mean_squares(model).reshape(len(chips), 2, -1)
    rigid = np.zeros((3, *weight.shape))
    rigid[0, :, 0, 0] = rigid[1, :, 1, 0] = 1.0
    for c, chip in enumerate(chips):
        u, v = positions[chip.number]
        rigid[2, c] = -v, u
    # about the middle of the detector a rotation is no shift
    rigid[2, ..., 0] -= np.einsum("ca,ca->a", weight[..., 0], rigid[2, ..., 0])
    stacked = np.stack([errors[chip.number] for chip in chips], axis=1)
    normal = np.einsum("pcak,cak,qcak->pq", rigid, weight, rigid)
    projected = np.einsum("pcak,ncak->np", rigid * weight, stacked)
    rest = stacked - np.einsum("np,pcak->ncak", np.linalg.solve(normal, projected.T).T, rigid)
    return {chip.number: rest[:, c] for c, chip in enumerate(chips)}


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Errors of parameters: on any chip at any epoch a polynomial."""

    row: Row
    model: DistortionModel
    mean: Float  # (D,), where there is no error
    theta: Float  # (n, D), or (n, n_global) where no frame of an exposure errs
    # code of an exposure whose frame errs, and takes the place of any new one
    exposure: int | None = None
    frames: bool = False  # whether the frame of the exposure of each draw's star errs
    # takes an epoch and a chip number to what is added to these polynomials, (n, 2, K)
    more: Callable[[float | None, int], Float] | None = None
    pools: tuple[Pool, ...] = ()  # finite sets that the parameters are taken from

    def on(self, domain: EvaluationDomain, image: Image) -> PolynomialField:
        """The errors at the positions of a domain, less what an alignment takes up."""

        def coefficients(chip: int) -> Float:
            exposure = image.exposure if self.frames else self.exposure
            out = polynomial_errors(
                self.model, self.mean, self.theta, epoch=domain.epoch, chip=chip, exposure=exposure
            )
            return out if self.more is None else out + self.more(domain.epoch, chip)

        return PolynomialField.of((self.row,), domain, image, coefficients)


@dataclass(frozen=True, eq=False)
class PolynomialField(DrawnField):
    """Errors that are polynomials of the pixel: one row, or none for a sum of rows."""

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
        """The field of coefficients by chip number, less what an alignment takes up."""
        model, mean = domain.model, image.aligned_by
        if mean is None:
            return cls(rows, domain, {chip: coefficients(chip) for chip in domain.chips})
        every = {chip.number: coefficients(chip.number) for chip in model.chips}
        positions = {
            chip: place_of(model, epoch=domain.epoch, chip=chip).polynomial(mean) for chip in every
        }
        return cls(rows, domain, without_rigid(every, positions, model))

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(next(iter(self.coefficients.values())))

    def errors(self, draws: slice, scale: Scale) -> Float:
        """Errors (d, N, 2) of some draws."""
        size = scale.get(self.rows[0].name, 1.0) if self.rows else 1.0
        parts = []
        for chip, phi in self.domain.basis.items():
            some = self.coefficients[chip][draws]
            # one product of matrices: many of two rows each take longer
            both = some.reshape(-1, some.shape[2]) @ phi.T
            parts.append(np.swapaxes(both.reshape(-1, 2, len(phi)), 1, 2))
        out = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return out if size == 1.0 else size * out

    def total(self) -> Float:
        """Mean squares (P, 2), by second moments where they are those of positions."""
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
