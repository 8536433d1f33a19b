"""The coefficients of a difference between calibrations, each with its error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.assess.comparison.compare import Comparison, term_sigmas
from bayesdist.assess.comparison.gap import GapDifference
from bayesdist.model import AXES

__all__ = ["comparison_table", "difference_table", "gap_table"]

Float = NDArray[np.float64]


def comparison_table(found: Comparison) -> Table:
    """Difference of each coefficient.

    Returns columns: form ('legendre': of products over the detector; 'monomial': of pixel offsets
    from the reference pixel of A), axis, i, j, difference, sigma and z (NaN where no error is
    known, or the term was taken out), unit.
    """
    frame = found.frame
    K, basis = frame.basis.n_terms, frame.basis
    to_monomials = np.kron(np.eye(2), basis.monomial_matrix)
    forms: dict[str, tuple[Float, Float | None]] = {
        "legendre": (frame.difference.ravel(), None),
        "monomial": (to_monomials @ frame.difference.ravel(), None),
    }
    if frame.cov is not None:
        sigma = term_sigmas(frame)
        of_monomials = np.sqrt(
            np.maximum(np.einsum("ij,jk,ik->i", to_monomials, frame.cov, to_monomials), 0.0)
        )
        correlated = found.a.correlated and found.b.correlated
        forms["legendre"] = (forms["legendre"][0], sigma if correlated else None)
        forms["monomial"] = (forms["monomial"][0], of_monomials)
    rows = []
    for form, (values, errors) in forms.items():
        for n in range(2 * K):
            i, j = basis.terms[n % K]
            sigma_n = np.nan if errors is None or not errors[n] > 0 else float(errors[n])
            if form == "monomial" and not (found.a.correlated and found.b.correlated) and i + j < 2:
                sigma_n = np.nan  # rests on correlations
            unit = "pix" if form == "legendre" else _unit(i + j)
            value = float(values[n])
            rows.append((form, AXES[n // K], i, j, value, sigma_n, value / sigma_n, unit))
    names = ("form", "axis", "i", "j", "difference", "sigma", "z", "unit")
    return Table(rows=rows, names=names)


def _unit(order: int) -> str:
    """Unit of a monomial's coefficient where positions are in pixels."""
    return {0: "pix", 1: ""}.get(order, f"pix^{1 - order}")


def difference_table(found: Comparison) -> Table:
    """The difference over the grid, point by point.

    Returns columns x, y, du, dv and, where errors are known, sigma_u, sigma_v, correlation, chi2;
    in pixels.
    """
    X, Y = np.meshgrid(found.x, found.y)
    columns = {"x": X, "y": Y, "du": found.du, "dv": found.dv}
    for name in ("sigma_u", "sigma_v", "correlation", "chi2"):
        values = getattr(found, name)
        if values is not None:
            columns[name] = values
    table = Table({name: values.ravel() for name, values in columns.items()})
    for name in table.colnames:
        if name not in ("correlation", "chi2"):
            table[name].unit = "pix"
    return table


def gap_table(gaps: Sequence[GapDifference]) -> Table:
    """Table of the offsets of chips from the reference chip, A minus B.

    `gaps`: one for each chip but the reference. Returns columns: chip, reference, quantity,
    difference, sigma and z (NaN without errors), unit.
    """
    quantities = (("shift_x", "pix"), ("shift_y", "pix"), ("scale", ""), ("rotation", "rad"))
    rows = []
    for gap in gaps:
        sigma = np.full(4, np.nan) if gap.sigma is None else gap.sigma
        for (name, unit), value, error in zip(quantities, gap.values, sigma, strict=True):
            z = value / error if error > 0 else np.nan
            rows.append((gap.chip, gap.reference, name, float(value), float(error), float(z), unit))
    names = ("chip", "reference", "quantity", "difference", "sigma", "z", "unit")
    return Table(rows=rows, names=names)
