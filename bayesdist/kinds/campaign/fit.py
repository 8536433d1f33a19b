"""Fit of a campaign: look-up tables, errors, all exposures jointly, and each exposure alone.

Look-up tables are fitted together with the polynomial, or taken from another run.  Fits of new
exposures test whether the release still describes them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.parts import FitArtefacts, StoredLookupTables, load_errors
from bayesdist.app.run import Run
from bayesdist.app.stars import QUOTED, ErrorLaw
from bayesdist.app.store.made_from import input_name
from bayesdist.app.store.rundir import PAIRS, RunDirectory, part_files
from bayesdist.data import Matches, centroid_errors, read_matches, with_measured_motions
from bayesdist.diagnose.tables import BetweenNodes, measured_between
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, fit_by_magnitude, fit_linear, load, residuals
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.compare.monitoring import NewFit, fit_new, with_star_errors_of
from bayesdist.infer.exposures.alone import ExposureSolutions, fit_exposures
from bayesdist.infer.exposures.hierarchy import (
    HierarchicalFit,
    fit_hierarchical,
    held_in_reference,
    trend_p_values,
)
from bayesdist.infer.nodes import (
    Iteration,
    TableFit,
    corrected_matches,
    fit_with_tables,
    held_sigma,
    on_the_chips,
)
from bayesdist.infer.solution.linear import Rejection
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.inputs import CampaignInputs, frames_not_set
from bayesdist.kinds.campaign.linear_terms import (
    FIXED,
    ExposuresAlone,
    LinearTermScatter,
    gap_priors,
    line_sections,
    with_gap,
)
from bayesdist.kinds.campaign.matching import affine_model_of
from bayesdist.kinds.campaign.reference import held_tables, rate_priors
from bayesdist.kinds.campaign.series import Series
from bayesdist.model import Chip, DistortionModel, LookupTable, corrected
from bayesdist.model.frames import RIGID
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import TREND

log = logging.getLogger("bayesdist")

SERIES = ("A_2", "A_3", "B_1", "B_2", "B_3")

MIN_SCATTER_RATIO = 2.0  # ratio of scatters above which centroid errors cannot explain them
MIN_EXPLAINED = 0.5  # fraction of the variance of the scatters explained by the dates
MIN_EXPOSURES = 5  # exposures: a parabola in time has three parameters
SIGMA_OF_MEDIAN = 1.4826  # standard deviation in units of the median absolute deviation
ROUGH_ITERATIONS = 1  # iterations of the tables that are used only to estimate star errors


def fit_campaign(run: Run) -> Run:
    """Fit the look-up tables, the errors, all exposures jointly, and each exposure alone."""
    with frames_not_set():
        return run.having(**_fitted(run.stars, run.inputs))


def _fitted(pairs: Matches, inputs: CampaignInputs) -> FitArtefacts:
    """Artefacts of the stage 'fit'."""
    config = inputs.config
    affine = affine_model_of(config, pairs)
    tables, fit_of_tables = fit_tables(pairs, inputs)
    if tables.tables:
        pairs = on_the_chips(corrected_matches(tables.tables, pairs), affine)
    errors = QUOTED if inputs.has_quoted_errors else errors_with_catalogue(pairs, inputs)
    stars = errors.applied(pairs)
    rejection = Rejection(config.fit.clip_chi2, config.fit.clip_abs)
    joint = _joint(stars, affine, inputs, rejection)
    number = config.chips()[0].number
    alone = fit_exposures(stars, affine, chip=number, rejection=rejection)
    facts = {
        **line_sections(joint, number),
        "tables": tables_section(config, tables, fit_of_tables),
        "scatter": {
            name: {"value": tau, "interval_68": list(joint.tau_interval(0.68)[name])}
            for name, tau in joint.tau.items()
        },
        "deviations": {"warnings": _trends(joint, stars)},
        "exposures_skipped": dict(alone.skipped),
        "exposures_outlying": list(joint.outlying),
    }
    return {
        "fit": joint.fit,
        "errors": errors,
        "priors": joint.priors,
        "parts": {
            "tables": tables,
            "scatter": LinearTermScatter(joint.scatter.kinds, joint.tau_draws, joint.settling),
            "alone": ExposuresAlone(_series(alone, joint.model.chips[0])),
        },
        "fit_facts": facts,
    }


def _joint(
    stars: Matches, affine: DistortionModel, inputs: CampaignInputs, rejection: Rejection
) -> HierarchicalFit:
    """Fit all exposures jointly; they deviate from the model by the scatter that is found."""
    config = inputs.config
    asked, scale = config.time(), config.detector.scale_mas
    pixel = 1.0 if scale is None else inputs.pixel_arcsec / inputs.unit_arcsec
    drifting = with_gap(replace(affine, time=asked))
    held = held_in_reference(stars, drifting, config.chips()[0].number)
    model = replace(held, chip_deviations=True)
    with closing(load(model, stars, config.resources())) as shards:
        return fit_hierarchical(
            shards,
            model,
            priors=rate_priors(config, model, inputs.base) or gap_priors(model, asked, pixel),
            pixel=pixel,
            seed=config.sampler.seed,
            rejection=rejection,
        )


def _series(alone: ExposureSolutions, reference: Chip) -> Series:
    """Linear terms of all chips and the constant in v, without terms that the gauge fixes."""
    fixed = {f"{prefix}{term}" for prefix in ("", f"{reference.name}.") for term in FIXED}
    labels = [s for s in alone.labels if s.split(".")[-1] in SERIES and s not in fixed]
    epoch, values, cov = alone.series(*labels)
    return Series(epoch, values, cov, tuple(labels), alone.names, source="exposures")


def _trends(joint: HierarchicalFit, stars: Matches) -> list[str]:
    """Clauses about deviations that drift with time although they are modelled as scatter.

    Only scale and shears are tested: motion of the chips relative to each other has its own test
    (`bayesdist.diagnose.score.motions`).
    """
    if stars.epoch is None:
        return []
    model = joint.model
    codes, rows = np.unique(stars.exposure, return_index=True)
    dates = dict(zip((stars.exposure_names[k] for k in codes), stars.epoch[rows], strict=True))
    typical = [k for k, name in enumerate(model.exposures) if name not in joint.outlying]
    epoch = np.array([dates[model.exposures[k]] for k in typical])
    values = joint.fit.mean[joint.index].reshape(len(joint.scatter.kinds), -1).T[typical]
    breaks = () if model.time is None else model.time.breaks
    p = trend_p_values(values, epoch, breaks)
    return [
        f"the {kind} of the exposures drifts with time (p = {p_k:.1g}), and is taken to scatter "
        "between exposures: extend model.tdd.terms"
        for kind, p_k in zip(joint.scatter.kinds, p, strict=True)
        if kind.split(".")[-1] not in RIGID and p_k * len(p) < TREND.value
    ]


def refuse_outrun_stars(inputs: CampaignInputs, fit: LinearFit, pairs: Matches) -> None:
    """Refuse a catalogue without proper motions if residuals grow with the time from its epoch.

    The mean square residual of moving stars is a parabola in time.
    """
    if inputs.catalog.pm_u is not None or pairs.epoch is None:
        return
    size = np.abs(residuals(fit, pairs))
    names = range(len(pairs.exposure_names))
    rows = [np.flatnonzero(pairs.exposure == k) for k in names]
    rows = [star_rows for star_rows in rows if len(star_rows)]
    if len(rows) < MIN_EXPOSURES:
        return
    date = np.array([pairs.epoch[star_rows[0]] for star_rows in rows])
    scatter = np.array([SIGMA_OF_MEDIAN * np.median(size[star_rows]) for star_rows in rows])
    if np.ptp(date) == 0 or scatter.max() < MIN_SCATTER_RATIO * scatter.min():
        return
    at = (date - date.mean()) / np.ptp(date)
    curve = np.polynomial.Polynomial.fit(at, scatter**2, 2).convert()
    unexplained = np.var(scatter**2 - curve(at)) / np.var(scatter**2)
    if unexplained > 1.0 - MIN_EXPLAINED or curve.coef[2] <= 0:
        return
    low, high = int(np.argmin(scatter)), int(np.argmax(scatter))
    raise InputError(
        f"has no proper motions, and the exposures span {np.ptp(date):.1f} years: residuals "
        f"scatter by {scatter[low]:.2g} {fit.unit} in {date[low]:.1f} and by {scatter[high]:.2g} "
        f"{fit.unit} in {date[high]:.1f}",
        where=inputs.catalog.source,
        do="give it columns pm_u and pm_v, or calibrate exposures of one epoch",
    )


def fit_tables(
    pairs: Matches, inputs: CampaignInputs
) -> tuple[StoredLookupTables, TableFit | None]:
    """Fit the configured look-up tables, and combine them with those held fixed.

    The tables of the detector are fitted unless they are taken from another run, in which case the
    tables of the filter are fitted.  The linear part of each exposure is free.

    Returns
    -------
    stored : StoredLookupTables
        Fitted and fixed tables.
    fit : TableFit or None
        None if no tables are fitted.
    """
    config, filter = inputs.config, inputs.filter
    model = affine_model_of(config, pairs)
    block, grid = config.tables, config.assess.grid
    held = held_tables(block, config.chips(), inputs.base)
    if block.method == "none":
        if not held:
            return StoredLookupTables(), None
        placed = on_the_chips(corrected_matches(held, pairs), model)
        if inputs.has_quoted_errors:
            fit = fit_linear(placed, model)
        else:
            errors = errors_with_catalogue(placed, inputs)
            fit = fit_linear(errors.applied(placed), model)
            pairs = errors.applied(pairs)
        between = measured_between(pairs, fit, held, filter=filter, fitted=False)
        of_nodes = _on_the_grid(held, fit, "", grid, partial(_held_variance, held))
        return _stored(held, of_nodes, between), None
    rough = None
    if not inputs.has_quoted_errors:
        pairs, rough = _with_errors(pairs, inputs, held)
    table_fit = fit_with_tables(
        pairs,
        model,
        filter=filter if held else "",
        beneath=held,
        method=block.method,
        step=block.step,
        max_iterations=block.max_iterations,
        start=rough,
        report=_log_iteration,
    )
    has_covariance = bool(table_fit.posteriors)
    variance = (
        table_fit.shift_variance if has_covariance else partial(_held_variance, table_fit.tables)
    )
    between = measured_between(
        pairs,
        table_fit.solution,
        table_fit.tables,
        filter=table_fit.filter,
        posteriors=table_fit.posteriors,
        mixture=table_fit.mixture,
    )
    of_nodes = _on_the_grid(table_fit.tables, table_fit.solution, table_fit.filter, grid, variance)
    return _stored(table_fit.tables, of_nodes, between), table_fit


def errors_with_catalogue(pairs: Matches, inputs: CampaignInputs) -> ErrorLaw:
    """Centroid errors by magnitude, which are added to each star's error of the catalogue.

    Each exposure is fitted by itself (`fit_by_magnitude`), and the errors of the catalogue are
    subtracted from the scatter (`centroid_errors`). Only stars with a measured motion are used: an
    assumed motion makes the error of a star many times that of the others of its magnitude.
    """
    stars = with_measured_motions(pairs, inputs.catalog)
    fit, _, total = fit_by_magnitude(stars, affine_model_of(inputs.config, stars))
    refuse_outrun_stars(inputs, fit, stars.with_errors(total))
    return ErrorLaw(by_magnitude=centroid_errors(stars, total), with_catalogue=True)


def _with_errors(
    pairs: Matches, inputs: CampaignInputs, held: tuple[LookupTable, ...]
) -> tuple[Matches, TableFit]:
    """Pairs with errors by magnitude that exclude the table pattern, and a rough fit of the tables.

    Without tables the residuals scatter twice as much as the centroids.  With errors from that
    scatter the tables would be smoothed too much, and the errors of the tables would be twice too
    large.  The smoothness of the rough tables hardly matters, because it hardly affects the
    scatter.
    """
    model, block = affine_model_of(inputs.config, pairs), inputs.config.tables
    rough = fit_with_tables(
        errors_with_catalogue(pairs, inputs).applied(pairs),
        model,
        filter=inputs.filter if held else "",
        beneath=held,
        method=block.method,
        step=block.step,
        max_iterations=ROUGH_ITERATIONS,
        report=_log_iteration,
    )
    errors = errors_with_catalogue(rough.corrected(pairs), inputs)
    return errors.applied(pairs), rough


def _stored(
    tables: Sequence[LookupTable], of_nodes: Mapping[int, Float], between: Sequence[BetweenNodes]
) -> StoredLookupTables:
    """Tables in the order of their file: those of the detector first, by chip number."""
    return StoredLookupTables(
        tuple(sorted(tables, key=lambda table: (table.filter != "", table.chip))),
        dict(sorted(of_nodes.items())),
        {
            chip_between.chip: chip_between
            for chip_between in sorted(between, key=lambda chip_between: chip_between.chip)
        },
    )


def _log_iteration(one: Iteration) -> None:
    log.info(
        "fit: tables, iteration %d: moved %.2g px, residuals %.4f px",
        one.number,
        one.moved,
        one.rms,
    )


def _on_the_grid(
    tables: Sequence[LookupTable],
    fit: LinearFit,
    filter: str,
    grid: tuple[int, int],
    variance: Callable[..., Float],
) -> dict[int, Float]:
    """Position errors (ny, nx, 2) on the grid of the assessment, by chip.

    ``variance(x, y, chip=)`` returns the variance (n, 2) of the shift by the tables at pixels x and
    y.
    """
    out = {}
    for chip in fit.model.chips:
        x, y = mesh(*grid_pixels(chip.size, grid))
        px, py = corrected(tables, x, y, chip=chip.number, filter=filter)
        J = fit.model.slopes(fit.mean, px, py, chip=chip.number)
        sigma = np.sqrt(np.einsum("nab,nb->na", J**2, variance(x, y, chip=chip.number)))
        out[chip.number] = sigma.reshape(grid[1], grid[0], 2)
    return out


def _held_variance(tables: Sequence[LookupTable], x: Float, y: Float, *, chip: int) -> Float:
    """Variance (n, 2) of the shift by tables that have no covariance or are held fixed."""
    return held_sigma(tables, x, y, chip=chip) ** 2


def _warnings(config: Config, stored: StoredLookupTables, fit: TableFit | None) -> Iterator[str]:
    """Warnings about the errors of the tables, each as a clause."""
    block = config.tables
    if block.detector is not None and any(t.sigma is None for t in stored.tables if not t.filter):
        yield "the detector's tables have no errors, and none are counted"
    if stored.tables and len(stored.between) < len(config.chips()):
        yield (
            "too few stars lie near each other to tell what the look-up tables leave between "
            "their nodes, and no error is counted for it"
        )
    if fit is None:
        return
    if block.method == "binned":
        yield (
            "the tables are smoothed bins: their errors are those of the bins; what smoothing "
            "takes off the pattern is among what lies between the nodes"
        )
    if not fit.converged:
        yield (
            f"the look-up tables still moved by {fit.progress[-1].moved:.2g} pixels in the last "
            f"of {len(fit.progress)} iterations"
        )


def tables_section(
    config: Config, stored: StoredLookupTables, fit: TableFit | None
) -> dict[str, object]:
    """Section 'tables' of summary.json."""
    out: dict[str, object] = {
        "method": config.tables.method,
        "detector": config.tables.detector,
        "chips": [_row(table) for table in stored.tables],
        "between_nodes": [_between(chip_between) for chip_between in stored.between.values()],
        "warnings": list(_warnings(config, stored, fit)),
    }
    if fit is not None:
        out |= {
            "converged": fit.converged,
            "rms_before": fit.progress[0].rms,
            "rms_after": fit.progress[-1].rms,
        }
    return out


def _row(table: LookupTable) -> Mapping[str, object]:
    return {
        "chip": table.chip,
        "filter": table.filter or None,
        "nodes": list(table.shape),
        "rms": float(np.sqrt((table.values**2).mean())),
        "largest": float(np.hypot(*table.values).max()),
        "sigma_median": None if table.sigma is None else float(np.median(table.sigma)),
    }


def _between(one: BetweenNodes) -> Mapping[str, object]:
    """Rms between the nodes along x and y (pixels), and mean squares as measured."""
    return {
        "chip": one.chip,
        "rms_x": float(one.left.mean[0] ** 0.5),
        "rms_y": float(one.left.mean[1] ** 0.5),
        "square": one.square.tolist(),
        "square_error": one.error.tolist(),
        "n_pairs": one.n_pairs,
    }


def fit_new_exposures(release: Run, new: Path) -> tuple[Matches, NewFit, tuple[str, ...]]:
    """Fit new exposures of a campaign, with deviations drawn from the scatter of the release.

    The catalogue error of a star, which is common to all its exposures, is included.  If the
    release has the same catalogue, the effect of that error on the release is taken into account.

    Parameters
    ----------
    release : Run
    new : Path
        Run directory of a campaign with completed stage 'match', or a file or folder of pairs as
        stored in a run.  Star lists must be matched first.

    Returns
    -------
    Matches
        Pairs with errors, and with pixels corrected by the look-up tables of the release.
    NewFit
        Their fit.
    tuple of str
        Exposures that are left out because the release was made from them.

    Raises
    ------
    InputError
        If pairs have no epochs, are in another filter or unit than the release, or are all of
        exposures that the release was made from, or if star lists are not matched yet.
    """
    run = RunDirectory(new) if (new / "run.json").exists() else None
    released, config = release.solution, release.config
    pairs = _pairs(run, new, released.model.unit)
    if not pairs.has_epoch:
        raise InputError("has no epochs", where=str(new), do="give a column 'epoch'")
    _refuse_other_filters(release.config, pairs, ", ".join(pairs.sources))
    is_released = np.isin(pairs.exposure_names, released.model.exposures)
    left_out = tuple(np.asarray(pairs.exposure_names)[is_released].tolist())
    fresh = ~is_released[pairs.exposure]
    if not fresh.any():
        raise InputError(
            f"all of {len(left_out)} exposures were used to make the release",
            where=str(new),
            do="give pairs of other exposures",
        )
    pairs = pairs.select(fresh)
    pairs = pairs.with_exposure_names(pairs.exposures)
    placed, errors = release.as_placed(pairs), release.errors.by_magnitude
    if run is not None and "fit" in run.record.artefacts:
        errors = load_errors(run.path).by_magnitude or errors
    if placed.mag is not None and errors is not None:
        placed = placed.with_errors(errors, in_quadrature=True)
    scatter = release.part(LinearTermScatter)
    new_fit = fit_new(
        released,
        placed,
        rejection=Rejection(config.fit.clip_chi2, config.fit.clip_abs),
        compute=config.resources(),
        scatter=dict(zip(scatter.kinds, np.sqrt((scatter.tau**2).mean(axis=0)), strict=True)),
    )
    with_centroids = cast(CampaignConfig, config).campaign.sigma == "columns"
    of_catalogue = _catalogue_errors(pairs, run, with_centroids=with_centroids)
    if of_catalogue is not None:
        is_same = run is not None and _catalogue_of(run) == _catalogue_of(release.directory)
        made_from = (release.fit, release.matches) if is_same else None
        new_fit = with_star_errors_of(of_catalogue, new_fit, placed, made_from)
    return placed, new_fit, left_out


def _pairs(run: RunDirectory | None, new: Path, unit: str) -> Matches:
    """Matched pairs of another run, or of a table."""
    if run is None:
        if new.suffix == ".toml":
            raise InputError(
                "is a configuration with star lists that have to be matched first",
                where=str(new),
                do="give the folder of its 'bayesdist run', or of 'bayesdist stage match'",
            )
        if not new.exists():
            raise InputError("there is no such file", where=str(new), do="check the name")
        pairs = read_matches(new, unit=unit)
    else:
        # pairs of matched stars have no catalogue in common with those of a campaign
        if not isinstance(run.config, CampaignConfig) or not part_files(run / PAIRS):
            raise InputError(
                "is a run without matched pairs of a campaign",
                where=str(run.path),
                do="give one whose stage 'match' has been run, or a table of pairs",
            )
        pairs = read_matches(run / PAIRS, unit=unit)
    return pairs


def _refuse_other_filters(config: Config, pairs: Matches, where: str) -> None:
    mine = cast(CampaignConfig, config).campaign.filter
    other_filters = sorted({name for name in pairs.filter_names if name} - {mine})
    if mine is not None and other_filters:
        raise InputError(
            f"the pairs are in filter {other_filters[0]}, but the release is in {mine}",
            where=where,
            do="give pairs in the filter of the release",
        )


def _catalogue_errors(
    pairs: Matches, run: RunDirectory | None, *, with_centroids: bool
) -> StarErrors | None:
    """Errors of the catalogue by star code; None if there are none.

    `with_centroids` is True if the errors of the pairs include those of the centroids.  Otherwise
    they are the smallest error of each star in its pairs.
    """
    if with_centroids:
        if run is None:
            raise InputError(
                "have errors that include those of the centroids, which do not show the errors of "
                "the catalogue that all exposures of a star have in common",
                where=", ".join(pairs.sources),
                do="give the folder of the run that matched them",
            )
        matched = Run.of(run)
        return matched.kind.star_errors(matched)
    if pairs.star is None or pairs.sigma_u is None or pairs.sigma_v is None or pairs.mag is None:
        return None
    if pairs.rho_uv is not None:
        return StarErrors.contained_in(pairs)
    sigma = np.full((int(pairs.star.max()) + 1, 2), np.inf)
    for axis, values in enumerate((pairs.sigma_u, pairs.sigma_v)):
        np.minimum.at(sigma[:, axis], pairs.star, values)
    return StarErrors(np.where(np.isfinite(sigma), sigma, 0.0))


def _catalogue_of(run: RunDirectory) -> str | None:
    """Hash of the catalogue of a campaign."""
    config, base = cast(CampaignConfig, run.config), Path(run.facts["base"])
    name = input_name(base / config.campaign.catalog, base)
    digest: str | None = run.facts["inputs"].get(name)
    return digest
