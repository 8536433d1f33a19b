"""Posterior: outliers, correlations of coefficients, and ranks of the draws."""

from __future__ import annotations

import numpy as np

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
from bayesdist.report.run import ReportedRun, marked
from bayesdist.report.texttable import TextTable, tabulated
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

_INDEPENDENCE = (
    "Independence sampling draws each proposal from a fixed approximation of the posterior,"
    " whatever the current position, and accepts it by the ratio of true to approximate density:"
    " draws are nearly independent, so that a few steps of many walkers are enough."
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
