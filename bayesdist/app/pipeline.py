"""Steps of a calibration in Python, as functions of a run.

The steps follow a configuration, and paths in it are relative to `base`; nothing is written except
by `export` and `report`::

    config, text = load_config("job/config.toml")
    run = Run.of(RunDirectory.unsaved(config, text, files=True, base=Path("job")))
    run = evaluate(diagnose(sample(fit(match(run)))))
    export(run, Path("products"))

The results are identical to those of `bayesdist run` with the same configuration, which calls these
functions in `bayesdist.app.stages.make_stages` and writes their results.  A `report` shows a run
that is in a folder.  `rehearse` finds errors in the data or the configuration before anything else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from bayesdist.app.calibrations import difference_from_previous
from bayesdist.app.diagnosing import check_pairs, diagnostics_of_run
from bayesdist.app.evaluating import (
    assessment_rng,
    error_model_of_fit,
    evaluation_of_run,
    rehearsal_settings,
)
from bayesdist.app.products import export, product_of_run, rehearse_files, rehearse_outline
from bayesdist.app.report import report
from bayesdist.app.run import Run
from bayesdist.assess import Requirement
from bayesdist.assess.budget import budget_of
from bayesdist.assess.requirements.margins import judge
from bayesdist.assess.terms.given import centroid_errors
from bayesdist.diagnose.residuals.stars import centroid_scatter, star_sample
from bayesdist.errors import InputError

__all__ = ["diagnose", "evaluate", "export", "fit", "match", "rehearse", "report", "sample"]

REHEARSAL_DRAWS = 100  # of the solution, to judge requirements by


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


def rehearse(run: Run) -> Run:
    """Run with the inputs and, for matched stars, their fit; nothing is written.

    Errors in the data or the configuration are found here, before hours of sampling.
    """
    kind, config = run.kind, run.config
    kind.refuse(run.inputs)
    outline = kind.outline(run.inputs)
    if outline is not None:  # matching takes long
        rehearse_outline(outline, config, run.base, str(run.directory.path))
        return run
    check_pairs(run.stars, config)
    run = kind.fit(run)
    _check_residuals(run)
    rehearse_solution(run)
    return run


def rehearse_solution(run: Run) -> None:
    """Refuse terms, requirements and products that cannot be made from a fit."""
    _rehearse_evaluation(run, REHEARSAL_DRAWS)
    product = product_of_run(run, run.fit, str(run.directory.path))
    rehearse_files(product, run.config)
    previous = run.config.products.previous
    if previous is not None:
        path = run.base / previous
        difference_from_previous(product.calibration, path, product.options.epoch)


def _check_residuals(run: Run) -> None:
    """Refuse a budget with errors included in the residuals that exceed the residuals."""
    fit = run.fit
    held = run.config.held_in_residuals(fit.model.unit)
    if held:
        stars = star_sample(run.sample, len(run.matches), fit)
        scatter = centroid_scatter(stars, n_params=fit.model.n_params)
        if scatter is not None:
            centroid_errors(scatter, held)


def _rehearse_evaluation(run: Run, n_draws: int) -> None:
    """Refuse terms and requirements that the run cannot be judged by."""
    config, settings = run.config, rehearsal_settings(run)
    errors = error_model_of_fit(run)
    drawn = errors.drawn(n_draws, assessment_rng(config))
    budget_of(drawn, settings.domain(errors))
    # without a posterior there are no centroid errors yet
    has_mag = run.placed.has_mag
    # one requirement of each form, because names, limits and probabilities are never refused
    forms = {
        replace(r, name="any", limit=1.0, probability=0.5): _of_any_star(r, has_mag=has_mag)
        for r in reversed(config.requirements())
    }
    # all are met, so that no smaller errors that would meet them are searched for
    requirements = [replace(r, limit=1e9) for r in reversed(forms.values())]
    judge(
        drawn,
        requirements,
        grid=settings.grid,
        epoch=settings.epoch,
        pixel_scale=settings.pixel_scale(errors),
        adaptive=False,
    )


def _of_any_star(requirement: Requirement, *, has_mag: bool) -> Requirement:
    """Requirement without its magnitude; refused if it has one and the matches have none."""
    if requirement.magnitude is not None and not has_mag:
        raise InputError(
            f"names magnitude {requirement.magnitude:g}, but the matches have no magnitudes",
            where=requirement.where,
            do="name their column in [data.columns], or leave magnitude out",
        )
    return replace(requirement, magnitude=None)
