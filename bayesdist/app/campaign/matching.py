"""Stage 0 of a campaign: star lists to pairs."""

from __future__ import annotations

import logging

import numpy as np

from bayesdist.app.campaign.inputs import cuts_of, parities_of, start_of
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.campaign.soundness import input_doubts, refuse_few, shear_doubts
from bayesdist.app.session import write_table
from bayesdist.app.star_files import PAIRS, part_files
from bayesdist.data import (
    MatchTable,
    StarCuts,
    StarList,
    match_campaign,
    neutralise_aberration,
    write_partitioned,
)
from bayesdist.errors import InputError
from bayesdist.model import Chip
from bayesdist.products import read_idctab

__all__ = ["run_match"]

log = logging.getLogger("bayesdist")


def run_match(session: CampaignSession) -> None:
    block, run, inputs = session.block, session.run, session.inputs
    cuts = cuts_of(block)
    tab = read_idctab(session.base / block.initial_distortion)
    parities = parities_of(block, inputs.catalog, tab)
    for text in (*([inputs.plane] if inputs.plane else []), *inputs.catalog.notes):
        log.info("match: catalogue: %s", text)
    found = match_campaign(
        _gauge_first(inputs.lists, cuts, session.reference_chip),
        inputs.log,
        inputs.catalog,
        start_of(tab, session.unit_arcsec, block.filter),
        cuts=cuts,
        radius=block.radius,
        mirrored=parities,
        skip=True,
    )
    _refuse_bare(found.table, session.config.chips(), inputs.catalog.source)
    left = inputs.log.select(names=found.table.exposure_names)
    if found.left_out:
        refuse_few(left.values("epoch"), session.config.time())
    summary = found.summary()
    order = [list(inputs.log.names).index(name) for name in summary["exposure"]]
    for name in ("vafactor", "pa_v3"):
        summary[name] = inputs.log.values(name)[order]
    warnings = [
        *_doubtful_parity(found.mirrored, parities, f"{tab.instrument}/{tab.detector}"),
        *found.warnings(inputs.log),
        *input_doubts(session),
        # as the stars show them, for the log need not have them
        *shear_doubts(np.asarray(summary["rotation"]), "of the matches"),
    ]
    write_table(summary, run / "matching.ecsv")
    for stale in part_files(run / PAIRS):
        stale.unlink()
    write_partitioned([neutralise_aberration(found.table, inputs.log)], run / PAIRS)
    session.forget()
    if session.config.holdout is not None:
        _refuse_bare(session.pairs, session.config.chips(), "what is not held out")
        some = inputs.log.select(names=session.pairs.exposure_names)
        refuse_few(some.values("epoch"), session.config.time() if session.free_rates else None)
    false = float(np.sum(summary["false_share"] * summary["matched"]) / summary["matched"].sum())
    run.summarise(
        matching={
            "n_exposures": len(found.reports),
            "n_detections": sum(len(one) for one in inputs.lists),
            "n_pairs": len(found.table),
            "n_catalog": inputs.n_catalog,
            "n_catalog_used": len(inputs.catalog),
            "left_out": dict(found.left_out),
            "completeness": {
                "median": float(np.median(summary["completeness"])),
                "least": float(np.min(summary["completeness"])),
            },
            "false_share": false,
            "parity": "mirrored" if found.mirrored else "direct",
            "tangent_point": inputs.catalog.tangent_point,
            "radius": [float(summary["radius_min"].min()), float(summary["radius_max"].max())],
            "warnings": warnings,
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
    if found.mirrored:
        log.info(
            "match: the catalogue is mirrored against the detector's axes: u is taken with the "
            "opposite sign%s",
            "" if inputs.catalog.tangent_point is None else " and grows to the west",
        )
    for text in warnings:
        log.warning("match: WARNING: %s", text)


def _doubtful_parity(mirrored: bool, parities: tuple[bool, ...], detector: str) -> list[str]:
    """Whether the stars have another parity than the known distortion says, as a clause."""
    if mirrored == parities[0]:
        return []
    return [
        f"the stars lie mirrored against what the detector of the known distortion, {detector}, "
        "sees of the sky: x and y of the lists may be swapped, or the axes of the detector are not "
        "those of this detector"
    ]


def _gauge_first(lists: tuple[StarList, ...], cuts: StarCuts, chip: int) -> tuple[StarList, ...]:
    """The lists, led by one with enough stars on the reference chip.

    The first exposure's stars there define the gauge of the joint fit.  The order stays where the
    first list has at least half of what the others have.
    """
    counts = np.array([int((one.chip[cuts.passed(one)[0]] == chip).sum()) for one in lists])
    usual = np.median(counts[counts > 0]) if counts.any() else 0.0
    if counts[0] >= 0.5 * usual:
        return lists
    first = int(np.argmax(counts >= usual))
    return (lists[first], *lists[:first], *lists[first + 1 :])


def _refuse_bare(pairs: MatchTable, chips: tuple[Chip, ...], where: str) -> None:
    """Refuse pairs that leave a chip without any."""
    for chip in chips:
        if chip.number not in pairs.chip_numbers:
            raise InputError(
                f"no detection on chip {chip.name} is matched in any exposure",
                where=where,
                do="widen the cuts, or drop its [[chip]] block",
            )
