"""A solution on one chip at one epoch in one exposure, chip positions, and the coefficient table.

On one chip at one epoch in one exposure a solution is a single polynomial. Maps, budgets and
margins therefore need only the 2 K coefficients (K terms on each axis) and their covariance,
instead of one Jacobian row per grid point and parameter. Their cost is independent of the number of
exposures.

The table of coefficients has formal and posterior errors, in Legendre and monomial form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from astropy.table import MaskedColumn, Table
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import AXES, Chip, DistortionModel, Groups, PolynomialBasis
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from bayesdist.infer import LinearFit, Posterior


@dataclass(frozen=True, eq=False)
class Place:
    """One chip at one epoch in one exposure, where the model is a single polynomial."""

    model: DistortionModel
    group: Groups  # a single group
    epoch: float | None  # decimal years, as requested

    @property
    def chip(self) -> Chip:
        """Chip of this place."""
        return self.model.chips[int(self.group.chip[0])]

    @property
    def basis(self) -> PolynomialBasis:
        """Basis of the polynomial."""
        return self.model.basis(self.chip.number)

    def polynomial(self, theta: ArrayLike) -> Float:
        """Legendre coefficients (..., 2, K) of (u, v) for parameters theta (..., D)."""
        return self.model.effective(theta, self.group)[..., 0, :, :]

    def covariance(self, solution: Solution) -> Float:
        """Covariance (2, K, 2, K) of `polynomial`, linearised at the mean of the solution."""
        [(columns, d)] = self.model.effective_jacobian(solution.mean, self.group)
        K = self.model.n_terms
        d = d.reshape(2 * K, -1)
        cov = np.asarray(solution.cov, float)[np.ix_(columns, columns)]
        return (d @ cov @ d.T).reshape(2, K, 2, K)


def place_of(
    model: DistortionModel,
    *,
    epoch: float | None = None,
    exposure: int | str | None = None,
    chip: int | None = None,
) -> Place:
    """Select a chip, an epoch and an exposure of a model.

    `epoch`: decimal years; required if the model depends on time. `exposure`: code or name; the
    gauge exposure by default. `chip`: chip number; the first chip by default. Raises InputError if
    the chip or exposure is unknown, or the epoch is missing or not finite.
    """
    if epoch is not None and not np.isfinite(epoch):
        raise InputError(f"the epoch is {epoch}", do="give it in decimal years")
    if chip is not None:
        model.chip_code(chip)  # a model of one chip would accept any number
    group = model.groups(1, epoch=epoch, exposure=exposure, chip=chip)
    return Place(model, group, None if epoch is None else float(epoch))


@dataclass(frozen=True, eq=False)
class ChipFrame:
    """Position of a chip in the focal plane, along the pixel axes of the first chip."""

    centre: Float  # (2,), centre of the chip in pixels of the first chip
    middle: Float  # (2,), the same point in pixels of this chip
    turn: Float  # (2, 2), matrix that converts pixel offsets to those of the first chip

    def __call__(self, x: Float, y: Float) -> Float:
        """Convert pixels of the chip to positions (2, N) in the focal plane."""
        return self.centre[:, None] + self.turn @ (np.stack([x, y]) - self.middle[:, None])

    def outline(self, size: tuple[float, float]) -> Float:
        """Corners (4, 2) of a chip with these columns and rows in the focal plane, in pixels."""
        right, top = size[0] + 0.5, size[1] + 0.5
        return self(np.array([0.5, right, right, 0.5]), np.array([0.5, 0.5, top, top])).T


def chip_frames(solution: Solution, *, epoch: float | None = None) -> tuple[ChipFrame, ...]:
    """Positions of all chips in the focal plane, in the order of the model's chips.

    `epoch`: decimal years; required if the model depends on time. The solution is linearised about
    the centre of each chip, so that outlines show gaps and rotations but no distortion.
    """
    centres, gradients, middles = [], [], []
    for chip in solution.model.chips:
        place = place_of(solution.model, epoch=epoch, chip=chip.number)
        polynomial = place.polynomial(solution.mean)
        middle = (np.array(chip.size) + 1) / 2
        centres.append(polynomial @ place.basis.evaluate(*middle[:, None])[0])
        px, py = place.basis.gradient(*middle[:, None])
        gradients.append(np.column_stack([polynomial @ px[0], polynomial @ py[0]]))
        middles.append(middle)
    turns = [np.linalg.lstsq(gradients[0], gradient, rcond=None)[0] for gradient in gradients]
    offsets = np.transpose([centre - centres[0] for centre in centres])
    at = middles[0] + np.linalg.lstsq(gradients[0], offsets, rcond=None)[0].T
    return tuple(map(ChipFrame, at, middles, turns))


def chip_places(solution: Solution, *, epoch: float | None = None) -> tuple[tuple[int, int], ...]:
    """Row and column of each chip in a drawing of the detector, along the axes of the first chip.

    Parameters
    ----------
    solution : Solution
    epoch : float, optional
        Decimal years; required if the model depends on time.

    Returns
    -------
    tuple of (row, column)
        In the order of the model's chips. Row 0 is at the top (largest y), column 0 at the left.
        If two chips would have the same row and column, all chips are placed in one column.

    Raises
    ------
    InputError
        If the model depends on time and the epoch is missing.
    """
    chips = solution.model.chips
    x, y = np.transpose([frame.centre for frame in chip_frames(solution, epoch=epoch)])
    half = np.array([c.size for c in chips]).min(axis=0) / 2
    places = tuple(zip(_ranks(-y, half[1]), _ranks(x, half[0]), strict=True))
    if len(set(places)) < len(places):
        order = np.argsort(-y, kind="stable").tolist()
        places = tuple((order.index(k), 0) for k in range(len(chips)))
    return places


def _ranks(values: Float, least: float) -> list[int]:
    """Group number of each value, ascending; a gap larger than `least` starts a new group."""
    order = np.argsort(values, kind="stable")
    new = np.diff(values[order]) > least
    ranks = np.empty(len(values), np.int64)
    ranks[order] = np.concatenate([[0], np.cumsum(new)])
    return ranks.tolist()


def coefficient_table(fit: LinearFit, posterior: Posterior | None = None) -> Table:
    """Table of all parameters of the model with their uncertainties.

    Returns one row for each parameter, followed by one for each polynomial coefficient in monomial
    form, the coefficient of (x - xref)^i (y - yref)^j. Columns: name, chip, axis, i, j, form
    ('legendre', 'monomial', 'tdd' or 'frame'), lsq_value and lsq_sigma of the least-squares
    solution; with a posterior also mean, sd, lo68, hi68, lo95, hi95, and, for sampled parameters,
    rhat and ess_bulk; unit.
    """
    model = fit.model
    sampled = None if posterior is None else posterior.flat
    blocks = [_columns(fit.mean, np.sqrt(np.diag(fit.cov)), sampled)]
    rows = [
        (p.name, p.chip, p.axis, p.i, p.j, "legendre" if p.kind == "polynomial" else p.kind, p.unit)
        for p in model.parameters
    ]
    for chip in model.chips:
        basis = model.basis(chip.number)
        prefix = f"{chip.name}." if len(model.chips) > 1 else ""
        for axis, name in enumerate(AXES):
            part = model.coefficient_slice(chip.number, axis)
            value, cov = basis.to_monomials(fit.mean[part], fit.cov[part, part])
            draws = None
            if posterior is not None:
                draws = basis.to_monomials(posterior.flat[:, part])
            blocks.append(_columns(value, np.sqrt(np.diag(cov)), draws))
            for i, j in basis.terms:
                unit = model.unit + (f" / pix{i + j}" if i + j else "")
                label = f"{prefix}{name}[x^{i} y^{j}]"
                rows.append((label, chip.number, name, i, j, "monomial", unit))
    table = Table()
    for k, (column, blank) in enumerate(
        (("name", ""), ("chip", -1), ("axis", ""), ("i", -1), ("j", -1), ("form", ""))
    ):
        values = [row[k] for row in rows]
        mask = [v is None for v in values]
        filled = [blank if v is None else v for v in values]
        table[column] = MaskedColumn(filled, mask=mask) if any(mask) else filled
    for column in blocks[0]:
        table[column] = np.concatenate([block[column] for block in blocks])
    if posterior is not None:
        unknown = np.full(len(rows) - model.n_params, np.nan)
        c = posterior.convergence
        for column, measured in (("rhat", c.rhat), ("ess_bulk", c.ess_bulk)):
            padded = np.concatenate([measured[: model.n_params], unknown])
            table[column] = MaskedColumn(padded, mask=~np.isfinite(padded))
    table["unit"] = [row[-1] for row in rows]
    return table


def _columns(value: Float, sigma: Float, draws: Float | None) -> dict[str, Float]:
    """Columns of a block of rows; statistics of the draws (n, rows) are added if given."""
    columns = {"lsq_value": value, "lsq_sigma": sigma}
    if draws is not None:
        tails = {"lo68": 0.16, "hi68": 0.84, "lo95": 0.025, "hi95": 0.975}
        quantiles = np.quantile(draws, list(tails.values()), axis=0)
        columns |= {"mean": draws.mean(axis=0), "sd": draws.std(axis=0, ddof=1)}
        columns |= dict(zip(tails, quantiles, strict=True))
    return columns
