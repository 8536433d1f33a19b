"""Traces: the chains that the posterior came from."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bayesdist.report.numbers import broken_name, display_scale
from bayesdist.report.style import CYCLE, HYPER_LABELS, INK, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.infer import Posterior

__all__ = ["slowest_parameters", "traces"]

Float = NDArray[np.float64]

_TRACE_POINTS = 2_000  # draws that stand as points in a trace


def slowest_parameters(
    posterior: Posterior, n: int = 4, *, without: Collection[str] = ()
) -> tuple[str, ...]:
    """The parameters of theta with the fewest effective draws: the worst that the chains offer.

    Parameters
    ----------
    posterior : Posterior
    n : int
    without : collection of str
        Parameters that are passed over.

    Returns
    -------
    tuple of str
    """
    names = posterior.model.names
    known = dict(zip(posterior.convergence.names, posterior.convergence.ess_bulk, strict=True))
    ess = np.array([known.get(name, np.inf) for name in names], float)
    order = np.argsort(np.where(np.isfinite(ess), ess, -np.inf), kind="stable")
    return tuple(names[k] for k in order if names[k] not in without)[:n]


def traces(posterior: Posterior, names: Sequence[str] | None = None) -> Figure:
    """Chains of the slowest parameters and of f, j, s_out, and their densities, by ensemble.

    Parameters
    ----------
    posterior : Posterior
    names : sequence of str, optional
        Parameters of theta; those of `slowest_parameters` by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    names = tuple(slowest_parameters(posterior) if names is None else names)
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
    for key in ("f", "j", "s_out"):
        if key in posterior.hyper:
            percent = key == "f"
            values = np.asarray(posterior.hyper[key], float) * (100.0 if percent else 1.0)
            rows.append((HYPER_LABELS[key], "%" if percent else posterior.model.unit, values))
    with figure_style():
        fig = new_figure(WIDTH, 1.0 * len(rows) + 0.7)
        axes = fig.subplots(
            len(rows), 2, sharey="row", sharex="col", width_ratios=(4, 1), squeeze=False
        )
        for (trace, density), (label, unit, values) in zip(axes, rows, strict=True):
            scale = display_scale(unit, values)
            _trace_row(trace, density, _by_walker(values * scale.factor, posterior))
            trace.set_ylabel(f"{label}\n[{scale.unit or 'no unit'}]", fontsize=7.5)
            trace.yaxis.set_major_locator(MaxNLocator(4))
        axes[-1, 0].set_xlabel("step after warm-up [count]")
        axes[-1, 1].set_xlabel("density [relative]")
        fig.align_ylabels(axes[:, 0])
        handles, labels = axes[0, 0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper left", ncols=len(labels))
    return fig


def _by_walker(values: Float, posterior: Posterior) -> Float:
    """Draws (ensembles, walkers, steps) of an array (ensembles, draws), walker after walker."""
    ensembles, draws = values.shape
    walkers = posterior.sampler.walkers
    # a posterior that was thinned on the way has lost its order in time: show it as it is
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
