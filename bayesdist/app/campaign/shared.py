"""Errors that the stars of a campaign have in common, beyond what it knows of them already.

The scatter of the exposures, the errors of the catalogue and those of the tables are counted by
themselves.  So cells and exposures are asked for what is left:

- Exposures deviate by the priors of the fit; their deviations are among the errors of the exposures
  and are counted once (see `robust_covariance`).
- A star of the catalogue is wrong by the same amount in all exposures, and mostly lies in the same
  cell.  What that adds to the variance by cells is computed from the catalogue's errors, as what it
  adds to the covariance is, and is taken off.
- Tables that were fitted in this run have taken what the stars of a place share: cells would show
  too little.  Then only exposures are clusters, and what the tables leave between their nodes, a
  row of its own in the budget, stands for what is left out at a place.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from bayesdist.app.campaign.systematics import (
    covariance_of,
    errors_by_star,
    shared_stars_of,
)
from bayesdist.app.correlated import ENOUGH, EXPOSURES, SharedErrors, facts_of
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.robust import (
    Cells,
    RobustCovariance,
    by_fitting_cells,
    recommended_cells,
    robust_covariance,
)
from bayesdist.infer.robust.known import catalogue_in_cells

if TYPE_CHECKING:
    from bayesdist.app.campaign.session import CampaignSession

__all__ = ["measured_shared_errors"]

Float = NDArray[np.float64]

log = logging.getLogger("bayesdist")


@threadpool_limits.wrap(limits=1, user_api="blas")
def measured_shared_errors(session: CampaignSession) -> SharedErrors | None:
    """What the residuals of a campaign say of errors in common; None where they say nothing.

    Its covariances are those of the posterior with the errors of the catalogue: without, and with,
    what clusters show beyond.
    """
    fitted = session.config.tables.method != "none"
    exposures = len(session.model.exposures) >= EXPOSURES
    if len(session.shards) < ENOUGH or (fitted and not exposures):
        log.info("assess: correlation of errors was not measured: too few stars or exposures")
        return None
    cells = recommended_cells(session.model)
    try:
        robust = robust_covariance(
            session.shards,
            session.posterior,
            cells,
            exposures=exposures,
            priors=session.priors,
            frames=False,
            settling=session.settling,
            detector=not fitted,
            known=() if fitted else _known(session, cells),
        )
    except (InputError, DegenerateError) as error:
        log.info("assess: correlation of errors was not measured: %s", error)
        return None
    robust = by_fitting_cells(robust)
    before = covariance_of(session.posterior, session.fit, shared_stars_of(session))
    facts = facts_of(session, robust, at_place=not session.tables)
    return SharedErrors(before + _beyond(robust, before), before, facts)


def _beyond(robust: RobustCovariance, before: Float) -> Float:
    """What is added to the covariance of all parameters; frames follow as they are correlated."""
    if not robust.exceeds:
        return np.zeros_like(before)
    D = len(robust.formal)
    follow = np.linalg.solve(before[:D, :D], before[:D]).T
    more = follow @ (robust.cov - robust.formal) @ follow.T
    return np.asarray((more + more.T) / 2)


def _known(session: CampaignSession, cells: Cells) -> tuple[Float, ...]:
    matches = session.matches
    errors = errors_by_star(session.inputs.catalog, session.largest_vafactor)
    if errors is None or matches.star is None:
        return ()
    return catalogue_in_cells(session.fit, matches, errors, cells)
