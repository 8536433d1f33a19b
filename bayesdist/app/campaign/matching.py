"""Stage 0 of a campaign: star lists to pairs."""

from __future__ import annotations

import logging

import numpy as np

from bayesdist.app.campaign.inputs import cuts_of, start_of
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.session import write_table
from bayesdist.app.star_files import PAIRS, part_files
from bayesdist.data import match_campaign, neutralise_aberration, write_partitioned

__all__ = ["run_match"]

log = logging.getLogger("bayesdist")


def run_match(session: CampaignSession) -> None:
    block, run, inputs = session.block, session.run, session.inputs
    found = match_campaign(
        inputs.lists,
        inputs.log,
        inputs.catalog,
        start_of(session.base / block.start, session.unit_arcsec, block.filter),
        cuts=cuts_of(block),
        radius=block.radius,
        need_all_chips=True,
    )
    summary = found.summary()
    order = [list(inputs.log.names).index(name) for name in summary["exposure"]]
    for name in ("vafactor", "pa_v3"):
        summary[name] = inputs.log.values(name)[order]
    write_table(summary, run / "matching.ecsv")
    for stale in part_files(run / PAIRS):
        stale.unlink()
    write_partitioned([neutralise_aberration(found.table, inputs.log)], run / PAIRS)
    session.forget()
    false = float(np.sum(summary["false_share"] * summary["matched"]) / summary["matched"].sum())
    run.summarise(
        matching={
            "n_exposures": len(found.reports),
            "n_detections": int(summary["detected"].sum()),
            "n_pairs": len(found.table),
            "n_catalog": inputs.n_catalog,
            "n_catalog_used": len(inputs.catalog),
            "completeness": {
                "median": float(np.median(summary["completeness"])),
                "least": float(np.min(summary["completeness"])),
            },
            "false_share": false,
            "radius": [float(summary["radius_min"].min()), float(summary["radius_max"].max())],
        }
    )
    log.info(
        "match: %d pairs of %d detections in %d exposures, median completeness %.3f, %.2g false",
        len(found.table),
        int(summary["detected"].sum()),
        len(found.reports),
        float(np.median(summary["completeness"])),
        false,
    )
