"""Posterior: outliers, correlations of coefficients, and ranks of the draws."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.infer.catalogue.added_errors import DECISIVE
from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.context import ReportInput, needed
from bayesdist.report.figures.corners import Column, corner_figure
from bayesdist.report.figures.style import (
    COLORBAR,
    CYCLE,
    DIVERGING,
    OUTLINE,
    WIDTH,
    legend_above,
    new_figure,
)
from bayesdist.report.texttable import TextTable, tabulated
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.numbers import (
    MISSING,
    Scale,
    broken_name,
    count,
    display_scale,
    interval,
    number,
    percent,
    rounded,
)

if TYPE_CHECKING:
    from bayesdist.infer import Posterior

_MIXTURE = ("f", "j", "s_out")
_MAX_POINTS = 20_000  # draws that enter a corner plot
N_SLOWEST = 4  # parameters whose ranks are shown
_NAMED = 25  # coefficients that have room for their names
RANK_BINS = 20
_INDEPENDENCE = (
    "Independence sampling draws each proposal from a fixed approximation of the posterior,"
    " whatever the current position, and accepts it by the ratio of true to approximate density:"
    " draws are nearly independent, so that a few steps of many walkers are enough."
)


@REPORT.table("outliers", needs=("posterior",))
def outlier_table(r: ReportInput) -> TextTable:
    """Table of the mixture's own parameters, and of the number of stars or detections it flags."""
    post, words = needed(r.posterior), r.words
    named = {
        "f": (f"Fraction of {words.false_rows}, f", ""),
        "j": ("Jitter, j: error beyond the quoted one", r.unit),
        "s_out": (f"Scale of the {words.false_rows}, s_out", r.unit),
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
        rows.append((name, *(r.marked(c) for c in cells), scale.unit))
    for name, number_of in (
        (f"{words.rows.capitalize()} flagged (probability above 0.5)", count(post.n_flagged)),
        (
            f"{words.false_rows.capitalize()} expected (sum of the probabilities)",
            number(post.n_false, 4),
        ),
    ):
        rows.append((name, r.marked(number_of), MISSING, MISSING, words.rows))
    mixture, grouped = post.mixture, r.added_errors
    note = f"Outlier component: {mixture.model}"
    if mixture.match_radius is not None:
        note += f", match radius {number(mixture.match_radius)} {r.unit}"
    if mixture.jitter is not None:
        note += f"; jitter fixed at {number(mixture.jitter)} {r.unit}"
    a, b = mixture.fraction_prior
    if mixture.jitter_scale is not None:
        note += f"; prior of j: scale {number(mixture.jitter_scale)} {r.unit}"
    if mixture.outlier_scale is not None:
        note += f"; prior of s_out: about {number(mixture.outlier_scale)} {r.unit}"
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
def added_errors_table(r: ReportInput) -> TextTable:
    """Table of errors beyond the quoted ones, by the groups that the evidence asks for."""
    found = needed(r.added_errors)
    scale = display_scale(r.unit, found.sigma)
    rows = []
    for g, label in enumerate(found.labels):
        for a, axis in enumerate("uv" if found.by_axis else ("u and v",)):
            size, error = scale.factor * found.sigma[g, a], scale.factor * found.sigma_error[g, a]
            rows.append(
                {
                    "Stars": f"{found.by} {label}" if found.by else "all",
                    "Axis": axis,
                    "Number": count(found.n[g, a]),
                    f"Error [{scale.unit}]": rounded(size, error),
                    "σ": number(error, 2),
                    "Added to the quoted errors": number(scale.factor * found.excess[g, a], 3),
                }
            )
    gains = ", ".join(f"by {name} {number(gain, 3)}" for name, gain in found.evidence.items())
    note = (
        "Restricted likelihood of the residuals, false matches allowed for. ln evidence over one"
        f" error for both axes: {gains}; groups are formed from {number(DECISIVE)} on."
    )
    if found.added is not None:
        note += " What is beyond the least was added to the quoted errors, and j is the least."
    return tabulated("Errors beyond the quoted ones", rows, words=(0, 1), note=note)


@REPORT.figure("outliers", needs=("posterior.hyper",))
def outliers_corner(r: ReportInput) -> Plot:
    """Corner plot of the outlier fraction, jitter and outlier scale, of those that were sampled."""
    posterior = needed(r.posterior)
    columns = [
        Column(label, unit, draws.ravel()[:: max(1, draws.size // _MAX_POINTS)])
        for label, unit, draws in _mixture_draws(posterior)
    ]
    text = "Joint posterior of the mixture's parameters; dashed lines hold 68 %."
    if "f" in posterior.hyper:
        text += f" The fraction of {r.words.false_rows} is {percent(r.sampled_mean('f'))}."
    return Plot(
        corner_figure(columns),
        "Outlier fraction, jitter and outlier scale",
        text,
        "Corner plot of f, j and s_out, as sampled.",
    )


@REPORT.figure("coefficients", needs=("posterior",))
def correlations(r: ReportInput) -> Plot:
    """Matrix of the correlations between coefficients, as a map of colours."""
    posterior = needed(r.posterior)
    names, matrix = correlation_matrix(posterior)
    fig = new_figure(0.72 * WIDTH, 0.62 * WIDTH, layout="compressed")
    ax = fig.subplots()
    image = ax.imshow(matrix, vmin=-1, vmax=1, cmap=DIVERGING, interpolation="nearest")
    step = -(-len(names) // _NAMED)
    ax.set_xticks(range(0, len(names), step), names[::step], rotation=90)
    ax.set_yticks(range(0, len(names), step), names[::step])
    ax.set_xlabel("coefficient [name]")
    ax.set_ylabel("coefficient [name]")
    fig.colorbar(image, ax=ax, label="correlation [no unit]", **COLORBAR)
    upper = np.triu(np.abs(matrix), k=1)
    i, j = np.unravel_index(int(upper.argmax()), upper.shape)
    sd, formal = np.sqrt(np.diag(posterior.cov)), np.sqrt(np.diag(r.fit.cov))
    ratio = number(float(np.median(sd[formal > 0] / formal[formal > 0])))
    most = (
        f"the strongest correlation is {number(float(matrix[i, j]), 2)}, of {names[i]} and"
        f" {names[j]}"
        if len(names) > 1
        else "there is one coefficient alone"
    )
    return Plot(
        fig,
        "Correlations of the coefficients",
        f"Correlations of the posterior; {most}. Coefficients that are strongly correlated must"
        " not be quoted without their covariance, which posterior.nc and the products hold. Over"
        f" all parameters the posterior's sd is {ratio} times the formal σ of least squares"
        " (median).",
        f"Matrix of correlations of {len(names)} coefficients; {most}.",
    )


def correlation_matrix(posterior: Posterior) -> tuple[list[str], Float]:
    """Names, and correlations (n, n), of coefficients that are free and no exposure's frame."""
    moves = np.ptp(posterior.flat, axis=0) > 0
    kinds = [p.kind for p in posterior.model.parameters]
    chosen = [k for k, kind in enumerate(kinds) if kind != "frame" and moves[k]]
    cov = np.asarray(posterior.cov)[np.ix_(chosen, chosen)]
    sd = np.sqrt(np.diag(cov))
    return [posterior.model.names[k] for k in chosen], cov / np.outer(sd, sd)


def _mixture_draws(posterior: Posterior) -> list[tuple[str, str, Float]]:
    """Label, unit and draws (ensembles, draws) of each of f, j, s_out that was sampled."""
    unit = posterior.model.unit
    hyper = {key: np.asarray(draws, float) for key, draws in posterior.hyper.items()}
    return [
        (key, "%", 100.0 * hyper[key]) if key == "f" else (key, unit, hyper[key])
        for key in _MIXTURE
        if key in hyper
    ]


@REPORT.figure("coefficients", needs=("posterior",))
def ranks(r: ReportInput) -> Plot:
    """Ranks of the draws of each ensemble among all, of the slowest parameters and f, j, s_out."""
    posterior = needed(r.posterior)
    rows = [
        (broken_name(name), posterior.theta[..., posterior.model.names.index(name)])
        for name in slowest_parameters(posterior, without=r.held)
    ]
    rows += [(label, draws) for label, _, draws in _mixture_draws(posterior)]
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    fig = new_figure(WIDTH, 0.5 + 1.5 * lines)
    axes = fig.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for ax in axes[len(rows) :]:
        ax.remove()
    ensembles, draws = rows[0][1].shape
    ess = dict(zip(posterior.convergence.names, posterior.convergence.ess_bulk, strict=True))
    worst = min((v for v in ess.values() if np.isfinite(v)), default=float(ensembles * draws))
    # a share of the draws of an ensemble that is 1 / bins, known from its effective draws
    band = 2.0 * np.sqrt((1.0 - 1.0 / ensembles) * (RANK_BINS - 1) * ensembles / max(worst, 1.0))
    edges, farthest = np.linspace(0.0, 1.0, RANK_BINS + 1), band
    for ax, (label, values) in zip(axes, rows, strict=False):
        ax.axhspan(1 - band, 1 + band, color=OUTLINE, alpha=0.25, lw=0)
        for k, counts in enumerate(rank_counts(values, RANK_BINS)):
            share = counts * RANK_BINS / draws
            farthest = max(farthest, float(np.abs(share - 1).max()))
            color = CYCLE[k % len(CYCLE)]
            ax.stairs(share, edges, color=color, lw=1.1, baseline=None, label=f"ensemble {k + 1}")
        ax.set_title(label.replace("\n", " "))
    for ax in axes[: len(rows)]:
        spec = ax.get_subplotspec()
        if spec.colspan.start == 0:
            ax.set_ylabel("draws / expected\n[no unit]")
        if spec.rowspan.start == (len(rows) - 1 - spec.colspan.start) // columns:
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


def rank_counts(draws: Float, bins: int) -> Int:
    """Numbers (ensembles, bins) of draws (ensembles, draws) in equal bins of their ranks."""
    order = np.argsort(draws, axis=None, kind="stable")
    which = np.empty(draws.size, np.int64)
    which[order] = np.arange(draws.size) * bins // draws.size
    return np.array([np.bincount(w, minlength=bins) for w in which.reshape(draws.shape)])


def slowest_parameters(posterior: Posterior, *, without: Collection[str] = ()) -> tuple[str, ...]:
    """Parameters of theta with the fewest effective draws, but for those in `without`."""
    names = posterior.model.names
    known = dict(zip(posterior.convergence.names, posterior.convergence.ess_bulk, strict=True))
    ess = np.array([known.get(name, np.inf) for name in names], float)
    order = np.argsort(np.where(np.isfinite(ess), ess, -np.inf), kind="stable")
    return tuple(names[k] for k in order if names[k] not in without)[:N_SLOWEST]
