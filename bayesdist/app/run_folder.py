"""A run in memory written to a folder, and the folder of a run copied."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from bayesdist.app.run import Run
from bayesdist.app.screen import log_file
from bayesdist.app.stages import make_stages
from bayesdist.app.store.lock import LOCK
from bayesdist.app.store.made_from import places_of
from bayesdist.app.store.output import atomic_directory
from bayesdist.app.store.refusals import refuse_other_inputs
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data.formats import write_matches

MATCHES_FILE = "matches.h5"  # stars of a run that was made in memory
# stages of a run in memory that are saved; products are made from them
STAGES = ("fit", "sample", "diagnose", "evaluate", "export")


def save_run(run: Run, folder: Path) -> None:
    """Write a run to a folder, together with its stars; it appears whole or not at all.

    Parameters
    ----------
    run : Run
        Run in memory, or in another folder, which is copied.
    folder : pathlib.Path
        New or empty folder.

    Raises
    ------
    InputError
        If the folder is not empty or cannot be made, or files that the run was made from have
        changed.
    """
    if not run.directory.in_memory:
        copy_run(run.directory, folder)
        return
    unsaved, config = run.directory, run.config
    has_matches = not unsaved.facts["inputs"]  # else the stars are in files
    with atomic_directory(folder) as temporary:
        if has_matches:
            write_matches(temporary / MATCHES_FILE, run.inputs.load())
        base = temporary if has_matches else run.base
        directory = RunDirectory.plan(temporary, config, unsaved.text, base)
        if not has_matches:
            refuse_other_inputs(unsaved.facts["inputs"], directory.facts["inputs"], base)
        saved = replace(run, directory=directory, made={"inputs": run.inputs})
        directory.begin()
        with log_file(directory / "bayesdist.log"):
            make_stages(saved, STAGES, ready=run, source=str(folder))
        directory.note(**places_of(folder if has_matches else base, folder))


def copy_run(source: RunDirectory, folder: Path) -> None:
    """Copy the folder of a run; the copy appears whole or not at all.

    Parameters
    ----------
    source : RunDirectory
    folder : pathlib.Path
        New or empty folder.

    Raises
    ------
    InputError
        If the folder is not empty or cannot be made.
    """
    with atomic_directory(folder) as temporary:
        ignored = shutil.ignore_patterns(LOCK)
        shutil.copytree(source.path, temporary, dirs_exist_ok=True, ignore=ignored)
