"""Checks of a run other than those of residuals: kind of run, sampling, fit, catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.kind import kind_of
from bayesdist.assess.requirements.verdict import assumption_checks
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior
from bayesdist.utils.checks import Check


def run_checks(
    data: FitData,
    posterior: Posterior | None,
    found: Diagnostics,
    config: Config,
    series: Mapping[str, Any] | None,
) -> tuple[Check, ...]:
    """Checks of a run that has been sampled, or of a fit alone, in addition to its diagnostics.

    `series` is the section 'time_dependence' of summary.json; None if the run has none.
    """
    catalogue = motions = None
    if data.matched.has_catalogue:
        catalogue = data.matched.states_errors or config.states_catalogue
        motions = data.matched.states_motion_errors or config.states_motions
    return (
        *kind_of(config).checks(data, series or {}),
        *assumption_checks(
            posterior,
            found,
            data.model.time,
            catalogue_stated=catalogue,
            motions_stated=motions,
        ),
    )
