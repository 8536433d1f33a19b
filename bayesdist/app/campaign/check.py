"""What a campaign would begin with."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.campaign.stages import rehearse_campaign

__all__ = ["campaign_lines"]

ONE_ROLL = 2.0  # degrees: roll angles within this say the same


def campaign_lines(session: CampaignSession) -> Iterator[str]:
    """Inputs, dates and roll angles of a campaign, as lines of text."""
    rehearse_campaign(session)
    inputs, config = session.inputs, session.config
    log, catalog = inputs.log, inputs.catalog
    epochs, rolls = log.values("epoch"), log.values("pa_v3")
    n = sum(len(one) for one in inputs.lists)
    yield f"exposures    {len(log.names)} in {', '.join(log.filters)}, {n} detections"
    yield f"catalogue    {len(catalog)} of {inputs.n_catalog} stars, in {catalog.unit}"
    yield f"epochs       {epochs.min():.2f} to {epochs.max():.2f}"
    factors = log.values("vafactor")
    yield f"VAFACTOR     {factors.min():.7f} to {factors.max():.7f}"
    if np.isfinite(rolls).all():
        yield f"PA_V3        {rolls.min():.1f} to {rolls.max():.1f} degrees"
        # half a turn says nothing new of a shear
        spread = np.abs(np.exp(2j * np.radians(rolls)).mean())
        if spread > np.cos(2 * np.radians(ONE_ROLL)):
            yield (
                "WARNING: all exposures have one roll angle (or half a turn apart): a shear of the "
                "catalogue cannot be told from one of the detector"
            )
    time = config.time()
    if time is not None:
        edges = [-np.inf, *time.breaks, np.inf]
        counts = np.histogram(epochs, edges)[0]
        yield f"segments     {', '.join(str(k) for k in counts)} exposures"
    chips = ", ".join(chip.name for chip in config.chips())
    yield f"model        order {config.model.order}, chips {chips}, tables: {config.tables.method}"
