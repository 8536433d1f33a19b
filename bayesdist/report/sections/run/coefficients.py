"""Parameters: Legendre coefficients, time dependence, frames, and monomial coefficients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.assess.solution import coefficient_table
from bayesdist.report.contents import REPORT
from bayesdist.report.run import ReportedRun, has_several_chips, marked
from bayesdist.report.sections.gauge import gauge_mark, gauge_note
from bayesdist.report.texttable import MAX_ROWS, TextTable, further, tabulated
from bayesdist.utils.text import MISSING, interval, number, rounded

_ON_SCREEN = ("68 %", "95 %", "R-hat", "ESS")
MAX_PRINTED = 240  # Legendre coefficients on paper: two pages
_WIDER = 1.05  # ratio to the sampled error that rounding or few draws cannot explain
_SMALL = 1e-3  # dimensionless numbers below it are shown in 10^-6


@REPORT.table("coefficients")
def coefficient_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of Legendre coefficients, of time dependence and frames, of monomial coefficients.

    All are folded on screen; the Legendre coefficients are printed.
    """
    kinds = {p.name: p.kind for p in run.model.parameters}
    table = coefficient_table(run.fit, run.solution)
    rows = list(table)
    mark, held = gauge_mark(run), run.held_parameters
    groups = []
    for names in (("polynomial",), ("tdd", "frame")):
        rows_of_kind = [row for row in rows if kinds.get(str(row["name"])) in names]
        free = [row for row in rows_of_kind if str(row["name"]) not in held]
        groups.append(
            (free, [str(row["name"]) for row in rows_of_kind if str(row["name"]) in held])
        )
    (polynomial, fixed), (other_parameters, fixed_others) = groups
    legendre = _parameter_table(
        run,
        f"Legendre coefficients [{run.model.unit}]{mark}: formal error beside posterior error",
        polynomial,
        with_unit=False,
    )
    notes = gauge_note(run), _common_note(run, table), _held_note(run, fixed)
    out = [replace(legendre, note=_notes(*notes), leading=MAX_PRINTED, folded=True)]
    if other_parameters:
        table = _parameter_table(
            run,
            f"Time dependence and exposure frames{mark}",
            other_parameters[:MAX_ROWS],
            with_unit=True,
        )
        note = _notes(_held_note(run, fixed_others), further(len(other_parameters)))
        out.append(replace(table, note=note, detail=True, folded=True))
    out += [_monomial_table(run, chip.number) for chip in run.model.chips]
    return tuple(out)


def _notes(*sentences: str) -> str:
    return " ".join(s for s in sentences if s)


def _common_note(run: ReportedRun, table: Table) -> str:
    """Note on posterior errors that are larger than the scatter of the sampler's draws."""
    sampled = dict(zip(run.posterior.model.names, run.posterior.sigma, strict=True))
    wider = [
        float(row["sd"]) > _WIDER * sampled[str(row["name"])]
        for row in table
        if str(row["name"]) in sampled and row["sd"] is not np.ma.masked
    ]
    if not any(wider):
        return ""
    return (
        "The posterior's errors include those that many stars share (structure beyond the"
        " polynomial, variation between exposures, the catalogue); the formal σ does not."
    )


def _held_note(run: ReportedRun, names: list[str]) -> str:
    """Note on parameters that are not measurements, grouped by term."""
    if not names:
        return ""
    terms: dict[str, list[str]] = {}
    for name in names:
        term, _, kind = name.rpartition(".")
        terms.setdefault(term, []).append(kind)
    texts = [
        f"{term} ({', '.join(kinds)})" if term else ", ".join(kinds)
        for term, kinds in terms.items()
    ]
    return f"{run.kind.words.held}: {'; '.join(texts)}."


def _readable(row: Any) -> tuple[float, str]:
    """Factor and unit for displaying a parameter; small ratios and angles are shown in 10^-6."""
    unit = str(row["unit"] or "")
    largest = max(abs(float(row["lsq_value"])), float(row["lsq_sigma"]))
    return (1e6, "10⁻⁶") if not unit and largest < _SMALL else (1.0, unit or "none")


def _parameter_table(
    run: ReportedRun, caption: str, rows: list[Any], *, with_unit: bool
) -> TextTable:
    def cell(row: Any, key: str, factor: float = 1.0) -> Any:
        value = row[key]
        return value if value is np.ma.masked else factor * value

    out = []
    for row in rows:
        factor, unit = _readable(row) if with_unit else (1.0, "")
        sigma, sd = cell(row, "lsq_sigma", factor), cell(row, "sd", factor)
        ratio = None
        if number(sigma) != MISSING and number(sd) != MISSING and float(sigma) > 0:
            ratio = float(sd) / float(sigma)
        sampled = {
            "Posterior mean": rounded(cell(row, "mean", factor), sd),
            "sd": number(sd, 2),
            "sd / σ": number(ratio),
            "68 %": interval(cell(row, "lo68", factor), cell(row, "hi68", factor), sd),
            "95 %": interval(cell(row, "lo95", factor), cell(row, "hi95", factor), sd),
        }
        out.append(
            {
                "Name": str(row["name"]),
                "Least squares": rounded(cell(row, "lsq_value", factor), sigma),
                "Formal σ": number(sigma, 2),
                **{key: marked(run, text) for key, text in sampled.items()},
                "R-hat": number(cell(row, "rhat"), 4),
                "ESS": number(cell(row, "ess_bulk"), 3),
                **({"Unit": unit} if with_unit else {}),
            }
        )
    # omitted on paper: intervals that follow from sd, and convergence, which was tested as a whole
    on_paper = tuple(k for k, name in enumerate(out[0]) if name not in _ON_SCREEN)
    return tabulated(caption, out, words=(0, 10), on_paper=on_paper)


def _monomial_table(run: ReportedRun, chip: int) -> TextTable:
    """Table of coefficients of (x - xref)^i (y - yref)^j with propagated errors."""
    model = run.model
    basis = model.basis(chip)
    gauge = gauge_note(run) if chip == model.chips[0].number else ""
    name = model.chips[model.chip_code(chip)].name if has_several_chips(run) else chip
    cells = []
    for axis in (0, 1):
        coefficients = run.model.coefficient_slice(chip, axis)
        for solution in (run.fit, run.posterior):
            cov = np.asarray(solution.cov)[coefficients, coefficients]
            values, covariance = basis.to_monomials(np.asarray(solution.mean)[coefficients], cov)
            sigma = np.sqrt(np.diag(covariance))
            texts = [(rounded(c, s), number(s, 2)) for c, s in zip(values, sigma, strict=True)]
            if solution is run.posterior:
                texts = [(marked(run, c), marked(run, s)) for c, s in texts]
            cells.append(texts)
    rows = []
    for axis in (0, 1):
        formal, posterior = cells[2 * axis : 2 * axis + 2]
        for (i, j), f, p in zip(basis.terms, formal, posterior, strict=True):
            rows.append(("uv"[axis], str(i), str(j), *f, *p))
    x, y = basis.reference_pixel
    return TextTable(
        f"Monomial coefficients, chip {name}: of (x − {x:g})^i (y − {y:g})^j"
        f" [{run.model.unit}/pix^(i + j)]{gauge_mark(run)}",
        ("Axis", "i", "j", "Least squares", "Formal σ", "Posterior mean", "sd"),
        tuple(rows),
        note=_notes(
            "Monomial coefficients are strongly correlated: their errors must not be combined as"
            " if they were independent. The covariance stands in the products.",
            gauge,
        ),
        detail=True,
        folded=True,
    )
