"""Runs in folders: opened, made from a configuration, saved from memory, or copied."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

from bayesdist.app.python_terms import in_python_terms
from bayesdist.app.run import Run
from bayesdist.app.screen import log_file
from bayesdist.app.stages import make_stages
from bayesdist.app.stages import run as run_configuration
from bayesdist.app.store.made_from import places_of, refuse_other_inputs
from bayesdist.app.store.record import atomic_directory
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.store import LOCK
from bayesdist.data.formats import write_matches
from bayesdist.errors import InputError

__all__ = ["open_run", "run"]

MATCHES_FILE = "matches.h5"  # stars of a run that was made in memory
# stages of a run in memory that are saved; products are made from them
STAGES = ("fit", "sample", "diagnose", "evaluate", "export")


@in_python_terms(keys=False)
def open_run(folder: str | os.PathLike[str]) -> Run:
    """Open a run that is in a folder.

    Parameters
    ----------
    folder : path-like

    Returns
    -------
    Run
        Its parts are read when they are first used.

    Raises
    ------
    InputError
        If the folder holds no run, the run has not been sampled, or its inputs have changed.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model = bd.DistortionModel(1, (chip,), "pix")
    >>> truth, rng = [0, 1000, 0, 0, 0, 1000], np.random.default_rng(1)
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> folder = bd.calibrate(stars, order=1, size=(2048, 2048)).save("camera-run")
    >>> bd.open_run("camera-run").model.order
    1
    """
    directory = RunDirectory(Path(folder))
    if not directory.is_initialized:
        raise InputError(
            "is not a run: it has no run.json",
            where=str(folder),
            do="restore it, or make the run again with bayesdist.run",
        )
    directory = RunDirectory.open(Path(folder))
    directory.require("open_run", ("fit", "sample", "diagnose"))
    return Run.of(directory)


@in_python_terms(keys=False)
def run(
    config: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    seed: int | None = None,
    report: bool = True,
) -> Run:
    """Make the run of a configuration file, as ``bayesdist run`` does.

    Parameters
    ----------
    config : path-like
        TOML file; paths in it are relative to it.
    folder : path-like
        Folder of the run.
    resume : bool
        Resume the run that is in the folder.
    overwrite : bool
        Replace the run that is in the folder.
    seed : int, optional
        Seed in place of the configured one.
    report : bool
        False to leave out the report and its figures, which may take as long as everything else;
        `Run.report` writes it at any time.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If the configuration or its inputs cannot be used, or the folder holds something else.

    Examples
    --------
    >>> from pathlib import Path
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model = bd.DistortionModel(1, (chip,), "pix")
    >>> truth, rng = [0, 1000, 0, 0, 0, 1000], np.random.default_rng(1)
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> stars.to_table().write("stars.ecsv")
    >>> config = '''
    ... data = {matches = "stars.ecsv"}
    ... detector = {size = [2048, 2048]}
    ... model = {order = 1}
    ... '''
    >>> n = Path("camera.toml").write_text(config)
    >>> bd.run("camera.toml", "camera-run", report=False).model.order
    1
    """
    if (Path(folder) / "run.json").exists() and not (resume or overwrite):
        raise InputError(
            "the folder holds another run",
            where=str(folder),
            do="give resume=True or overwrite=True, or choose another folder",
        )
    return open_run(
        run_configuration(
            Path(config), Path(folder), resume=resume, force=overwrite, seed=seed, report=report
        )
    )


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
