"""The fit or posterior that a file or a run holds."""

from __future__ import annotations

from pathlib import Path

from bayesdist.assess.solution import Solution
from bayesdist.infer import load_fit, load_posterior

__all__ = ["solution_at"]


def solution_at(path: Path) -> Solution | None:
    """The fit or posterior at a place; None where it is no such file.

    Parameters
    ----------
    path : pathlib.Path
        A run directory stands for its posterior, or its fit where there is none yet.

    Raises
    ------
    InputError
        As `load_posterior` and `load_fit`.
    """
    if path.is_dir():
        if (path / "posterior.nc").exists() or not (path / "fit.nc").exists():
            return load_posterior(path)
        return load_fit(path / "fit.nc")
    if path.suffix != ".nc":
        return None
    return load_fit(path) if path.name == "fit.nc" else load_posterior(path)
