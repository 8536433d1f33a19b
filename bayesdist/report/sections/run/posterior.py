"""Posterior: outliers, the most correlated coefficients, and the chains."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bayesdist.infer.catalogue.added_errors import DECISIVE
from bayesdist.numbers import (
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
from bayesdist.report.contents import REPORT
from bayesdist.report.context import ReportInput, needed
from bayesdist.report.corners import Column, corner_figure
from bayesdist.report.registry import Plot
from bayesdist.report.style import CYCLE, INK, WIDTH, legend_above, new_figure
from bayesdist.report.texttable import TextTable

if TYPE_CHECKING:
    from bayesdist.infer import Posterior

__all__ = [
    "added_errors_table",
    "coefficients_corner",
    "correlated_parameters",
    "outlier_table",
    "outliers_corner",
    "slowest_parameters",
    "traces",
]

Float = NDArray[np.float64]

_MIXTURE_LABELS = {"f": "f", "j": "j", "s_out": r"$s_\mathrm{out}$"}
_MAX_POINTS = 20_000  # draws that enter a corner plot
LABEL_AT = (-0.11, 0.5)  # in fractions of the panel of a trace
_TRACE_POINTS = 2_000  # draws that stand as points in a trace


def _with_mixture(r: ReportInput) -> bool:
    return r.posterior is not None and bool(r.posterior.hyper)


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
                (
                    f"{found.by} {label}" if found.by else "all",
                    axis,
                    count(found.n[g, a]),
                    rounded(size, error),
                    number(error, 2),
                    number(scale.factor * found.excess[g, a], 3),
                )
            )
    gains = ", ".join(f"by {name} {number(gain, 3)}" for name, gain in found.evidence.items())
    note = (
        "Restricted likelihood of the residuals, false matches allowed for. ln evidence over one"
        f" error for both axes: {gains}; groups are formed from {number(DECISIVE)} on."
    )
    if found.added is not None:
        note += " What is beyond the least was added to the quoted errors, and j is the least."
    heads = ("Stars", "Axis", "Number", f"Error [{scale.unit}]", "σ", "Added to the quoted errors")
    return TextTable("Errors beyond the quoted ones", heads, tuple(rows), words=(0, 1), note=note)


@REPORT.figure("outliers", needs=("posterior",), when=_with_mixture)
def outliers_corner(r: ReportInput) -> Plot:
    """Corner plot of the outlier fraction, jitter and outlier scale, of those that were sampled."""
    posterior = needed(r.posterior)
    columns = [
        Column(label, unit, _thinned(draws.ravel()))
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
def coefficients_corner(r: ReportInput) -> Plot:
    """Corner plot of coefficients, as differences from least squares, with its Gaussian over it."""
    posterior, fit = needed(r.posterior), r.fit
    names = correlated_parameters(posterior)
    index = [posterior.model.names.index(name) for name in names]
    draws = _thinned(posterior.flat)[:, index] - fit.mean[index]
    columns = [
        Column(f"{broken_name(name)}\n− l. s.", posterior.model.units[k], draws[:, c])
        for c, (name, k) in enumerate(zip(names, index, strict=True))
    ]
    sd = np.sqrt(np.diag(posterior.cov))
    formal = np.sqrt(np.diag(fit.cov))
    ratio = float(np.median(sd[formal > 0] / formal[formal > 0]))
    return Plot(
        corner_figure(columns, formal=np.asarray(fit.cov)[np.ix_(index, index)]),
        "Coefficients with the strongest correlations",
        "Filled: posterior; lines: the formal Gaussian of least squares, whose estimate is the zero"
        " of each axis. Where they agree, the quoted errors and the rejection did no harm. Over all"
        f" parameters the posterior sd is {number(ratio)} times the formal σ (median).",
        "Corner plot of the most correlated coefficients, posterior against least squares.",
    )


def correlated_parameters(posterior: Posterior, n: int = 5) -> tuple[str, ...]:
    """Coefficients in the n strongest correlations of the posterior, in the model's order.

    Polynomial and time-dependent terms only, without those that are held.
    """
    moves = np.ptp(posterior.flat, axis=0) > 0
    kinds = [p.kind for p in posterior.model.parameters]
    chosen = [k for k, kind in enumerate(kinds) if kind != "frame" and moves[k]]
    cov = np.asarray(posterior.cov)[np.ix_(chosen, chosen)]
    sd = np.sqrt(np.diag(cov))
    strength = np.triu(np.abs(cov / np.outer(sd, sd)), k=1)
    picked: list[int] = []
    for flat in np.argsort(-strength, axis=None, kind="stable"):
        for k in divmod(int(flat), len(chosen)):
            if k not in picked and len(picked) < n:
                picked.append(k)
        if len(picked) == min(n, len(chosen)):
            break
    return tuple(posterior.model.names[chosen[k]] for k in sorted(picked))


def _mixture_draws(posterior: Posterior) -> list[tuple[str, str, Float]]:
    """Label, unit and draws (ensembles, draws) of each of f, j, s_out that was sampled."""
    unit = posterior.model.unit
    hyper = {key: np.asarray(draws, float) for key, draws in posterior.hyper.items()}
    return [
        (label, "%", 100.0 * hyper[key]) if key == "f" else (label, unit, hyper[key])
        for key, label in _MIXTURE_LABELS.items()
        if key in hyper
    ]


def _thinned(draws: Float) -> Float:
    return draws[:: max(1, len(draws) // _MAX_POINTS)]


@REPORT.figure("coefficients", needs=("posterior",))
def traces(r: ReportInput) -> Plot:
    """Chains of the slowest parameters and of f, j, s_out, and their densities, by ensemble."""
    posterior = needed(r.posterior)
    names = slowest_parameters(posterior, without=r.held)
    rows: list[tuple[str, str, Float]] = []
    for name in names:
        k = posterior.model.names.index(name)
        mean = float(posterior.mean[k])
        rows.append(
            (
                broken_name(name) + ("\n" if len(name) > 6 else " ") + "− mean",
                posterior.model.units[k],
                posterior.theta[..., k] - mean,
            )
        )
    rows += _mixture_draws(posterior)
    fig = new_figure(WIDTH, 1.0 * len(rows) + 0.7)
    axes = fig.subplots(
        len(rows), 2, sharey="row", sharex="col", width_ratios=(4, 1), squeeze=False
    )
    for (trace, density), (label, unit, values) in zip(axes, rows, strict=True):
        scale = display_scale(unit, values)
        _trace_row(trace, density, _by_walker(values * scale.factor, posterior))
        trace.set_ylabel(f"{label}\n[{scale.unit or 'no unit'}]", fontsize=7.5)
        trace.yaxis.set_major_locator(MaxNLocator(4))
        trace.yaxis.set_label_coords(*LABEL_AT)  # aligned; to measure all ticks takes far longer
    axes[-1, 0].set_xlabel("step after warm-up [count]")
    axes[-1, 1].set_xlabel("density [relative]")
    legend_above(fig, axes[0, 0])
    return Plot(
        fig,
        "Chains",
        "The coefficients with the fewest effective draws, and the mixture's parameters. The"
        " ensembles are independent: equal levels and equal densities are what convergence looks"
        " like.",
        "Traces of the slowest parameters and densities by ensemble.",
    )


def slowest_parameters(
    posterior: Posterior, n: int = 4, *, without: Collection[str] = ()
) -> tuple[str, ...]:
    """Parameters of theta with the n fewest effective draws, but for those in `without`."""
    names = posterior.model.names
    known = dict(zip(posterior.convergence.names, posterior.convergence.ess_bulk, strict=True))
    ess = np.array([known.get(name, np.inf) for name in names], float)
    order = np.argsort(np.where(np.isfinite(ess), ess, -np.inf), kind="stable")
    return tuple(names[k] for k in order if names[k] not in without)[:n]


def _by_walker(values: Float, posterior: Posterior) -> Float:
    """Draws (ensembles, walkers, steps) of an array (ensembles, draws), walker after walker."""
    ensembles, draws = values.shape
    walkers = posterior.sampler.walkers
    # a posterior that was thinned while sampling has lost its order in time: show it as it is
    return values.reshape(ensembles, walkers if draws % walkers == 0 else 1, -1)


def _trace_row(trace: Axes, density: Axes, ensembles: Float) -> None:
    low, high = np.quantile(ensembles, [0.0005, 0.9995])
    pad = 0.1 * (high - low) or 1e-6 * max(abs(high), 1e-12)
    edges = np.linspace(low - pad, high + pad, 41)
    n_steps = ensembles.shape[-1]
    step = max(1, n_steps * len(ensembles) // _TRACE_POINTS)
    blocks = np.array_split(np.arange(n_steps), min(30, n_steps))
    for k, walkers in enumerate(ensembles):
        color = CYCLE[k % len(CYCLE)]
        # one walker of each ensemble as points, the running median over all walkers as a line
        trace.plot(
            np.arange(0, n_steps, step),
            walkers[0, ::step],
            ".",
            ms=1.0,
            alpha=0.4,
            color=color,
            rasterized=True,
            zorder=1,
        )
        middle = [np.median(walkers[:, b]) for b in blocks]
        at = [float(b.mean()) for b in blocks]
        trace.plot(at, middle, color=color, lw=1.2, label=f"ensemble {k + 1}", zorder=3)
        counts, _ = np.histogram(walkers, edges)
        density.stairs(counts / max(counts.max(), 1), edges, orientation="horizontal", color=color)
    trace.set_xlim(0, max(n_steps - 1, 1))
    trace.set_ylim(edges[0], edges[-1])
    density.set_xlim(0, 1.1)
    trace.axhline(float(np.mean(ensembles)), color=INK, lw=0.5, zorder=4)
