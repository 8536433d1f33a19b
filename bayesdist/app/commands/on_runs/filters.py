"""Filters beside the reference: offsets of linear terms, whether all drift alike, and figures.

ACS ISR 2015-06, section 4.4.4 and Figures 25 and 26.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table

from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.errors import InputError
from bayesdist.infer.series import FilterDependence, Series, TrendModel, filter_dependence
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import linear_terms, lines, reference_gauge, without_frames
from bayesdist.model import TimeDependence
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import DIFFERENCE

Measured = tuple[float, float]  # value and standard deviation

# places of the linear terms: power of x, power of y
POWERS = {"2": (1, 0), "3": (0, 1)}


@dataclass(frozen=True, eq=False)
class FilterComparison:
    """Differences between filters, as exposures that were each fitted alone show them."""

    reference: str  # the filter that the others are compared with
    # what a filter adds to a drifting term, as 'WFC2.A_2', where all filters drift alike
    offsets: Mapping[tuple[str, str], Measured]
    # what it adds to the term's rate, per year, where it has rates of its own
    rates: Mapping[tuple[str, str], Measured]
    # probability of such differences of rates where there are none: the least of all chips,
    # multiplied by their number
    p_value: float
    # whether on some chip rates of each filter's own predict exposures better that were not used
    depends: bool

    @property
    def alike(self) -> bool:
        """Boolean: one drift serves all filters."""
        return not self.depends and DIFFERENCE.met_by(self.p_value)

    @property
    def sentence(self) -> str:
        """The verdict in words."""
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

    `series`: the reference filter first. `time`: what drifts. InputError where nothing can be
    compared.
    """
    if time is None:
        raise InputError("nothing drifts", where="model.tdd", do="give the terms that do")
    reference = next(iter(series))
    trend = TrendModel("lines" if time.breaks else "line", time.breaks, reference=time.epoch0)
    by_chip: dict[str, list[str]] = {}
    for term in series[reference].coefficients:
        in_all = all(term in one.coefficients for one in series.values())
        # the distance between the chips has steps only: no rates to compare
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
    found = []
    # chips scatter together: fitted jointly their chains hardly move, and would say little more
    for terms in by_chip.values():
        one = filter_dependence(_pooled(series, terms), trend, seed=seed)
        offsets |= _against(one, one.common.group_offset, reference)
        rates |= _against(one, one.separate.group_slope, reference)
        found.append(one)
    p_value = min(1.0, len(found) * min(one.all_slopes.p_value for one in found))
    return FilterComparison(reference, offsets, rates, p_value, any(one.depends for one in found))


def _pooled(series: Mapping[str, Series], terms: Sequence[str]) -> Series:
    """Exposures of all filters in one series, with the filters as groups."""
    chosen = {filter: one.only(*terms) for filter, one in series.items()}
    return Series(
        np.concatenate([one.epoch for one in chosen.values()]),
        np.concatenate([one.values for one in chosen.values()]),
        np.concatenate([one.cov for one in chosen.values()]),
        tuple(terms),
        tuple(f"{filter}.{name}" for filter, one in chosen.items() for name in one.names),
        tuple(filter for filter, one in chosen.items() for _ in one.names),
        source="exposures of all filters",
    )


def _place(term: str) -> tuple[str, int, int]:
    """Axis and powers of a linear term: 'WFC2.B_2' is ('v', 1, 0)."""
    letter, _, digit = term.split(".")[-1].partition("_")
    return ("u" if letter == "A" else "v", *POWERS.get(digit, (0, 0)))


def _against(
    found: FilterDependence, draws: Float, reference: str
) -> dict[tuple[str, str], Measured]:
    """Draws (n, G - 1, k) of what filters add to the first one, as differences to the reference."""
    every = np.concatenate([np.zeros_like(draws[:, :1]), draws], axis=1)
    difference = every - every[:, [found.names.index(reference)]]
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
    """Linear terms of each filter with the drift taken out, and how they differ.

    `solutions`: the reference filter first; without a `comparison` offsets are theirs. A row is a
    filter, chip and term A_2, A_3, B_2, B_3 that the gauge does not fix, at the reference date: per
    pixel of u, v, and as what it does at half the chip, in the unit of u, v.
    """
    reference = next(iter(solutions))
    offsets = {} if comparison is None else comparison.offsets
    rates = {} if comparison is None else comparison.rates
    known: dict[str, Measured] = {}
    rows = []
    for filter, solution in solutions.items():
        view = reference_gauge(solution, chip)
        time = view.model.time
        epoch = None if time is None else time.epoch0[0]
        for one in view.model.chips:
            found = linear_terms(view, one.number, epoch=epoch)
            fixed = {"A_1", "B_1", "A_3"} if one.number == chip else {"A_1", "B_1"}
            for name, value, sigma in zip(found.labels, found.values, found.sigma, strict=True):
                if name in fixed:
                    continue
                term = f"{one.name}.{name}" if len(view.model.chips) > 1 else name
                first = known.setdefault(term, (value, sigma))
                offset = (0.0, 0.0)
                if filter != reference:
                    plain = value - first[0], float(np.hypot(sigma, first[1]))
                    offset = offsets.get((filter, term), plain)
                rate = rates.get((filter, term), (np.nan, np.nan))
                lever = one.size[0 if _place(term)[1] else 1] / 2
                rows.append(
                    {
                        "filter": filter,
                        "chip": one.number,
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
    fits: Mapping[str, Fitted],
    solutions: Mapping[str, Solution],
) -> tuple[str, ...]:
    """Write filters_A_2.png and the like, and return their names."""
    # figures take seconds to import
    from bayesdist.report.drawing import save_figures
    from bayesdist.report.figures.commands import FilterTerm, filters_figure

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
