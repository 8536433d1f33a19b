"""The stages of a run, where those of a campaign differ."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayesdist.app.campaign.fit import run_campaign_fit
from bayesdist.app.campaign.holdout import check_named
from bayesdist.app.campaign.lines import summarise_lines
from bayesdist.app.campaign.matching import run_match
from bayesdist.app.campaign.reference import rehearse_references
from bayesdist.app.campaign.release import release
from bayesdist.app.campaign.series import run_series
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.campaign.soundness import frames_not_set, refuse_unsound
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.export import run_export
from bayesdist.products import read_idctab

__all__ = ["CAMPAIGN_STAGES", "rehearse_campaign"]


def _fit(session: CampaignSession) -> None:
    with frames_not_set():
        run_campaign_fit(session)


def _assess(session: CampaignSession) -> None:
    run_series(session)  # first: what it finds doubtful is among the warnings
    run_assess(session)
    summarise_lines(session, session.solution)  # with all errors that have been measured


def _export(session: CampaignSession) -> None:
    asked = session.config.products.release is not None
    run_export(session, release(session, session.solution) if asked else [])


CAMPAIGN_STAGES: dict[str, Callable[[Any], None]] = {
    "match": run_match,
    "fit": _fit,
    "assess": _assess,
    "export": _export,
}


def rehearse_campaign(session: CampaignSession) -> None:
    """Read all that the campaign begins with; nothing is matched or written.

    Raises
    ------
    BayesdistError
        For inputs that cannot be read or do not go together.
    """
    refuse_unsound(session)
    check_named(session)
    read_idctab(session.base / session.block.initial_distortion)
    rehearse_references(session.config, session.inputs.catalog.unit, session.base)
    if session.config.products.release is not None:
        read_idctab(session.base / session.config.products.release.reference)
