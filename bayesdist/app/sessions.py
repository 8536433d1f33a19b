"""Which kind of session a run is, and what it does in its own way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from bayesdist.app.campaign.check import campaign_lines
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.campaign.stages import CAMPAIGN_STAGES, rehearse_campaign
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.selfcal.check import selfcal_lines
from bayesdist.app.selfcal.session import SelfcalSession
from bayesdist.app.selfcal.stages import SELFCAL_STAGES, rehearse_selfcal
from bayesdist.app.session import Session
from bayesdist.app.stages import rehearse

__all__ = ["own_lines", "own_stages", "rehearse_run", "session_of"]


def session_of(run: RunDirectory) -> Session:
    """The session of a run: of matched stars, of a campaign, or of a self-calibration."""
    if run.config.campaign is not None:
        return CampaignSession(run)
    return SelfcalSession(run) if run.config.selfcal is not None else Session(run)


def own_stages(session: Session) -> Mapping[str, Callable[[Session], None]]:
    """Stages that differ from those of matched stars; 'match' where a run begins with lists."""
    if isinstance(session, CampaignSession):
        return CAMPAIGN_STAGES
    return SELFCAL_STAGES if isinstance(session, SelfcalSession) else {}


def rehearse_run(session: Session) -> None:
    """Whatever can be known to be wrong before anything is written.

    Raises
    ------
    BayesdistError
    """
    if isinstance(session, CampaignSession):
        rehearse_campaign(session)
    elif isinstance(session, SelfcalSession):
        rehearse_selfcal(session)
    else:
        rehearse(session)


def own_lines(session: Session) -> Iterator[str] | None:
    """What `check` says of a run that begins with lists; None for matched stars."""
    if isinstance(session, CampaignSession):
        return campaign_lines(session)
    return selfcal_lines(session) if isinstance(session, SelfcalSession) else None
