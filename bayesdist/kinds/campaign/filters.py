"""Comparison of other filters with the reference: linear terms, drift, and figures.

See Kozhurina-Platais et al. (2015), section 4.4.4 and Figures 25 and 26.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table

from bayesdist.app.run import Run
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import linear_terms, lines, reference_gauge, without_frames
from bayesdist.kinds.campaign.parts import ExposuresAlone
from bayesdist.kinds.campaign.series import FilterDependence, Series, TrendModel, filter_dependence
from bayesdist.model import TimeDependence
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import DIFFERENCE

Measured = tuple[float, float]  # value and standard deviation

# powers of x and y of the linear terms
POWERS = {"2": (1, 0), "3": (0, 1)}


@dataclass(frozen=True, eq=False)
class FilterComparison:
    """Differences between filters, from exposures that were fitted one by one."""

    reference: str  # reference filter
    # offset by (filter, term), with terms such as 'WFC2.A_2', if all filters have a common drift
    offsets: Mapping[tuple[str, str], Measured]
    # difference of the rate, per year, by (filter, term), if each filter has separate rates
    rates: Mapping[tuple[str, str], Measured]
    # p-value of the differences of rates: the smallest of all chips, multiplied by their number
    p_value: float
    # True if separate rates for each filter predict unused exposures better on any chip
    depends: bool

    @property
    def alike(self) -> bool:
        """True if one drift is sufficient for all filters."""
        return not self.depends and DIFFERENCE.met_by(self.p_value)

    @property
    def sentence(self) -> str:
        """Verdict in words."""
        if self.alike:
            return f"one drift serves all filters (p = {self.p_value:.2g})"
        worst = max(self.rates, key=lambda key: abs(self.rates[key][0] / self.rates[key][1]))
        value, sigma = self.rates[worst]
        return (
            f"the drift is not the same in all filters (p = {self.p_value:.2g}): most of all that "
            f"of {worst[1]} in {worst[0]} differs, by {value:.2g} +- {sigma:.2g} a year"
        )


def compare_filters(
    series: Mapping[str, Series], time: TimeDependence | None, *, seed: int = 1
) -> FilterComparison:
    """Compare the drifting terms of exposures in several filters, chip by chip.

    Parameters
    ----------
    series : mapping of str to Series
        Linear terms of the exposures of each filter; the reference filter comes first.
    time : TimeDependence or None
        Drift of the model.
    seed : int

    Returns
    -------
    FilterComparison

    Raises
    ------
    InputError
        If nothing drifts, or no drifting term is known in all filters.
    """
    if time is None:
        raise InputError("no term drifts", where="model.tdd", do="give the drifting terms")
    reference = next(iter(series))
    trend = TrendModel("lines" if time.breaks else "line", time.breaks, reference=time.epoch0)
    by_chip: dict[str, list[str]] = {}
    for term in series[reference].coefficients:
        in_all = all(term in item.coefficients for item in series.values())
        # constant terms have steps but no rates to compare
        if in_all and _place(term) in time.terms and any(_place(term)[1:]):
            by_chip.setdefault(term.rpartition(".")[0], []).append(term)
    if not by_chip:
        raise InputError(
            "no drifting term is known in all filters",
            where="exposures",
            do="run the stage 'fit' of each again",
        )
    offsets: dict[tuple[str, str], Measured] = {}
    rates: dict[tuple[str, str], Measured] = {}
    dependences = []
    # fitted separately: chips scatter together, so that joint chains would hardly move
    for terms in by_chip.values():
        item = filter_dependence(_pooled(series, terms), trend, seed=seed)
        offsets |= _against(item, item.common.group_offset, reference)
        rates |= _against(item, item.separate.group_slope, reference)
        dependences.append(item)
    p_value = min(1.0, len(dependences) * min(item.all_slopes.p_value for item in dependences))
    return FilterComparison(
        reference, offsets, rates, p_value, any(item.depends for item in dependences)
    )


def _pooled(series: Mapping[str, Series], terms: Sequence[str]) -> Series:
    """Exposures of all filters in one series, with the filters as groups."""
    chosen = {filter: selected.only(*terms) for filter, selected in series.items()}
    return Series(
        np.concatenate([selected.epoch for selected in chosen.values()]),
        np.concatenate([selected.values for selected in chosen.values()]),
        np.concatenate([selected.cov for selected in chosen.values()]),
        tuple(terms),
        tuple(f"{filter}.{name}" for filter, selected in chosen.items() for name in selected.names),
        tuple(filter for filter, selected in chosen.items() for _ in selected.names),
        source="exposures of all filters",
    )


def _place(term: str) -> tuple[str, int, int]:
    """Axis and powers of a linear term; for example, 'WFC2.B_2' is ('v', 1, 0)."""
    letter, _, digit = term.rsplit(".", maxsplit=1)[-1].partition("_")
    return ("u" if letter == "A" else "v", *POWERS.get(digit, (0, 0)))


def _against(
    found: FilterDependence, draws: Float, reference: str
) -> dict[tuple[str, str], Measured]:
    """Mean and sigma of filter offsets relative to `reference`, from draws (n, G - 1, k)."""
    offsets = np.concatenate([np.zeros_like(draws[:, :1]), draws], axis=1)
    difference = offsets - offsets[:, [found.names.index(reference)]]
    mean, sigma = difference.mean(axis=0), difference.std(axis=0, ddof=1)
    return {
        (filter, term): (float(mean[f, k]), float(sigma[f, k]))
        for f, filter in enumerate(found.names)
        if filter != reference
        for k, term in enumerate(found.common.series.coefficients)
    }


def comparison_table(
    solutions: Mapping[str, Solution], comparison: FilterComparison | None, *, chip: int
) -> Table:
    """Linear terms of each filter after removal of the drift, and their differences.

    There is one row per filter, chip and term A_2, A_3, B_2, B_3 that the gauge does not fix, at
    the reference date.  Terms are per pixel, and also as their effect at half the chip, in the unit
    of u, v.

    Parameters
    ----------
    solutions : mapping of str to Solution
        Solutions by filter; the reference filter comes first.
    comparison : FilterComparison or None
        Offsets and rates; without it offsets are differences of the solutions.
    chip : int
        Number of the chip that defines the gauge.
    """
    reference = next(iter(solutions))
    offsets = {} if comparison is None else comparison.offsets
    rates = {} if comparison is None else comparison.rates
    reference_terms: dict[str, Measured] = {}
    rows = []
    for filter, solution in solutions.items():
        view = reference_gauge(solution, chip)
        time = view.model.time
        epoch = None if time is None else time.epoch0[0]
        for item in view.model.chips:
            terms = linear_terms(view, item.number, epoch=epoch)
            fixed = {"A_1", "B_1", "A_3"} if item.number == chip else {"A_1", "B_1"}
            for name, value, sigma in zip(terms.labels, terms.values, terms.sigma, strict=True):
                if name in fixed:
                    continue
                term = f"{item.name}.{name}" if len(view.model.chips) > 1 else name
                first = reference_terms.setdefault(term, (value, sigma))
                offset = (0.0, 0.0)
                if filter != reference:
                    plain = value - first[0], float(np.hypot(sigma, first[1]))
                    offset = offsets.get((filter, term), plain)
                rate = rates.get((filter, term), (np.nan, np.nan))
                lever = item.size[0 if _place(term)[1] else 1] / 2
                rows.append(
                    {
                        "filter": filter,
                        "chip": item.number,
                        "term": name,
                        "value": value,
                        "sigma": sigma,
                        "offset": offset[0],
                        "sigma_offset": offset[1],
                        "at_edge": lever * offset[0],
                        "sigma_at_edge": lever * offset[1],
                        "rate_difference": rate[0],
                        "sigma_rate_difference": rate[1],
                    }
                )
    table = Table(rows=rows)
    for name in ("at_edge", "sigma_at_edge"):
        table[name].unit = next(iter(solutions.values())).model.unit
    table.meta["reference"] = reference
    table.meta["epoch"] = epoch
    if comparison is not None:
        table.meta["drift"] = {
            "alike": comparison.alike,
            "p_value": comparison.p_value,
            "own_rates_predict_better": comparison.depends,
            "verdict": comparison.sentence,
        }
    return table


TERMS = ("A_2", "B_3", "B_2")


def draw_filters(
    folder: Path,
    runs: Mapping[str, Run],
    solutions: Mapping[str, Solution],
) -> tuple[str, ...]:
    """Write filters_A_2.png and so on, and return their names."""
    # imported here because plotting takes seconds to import
    from bayesdist.report.drawing import save_figures
    from bayesdist.report.figures.commands import FilterTerm, filters_figure

    model = next(iter(runs.values())).model
    time = model.time
    if time is None or len(runs) < 2:
        return ()
    views = {
        name: reference_gauge(without_frames(item), model.chips[0].number)
        for name, item in solutions.items()
    }
    edges = np.asarray(time.breaks)
    figures = {}
    for term in TERMS:
        courses = []
        for chip in sorted(model.chips, key=lambda c: c.name):
            for name, run in runs.items():
                label = f"{chip.name}.{term}"
                series = run.part(ExposuresAlone).series
                if label not in series.coefficients:
                    continue
                segments = [lines(views[name], s, chip=chip.number) for s in range(time.n_segments)]
                alpha, beta = (
                    [item.select(f"{term}.{part}") for item in segments]
                    for part in ("alpha", "beta")
                )
                k = series.coefficients.index(label)
                s = np.searchsorted(edges, series.epoch, side="right")
                rate = np.array([item.values[0] for item in beta])[s]
                courses.append(
                    FilterTerm(
                        name,
                        chip.name,
                        series.epoch,
                        series.values[:, k] - rate * (series.epoch - np.array(time.epoch0)[s]),
                        np.sqrt(np.maximum(series.cov[:, k, k], 0.0)),
                        np.array([item.values[0] for item in alpha]),
                        np.array([item.sigma[0] for item in alpha]),
                    )
                )
        if courses:
            figures[f"filters_{term}"] = filters_figure(term, courses, time.breaks)
    save_figures(figures, folder)
    return tuple(f"{name}.png" for name in figures)
