"""Steps of a calibration in Python, as functions of a run.

The steps follow a configuration, and paths in it are relative to `base`; nothing is written except
by `export` and `report`::

    config, text = load_config("job/config.toml")
    run = Run.of(RunDirectory.unsaved(config, text, files=True, base=Path("job")))
    run = evaluate(diagnose(sample(fit(match(run)))))
    export(run, Path("products"))

The results are identical to those of `bayesdist run` with the same configuration, which calls these
functions in `bayesdist.app.stages.make_stages` and writes their results.  A `report` shows a run
that is in a folder.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bayesdist.app.diagnosing import diagnostics_of_run
from bayesdist.app.evaluating import evaluation_of_run
from bayesdist.app.products import export
from bayesdist.app.report import report
from bayesdist.app.run import Run

__all__ = ["diagnose", "evaluate", "export", "fit", "match", "report", "sample"]


def match(run: Run) -> Run:
    """Match stars, and divide them into fitted and held-out stars.

    Parameters
    ----------
    run : Run

    Returns
    -------
    Run
        With `stars` and `held_stars`.

    Raises
    ------
    InputError
        If the inputs are inconsistent.
    """
    run.kind.refuse(run.inputs)
    return run.kind.match(run)


def fit(run: Run) -> Run:
    """Fit by least squares.

    Parameters
    ----------
    run : Run

    Returns
    -------
    Run
        With `fit`, and the `matches` that it used.
    """
    return run.kind.fit(run)


def sample(
    run: Run,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Sample the posterior of a fit.

    Parameters
    ----------
    run : Run
    folder : Path, optional
        Folder for checkpoints.
    progress : callable, optional
        Called with the number of steps made and the largest number of steps.

    Returns
    -------
    Run
        With `posterior`.
    """
    return run.having(posterior=run.kind.sample(run, folder=folder, progress=progress))


def diagnose(run: Run) -> Run:
    """Test the residuals, and the held-out stars.

    Parameters
    ----------
    run : Run

    Returns
    -------
    Run
        With `diagnostics`.
    """
    return run.having(diagnostics=diagnostics_of_run(run))


def evaluate(run: Run) -> Run:
    """Evaluate maps, budget, margins and validity periods.

    Parameters
    ----------
    run : Run

    Returns
    -------
    Run
        With `evaluation`.
    """
    return run.having(evaluation=evaluation_of_run(run))
