"""Tables of the parameters: Legendre, time dependence and frames, monomial."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.report.context import ReportInput
from bayesdist.report.numerals import MISSING, interval, number, rounded
from bayesdist.report.tables.text import MOST_ROWS, TextTable, further, marked

__all__ = ["coefficient_tables"]


def coefficient_tables(inputs: ReportInput) -> tuple[TextTable, ...]:
    """Legendre coefficients, then monomial ones, then time dependence and frames."""
    kinds = {p.name: p.kind for p in inputs.fit.model.parameters}
    rows = list(inputs.coefficients)
    polynomial = [r for r in rows if kinds.get(str(r["name"])) == "polynomial"]
    others = [r for r in rows if kinds.get(str(r["name"])) in ("tdd", "frame")]
    out = [
        _parameter_table(
            inputs,
            f"Legendre coefficients [{inputs.unit}]: formal error beside posterior error",
            polynomial,
            with_unit=False,
        )
    ]
    if others:
        table = _parameter_table(
            inputs, "Time dependence and exposure frames", others[:MOST_ROWS], with_unit=True
        )
        out.append(replace(table, note=further(len(others))))
    out += [_monomial_table(inputs, chip.number) for chip in inputs.fit.model.chips]
    return tuple(out)


def _parameter_table(
    inputs: ReportInput, caption: str, rows: list[Any], *, with_unit: bool
) -> TextTable:
    known = set(inputs.coefficients.colnames)

    def cell(row: Any, key: str) -> Any:
        return row[key] if key in known else None

    out = []
    for r in rows:
        sigma, sd = cell(r, "sigma"), cell(r, "sd")
        ratio = None
        if number(sigma) != MISSING and number(sd) != MISSING and float(sigma) > 0:
            ratio = float(sd) / float(sigma)
        sampled = (
            rounded(cell(r, "mean"), sd),
            number(sd, 2),
            number(ratio),
            interval(cell(r, "lo68"), cell(r, "hi68"), sd),
            interval(cell(r, "lo95"), cell(r, "hi95"), sd),
        )
        rhat = cell(r, "rhat")
        out.append(
            (
                str(r["name"]),
                rounded(cell(r, "value"), sigma),
                number(sigma, 2),
                *(marked(inputs, c) for c in sampled),
                number(rhat, 4),
                number(cell(r, "ess_bulk"), 3),
                *((str(cell(r, "unit") or "none"),) if with_unit else ()),
            )
        )
    heads = (
        "Name",
        "Least squares",
        "Formal σ",
        "Posterior mean",
        "sd",
        "sd / σ",
        "68 %",
        "95 %",
        "R-hat",
        "ESS",
    )
    columns = (*heads, *(("Unit",) if with_unit else ()))
    return TextTable(caption, columns, tuple(out), words=(0, len(heads)))


def _monomial_table(inputs: ReportInput, chip: int) -> TextTable:
    """Coefficients of (x - xref)^i (y - yref)^j with the errors that carry over."""
    model = inputs.fit.model
    basis = model.basis(chip)
    name = model.chips[model.chip_code(chip)].name if inputs.several else chip
    cells = []
    for axis in (0, 1):
        where = inputs.fit.model.coefficient_slice(chip, axis)
        for solution in (inputs.fit, inputs.posterior):
            if solution is None:
                cells.append([(MISSING, MISSING)] * basis.n_terms)
                continue
            cov = np.asarray(solution.cov)[where, where]
            values, covariance = basis.to_monomials(np.asarray(solution.mean)[where], cov)
            sigma = np.sqrt(np.diag(covariance))
            texts = [(rounded(c, s), number(s, 2)) for c, s in zip(values, sigma, strict=True)]
            if solution is inputs.posterior:
                texts = [(marked(inputs, c), marked(inputs, s)) for c, s in texts]
            cells.append(texts)
    rows = []
    for axis in (0, 1):
        formal, posterior = cells[2 * axis : 2 * axis + 2]
        for (i, j), f, p in zip(basis.terms, formal, posterior, strict=True):
            rows.append(("uv"[axis], str(i), str(j), *f, *p))
    x, y = basis.reference_pixel
    return TextTable(
        f"Monomial coefficients, chip {name}: of (x − {x:g})^i (y − {y:g})^j"
        f" [{inputs.unit}/pix^(i + j)]",
        ("Axis", "i", "j", "Least squares", "Formal σ", "Posterior mean", "sd"),
        tuple(rows),
        note="Monomial coefficients are strongly correlated: their errors must not be combined as"
        " if they were independent. The covariance stands in the products.",
    )
