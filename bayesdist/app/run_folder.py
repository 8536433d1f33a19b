"""A run in memory written to a folder, and the folder of a run copied."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from bayesdist.app.results import Results
from bayesdist.app.screen import log_file
from bayesdist.app.stages import make_stages
from bayesdist.app.store.lock import LOCK
from bayesdist.app.store.output import atomic_directory
from bayesdist.app.store.refusals import refuse_foreign_files
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data.formats.record import write_matches
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder

MATCHES_FILE = "matches.h5"  # stars of a run that was made in memory
# artefacts of a run in memory that are saved, each by a stage; products are made from them
ARTEFACTS = ("fitted", "posterior", "stored", "evaluation")
STAGES = ("fit", "sample", "diagnose", "evaluate", "export")


def save_run(results: Results, folder: Path, *, overwrite: bool) -> None:
    """Write a run in memory to a folder, together with its stars.

    Parameters
    ----------
    results : Results
        Artefacts of a run in memory.
    folder : pathlib.Path
    overwrite : bool
        Replace the run that is in the folder.

    Raises
    ------
    InputError
        If the folder holds other files, or a run that is not to be replaced, or the stars are on
        disk in files that the run does not name.
    """
    unsaved = results.run
    _refuse_run(folder, overwrite)
    base = results.base
    if results.config.data is not None and results.config.data.matches == MATCHES_FILE:
        if not results.inputs.in_memory:
            raise InputError(
                "the stars are in other files, which the folder would not hold",
                where=", ".join(results.inputs.sources),
                do="give the path of these files to bayesdist.calibrate",
            )
        if not (folder / "run.json").exists():
            refuse_foreign_files(folder, unsaved.text)
        base = made_folder(folder)
        write_matches(folder / MATCHES_FILE, results.inputs)
    directory = RunDirectory.plan(folder, results.config, unsaved.text, base, force=overwrite)
    saved = replace(results, run=directory, made={"inputs": results.inputs})
    with directory.locked():
        directory.begin()
        with log_file(directory / "bayesdist.log"):
            make_stages(saved, STAGES, ready={name: getattr(results, name) for name in ARTEFACTS})


def copy_run(source: RunDirectory, folder: Path, *, overwrite: bool) -> None:
    """Copy the folder of a run; the copy appears whole or not at all.

    Parameters
    ----------
    source : RunDirectory
    folder : pathlib.Path
    overwrite : bool
        Replace the run that is in the folder.

    Raises
    ------
    InputError
        If the folder holds other files, or a run that is not to be replaced, or is that of the
        run itself.
    """
    if folder.resolve() == source.path.resolve():
        raise InputError("the run is in this folder", where=str(folder), do="choose another one")
    _refuse_run(folder, overwrite)
    if (folder / "run.json").exists():
        RunDirectory(folder).clear()
        (folder / LOCK).unlink(missing_ok=True)
    with atomic_directory(folder) as temporary:
        ignored = shutil.ignore_patterns(LOCK)
        shutil.copytree(source.path, temporary, dirs_exist_ok=True, ignore=ignored)


def _refuse_run(folder: Path, overwrite: bool) -> None:
    """Raise InputError if a folder holds a run that is not to be replaced."""
    if not overwrite and (folder / "run.json").exists():
        raise InputError(
            "the folder holds another run",
            where=str(folder),
            do="give overwrite=True, or choose another folder",
        )
