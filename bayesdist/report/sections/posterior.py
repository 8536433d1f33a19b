"""Posterior: parameters, outliers, correlations of coefficients, and ranks of the draws.

Parameters are Legendre coefficients, time dependence, frames, and monomial coefficients.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.assess.solution import coefficient_table
from bayesdist.infer.catalogue.added_errors import DECISIVE
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.style import WIDTH, legend_above, new_figure
from bayesdist.report.plots.posterior import (
    MIXTURE,
    correlation_matrix,
    draw_corner,
    draw_ranks,
    mixture_column,
    plot_correlations,
    rank_band,
    slowest_parameters,
)
from bayesdist.report.run import ReportedRun, gauge_mark, gauge_note, has_several_chips, marked
from bayesdist.report.texttable import MAX_ROWS, TextTable, further, tabulated
from bayesdist.utils.text import (
    MISSING,
    Scale,
    count,
    display_scale,
    interval,
    number,
    percent,
    rounded,
)

_ON_SCREEN = ("68 %", "95 %", "R-hat", "ESS")
MAX_PRINTED = 240  # Legendre coefficients on paper: two pages
_WIDER = 1.05  # ratio to the sampled error that rounding or few draws cannot explain
_SMALL = 1e-3  # dimensionless numbers below it are shown in 10^-6

_INDEPENDENCE = (
    "Independence sampling draws each proposal from a fixed approximation of the posterior,"
    " whatever the current position, and accepts it by the ratio of true to approximate density:"
    " draws are nearly independent, so that a few steps of many walkers are enough."
)


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


@REPORT.table("outliers")
def outlier_table(run: ReportedRun) -> TextTable:
    """Table of the parameters of the mixture, and of the number of stars or detections flagged."""
    post, words = run.posterior, run.kind.words
    named = {
        "f": (f"Fraction of {words.false_rows}, f", ""),
        "j": ("Jitter, j: error beyond the quoted one", run.model.unit),
        "s_out": (f"Scale of the {words.false_rows}, s_out", run.model.unit),
    }
    rows = []
    for key, (name, unit) in named.items():
        if key not in post.hyper:
            continue
        draws = np.asarray(post.hyper[key], float)
        scale = display_scale(unit, draws) if unit else Scale(1.0, "fraction")
        v = draws * scale.factor
        low, high = np.quantile(v, [0.025, 0.975])
        sd = float(v.std())
        cells = (rounded(v.mean(), sd), number(sd, 2), interval(low, high, sd))
        rows.append((name, *(marked(run, c) for c in cells), scale.unit))
    for name, number_of in (
        (f"{words.rows.capitalize()} flagged (probability above 0.5)", count(post.n_flagged)),
        (
            f"{words.false_rows.capitalize()} expected (sum of the probabilities)",
            number(post.n_false, 4),
        ),
    ):
        rows.append((name, marked(run, number_of), MISSING, MISSING, words.rows))
    mixture, grouped = post.mixture, run.added_errors
    note = f"Outlier component: {mixture.model}"
    if mixture.match_radius is not None:
        note += f", match radius {number(mixture.match_radius)} {run.model.unit}"
    if mixture.jitter is not None:
        note += f"; jitter fixed at {number(mixture.jitter)} {run.model.unit}"
    a, b = mixture.fraction_prior
    if mixture.jitter_scale is not None:
        note += f"; prior of j: scale {number(mixture.jitter_scale)} {run.model.unit}"
    if mixture.outlier_scale is not None:
        note += f"; prior of s_out: about {number(mixture.outlier_scale)} {run.model.unit}"
    note += "." if mixture.model == "none" else f"; prior of f: Beta({a:g}, {b:g})."
    if mixture.model != "none":
        errors = "errors of f and s_out are" if "s_out" in post.hyper else "error of f is"
        note += (
            f" The {errors} for {words.false_rows} of this shape; of another one, which shows in"
            " the wings of the residuals, f may be off by more."
        )
    if grouped is not None and grouped.added is not None:
        note += f" Errors differ by {grouped.grouping}: j is the least of those beyond the quoted."
    return TextTable(
        "Outlier mixture",
        ("Quantity", "Mean", "sd", "95 % interval", "Unit"),
        tuple(rows),
        words=(0, 4),
        note=note,
    )


@REPORT.table("outliers", needs=("added_errors",))
def added_errors_table(run: ReportedRun) -> TextTable:
    """Table of errors in addition to the quoted ones, in the groups that the evidence supports."""
    added = needed(run.added_errors)
    scale = display_scale(run.model.unit, added.sigma)
    rows = []
    for g, label in enumerate(added.labels):
        for a, axis in enumerate("uv" if added.by_axis else ("u and v",)):
            size, error = scale.factor * added.sigma[g, a], scale.factor * added.sigma_error[g, a]
            rows.append(
                {
                    "Stars": f"{added.by} {label}" if added.by else "all",
                    "Axis": axis,
                    "Number": count(added.n[g, a]),
                    f"Error [{scale.unit}]": rounded(size, error),
                    "σ": number(error, 2),
                    "Added to the quoted errors": number(scale.factor * added.excess[g, a], 3),
                }
            )
    gains = ", ".join(f"by {name} {number(gain, 3)}" for name, gain in added.evidence.items())
    note = (
        "Restricted likelihood of the residuals, false matches allowed for. ln evidence over one"
        f" error for both axes: {gains}; groups are formed from {number(DECISIVE)} on."
    )
    if added.added is not None:
        note += " What is beyond the least was added to the quoted errors, and j is the least."
    folded = added.added is None  # the errors stand as they were quoted
    return tabulated("Errors beyond the quoted ones", rows, words=(0, 1), note=note, folded=folded)


@REPORT.figure("outliers", needs=("posterior.hyper",), folded=True)
def outliers_corner(run: ReportedRun) -> Plot:
    """Corner plot of the outlier fraction, jitter and outlier scale, of those that were sampled."""
    posterior = run.posterior
    columns = [mixture_column(posterior, name) for name in MIXTURE if name in posterior.hyper]
    side = WIDTH if len(columns) > 3 else 1.6 * len(columns) + 0.9
    figure = new_figure(side, side)
    draw_corner(figure, columns)
    text = "Joint posterior of the mixture's parameters; dashed lines hold 68 %."
    if "f" in posterior.hyper:
        fraction = float(np.mean(posterior.hyper["f"]))
        text += f" The fraction of {run.kind.words.false_rows} is {percent(fraction)}."
    return Plot(
        figure,
        "Outlier fraction, jitter and outlier scale",
        text,
        "Corner plot of f, j and s_out, as sampled.",
    )


@REPORT.figure("coefficients", folded=True)
def correlations(run: ReportedRun) -> Plot:
    """Matrix of the correlations between coefficients, as a map of colours."""
    posterior = run.posterior
    names, matrix = correlation_matrix(posterior)
    fig = new_figure(0.72 * WIDTH, 0.62 * WIDTH, layout="compressed")
    plot_correlations(posterior, fig.subplots())
    upper = np.triu(np.abs(matrix), k=1)
    i, j = np.unravel_index(int(upper.argmax()), upper.shape)
    sd, formal = np.sqrt(np.diag(posterior.cov)), np.sqrt(np.diag(run.fit.cov))
    ratio = number(float(np.median(sd[formal > 0] / formal[formal > 0])))
    pair = (
        f"the strongest correlation is {number(float(matrix[i, j]), 2)}, of {names[i]} and"
        f" {names[j]}"
        if len(names) > 1
        else "there is one coefficient alone"
    )
    return Plot(
        fig,
        "Correlations of the coefficients",
        f"Correlations of the posterior; {pair}. Coefficients that are strongly correlated must"
        " not be quoted without their covariance, which posterior.nc and the products hold. Over"
        f" all parameters the posterior's sd is {ratio} times the formal σ of least squares"
        " (median).",
        f"Matrix of correlations of {len(names)} coefficients; {pair}.",
    )


@REPORT.figure("coefficients", folded=True)
def ranks(run: ReportedRun) -> Plot:
    """Ranks of the draws of each ensemble among all, of the slowest parameters and f, j, s_out."""
    posterior = run.posterior
    names = list(slowest_parameters(posterior, without=run.held_parameters))
    names += [name for name in MIXTURE if name in posterior.hyper]
    columns = min(4, len(names))
    lines = -(-len(names) // columns)
    fig = new_figure(WIDTH, 0.5 + 1.5 * lines)
    axes = fig.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for ax in axes[len(names) :]:
        ax.remove()
    axes = axes[: len(names)]
    band = rank_band(posterior)
    farthest = max(
        draw_ranks(ax, posterior, name, band) for ax, name in zip(axes, names, strict=True)
    )
    for ax in axes:
        spec = ax.get_subplotspec()
        if spec.colspan.start == 0:
            ax.set_ylabel("draws / expected\n[no unit]")
        if spec.rowspan.start == (len(names) - 1 - spec.colspan.start) // columns:
            ax.tick_params(labelbottom=True)
            ax.set_xlabel("rank [fraction]")
    axes[0].set_xlim(0, 1)
    axes[0].set_ylim(max(0.0, 1 - 1.2 * farthest), 1 + 1.2 * farthest)
    legend_above(fig, axes[0])
    return Plot(
        fig,
        "Ranks of the draws",
        "Ranks of the draws of each independent ensemble among those of all, for the coefficients"
        " with the fewest effective draws and for the mixture's parameters. Ensembles that sample"
        " one distribution have flat histograms, within the band of 2 σ. "
        f"{_INDEPENDENCE}",
        "Histograms of the ranks of the draws, by ensemble, which are flat where chains agree.",
    )
