"""The whole job: a configuration in, a finished run directory out."""

from __future__ import annotations

import logging
from contextlib import closing
from pathlib import Path

from bayesdist.app.config import load_config
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.screen import log_file, progress_bar
from bayesdist.app.session import STAGES, Session
from bayesdist.app.sessions import own_stages, rehearse_run, session_of
from bayesdist.app.stages import NEEDS, require, run_stage
from bayesdist.errors import InputError, NotConvergedError
from bayesdist.infer.checks import convergence_check

__all__ = ["continue_stage", "run"]

log = logging.getLogger("bayesdist")


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
        Go on with the run that is there: stages that are done are skipped, checkpoints are used.
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
    with closing(session_of(directory)) as session:
        _begin(session)
        with log_file(directory / "bayesdist.log"):
            redo = False
            for stage in STAGES:
                if stage == "match" and stage not in own_stages(session):
                    continue
                if directory.done(stage) and not redo:
                    log.info("%s: done before", stage)
                    continue
                redo = True  # what comes after a stage that is made anew is made anew
                _run_stage(session, stage)
        _judge(session, strict)
    return directory.path


def continue_stage(path: str | Path, stage: str, *, strict: bool = False) -> RunDirectory:
    """One stage of a run.

    Raises
    ------
    BayesdistError
    """
    directory = RunDirectory.open(path)
    with closing(session_of(directory)) as session:
        listed = "match" in own_stages(session)
        if stage == "match" and not listed:
            raise InputError(
                "has no star lists to match", where=str(path), do="begin with the stage 'fit'"
            )
        require(session, stage, ("match",) if listed and stage == "fit" else NEEDS[stage])
        _begin(session)
        with log_file(directory / "bayesdist.log"):
            _run_stage(session, stage)
        if stage == "sample":
            _judge(session, strict)
    return directory


def _begin(session: Session) -> None:
    """Begin a planned run once it is known that it can be carried out."""
    if session.run.begun:
        session.run.follow()
        return
    rehearse_run(session)
    session.run.begin()
    session.begun()


def _run_stage(session: Session, stage: str) -> None:
    with progress_bar(stage) as progress:
        session.progress = progress if stage == "sample" else None
        run_stage(session, stage, own_stages(session).get(stage))


def _judge(session: Session, strict: bool) -> None:
    posterior = session.posterior
    if strict and convergence_check(posterior.convergence).level == "fail":
        exact = posterior.sampler.exact
        raise NotConvergedError(
            f"the sampler has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(session.run.path),
            do="raise sampler.max_steps and resume, or simplify the model"
            if exact
            else "set sampler.second_stage = 'always' and run with --force",
        )
