"""Complete calibration, from a configuration to a finished run directory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bayesdist.app.config import load_config
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.pipeline import (
    diagnose,
    error_model,
    evaluate,
    export,
    fit,
    match,
    report,
    sample,
)
from bayesdist.app.rehearsal import rehearse
from bayesdist.app.results import Results, open_results
from bayesdist.app.saving import (
    save_diagnosed,
    save_evaluation,
    save_figures,
    save_fit,
    save_matches,
    save_products,
    save_sampled,
)
from bayesdist.app.screen import log_file, progress_bar
from bayesdist.app.store.made_from import NEEDS, STAGES
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.evaluation import Evaluation
from bayesdist.errors import InputError, NotConvergedError
from bayesdist.infer import Posterior
from bayesdist.infer.posterior.checks import convergence_check
from bayesdist.utils.memory import release_memory

__all__ = ["continue_stage", "make_stages", "run"]

ASSESS = ("diagnose", "evaluate")


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
    with initialized(directory) as results:
        names = list(STAGES)
        names = names[names.index(results.config.begins_with) : None if report else -1]
        results = make_stages(results, names)
        _require_converged(results, strict)
    return directory.path


def make_stages(
    results: Results,
    stages: Collection[str],
    *,
    force: bool = False,
    pdf: bool = False,
    ready: Mapping[str, Any] | None = None,
    source: str = "",
) -> Results:
    """Run stages that are not up to date, and save their results.

    Results of other stages are loaded from the folder when they are needed.

    Parameters
    ----------
    results : Results
    stages : collection of str
        Names of the stages.
    force : bool
        Run the stages even if they are up to date.
    pdf : bool
        Write figures as PDF, too.
    ready : mapping of str to object, optional
        Artefacts by name that were computed before and only have to be saved.
    source : str
        Name of the run in its products; by default that of its folder.

    Returns
    -------
    Results
    """
    r, run, config, base = results, results.run, results.config, results.base
    source, ready = source or str(run.path), ready or {}

    def stage(
        name: str, artefact: str, make: Callable[[], Any], save: Callable[[Results], None]
    ) -> None:
        """Make and save an artefact if its stage is to be run."""
        nonlocal r

        def made() -> Results:
            value = ready[artefact] if artefact in ready else make()
            results_of_stage = r.having(**{artefact: value})
            save(results_of_stage)
            # matches are read back, so that their rows refer to the files of the run
            return results_of_stage if name != "match" else r.having(inputs=r.inputs)

        if name in stages:
            r = run.make(name, made, force=force).value or r
            release_memory()

    def fitted() -> Fitted:
        """Fit of the rehearsal if there is one, otherwise a new one."""
        return r.made.get("fitted") or fit(r.matched, config, base, r.reader).fitted

    def exported() -> list[dict[str, Any]]:
        evaluation, posterior = r.stored_evaluation, r.posterior
        return export(
            evaluation, posterior, r.stored, r.data, config, base, run.path, source=source
        )

    stage("match", "matched", lambda: match(r.inputs, config), save_matches)
    stage("fit", "fitted", fitted, save_fit)
    stage("sample", "posterior", lambda: _sampled(r), save_sampled)
    stage("diagnose", "stored", lambda: diagnose(r.posterior, r.data, config, base), save_diagnosed)
    stage("evaluate", "evaluation", lambda: evaluated(r), save_evaluation)
    stage("export", "products", exported, save_products)
    stage("report", "figures", lambda: report(r, pdf=pdf), save_figures)
    return r


def evaluated(results: Results) -> Evaluation:
    """Maps, budget, margins and validity periods of a run that was sampled and diagnosed."""
    posterior, diagnostics, data = results.posterior, results.diagnostics, results.data
    return evaluate(
        error_model(posterior, diagnostics, data, results.config),
        posterior,
        diagnostics,
        data,
        results.config,
        results.base,
        source=results.source_name,
        series=results.series,
    )


def _sampled(r: Results) -> Posterior:
    """Sample the posterior with a progress bar."""
    with progress_bar("sample") as progress:
        return sample(r.data, r.config, folder=r.run.path, progress=progress)


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
            "has no star lists to match", where=str(path), do="begin with the stage 'fit'"
        )
    stages = ASSESS if stage == "assess" else (stage,)
    needs = (begins_with,) if stage == "fit" != begins_with else NEEDS[stages[0]]
    directory.require(stage, needs)
    with initialized(directory) as results:
        results = make_stages(results, stages, force=True, pdf=pdf)
        if stage == "sample":
            _require_converged(results, strict)
    return directory


@contextmanager
def initialized(directory: RunDirectory) -> Iterator[Results]:
    """Check that a run can be carried out, create its folder, and open its results."""
    with open_results(directory) as results:
        begins = directory.is_planned
        if begins:
            results = rehearse(results)
        with directory.locked():
            directory.begin()
            if begins:
                results = results.adopting_inputs()
            with log_file(directory / "bayesdist.log"):
                yield results


def _require_converged(results: Results, strict: bool) -> None:
    """Raise NotConvergedError if `strict` and the sampler has not converged."""
    posterior = results.posterior
    if strict and convergence_check(posterior.convergence).level == "fail":
        raise NotConvergedError(
            f"the sampler has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(results.run.path),
            do="raise sampler.max_steps and resume, or simplify the model",
        )
