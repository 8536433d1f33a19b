"""Table of the coefficients with formal and posterior errors, in Legendre and monomial form."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from astropy.table import MaskedColumn, Table

from bayesdist.model import AXES
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from bayesdist.infer import LinearFit, Posterior


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
