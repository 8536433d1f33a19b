"""Figures of a release of several filters: their linear terms without the common drift."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.infer.solution import Solution
from bayesdist.infer.transforms import lines, reference_gauge, without_frames

__all__ = ["draw_filters"]

TERMS = ("A_2", "B_3", "B_2")


def draw_filters(
    folder: Path,
    fits: Mapping[str, Fitted],
    solutions: Mapping[str, Solution],
) -> tuple[str, ...]:
    """Write filters_A_2.png and the like, and return their names.

    Parameters
    ----------
    folder : Path
    fits : mapping of filter to Fitted
        The reference filter first.
    solutions : mapping of filter to Solution
        As they are released.
    """
    # figures take seconds to import
    from bayesdist.report.drawing import save_figures
    from bayesdist.report.filters import FilterTerm, filters_figure

    model = next(iter(fits.values())).linear.model
    time = model.time
    if time is None or len(fits) < 2:
        return ()
    views = {
        name: reference_gauge(without_frames(one), model.chips[0].number)
        for name, one in solutions.items()
    }
    edges = np.asarray(time.breaks)
    figures = {}
    for term in TERMS:
        courses = []
        for chip in sorted(model.chips, key=lambda c: c.name):
            for name, fitted in fits.items():
                label = f"{chip.name}.{term}"
                series = required(fitted.alone, "fits of single exposures")
                if label not in series.coefficients:
                    continue
                found = [lines(views[name], s, chip=chip.number) for s in range(time.n_segments)]
                alpha, beta = (
                    [one.select(f"{term}.{part}") for one in found] for part in ("alpha", "beta")
                )
                k = series.coefficients.index(label)
                s = np.searchsorted(edges, series.epoch, side="right")
                rate = np.array([one.values[0] for one in beta])[s]
                courses.append(
                    FilterTerm(
                        name,
                        chip.name,
                        series.epoch,
                        series.values[:, k] - rate * (series.epoch - np.array(time.epoch0)[s]),
                        np.sqrt(np.maximum(series.cov[:, k, k], 0.0)),
                        np.array([one.values[0] for one in alpha]),
                        np.array([one.sigma[0] for one in alpha]),
                    )
                )
        if courses:
            figures[f"filters_{term}"] = filters_figure(term, courses, time.breaks)
    save_figures(figures, folder)
    return tuple(f"{name}.png" for name in figures)
