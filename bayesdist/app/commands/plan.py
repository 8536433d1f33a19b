"""`bayesdist plan` and `bayesdist select-order`: further exposures, and the polynomial order.

Requirements need a number of further exposures at certain dates.  The order is selected for the
data of a configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.config import load_config
from bayesdist.app.evaluating import assessment_rng
from bayesdist.app.result_files import judged_requirements
from bayesdist.app.run import Run
from bayesdist.app.screen import table_text
from bayesdist.app.stars import model_of, shards_of
from bayesdist.app.store.record import refuse_existing, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.evaluation import with_measured_centroids
from bayesdist.assess.model import with_diagnosed_errors, with_shared_stars
from bayesdist.assess.planning import (
    ExistingData,
    Futures,
    Need,
    Schedule,
    exposures_needed,
)
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.calibration.chip_map import chosen_chip
from bayesdist.data import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.infer import Shards
from bayesdist.infer.compare.order import OrderSelection, in_one_frame, select_order
from bayesdist.infer.compare.planning import (
    ExposureContent,
    exposure_content,
    with_information,
)
from bayesdist.infer.solution.linear import Rejection
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel
from bayesdist.model.basis import MAX_ORDER
from bayesdist.plugin import load_object
from bayesdist.utils.arrays import Float


def plan(run: str | Path, *, name: str | None = None, epochs: Sequence[float] = ()) -> str:
    """Number of exposures like the existing ones that the requirements of a run need, as text.

    Parameters
    ----------
    run : path
    name : str, optional
        Name of one requirement; all by default.
    epochs : sequence of float
        Possible dates of further exposures, in decimal years.
    """
    if str(run).endswith(".toml"):
        raise InputError(
            "is a file, not a run",
            where=str(run),
            do=f"compare dither patterns by 'bayesdist plan-dither {run}'",
        )
    with Run.of(RunDirectory.open(run)) as opened:
        opened.directory.require("plan", ("fit", "sample", "diagnose", "evaluate"))
        exposures = opened.kind.further_exposures(opened)
        if epochs and exposures.dateless:
            raise InputError(exposures.dateless, where=str(run), do="leave out --epochs")
        content = content_of(opened)
        needs = needs_of(opened, content, name=name, epochs=epochs)
        lines = [exposures.sentence(content)]
    for requirement, several in needs:
        lines.append("")
        lines.append(f"{requirement.name} (probability {requirement.probability:g} asked for)")
        for need in several:
            lines.append(f"  {need.sentence}")
            if need.by_number:
                lines.append(f"    probability by number of exposures: {need.table}")
    return "\n".join(lines)


def needs_of(
    run: Run,
    content: ExposureContent,
    *,
    name: str | None = None,
    epochs: Sequence[float] = (),
) -> list[tuple[Requirement, tuple[Need, ...]]]:
    """Number of exposures that each requirement of a run needs, for each schedule.

    Parameters
    ----------
    run : Run
        Run that was evaluated.
    content : ExposureContent
        Average exposure of the run, from `content_of`.
    name : str, optional
        Name of one requirement; all by default.
    epochs : sequence of float
        Dates of further exposures in decimal years.

    Returns
    -------
    list of tuple of Requirement and tuple of Need

    Raises
    ------
    InputError
        If there is no such requirement.
    """
    requirements = judged_requirements(run.directory)
    chosen = [r for r in requirements if name is None or r.name == name]
    if not chosen:
        names = ", ".join(repr(r.name) for r in requirements)
        raise InputError(
            f"has no requirement {name!r}" if names else "has no requirements",
            where=str(run.directory.path),
            do=f"name one of {names}" if names else "judge some with 'bayesdist requirements'",
        )
    now = {row["name"]: row["probability_met"] for row in run.directory.summary["margins"]}
    future, out = futures_of(run, content), []
    for requirement in chosen:
        needs = exposures_needed(
            schedules_of(run, requirement, content, epochs),
            future(requirement).probability,
            requirement.probability,
            now=now[requirement.name],
        )
        out.append((requirement, needs))
    return out


def content_of(run: Run) -> ExposureContent:
    """Average exposure of the run."""
    stars = run.diagnostics.sample
    jitter = float(np.mean(run.posterior.hyper.get("j", [0.0])))
    sigma = np.stack([np.asarray(stars.table.sigma_u), np.asarray(stars.table.sigma_v)], axis=1)
    true = np.ones(len(stars))
    if stars.outlier_probability is not None:
        true = 1.0 - stars.outlier_probability
    return exposure_content(
        run.posterior.model,
        stars.table,
        true[:, None] / (sigma**2 + jitter**2),
        n_total=stars.n_total,
        n_exposures=run.kind.further_exposures(run).count,
    )


def schedules_of(
    run: Run,
    requirement: Requirement,
    content: ExposureContent,
    epochs: Sequence[float] = (),
) -> list[Schedule]:
    """Schedules of exposures: at relevant dates, or one schedule if dates do not matter."""
    return run.kind.further_exposures(run).schedules(requirement, content, epochs)


def futures_of(run: Run, content: ExposureContent) -> Callable[[Requirement], Futures]:
    """Function that predicts the run with more exposures, for any requirement."""
    settings, errors = run.evaluation_settings, run.error_model
    errors = with_measured_centroids(errors, run.diagnostics, settings)
    diagnostics = run.diagnostics
    hierarchy = run.hierarchy
    # further exposures of the same stars do not reduce the effect of catalogue errors
    independent = with_diagnosed_errors(
        run.posterior, replace(diagnostics, catalogue=None), hierarchy, noise_alone=True
    )

    def solution(information: Float) -> Solution:
        extended = with_information(independent, information)
        if diagnostics.catalogue is None or hierarchy is None:
            return extended
        return with_shared_stars(extended, hierarchy, diagnostics.catalogue)

    exposures = run.kind.further_exposures(run)
    weight = np.mean([np.sum([m[axis, 0, 0] for m in content.moments.values()]) for axis in (0, 1)])
    seed = int(assessment_rng(run.config).integers(2**63))

    def of(requirement: Requirement) -> Futures:
        return Futures(
            errors,
            requirement,
            ExistingData(exposures.count, float(weight), content.n_stars, exposures.gain),
            solution,
            settings.grid,
            settings.epoch,
            settings.pixel_scale(errors),
            seed,
            run.config.discrepancy.priors(),
        )

    return of


def order(
    path: str | Path,
    orders: Sequence[int] = (3, 9),
    *,
    output: str | Path | None = None,
    chip: int | None = None,
    figure: str | Path | None = None,
    force: bool = False,
) -> str:
    """Compare polynomial orders on the data of a configuration.

    The order, priors and extra weights of the configuration have no effect.  Frames of exposures
    and drift are removed as in a fit of the highest order.  Orders that the data do not determine
    are listed with the reason, provided that two lower ones can be compared.

    Parameters
    ----------
    path : path
        Configuration.
    orders : sequence of int
        Lowest and highest order.
    output : path, optional
        ECSV file for the table.
    chip : int, optional
        Chip number, needed if there are several chips.
    figure : path, optional
        PNG file for the figure.
    force : bool
        Replace existing files.

    Returns
    -------
    str
        Table and verdict.
    """
    targets = [Path(name) for name in (output, figure) if name is not None]
    for target in targets:
        refuse_existing(target, force)
    low, high = orders
    if not 1 <= low < high <= MAX_ORDER:
        raise InputError(
            f"the orders go from {low} to {high}",
            where="--orders",
            do=f"give the lowest and the highest, between 1 and {MAX_ORDER}",
        )
    config, text = load_config(path)
    unsuitable = load_object(config.kind).no_order
    if unsuitable:
        raise InputError(
            unsuitable,
            where=str(path),
            do="run it, and see whether the report asks for terms of a higher order",
        )
    chips = [chip_of_model.number for chip_of_model in config.chips()]
    number_of = chosen_chip(chips or [1], chip, where=str(path), argument="--chip")
    with TemporaryDirectory() as nowhere:
        directory = RunDirectory.plan(nowhere, config, text, Path(path).resolve().parent)
        with Run.of(directory) as run:
            selection, failed = _selected(run, range(low, high + 1), number_of if chips else None)
    if output is not None:
        write_table(_table(selection, failed), Path(output))
    if figure is not None:
        _draw(selection, Path(figure))
    return "\n\n".join([_text(selection, failed), selection.sentence])


def _selected(
    run: Run, orders: Sequence[int], chip: int | None
) -> tuple[OrderSelection, dict[int, str]]:
    """Comparison of orders, and reasons why higher orders cannot be fitted."""
    failed: dict[int, str] = {}
    run = run.kind.match(run)
    for top in sorted(orders, reverse=True):
        try:
            return _compared(run, range(min(orders), top + 1), chip), failed
        except DegenerateError as error:
            if top <= min(orders) + 1:
                raise
            failed[top] = error.sentence
    raise AssertionError("the lowest two orders are compared or refused")


def _compared(run: Run, orders: Sequence[int], chip: int | None) -> OrderSelection:
    """Comparison of orders, based on a configuration of the highest.

    Errors by magnitude, tables, frames and drift are those of a fit of that order, because its
    residuals contain the least misfit.
    """
    config = run.config.of_order(max(orders))
    run = run.with_config(config)
    rejection = Rejection(config.fit.clip_chi2, config.fit.clip_abs)
    stars: Matches | Shards
    errors = run.kind.errors_before_fit(run)
    if errors is not None:
        model = model_of(run.stars, config)
        stars = shards_of(run.stars, model, config, errors, run.reader)
    else:
        run = run.kind.fit(run)
        chip_of_model = next(
            chip_of_model
            for chip_of_model in run.model.chips
            if chip in (None, chip_of_model.number)
        )
        model = DistortionModel(max(orders), (chip_of_model,), unit=run.model.unit)
        stars = in_one_frame(run.fit, run.matches, chip_of_model.number)
    return select_order(stars, model, orders=orders, rejection=rejection)


def _rows(found: OrderSelection, failed: dict[int, str]) -> list[dict[str, Any]]:
    """One row per order, ascending; orders that cannot be fitted have only the number of terms."""
    rows: list[dict[str, Any]] = [{**row} for row in found.rows()]
    empty = dict.fromkeys(rows[0])
    unfitted = [empty | {"order": n, "terms": (n + 1) * (n + 2) // 2} for n in sorted(failed)]
    return rows + unfitted


def _table(found: OrderSelection, failed: dict[int, str]) -> Table:
    rows = _rows(found, failed)
    table = Table(
        {key: [np.nan if row[key] is None else row[key] for row in rows] for key in rows[0]}
    )
    if failed:
        table["not_fitted"] = [failed.get(row["order"], "") for row in rows]
    for name in ("rms_u", "rms_v", "lost"):
        table[name].unit = found.unit
    noise = found.surfaces.noise
    table.meta = {
        "verdict": found.sentence,
        "order": found.order,
        "by_surfaces": found.by_surfaces,
        "by_stars": found.by_stars,
        "by_regions": found.by_regions,
        "n_used": found.n_used,
        "n_bins": found.surfaces.n_bins,
        "noise_u": float(noise[0]),
        "noise_v": float(noise[1]),
        "pair_rms": found.pair_rms,
        "error_scale": found.error_scale,
        "unit": found.unit,
    }
    return table


def _text(found: OrderSelection, failed: dict[int, str]) -> str:
    """Table with surfaces on the left, and held-out stars and regions on the right."""
    noise, s = found.surfaces.noise, found.surfaces
    rows = [
        {
            "order": f"{row['order']}{' *' if row['order'] == found.order else ''}",
            "terms": row["terms"],
            "rms u": row["rms_u"],
            "rms v": row["rms_v"],
            "chi2/dof u": row["chi2_u"],
            "chi2/dof v": row["chi2_v"],
            "F": row["F"],
            "p": row["p_surface"],
            "held-out stars": _with_error(row["stars"], row["stars_error"]),
            "held-out regions": _with_error(row["regions"], row["regions_error"]),
            "lost": row["lost"],
        }
        for row in _rows(found, failed)
    ]
    reasons = "".join(f"\norder {n} is not fitted: {failed[n]}" for n in sorted(failed))
    return (
        f"{found.n_used} pairs in {s.n_bins} bins; lengths in {found.unit}; noise of the bins "
        f"{noise[0]:.3g} (u), {noise[1]:.3g} (v); errors are {found.error_scale:.3g} times those "
        f"quoted\n\n{table_text(rows, 3)}\n\n"
        "*  chosen: F, p and what is held out (log density) are against this order; lost: how far "
        f"the model is from that of order {found.orders[-1]}{reasons}"
    )


def _with_error(value: float | None, error: float | None) -> str:
    return "" if value is None or error is None else f"{value:.4g} +- {error:.2g}"


def _draw(found: OrderSelection, path: Path) -> None:
    from bayesdist.report.drawing import png_of  # plotting takes seconds to import
    from bayesdist.report.figures.commands import order_comparison

    png = png_of(order_comparison(found))
    with atomic_path(path) as temporary:
        temporary.write_bytes(png)
