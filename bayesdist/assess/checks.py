"""Checks of the assumptions of an evaluation: residuals, catalogue and dates."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior
from bayesdist.infer.posterior.checks import sampling_checks
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import EITHER, LARGER, Check

GROUP = "Assumptions"

UNEXAMINED = Check(
    "Fit",
    "Residuals",
    "not examined",
    "bd.diagnose",
    "warn",
    "the residuals were not examined; give diagnostics=bd.diagnose(posterior, matches)",
    # structure would make errors larger; overestimated quoted errors would make them smaller
    EITHER,
)


def assumption_checks(
    posterior: Posterior | None,
    diagnostics: Diagnostics,
    time: TimeDependence | None,
    *,
    catalogue_stated: bool | None,
    motions_stated: bool | None,
) -> tuple[Check, ...]:
    """Checks of the sampling, the fit, the matching, the catalogue and the dates.

    A verdict relies on all of these, in addition to `Diagnostics.checks`.

    Parameters
    ----------
    posterior : Posterior or None
        None for a fit that was not sampled.
    diagnostics : Diagnostics
        Diagnostics of the posterior or of the fit.
    time : TimeDependence or None
        Time dependence of the model.
    catalogue_stated, motions_stated : bool or None
        True if errors of the reference catalogue's positions, and of its proper motions, are
        stated; None without a catalogue.

    Returns
    -------
    tuple of Check
    """
    return (
        *sampling_checks(posterior),
        *diagnostics.checks_of_input,
        *catalogue_checks(catalogue_stated),
        *time_checks(time, diagnostics.dates, motions_stated),
    )


def catalogue_checks(catalogue_stated: bool | None) -> Iterator[Check]:
    """Check that errors of the reference catalogue are stated; no check without a catalogue."""
    if catalogue_stated is None:
        return
    name, limit = "Error of the reference catalogue", "a row of [[budget]] or of the table"
    if catalogue_stated:
        yield Check(GROUP, name, "stated", limit, "pass")
        return
    sentence = (
        "no error of the reference catalogue is stated: give a [[budget]] row that is named after "
        "the catalogue, such as 'Gaia DR3', or in Python catalogue=bd.Catalogue('Gaia DR3', "
        "sigma_mas=...); an error of 0 needs a source"
    )
    yield Check(GROUP, name, "not stated", limit, "warn", sentence, LARGER)


def time_checks(
    time: TimeDependence | None, dates: Float, motions_stated: bool | None
) -> Iterator[Check]:
    """Checks that the data constrain a drift and that errors of the proper motions are stated.

    `time`: time dependence of the model; nothing is checked if it is None. `dates`: dates of the
    matches, decimal years. `motions_stated`: None without a catalogue.
    """
    if time is None:
        return
    segment = np.searchsorted(time.breaks, dates, side="right")
    counts = [visits_of(dates[segment == k], whole=dates).size for k in np.unique(segment)]
    if counts and min(counts) <= 2:
        yield Check(
            GROUP,
            "Dates that the drift is fitted to",
            level="warn",
            sentence=f"a drift is fitted to {('one date', 'two dates')[min(counts) - 1]}, so that "
            "neither the variation between exposures nor the curvature of the drift is measured",
            doubt=EITHER,
        )
    if motions_stated is False:
        yield Check(
            GROUP,
            "Error of the proper motions",
            "not stated",
            "a row of [[budget]] or of the table",
            "warn",
            "no error of the catalogue's proper motions is stated, and the drift is "
            "measured against them: give a [[budget]] row that names the motions, of size 0 with "
            "its source where they have none",
            LARGER,
        )


def visits_of(dates: Float, *, whole: Float | None = None) -> Float:
    """Start dates of the visits, ascending; consecutive exposures form one visit.

    A visit spans at most one day or 2 % of the baseline. `whole`: dates that define the baseline;
    `dates` by default.
    """
    if not dates.size:
        return dates
    span = max(1 / 365.25, float(np.ptp(dates if whole is None else whole)) / 50)
    ordered = np.unique(dates)
    first = [ordered[0]]
    while (i := np.searchsorted(ordered, first[-1] + span, side="right")) < ordered.size:
        first.append(ordered[i])
    return np.array(first)
