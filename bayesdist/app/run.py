"""The whole job: a configuration in, a finished run directory out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bayesdist.app.config import load_config
from bayesdist.app.kinds.kind import kind_of
from bayesdist.app.results import Results, open_results
from bayesdist.app.screen import log_file
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.export import run_export
from bayesdist.app.stages.fit import run_fit
from bayesdist.app.stages.match import run_match
from bayesdist.app.stages.rehearsal import rehearse
from bayesdist.app.stages.report import run_report
from bayesdist.app.stages.sample import run_sample
from bayesdist.app.store.made_from import NEEDS
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.errors import InputError, NotConvergedError
from bayesdist.infer.checks import convergence_check

__all__ = ["continue_stage", "initialized", "run", "run_stage"]

log = logging.getLogger("bayesdist")

STAGES: dict[str, Callable[[Results], Results]] = {
    "match": run_match,
    "fit": run_fit,
    "sample": run_sample,
    "assess": run_assess,
    "export": run_export,
    "report": run_report,
}


def run(
    config: str | Path,
    output: str | Path,
    *,
    resume: bool = False,
    force: bool = False,
    strict: bool = False,
    seed: int | None = None,
    command: str = "",
) -> Path:
    """Fit, sample, assess, export and report, as a configuration says.

    Parameters
    ----------
    config : path
        TOML file; paths in it are relative to it.
    output : path
        Run directory.
    resume : bool
        Resume the run that is there: stages that stand are skipped, checkpoints are used.
    force : bool
        Replace the run that is there.
    strict : bool
        Raise when the sampler has not converged (after everything has been written).
    seed : int, optional
        In place of the configured one.
    command : str
        For the record.

    Returns
    -------
    Path
        The run directory.

    Raises
    ------
    BayesdistError
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
        for stage in names[names.index(results.kind.begins_with) :]:
            results = run_stage(results, stage, force=False)
        _judge(results, strict)
    return directory.path


def continue_stage(path: str | Path, stage: str, *, strict: bool = False) -> RunDirectory:
    """One stage of a run.

    Raises
    ------
    BayesdistError
    """
    directory = RunDirectory.open(path)
    begins_with = kind_of(directory.config).begins_with
    if stage == "match" != begins_with:
        raise InputError(
            "has no star lists to match", where=str(path), do="begin with the stage 'fit'"
        )
    needs = (begins_with,) if stage == "fit" != begins_with else NEEDS[stage]
    directory.require(stage, needs, thorough=True)
    with initialized(directory) as results:
        results = run_stage(results, stage)
        if stage == "sample":
            _judge(results, strict)
    return directory


def run_stage(results: Results, stage: str, *, force: bool = True) -> Results:
    """Results with the artefact of a stage: loaded where it stands, and else made.

    Parameters
    ----------
    results : Results
    stage : str
    force : bool
        Make it also where it stands.
    """
    made = results.run.make(stage, lambda: STAGES[stage](results), force=force)
    return made.value or results


@contextmanager
def initialized(directory: RunDirectory) -> Iterator[Results]:
    """Results of a run whose folder is there, once it is known that it can be carried out.

    Parameters
    ----------
    directory : RunDirectory

    Yields
    ------
    Results
    """
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


def _judge(results: Results, strict: bool) -> None:
    """Raise where a sampler has not converged, if that is asked for."""
    posterior = results.posterior
    if strict and convergence_check(posterior.convergence).level == "fail":
        exact = posterior.sampler.exact
        raise NotConvergedError(
            f"the sampler has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(results.run.path),
            do="raise sampler.max_steps and resume, or simplify the model"
            if exact
            else "set sampler.second_stage = 'always' and run with --force",
        )
