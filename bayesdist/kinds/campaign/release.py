"""`bayesdist release`: one set of files from the finished runs of several filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.config.products import ReleaseBlock
from bayesdist.app.products.export import published_tables
from bayesdist.app.products.release_set import release_set
from bayesdist.app.run import Run
from bayesdist.app.screen import table_text
from bayesdist.app.store.output import record_folder, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.errors import InputError
from bayesdist.infer.exposures.shared_drift import with_drift_of
from bayesdist.infer.solution.solution import Solution
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.filters import (
    FilterComparison,
    compare_filters,
    comparison_table,
    draw_filters,
)
from bayesdist.kinds.campaign.parts import ExposuresAlone
from bayesdist.model import LookupTable

PRINTED = ("filter", "chip", "term", "at_edge", "sigma_at_edge")


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
