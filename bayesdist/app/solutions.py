"""The fit or posterior that a file or a run holds."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from bayesdist.app.rundir import RunDirectory
from bayesdist.app.sessions import session_of
from bayesdist.assess.solution import Solution
from bayesdist.infer import load_fit, load_posterior

__all__ = ["solution_at"]


def solution_at(path: Path) -> Solution | None:
    """The fit or posterior at a place; None where it is no such file.

    Parameters
    ----------
    path : pathlib.Path
        A run directory, or posterior.nc in it, stands for the posterior with the errors that the
        run was assessed with, or for the fit where there is no posterior yet.

    Raises
    ------
    InputError
        As `load_posterior` and `load_fit`.
    """
    if path.is_dir():
        if (path / "posterior.nc").exists() or not (path / "fit.nc").exists():
            return _signed(path)
        return load_fit(path / "fit.nc")
    if path.suffix != ".nc":
        return None
    if path.name == "fit.nc":
        return load_fit(path)
    return _signed(path.parent) if path.name == "posterior.nc" else load_posterior(path)


def _signed(folder: Path) -> Solution:
    """The posterior of a folder, as assessed where it is that of a run."""
    if not (folder / "run.json").exists():
        return load_posterior(folder)
    with closing(session_of(RunDirectory(folder))) as session:
        return session.signed
