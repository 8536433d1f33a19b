"""`bayesdist release`: one set of files from the finished runs of several filters.

Linear terms and drift of the other filters are compared with those of the reference; see
Kozhurina-Platais et al. (2015), section 4.4.4 and Figures 25 and 26.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.config.results import ReleaseBlock
from bayesdist.app.products import published_tables, release_set
from bayesdist.app.run import Run
from bayesdist.app.screen import table_text
from bayesdist.app.store.record import record_folder, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import linear_terms, lines, reference_gauge, without_frames
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.linear_terms import ExposuresAlone
from bayesdist.kinds.campaign.reference import with_drift_of
from bayesdist.kinds.campaign.series import FilterDependence, Series, TrendModel, filter_dependence
from bayesdist.model import LookupTable, TimeDependence
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import DIFFERENCE

PRINTED = ("filter", "chip", "term", "at_edge", "sigma_at_edge")

Measured = tuple[float, float]  # value and standard deviation

# powers of x and y of the linear terms
POWERS = {"2": (1, 0), "3": (0, 1)}


def release_runs(
    runs: Sequence[str | Path],
    output: str | Path,
    *,
    allow_unconverged: bool = False,
    command: str = "",
) -> str:
    """Write the files of a release for several filters to a new folder.

    Parameters
    ----------
    runs : sequence of path
        Finished runs of campaigns, one per filter.  The first is that of the reference filter: its
        section [products.release] defines the files, its drift is stored, and its tables are those
        of the detector.
    output : path
        Folder to create.
    allow_unconverged : bool
        Accept runs that have not converged; the files then state this.
    command : str
        Command line, for the record.

    Returns
    -------
    str
        Text to print.

    Raises
    ------
    InputError
        If a folder is not a run of a campaign, two runs have the same filter, settings or tables of
        the detector differ between the runs, or a run has not converged.
    """
    with ExitStack() as stack:
        by_filter: dict[str, Run] = {}
        for path in runs:
            run = stack.enter_context(_opened(path))
            if run.filter in by_filter:
                raise InputError(
                    f"is of filter {run.filter}, as {by_filter[run.filter].directory.path} is",
                    where=str(path),
                    do="give one run for each filter",
                )
            by_filter[run.filter] = run
        block = _require_alike(by_filter)
        doubts = _doubts(by_filter, allowed=allow_unconverged)
        solutions = _solutions(by_filter)
        comparison, why_not = _compared(by_filter)
        notes = [*doubts, *_notes(by_filter, comparison)]
        first = next(iter(by_filter.values()))
        chip = first.config.chips()[0].number
        table = comparison_table(solutions, comparison, chip=chip)
        if comparison is None:
            table.meta["drift"] = {"verdict": why_not}
        with record_folder(Path(output), "release.json", command) as (folder, record):
            tables = _tables(by_filter)
            files = release_set().write(block, chip, first.base, folder, solutions, tables, notes)
            write_table(table, folder / "filters.ecsv")
            figures = draw_filters(folder, by_filter, solutions)
            record |= {
                "runs": {name: str(run.directory.path) for name, run in by_filter.items()},
                "converged": not doubts,
                "drift": table.meta["drift"],
                "products": files,
                "figures": list(figures),
            }
    columns = {name: table[name].tolist() for name in table.colnames}
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    return _text(Path(output), files, rows, str(table["at_edge"].unit), why_not or None, comparison)


def _opened(path: str | Path) -> Run:
    """Finished run of a campaign."""
    directory = RunDirectory.open(path)
    if not isinstance(directory.config, CampaignConfig):  # only campaigns have filters to release
        raise InputError(
            "is not a run of a campaign", where=str(path), do="give runs that began with star lists"
        )
    directory.require("release", ("match", "fit", "sample"))
    return Run.of(directory)


# -- compatibility of the runs ---------------------------------------------------------------------


def _require_alike(by_filter: Mapping[str, Run]) -> ReleaseBlock:
    """Section of the release in the first run; raises InputError if runs are incompatible."""
    first, *other_runs = by_filter.values()
    block = first.config.products.release
    if block is None:
        raise InputError(
            "has no [products.release], but the first run determines what is released",
            where=str(first.directory.path),
            do="put the run of the reference filter first",
        )
    mine = _structure(first)
    for run in other_runs:
        for name, theirs in _structure(run).items():
            if theirs != mine[name]:
                raise InputError(
                    f"the {name} are not those of {first.directory.path}"
                    + (f": {theirs} and {mine[name]}" if name != "chips" else ""),
                    where=str(run.directory.path),
                    do="run both filters with the same settings",
                )
        if not _same_detector(first, run):
            raise InputError(
                f"the detector's tables are not those of {first.directory.path}",
                where=str(run.directory.path),
                do="name that run in tables.detector and run this filter again",
            )
    return block


def _structure(run: Run) -> dict[str, Any]:
    """Properties that the runs must have in common, by names in the plural."""
    model, time = run.posterior.model, run.posterior.model.time
    return {
        "chips": model.chips,
        "orders": model.order,
        "units": model.unit,
        "pixel scales": run.config.detector.scale_mas,
        "drifting terms": None if time is None else time.terms,
        "reference dates (RDATE)": None if time is None else time.epoch0,
        "breaks": None if time is None else time.breaks,
    }


def _same_detector(a: Run, b: Run) -> bool:
    """True if two runs have equal detector tables, to the precision of a D2IMFILE."""
    mine, theirs = (
        {
            t.chip: (t.first, t.step, t.values.astype(np.float32))
            for t in run.tables.tables
            if not t.filter
        }
        for run in (a, b)
    )
    return mine.keys() == theirs.keys() and all(
        mine[c][:2] == theirs[c][:2] and np.array_equal(mine[c][2], theirs[c][2]) for c in mine
    )


def _doubts(by_filter: Mapping[str, Run], *, allowed: bool) -> list[str]:
    """Sentences on runs that have not converged."""
    out = []
    for name, run in by_filter.items():
        convergence = run.posterior.convergence
        if not convergence.converged:
            why = "; ".join(convergence.reasons)
            if not allowed:
                raise InputError(
                    f"the run of {name} has not converged ({why})",
                    where=str(run.directory.path),
                    do="resume it with more steps, or release it with --allow-unconverged",
                )
            out.append(f"NOT CONVERGED: the run of {name} ({why}).")
    return out


# -- content of the release -----------------------------------------------------------------------


def _solutions(by_filter: Mapping[str, Run]) -> dict[str, Solution]:
    """Solution of the reference filter, and those of other filters with its drift."""
    (first, reference), *other_filters = by_filter.items()
    out: dict[str, Solution] = {first: reference.solution}
    for name, run in other_filters:
        solution: Solution = run.solution
        if solution.model.time is not None:
            solution = with_drift_of(
                solution,
                reference.solution,
                chip=reference.config.chips()[0].number,
                formal=run.fit,
            )
        out[name] = solution
    return out


def _tables(by_filter: Mapping[str, Run]) -> list[LookupTable]:
    """Tables of the detector, once, and those of the filters."""
    published = [
        published_tables(run.tables, held=run.config.tables.detector is not None)
        for run in by_filter.values()
    ]
    out = [table for table in published[0] if not table.filter]
    return out + [table for tables in published for table in tables if table.filter]


def _compared(by_filter: Mapping[str, Run]) -> tuple[FilterComparison | None, str]:
    """Comparison of the filters, or the reason why there is none."""
    if len(by_filter) < 2:
        return None, "not compared: there is one filter"
    first = next(iter(by_filter.values()))
    try:
        comparison = compare_filters(
            {name: run.part(ExposuresAlone).series for name, run in by_filter.items()},
            first.posterior.model.time,
            seed=first.config.sampler.seed,
        )
    except InputError as error:  # too few exposures, or no drift
        return None, f"not compared: {error.cause}"
    return comparison, ""


def _notes(by_filter: Mapping[str, Run], comparison: FilterComparison | None) -> list[str]:
    """Lines for HISTORY."""
    if len(by_filter) < 2:
        return []
    first = next(iter(by_filter))
    out = [f"Filters {', '.join(by_filter)}; the drift is that of {first}."]
    if comparison is not None:
        verdict = comparison.sentence
        out.append(f"Tested on the exposures: {verdict}.")
    return out


# -- printed text ---------------------------------------------------------------------------------


def _text(
    output: Path,
    files: Sequence[Mapping[str, Any]],
    rows: Sequence[Mapping[str, Any]],
    unit: str,
    why_not: str | None,
    comparison: FilterComparison | None,
) -> str:
    lines = [table_text([{"file": str(output / f["path"]), "kind": f["kind"]} for f in files])]
    for file in files:
        lines += [f"  {file['path']}: {text}" for text in file["findings"]]
    different = [row for row in rows if row["filter"] != rows[0]["filter"]]
    if different:
        reference = rows[0]["filter"]
        lines += ["", f"Against {reference}, at half the chip ({unit}), the drift taken out:"]
        lines.append(table_text([{k: row[k] for k in PRINTED} for row in different]))
    lines += ["", f"Drift: {comparison.sentence if comparison else why_not}"]
    if comparison is not None and not comparison.alike:
        lines.append("WARNING: the files hold one drift for all filters")
    return "\n".join(lines)


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
