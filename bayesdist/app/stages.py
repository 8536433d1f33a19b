"""Complete calibration, from a configuration to a finished run directory.

Each stage writes files, sections of summary.json and log messages.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.config import load_config
from bayesdist.app.diagnosing import holdout_summary, holdout_table, periods_summary, periods_table
from bayesdist.app.evaluating import idle_dates
from bayesdist.app.parts import write_stored_fit
from bayesdist.app.pipeline import (
    diagnose,
    evaluate,
    export,
    fit,
    match,
    rehearse,
    rehearse_solution,
    report,
    sample,
)
from bayesdist.app.result_files import write_diagnostics, write_evaluation
from bayesdist.app.run import Run
from bayesdist.app.screen import log_file, progress_bar
from bayesdist.app.stars import in_circle
from bayesdist.app.store.made_from import NEEDS, STAGES
from bayesdist.app.store.record import attributes, write_table
from bayesdist.app.store.rundir import RunDirectory, part_files
from bayesdist.app.store.summary import GeometryRow, SamplerSection
from bayesdist.data import Matches
from bayesdist.data.writing import write_columns
from bayesdist.errors import InputError, NotConvergedError
from bayesdist.files.atomic import made_folder, remove_leftovers
from bayesdist.infer import LinearFit, Posterior, save_posterior
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.posterior.checks import convergence_check
from bayesdist.infer.posterior.memberships import memberships_of
from bayesdist.infer.solution.geometry import geometries, skew_of
from bayesdist.infer.stars.stars import in_table_order, prepare
from bayesdist.utils.checks import warnings_of
from bayesdist.utils.memory import release_memory

__all__ = ["continue_stage", "make_stages", "run"]

ASSESS = ("diagnose", "evaluate")
FIT_ARTEFACTS = ("fit", "errors", "priors", "added_errors", "parts", "fit_facts")
# artefacts by the stages that save them, for a run in memory
ARTEFACTS = {
    "fit": FIT_ARTEFACTS,
    "sample": ("posterior",),
    "diagnose": ("diagnostics",),
    "evaluate": ("evaluation",),
}

log = logging.getLogger("bayesdist")

MATCHING = "matching.ecsv"


def run(
    config: str | Path,
    output: str | Path,
    *,
    resume: bool = False,
    force: bool = False,
    strict: bool = False,
    seed: int | None = None,
    report: bool = True,
    command: str = "",
) -> Path:
    """Match, fit, sample, diagnose, evaluate, export and report, as configured.

    Parameters
    ----------
    config : path
        TOML file; paths in it are relative to it.
    output : path
        Run directory.
    resume : bool
        Resume the existing run: stages that are up to date are skipped, and checkpoints are used.
    force : bool
        Replace the existing run.
    strict : bool
        Raise if the sampler has not converged (after everything has been written).
    seed : int, optional
        Seed that replaces the configured one.
    report : bool
        False to leave out the stage 'report'.
    command : str
        Command line, for the record.

    Returns
    -------
    Path
        The run directory.

    Raises
    ------
    BayesdistError
        If the run cannot be made.
    """
    settings, text = load_config(config)
    directory = RunDirectory.plan(
        output,
        settings,
        text,
        Path(config).resolve().parent,
        resume=resume,
        force=force,
        seed=seed,
        command=command,
    )
    with initialized(directory) as planned:
        names = list(STAGES)
        names = names[names.index(planned.config.begins_with) : None if report else -1]
        _require_converged(make_stages(planned, names), strict)
    return directory.path


def make_stages(
    run: Run,
    stages: Collection[str],
    *,
    force: bool = False,
    pdf: bool = False,
    ready: Run | None = None,
    source: str = "",
) -> Run:
    """Run stages that are not up to date, and save their results.

    Results of other stages are loaded from the folder when they are needed.

    Parameters
    ----------
    run : Run
    stages : collection of str
        Names of the stages.
    force : bool
        Run the stages even if they are up to date.
    pdf : bool
        Write figures as PDF, too.
    ready : Run, optional
        Run whose artefacts up to the evaluation only have to be saved.
    source : str
        Name of the run in its products; by default that of its folder.

    Returns
    -------
    Run
    """
    directory, source = run.directory, source or str(run.directory.path)

    def stage(name: str, make: Callable[[Run], Run], save: Callable[[Run], None]) -> None:
        """Make and save the artefacts of a stage if it is to be run."""
        nonlocal run

        def made() -> Run:
            if ready is not None and name in ARTEFACTS:
                artefacts = {item: getattr(ready, item) for item in ARTEFACTS[name]}
                after_stage = run.having(**artefacts)
            else:
                after_stage = make(run)
            save(after_stage)
            # matches are read back, so that their rows refer to the files of the run
            return after_stage if name != "match" else run.having(inputs=run.inputs)

        if name in stages:
            run = directory.make(name, made, force=force).value or run
            release_memory()

    stage("match", match, save_matches)
    stage("fit", _fitted, save_fit)
    stage("sample", _sampled, save_sampled)
    stage("diagnose", diagnose, save_diagnosed)
    stage("evaluate", evaluate, save_evaluation)
    stage(
        "export",
        lambda r: r.having(products=export(r, directory.path, source=source)),
        save_products,
    )
    stage("report", lambda r: r.having(figures=report(r, pdf=pdf)), save_figures)
    return run


def _fitted(run: Run) -> Run:
    """Run with the fit of its rehearsal if there is one, otherwise with a new one."""
    return run if "fit" in run.made else fit(run)


def _sampled(run: Run) -> Run:
    """Sample the posterior with a progress bar."""
    with progress_bar("sample") as progress:
        return sample(run, folder=run.directory.path, progress=progress)


def continue_stage(
    path: str | Path, stage: str, *, strict: bool = False, pdf: bool = False
) -> RunDirectory:
    """Run one stage of an existing run; 'assess' means 'diagnose' and 'evaluate'.

    Parameters
    ----------
    path : path
        Run directory.
    stage : str
        Name of the stage.
    strict : bool
        For 'sample': raise if the sampler has not converged.
    pdf : bool
        For 'report': write figures as PDF, too.

    Returns
    -------
    RunDirectory

    Raises
    ------
    BayesdistError
        If the stage cannot be run.
    """
    directory = RunDirectory.open(path)
    begins_with = directory.config.begins_with
    if stage == "match" != begins_with:
        raise InputError(
            "has no star lists to match", where=str(path), do="start with the stage 'fit'"
        )
    stages = ASSESS if stage == "assess" else (stage,)
    needs = (begins_with,) if stage == "fit" != begins_with else NEEDS[stages[0]]
    directory.require(stage, needs)
    with initialized(directory) as run:
        run = make_stages(run, stages, force=True, pdf=pdf)
        if stage == "sample":
            _require_converged(run, strict)
    return directory


@contextmanager
def initialized(directory: RunDirectory) -> Iterator[Run]:
    """Check that a run can be carried out, create its folder, and open it."""
    with Run.of(directory) as run:
        begins = directory.is_planned
        if begins:
            run = rehearse(run)
        with directory.locked():
            directory.begin()
            if begins:
                run = run.adopting_inputs()
            with log_file(directory / "bayesdist.log"):
                yield run


def _require_converged(run: Run, strict: bool) -> None:
    """Raise NotConvergedError if `strict` and the sampler has not converged."""
    posterior = run.posterior
    if strict and convergence_check(posterior.convergence).level == "fail":
        raise NotConvergedError(
            f"the sampler has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(run.directory.path),
            do="raise sampler.max_steps and resume, or simplify the model",
        )


def save_matches(run: Run) -> None:
    """Write the matches found in star lists."""
    folder = run.directory.path
    if run.match_table is not None:
        write_table(run.match_table, folder / MATCHING)
    for part in run.match_parts.values():
        part.save(folder)
    run.directory.summarise(**{run.kind.section: run.match_facts})


def save_fit(run: Run) -> None:
    """Write the least-squares solution and log anything suspicious before sampling starts."""
    artefacts = {name: getattr(run, name) for name in FIT_ARTEFACTS}
    write_stored_fit(run.directory.path, **artefacts)
    run.directory.summarise(**fit_sections(run))
    log_fit(run.fit, run.kind.words.rows)
    _log_geometry(run.fit)
    if run.kind.rehearses_fit:
        rehearse_solution(run)
    for level, text in run.kind.fit_notes(run):
        log.log(level, "fit: %s%s", "WARNING: " if level >= logging.WARNING else "", text)


def _log_geometry(fit: LinearFit) -> None:
    """Log scales, orientation, parity and distortion of each chip."""
    for chip in geometries(fit):
        log.info("fit: chip %d: %s", chip.chip, chip.sentence)
        for text in chip.warnings:
            log.warning("fit: WARNING: %s", text)


def save_sampled(run: Run) -> None:
    """Write the posterior, and its residuals and outlier probabilities of each star."""
    directory, matches, posterior = run.directory, run.matches, run.posterior
    facts, gauge = directory.facts, run.gauge_words
    provenance = {k: facts[k] for k in ("inputs", "seed", "versions", "created")}
    provenance |= {"gauge": gauge} if gauge else {}
    table = matches if matches.in_memory else None
    save_posterior(posterior, table, directory / "posterior.nc", provenance=provenance)
    write_star_files(matches, run.fit, posterior, directory / FOLDER)
    circle = in_circle(run.stars, run.config)
    directory.summarise(**sample_sections(posterior, in_circle=circle))
    c, n = posterior.convergence, posterior.sampler
    if c.converged:
        log.info("sample: converged after %d steps, %d passes", n.steps, n.passes)
    else:
        log.warning("sample: NOT CONVERGED after %d steps: %s", n.steps, "; ".join(c.reasons))


def save_diagnosed(run: Run) -> None:
    """Write the diagnostics, including those of held-out stars, periods and exposures."""
    directory, diagnostics = run.directory, run.diagnostics
    run.kind.save_diagnosed(run)
    write_diagnostics(directory, run.fit, run.posterior, diagnostics)
    if diagnostics.holdout is not None:
        write_table(holdout_table(diagnostics.holdout), directory / "holdout.ecsv")
        directory.summarise(holdout=holdout_summary(diagnostics.holdout))
        log.info("diagnose: %s", diagnostics.holdout.verdict)
        log.info("diagnose: %s", diagnostics.holdout.coverage_words)
    periods = diagnostics.periods
    if periods is not None:
        write_table(periods_table(periods), directory / "periods.ecsv")
        directory.summarise(periods=periods_summary(periods))
        for text in (periods.verdict, periods.pattern_sentence, *periods.cautions):
            log.info("diagnose: %s", text)


def save_evaluation(run: Run) -> None:
    """Write maps, budget, margins and validity periods."""
    directory, config, evaluation = run.directory, run.config, run.evaluation
    for text in warnings_of(evaluation.checks):
        log.warning("evaluate: WARNING: %s", text)
    if idle := idle_dates(config, config.requirements()):
        log.warning("evaluate: WARNING: %s", idle)
    gauge, solution = run.gauge_words, run.solution
    write_evaluation(directory, run.fit, run.posterior, solution, gauge, evaluation)
    directory.summarise(**run.kind.evaluation_sections(run))
    for period in evaluation.validity:
        log.info("evaluate: %s", period.sentence)
    largest = max(float(np.nanmax(period.per_axis)) for period in evaluation.maps)
    log.info("evaluate: largest uncertainty per axis %.4g %s (1 sigma)", largest, run.model.unit)


def save_products(run: Run) -> None:
    """List the exported files in summary.json and the log."""
    products = run.made["products"]
    run.directory.summarise(products=products)
    log.info("export: %s", ", ".join(p["path"] for p in products) or "no products asked for")


def save_figures(run: Run) -> None:
    """List the figures in summary.json."""
    run.directory.summarise(figures=run.made["figures"])


def fit_sections(run: Run) -> dict[str, Any]:
    """Sections 'data' and 'fit' of summary.json, and others known only while the fit is made."""
    fit, errors, stars = run.fit, run.errors, run.placed
    optional: dict[str, Any] = {}
    if errors.factor != 1.0:
        optional["error_scale"] = errors.factor
    if run.added_errors is not None:
        optional["added_errors"] = _added_errors(run.added_errors)
    if run.config.fit.skew:
        optional["skew"] = _skew(fit)
    return {
        "data": {
            "n_rows": stars.n_rows,
            "n_used": fit.n_used,
            "n_rejected": stars.n_rows - fit.n_used,
            "rejected": {**stars.rejected, **fit.rejected},
            "n_exposures": len(stars.exposure_names),
            "sources": list(stars.sources),
            "tangent_point": stars.tangent_point,
        },
        "fit": {
            "order": fit.model.order,
            **attributes(fit, "chi2 dof rms_u rms_v unit condition"),
            "n_parameters": fit.model.n_params,
            "geometry": [GeometryRow.row(chip) for chip in geometries(fit)],
            **optional,
        },
        **run.fit_facts,
    }


def _added_errors(found: GroupedErrors) -> dict[str, Any]:
    """Entry 'added_errors' of the section 'fit'."""
    columns = {
        "n": found.n,
        "added": found.sigma,
        "added_error": found.sigma_error,
        "excess": found.excess,
        "variance": found.variance,
        "variance_error": found.error,
    }
    return {
        "grouping": found.grouping,
        "by": found.by,
        "evidence": dict(found.evidence),
        "dispersion": found.dispersion,
        "groups": [
            {"label": label, "axis": axis} | {k: float(v[g, a]) for k, v in columns.items()}
            for g, label in enumerate(found.labels)
            for a, axis in enumerate("uv")
        ],
    }


def log_fit(fit: LinearFit, rows: str) -> None:
    """Log a line about the fit; `rows` is the word for rows of the data."""
    log.info(
        "fit: %d %s, %d rejected, rms %.4g and %.4g %s, chi2/dof %.3f",
        fit.n_rows,
        rows,
        fit.n_rejected,
        fit.rms_u,
        fit.rms_v,
        fit.unit,
        fit.chi2 / max(fit.dof, 1),
    )


def _skew(fit: LinearFit) -> Mapping[str, Any]:
    """Skew of the first chip and, if there are several, of each chip."""
    skews = {chip.number: skew_of(fit, chip=chip.number) for chip in fit.model.chips}
    rows = [
        {"value_rad": skew.value, "sigma_rad": skew.sigma, "significance": skew.significance}
        for skew in skews.values()
    ]
    each = [{"chip": number} | row for number, row in zip(skews, rows, strict=True)]
    return rows[0] | ({"chips": each} if len(rows) > 1 else {})


def sample_sections(posterior: Posterior, *, in_circle: bool) -> dict[str, Any]:
    """Sections 'outliers' and 'sampler' of summary.json.

    `in_circle` is True if stars were matched in circles about nominal positions.
    """
    return {
        "outliers": _outliers(posterior, in_circle),
        "sampler": SamplerSection.row(posterior.sampler, posterior.convergence),
    }


def _outliers(posterior: Posterior, in_circle: bool) -> dict[str, object]:
    out: dict[str, object] = {"model": posterior.mixture.model, "unit": posterior.unit}
    names = {"f": "fraction", "j": "jitter", "s_out": "scale"}
    for key, name in names.items():
        values = posterior.hyper.get(key)
        if values is not None:
            out[name] = {"mean": float(values.mean()), "sd": float(values.std(ddof=1))}
        elif key == "j":
            out[name] = {"mean": posterior.mixture.jitter, "sd": 0.0}
        elif key == "f":
            out[name] = {"mean": 0.0, "sd": 0.0}
    out["n_flagged"] = posterior.n_flagged
    if in_circle:
        out["match_circle"] = posterior.mixture.match_radius
    return out


FOLDER = "stars"


def write_star_files(matches: Matches, fit: LinearFit, posterior: Posterior, folder: Path) -> None:
    """Write residuals and memberships of each star in batches, replacing existing parts."""
    made_folder(folder)
    remove_leftovers(folder)
    for path in part_files(folder):
        path.unlink()
    for k, reader in enumerate(matches.readers()):  # one batch in memory at a time
        _write_part(reader.load(), fit, posterior, folder / f"part-{k:05d}.parquet")


def _write_part(table: Matches, fit: LinearFit, posterior: Posterior, path: Path) -> None:
    stars, order = prepare(posterior.model, table)
    memberships = memberships_of(posterior, stars).in_table_order(order)
    u, v = in_table_order(stars.residuals(posterior.mean), order).T
    columns = {
        "source": (table.source, table.sources),
        "row": table.row,
        "x": table.x,
        "y": table.y,
        "chip": table.chip_number,
        "residual_u": u,
        "residual_v": v,
        "used": in_table_order(fit.clip.keeps_of(stars), order),
        "outlier_probability": memberships.outlier_probability,
        "log_likelihood": memberships.log_likelihood,
        "log_likelihood_variance": memberships.log_likelihood_variance,
    }
    unit = posterior.unit
    write_columns(path, columns, {"x": "pix", "y": "pix", "residual_u": unit, "residual_v": unit})
