"""Reliability: how often requirements are met, against how often it is said; ranks of truths."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from bayesdist.report.figures.style import CYCLE, WIDTH, figure_style, new_figure

from .summary import RANK_BINS, WITHIN, reliability, simultaneous_band

TITLES = {
    "drift": "Drift, extrapolated by five years",
    "pattern": "A pattern that the model leaves out",
}


def reliability_figure(found: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """One panel for each kind of calibration."""
    with figure_style():
        fig = new_figure(WIDTH, 3.9)
        axes = fig.subplots(1, len(found), sharey=True, squeeze=False)[0]
        for ax, (kind, (said, met)) in zip(axes, found.items(), strict=True):
            ax.plot([0, 1], [0, 1], color="#9AA5B1", lw=0.8, zorder=1)
            for one in reliability(said, met):
                low, high = one.band()
                ax.plot(
                    [one.said] * 2,
                    [low, high],
                    color=CYCLE[0],
                    lw=7,
                    alpha=0.22,
                    zorder=2,
                    solid_capstyle="butt",
                )
                ax.plot(one.said, one.met, "o", color=CYCLE[1], ms=5, zorder=3)
                ax.annotate(
                    str(one.n),
                    (one.said, one.met),
                    xytext=(6, -9),
                    fontsize=7,
                    textcoords="offset points",
                )
            ax.set_title(f"{TITLES.get(kind, kind)}: {said.size} calibrations")
            ax.set_xlabel("probability that is said (mean of a bin)")
            ax.set_xlim(-0.06, 1.06)
            ax.set_ylim(-0.06, 1.06)
            ax.set_aspect("equal")
        axes[0].set_ylabel("share that meets its limit in truth")
        axes[0].plot([], [], "o", color=CYCLE[1], ms=5, label="share (number: calibrations)")
        axes[0].plot([], [], color=CYCLE[0], lw=5, alpha=0.22, label="99 % binomial band")
        axes[0].legend(loc="lower right")
    return fig


STATISTICS = ("rms", "p95", "max")


def ranks_figure(found: Mapping[str, np.ndarray]) -> Figure:
    """Histograms of ranks of four kinds of quantities, and all distributions less an even one."""
    kinds = {
        "coefficients": [r for name, r in found.items() if name[:2] in ("u_", "v_")],
        "positions": [r for name, r in found.items() if " at " in name],
        "rms, p95, maximum": [found[name] for name in STATISTICS],
    }
    rest = {name for name in found if name[:2] not in ("u_", "v_") and " at " not in name}
    kinds["likelihood, mixture, structure"] = [found[name] for name in rest - {*STATISTICS}]
    n = len(found["rms"])
    with figure_style():
        fig = new_figure(WIDTH, 4.6)
        upper, lower = fig.subplots(2, len(kinds), sharey="row")
        z = np.linspace(*WITHIN, 97)
        band = simultaneous_band(n, 0.95) * np.sqrt(z * (1 - z) / n)
        for top, below, (kind, ranks) in zip(upper, lower, kinds.items(), strict=True):
            counts, edges = np.histogram(np.concatenate(ranks), np.linspace(0, 1, RANK_BINS + 1))
            total = counts.sum()
            top.bar(
                edges[:-1], counts / total, 1 / RANK_BINS, align="edge", color=CYCLE[0], alpha=0.5
            )
            top.axhline(1 / RANK_BINS, color="#9AA5B1", lw=0.8)
            top.set_title(f"{len(ranks)} {kind}" if len(ranks) > 8 else kind)
            top.set_xlabel("rank of the truth")
            below.fill_between(z, -band, band, color=CYCLE[0], alpha=0.22, lw=0)
            for one in ranks:
                shares = np.mean(one[:, None] <= z, axis=0)
                below.plot(z, shares - z, color=CYCLE[1], lw=0.7, alpha=0.7)
            below.axhline(0, color="#9AA5B1", lw=0.8)
            below.set_xlabel("rank z")
        upper[0].set_ylabel("share of truths")
        lower[0].set_ylabel("share of ranks below z, less z")
        lower[0].plot([], [], color=CYCLE[0], lw=5, alpha=0.22, label="95 %, all z at once")
        lower[0].set_ylim(-0.13, 0.17)
        lower[0].legend(loc="upper right")
    return fig
