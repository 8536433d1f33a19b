"""What a campaign predicts of stars and exposures that were set aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import required
from bayesdist.assess.error_model import ErrorModel, solution_with_errors
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.data import MatchTable
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.holdout.predictive import ExposureDeviations, Predictive, predictive_of
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_influence import star_influence

__all__ = ["predictive_of_campaign"]

TOGETHER = 1.5  # steps between nodes over which tables err as one: what their covariance comes to


def predictive_of_campaign(
    posterior: Posterior,
    found: Diagnostics,
    errors: ErrorModel,
    data: FitData,
    settings: EvaluationSettings,
) -> Predictive:
    """The posterior with errors of catalogue and tables, and the scatter of the exposures.

    The stars of exposures that are held out whole were in the fit, in other exposures: what their
    errors in the catalogue did there is known and no part of their residuals.

    Parameters
    ----------
    posterior : Posterior
    found : Diagnostics
        Of it, without what is held out.
    errors : ErrorModel
    data : FitData
    settings : EvaluationSettings
    """
    fitted, held = data.stars, data.matched.held
    assert isinstance(fitted, MatchTable)
    catalogue, stars = data.matched.star_errors, None
    if catalogue is not None and isinstance(held, MatchTable) and held.star is not None:
        whole = np.isin(held.exposure_names, data.matched.whole)
        codes = np.unique(held.star[whole[held.exposure]])
        stars = star_influence(data.fit, fitted, catalogue, codes)
    scatter = required(data.fitted.scatter, "joint fit of exposures")
    return replace(
        predictive_of(solution_with_errors(posterior, found, data.fit)),
        deviations=ExposureDeviations(scatter.kinds, scatter.tau),
        stars=stars,
        local=errors.local_tables(settings.grid, settings.epoch),
        cell=_cell(data),
    )


def _cell(data: FitData) -> tuple[float, float] | None:
    """Pixels over which stars share the errors of the tables; None without tables."""
    tables = data.fitted.tables.tables
    if not tables:
        return None
    across, up = tables[0].step
    return TOGETHER * across, TOGETHER * up
