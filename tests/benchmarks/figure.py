"""The scaling figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.files.atomic import atomic_path
from bayesdist.report.figures.style import INK, PALETTE, WIDTH, figure_style, new_figure

__all__ = ["draw_scaling"]


def draw_scaling(scaling: dict[str, Any], path: Path) -> None:
    """Seconds and peak memory against the number of stars, both on logarithmic axes.

    Parameters
    ----------
    scaling : dict
        From `scaling.run`.
    path : Path
    """
    rows = scaling["rows"]
    n = np.array([row["n_stars"] for row in rows], float)
    seconds = np.array([row["seconds"] for row in rows])
    memory = np.array([row["peak_mb"] for row in rows]) / 1e3
    with figure_style():
        fig = new_figure(WIDTH, 3.2)
        left, right = fig.subplots(1, 2)
        left.loglog(n, seconds, "o", ms=5, color=PALETTE["blue"], label="fit and sample, measured")
        fitted = scaling["exponent"]
        if fitted is not None:
            ends = np.array([fitted["from"], fitted["to"]], float)
            line = 10 ** (fitted["intercept"] + fitted["value"] * np.log10(ends))
            text = f"N$^{{{fitted['value']:.2f} \\pm {fitted['error']:.2f}}}$"
            left.loglog(ends, line, "-", color=PALETTE["vermilion"], label=text)
        # slope one for the eye, through the last point
        left.loglog(n, seconds[-1] * n / n[-1], ":", color=INK, lw=0.8, label="slope 1")
        left.set(xlabel="number of stars", ylabel="wall time [s]")
        left.set_title(f"order {scaling['order']}, to an effective sample size of 400")
        left.legend()
        right.loglog(n, memory, "s", ms=5, color=PALETTE["green"])
        right.set_ylim(bottom=0.1)
        right.set(xlabel="number of stars", ylabel="peak resident memory [GB]")
        right.set_title("one process, libraries included")
        for axes in (left, right):
            axes.grid(True, which="major", lw=0.4, color="#D5DAE0")
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            fig.savefig(temporary, dpi=160)
