"""All that can be known to be wrong before anything is written."""

from __future__ import annotations

from bayesdist.app.assessment.judging import rehearse_evaluation
from bayesdist.app.assessment.periods import check_pairs
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.products.made_files import made_files, product_input
from bayesdist.app.results import Results
from bayesdist.assess import star_sample
from bayesdist.assess.terms.centroid import centroid_errors
from bayesdist.diagnose.residuals.centroid import centroid_scatter

__all__ = ["rehearse", "rehearse_solution"]

REHEARSAL_DRAWS = 100


def rehearse(results: Results) -> Results:
    """Results with what a run begins with and, of matched stars, their fit; nothing is written.

    What is wrong with the data or the configuration shows here, before hours of sampling.

    Parameters
    ----------
    results : Results

    Raises
    ------
    BayesdistError
    """
    kind, config, base = results.kind, results.config, results.base
    kind.refuse(results.inputs, config, base)
    if kind.begins_with == "match":  # which takes long
        return results
    matched = results.matched
    check_pairs(matched.stars, config)
    fitted = kind.fit(matched, config, base, results.reader)
    results = results.having(fitted=fitted)
    _check_residuals(results.data, config)
    rehearse_solution(results)
    return results


def rehearse_solution(results: Results) -> None:
    """Budget, margins and files of a fit, with few draws; nothing is written.

    Raises
    ------
    BayesdistError
    """
    data, config = results.data, results.config
    rehearse_evaluation(data, config, REHEARSAL_DRAWS)
    made_files(product_input(data.fit, data, config, str(results.run.path)), config)


def _check_residuals(data: FitData, config: Config) -> None:
    """Refuse a budget with errors that are said to be in the residuals and are larger than these.

    Raises
    ------
    InputError
    """
    fit = data.fit
    held = config.held_in_residuals(fit.model.unit)
    if held:
        stars = star_sample(data.sample, len(data.stars), fit)
        scatter = centroid_scatter(stars, n_params=fit.model.n_params)
        if scatter is not None:
            centroid_errors(scatter, held)
