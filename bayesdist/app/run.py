"""The whole job: a configuration in, a finished run directory out."""

from __future__ import annotations

import logging
from contextlib import ExitStack, closing
from pathlib import Path

from bayesdist.app.config import load_config
from bayesdist.app.made_from import NEEDS
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.screen import log_file, progress_bar
from bayesdist.app.session import STAGES, Session
from bayesdist.app.sessions import own_stages, rehearse_run, session_of
from bayesdist.app.stages import run_stage
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
    with ExitStack() as stack:
        session = _begun(directory, stack)
        for stage in STAGES:
            if stage != "match" or stage in own_stages(session):
                _run_stage(session, stage, force=False)
        _judge(session, strict)
    return directory.path


def continue_stage(path: str | Path, stage: str, *, strict: bool = False) -> RunDirectory:
    """One stage of a run.

    Raises
    ------
    BayesdistError
    """
    directory = RunDirectory.open(path)
    begins_with = "fit" if directory.config.data is not None else "match"
    if stage == "match" != begins_with:
        raise InputError(
            "has no star lists to match", where=str(path), do="begin with the stage 'fit'"
        )
    needs = (begins_with,) if stage == "fit" != begins_with else NEEDS[stage]
    directory.require(stage, needs, thorough=True)
    with ExitStack() as stack:
        session = _begun(directory, stack)
        _run_stage(session, stage, force=True)
        if stage == "sample":
            _judge(session, strict)
    return directory


def _begun(directory: RunDirectory, stack: ExitStack) -> Session:
    """The session of a run that has begun, once it is known that it can be carried out."""
    session = stack.enter_context(closing(session_of(directory)))
    begins = directory.is_planned
    if begins:
        rehearse_run(session)
    stack.enter_context(directory.locked())
    directory.begin()
    if begins:
        session.begun()
    stack.enter_context(log_file(directory / "bayesdist.log"))
    return session


def _run_stage(session: Session, stage: str, *, force: bool) -> None:
    """Run a stage, with a progress bar where it samples."""
    with progress_bar(stage) as progress:
        session.progress = progress if stage == "sample" else None
        run_stage(session, stage, own_stages(session).get(stage), force=force)


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
