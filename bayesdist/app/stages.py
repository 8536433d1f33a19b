"""Complete calibration, from a configuration to a finished run directory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from bayesdist.app.config import load_config
from bayesdist.app.pipeline import diagnose, evaluate, export, fit, match, report, sample
from bayesdist.app.rehearsal import rehearse
from bayesdist.app.run import Run
from bayesdist.app.saving import (
    FIT_ARTEFACTS,
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
from bayesdist.errors import InputError, NotConvergedError
from bayesdist.infer.posterior.checks import convergence_check
from bayesdist.utils.memory import release_memory

__all__ = ["continue_stage", "make_stages", "run"]

ASSESS = ("diagnose", "evaluate")
# artefacts by the stages that save them, for a run in memory
ARTEFACTS = {
    "fit": FIT_ARTEFACTS,
    "sample": ("posterior",),
    "diagnose": ("diagnostics",),
    "evaluate": ("evaluation",),
}


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
