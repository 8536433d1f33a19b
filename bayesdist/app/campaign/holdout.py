"""What a campaign predicts of stars and exposures that were set aside."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.assess.error_model import solution_with_errors
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.holdout.predictive import ExposureDeviations, Predictive, predictive_of
from bayesdist.infer.catalogue.star_influence import star_influence

if TYPE_CHECKING:
    from bayesdist.app.campaign.session import CampaignSession

__all__ = ["predictive_of_campaign"]

TOGETHER = 1.5  # steps between nodes over which tables err as one: what their covariance comes to


def predictive_of_campaign(session: CampaignSession, found: Diagnostics) -> Predictive:
    """The posterior with errors of catalogue and tables, and the scatter of the exposures.

    The stars of exposures that are held out whole were in the fit, in other exposures: what their
    errors in the catalogue did there is known and no part of their residuals.
    """
    fitted, held = session.matches, session.held_pairs
    errors, stars = session.catalogue_errors, None
    if errors is not None and held is not None and held.star is not None:
        whole = np.isin(held.exposure_names, session.matched.whole)
        codes = np.unique(held.star[whole[held.exposure]])
        stars = star_influence(session.fit, fitted, errors, codes)
    return replace(
        predictive_of(solution_with_errors(session.posterior, found, session.hierarchy)),
        deviations=ExposureDeviations(*session.scatter),
        stars=stars,
        local=session.errors_from(found).local_tables(session.config.assess.grid, session.epoch),
        cell=_cell(session),
    )


def _cell(session: CampaignSession) -> tuple[float, float] | None:
    """Pixels over which stars share the errors of the tables; None without tables."""
    if not session.tables:
        return None
    across, up = session.tables[0].step
    return TOGETHER * across, TOGETHER * up
