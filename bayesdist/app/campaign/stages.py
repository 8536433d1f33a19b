"""The stages of a run, where those of a campaign differ."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from bayesdist.app.campaign.fit import fit_campaign
from bayesdist.app.campaign.lines import line_sections
from bayesdist.app.campaign.matched import load_matched_campaign
from bayesdist.app.campaign.matching import match_lists
from bayesdist.app.campaign.reference import rehearse_references
from bayesdist.app.campaign.release import release
from bayesdist.app.campaign.series import run_series
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.campaign.soundness import refuse_unsound
from bayesdist.app.stages.assess import run_assess
from bayesdist.app.stages.export import run_export
from bayesdist.app.stages.fit import save_fitted
from bayesdist.products import read_idctab

__all__ = ["CAMPAIGN_STAGES", "rehearse_campaign"]

log = logging.getLogger("bayesdist")


def _match(session: CampaignSession) -> None:
    run, config, inputs = session.run, session.config, session.inputs
    matched = match_lists(config, session.base, inputs=inputs)
    matched.save(run.path)
    run.summarise(matching=matched.facts)
    # from now on pairs name the files that they lie in, as for a run that is resumed
    session.renew("matched", load_matched_campaign(run.path, config, inputs, run.summary))


def _fit(session: CampaignSession) -> None:
    session.renew("fitted", fit_campaign(session.matched, session.config, session.base))
    save_fitted(session)
    for text in session.fitted.facts["deviations"]["warnings"]:
        log.warning("fit: WARNING: %s", text)
    scatter = session.fitted.facts["scatter"]
    sizes = ", ".join(f"{name} {found['value']:.2g}" for name, found in scatter.items())
    log.info("fit: scatter of the exposures %s", sizes)


def _assess(session: CampaignSession) -> None:
    run_series(session)  # first: what it finds doubtful is among the warnings
    run_assess(session)
    # with all errors that have been measured
    session.run.summarise(**line_sections(session.solution, session.reference_chip))


def _export(session: CampaignSession) -> None:
    asked = session.config.products.release is not None
    run_export(session, release(session, session.solution) if asked else [])


CAMPAIGN_STAGES: dict[str, Callable[[Any], None]] = {
    "match": _match,
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
    refuse_unsound(session.config, session.inputs)
    read_idctab(session.base / session.block.initial_distortion)
    rehearse_references(session.config, session.inputs.catalog.unit, session.base)
    if session.config.products.release is not None:
        read_idctab(session.base / session.config.products.release.reference)
