"""Checks that can be made before anything is written."""

from __future__ import annotations

from dataclasses import replace

from bayesdist.app.assessment.error_terms import assessment_rng, errors_of_fit, rehearsal_settings
from bayesdist.app.assessment.periods import check_pairs
from bayesdist.app.calibrations import difference_from_previous
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.products.made_files import product_input, rehearse_files, rehearse_outline
from bayesdist.app.results import Results
from bayesdist.assess import Requirement
from bayesdist.assess.budget import budget_of
from bayesdist.assess.requirements.margins import judge
from bayesdist.assess.terms.given import centroid_errors
from bayesdist.diagnose.residuals.stars import centroid_scatter, star_sample
from bayesdist.errors import InputError

REHEARSAL_DRAWS = 100


def rehearse(results: Results) -> Results:
    """Results with the inputs and, for matched stars, their fit; nothing is written.

    Errors in the data or the configuration are found here, before hours of sampling.
    """
    kind, config, base = results.kind, results.config, results.base
    kind.refuse(results.inputs)
    outline = kind.outline(results.inputs)
    if outline is not None:  # matching takes long
        rehearse_outline(outline, config, base, str(results.run.path))
        return results
    matched = results.matched
    check_pairs(matched.stars, config)
    fitted = kind.fit(matched, config, base, results.reader)
    results = results.having(fitted=fitted)
    _check_residuals(results.data, config)
    rehearse_solution(results)
    return results


def rehearse_solution(results: Results) -> None:
    """Refuse terms, requirements and products that cannot be made from a fit."""
    data, config = results.data, results.config
    _rehearse_evaluation(data, config, REHEARSAL_DRAWS)
    product = product_input(data.fit, data, config, str(results.run.path))
    rehearse_files(product, config)
    if config.products.previous is not None:
        path = results.base / config.products.previous
        difference_from_previous(product.calibration, path, product.options.epoch)


def _check_residuals(data: FitData, config: Config) -> None:
    """Refuse a budget with errors included in the residuals that exceed the residuals."""
    fit = data.fit
    held = config.held_in_residuals(fit.model.unit)
    if held:
        stars = star_sample(data.sample, len(data.stars), fit)
        scatter = centroid_scatter(stars, n_params=fit.model.n_params)
        if scatter is not None:
            centroid_errors(scatter, held)


def _rehearse_evaluation(data: FitData, config: Config, n_draws: int) -> None:
    """Refuse terms and requirements that the run cannot be judged by."""
    settings = rehearsal_settings(data, config)
    errors = errors_of_fit(data.fit, data, config)
    drawn = errors.drawn(n_draws, assessment_rng(config))
    budget_of(drawn, settings.domain(errors))
    # without a posterior there are no centroid errors yet
    has_mag = data.placed.has_mag
    # one requirement of each form, because names, limits and probabilities are never refused
    forms = {
        replace(r, name="any", limit=1.0, probability=0.5): _of_any_star(r, has_mag=has_mag)
        for r in reversed(config.requirements())
    }
    requirements = list(reversed(forms.values()))
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
            f"names magnitude {requirement.magnitude:g}, and the matches have no magnitudes",
            where=requirement.where,
            do="name their column in [data.columns], or leave magnitude out",
        )
    return replace(requirement, magnitude=None)
