"""Matching of the star lists of a campaign with its catalogue, and what follows from the pairs."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.parts import Part
from bayesdist.app.run import Run
from bayesdist.app.stars import set_aside
from bayesdist.app.store.rundir import PAIRS, part_files
from bayesdist.assess.terms.parameters import ABERRATION, EXPOSURE_SCATTER, ScaleError
from bayesdist.calibration.calibration import Calibration
from bayesdist.data import (
    Detections,
    ExposureLog,
    Matches,
    match_campaign,
    neutralise_aberration,
    read_matches,
    write_partitioned,
)
from bayesdist.data.matching.campaign import CampaignMatches
from bayesdist.diagnose.overlap import OverlapTest, overlap_test
from bayesdist.errors import InputError
from bayesdist.infer.solution.geometry import geometry_of
from bayesdist.infer.solution.solution import Solution
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.inputs import (
    CampaignInputs,
    input_warnings,
    parities_of,
    refuse_few,
    segment_counts,
    shear_warnings,
)
from bayesdist.kinds.star_lists import (
    StarLists,
    known_calibration,
    positions_by_chip,
    start_of,
)
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.common.document import Document
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float

log = logging.getLogger("bayesdist")

GAUGE_EXPOSURES = 1  # leading exposures that define the gauge and cannot be held out


def match_lists(run: Run) -> Run:
    """Match star lists with a catalogue, exposure by exposure."""
    inputs: CampaignInputs = run.inputs
    config, block, lists = inputs.config, inputs.config.campaign, inputs.star_lists
    document = open_document(inputs.base / block.initial_distortion)
    initial = known_calibration(document, block.filter, config.detector.size)
    parities = parities_of(block, inputs.catalog, document)
    for text in (*([inputs.plane] if inputs.plane else []), *inputs.catalog.notes):
        log.info("match: catalogue: %s", text)
    start = start_of(initial, inputs.unit_arcsec)
    matches = match_campaign(
        _gauge_first(lists, config.chips()[0].number),
        inputs.log,
        inputs.catalog,
        lambda x, y, chip, epoch: positions_by_chip(start, x, y, chip),
        cuts=lists.cuts,
        radius=block.radius,
        mirrored=parities,
    )
    _refuse_bare(matches.table, config.chips(), inputs.catalog.source)
    if matches.left_out:
        remaining = inputs.log.select(names=matches.table.exposure_names)
        refuse_few(remaining.values("epoch"), config.time())
    table = _table(matches, inputs.log)
    warnings = [
        *_doubtful_parity(matches.mirrored, parities, document, _detector_of(initial)),
        *matches.warnings(inputs.log),
        *input_warnings(inputs),
        # roll angles of the matches, because the log need not have them
        *shear_warnings(np.asarray(table["rotation"]), "of the matches"),
    ]
    warnings = [_named_from(inputs.base, text) for text in warnings]
    pairs = neutralise_aberration(matches.table, inputs.log)
    facts = _facts(matches, table, inputs, warnings)
    run = with_pairs(run, pairs, facts, table)
    if run.held_stars is not None:
        _refuse_bare(run.stars, config.chips(), "what is not held out")
        fitted_log = inputs.log.select(names=run.stars.exposure_names)
        refuse_few(fitted_log.values("epoch"), config.time() if config.has_free_rates else None)
    _log(facts, int(table["detected"].sum()))
    return run


def _table(found: CampaignMatches, exposures: ExposureLog) -> Table:
    """One row per exposure, with its factor of velocity aberration and roll angle."""
    table = found.summary()
    names = list(exposures.names)
    order = [names.index(name) for name in table["exposure"]]
    for name in ("vafactor", "pa_v3"):
        table[name] = exposures.values(name)[order]
    return table


def _facts(
    found: CampaignMatches, table: Table, inputs: CampaignInputs, warnings: list[str]
) -> dict[str, Any]:
    """Section 'matching' of summary.json."""
    false = np.sum(table["false_fraction"] * table["matched"]) / table["matched"].sum()
    return {
        "n_exposures": len(found.reports),
        "n_detections": len(inputs.star_lists),
        "n_pairs": len(found.table),
        "n_catalog": len(inputs.whole_catalog),
        "n_catalog_used": len(inputs.catalog),
        "left_out": {k: _named_from(inputs.base, v) for k, v in found.left_out.items()},
        "completeness": {
            "median": float(np.median(table["completeness"])),
            "least": float(np.min(table["completeness"])),
        },
        "false_fraction": float(false),
        "parity": "mirrored" if found.mirrored else "direct",
        "tangent_point": inputs.catalog.tangent_point,
        "radius": [float(table["radius_min"].min()), float(table["radius_max"].max())],
        "warnings": warnings,
    }


def _named_from(base: Path, text: str) -> str:
    """Text of a result in which files are named relative to the folder of the configuration."""
    return text.replace(f"{base}{os.sep}", "") if base.is_absolute() else text


def _log(facts: Mapping[str, Any], n_detected: int) -> None:
    log.info(
        "match: %d pairs of %d detections in %d exposures, median completeness %.3f, %.2g false",
        facts["n_pairs"],
        n_detected,
        facts["n_exposures"],
        facts["completeness"]["median"],
        facts["false_fraction"],
    )
    if is_mirrored(facts):
        log.info(
            "match: the catalogue is mirrored against the detector's axes: u is taken with the "
            "opposite sign%s",
            "" if facts["tangent_point"] is None else " and grows to the west",
        )
    for text in facts["warnings"]:
        log.warning("match: WARNING: %s", text)


def _detector_of(calibration: Calibration) -> str:
    """Names of instrument and detector, or else the name of the calibration."""
    parts = filter(None, (calibration.instrument, calibration.detector))
    return "/".join(parts) or calibration.name


def _doubtful_parity(
    mirrored: bool, parities: tuple[bool, ...], initial: Document, detector: str
) -> list[str]:
    """Warning, as a clause, if the parity of the stars contradicts the initial distortion.

    Most formats state no parity, which cannot be contradicted.
    """
    if mirrored == parities[0] or initial.mirrored() is None:
        return []
    return [
        f"the stars lie mirrored against what the detector of the known distortion, {detector}, "
        "sees of the sky: x and y of the lists may be swapped, or the axes of the detector are not "
        "those of this detector"
    ]


def _gauge_first(star_lists: StarLists, chip: int) -> tuple[Detections, ...]:
    """Star lists, reordered if necessary so that the first has enough stars on the reference chip.

    These stars of the first exposure define the gauge of the joint fit.  The order is kept if the
    first list has at least half the median number of stars there.
    """
    lists = star_lists.lists
    pairs = zip(lists, star_lists.passed, strict=True)
    counts = np.array([int((detections.chip[good] == chip).sum()) for detections, good in pairs])
    usual = np.median(counts[counts > 0]) if counts.any() else 0.0
    if counts[0] >= 0.5 * usual:
        return lists
    first = int(np.argmax(counts >= usual))
    return (lists[first], *lists[:first], *lists[first + 1 :])


def _refuse_bare(pairs: Matches, chips: tuple[Chip, ...], where: str) -> None:
    """Refuse pairs if a chip has none."""
    for chip in chips:
        if chip.number not in pairs.chip_numbers:
            raise InputError(
                f"no detection on chip {chip.name} is matched in any exposure",
                where=where,
                do="widen the cuts, or drop its [[chip]] block",
            )


def campaign_lines(inputs: CampaignInputs) -> Iterator[str]:
    """Lines of text about the inputs, dates and roll angles of a campaign."""
    config, log, catalog, lists = inputs.config, inputs.log, inputs.catalog, inputs.star_lists
    epochs, rolls = log.values("epoch"), log.values("pa_v3")
    yield f"exposures    {len(log.names)} in {', '.join(log.filters)}"
    passed, removed = sum(int(good.sum()) for good in lists.passed), lists.cut_words
    yield f"detections   {len(lists)}: {passed} pass the cuts" + (f", {removed}" if removed else "")
    yield f"catalogue    {len(catalog)} of {len(inputs.whole_catalog)} stars, in {catalog.unit}"
    for text in (*([inputs.plane] if inputs.plane else []), *catalog.notes):
        yield f"             {text}"
    yield f"epochs       {epochs.min():.2f} to {epochs.max():.2f}"
    factors = log.values("vafactor")
    how = ", of the Earth alone" if config.campaign.vafactor_source == "earth" else ""
    yield f"aberration   {factors.min():.7f} to {factors.max():.7f}{how}"
    yield f"PA_V3        {_rolls(rolls)}"
    time = config.time()
    if time is not None:
        counts = segment_counts(epochs, time)
        yield f"segments     {', '.join(str(k) for k in counts)} exposures"
    chips = ", ".join(chip.name for chip in config.chips())
    yield f"model        order {config.model.order}, chips {chips}, tables: {config.tables.method}"
    document = open_document(inputs.base / config.campaign.initial_distortion)
    initial = known_calibration(document, config.campaign.filter, config.detector.size)
    for number in sorted({chip.number for chip in config.chips()} & set(initial.numbers)):
        sentence = geometry_of(initial.solution, number).sentence
        yield f"geometry     chip {number} of campaign.initial_distortion: {sentence}"
    for number, names in _without(inputs).items():
        yield f"chip {number}       no detections that pass the cuts in {', '.join(names)}"
    warnings, unknown = input_warnings(inputs), np.count_nonzero(np.isnan(rolls))
    if 0 < unknown < len(rolls):
        warnings.append(f"PA_V3 is missing of {unknown} of {len(rolls)} exposures")
    for text in (*warnings, *shear_warnings(rolls, "PA_V3")):
        yield f"WARNING      {text[0].upper() + text[1:]}"


def _rolls(rolls: np.ndarray) -> str:
    angles = rolls[np.isfinite(rolls)]
    if not len(angles):
        return "not known; roll angles will be those of the matches"
    return f"{angles.min():.1f} to {angles.max():.1f} degrees"


def _without(inputs: CampaignInputs) -> dict[int, list[str]]:
    """Exposures without usable detections on a chip, by chip number."""
    lists, out = inputs.star_lists, dict[int, list[str]]()
    for name, detections, good in zip(lists.names, lists.lists, lists.passed, strict=True):
        for chip in inputs.config.chips():
            if chip.number not in detections.chip[good]:
                out.setdefault(chip.number, []).append(name)
    return out


@dataclass(frozen=True, eq=False)
class MatchedPairs(Part):
    """Raw pixels matched with aberration-corrected catalogue positions and their errors."""

    title = "matched pairs"
    stage = "match"

    pairs: Matches  # all matches, fitted or held out

    def save(self, folder: Path) -> None:
        """Write the pairs to the folder of a run."""
        for stale in part_files(folder / PAIRS):
            stale.unlink()
        write_partitioned([self.pairs], folder / PAIRS)


def with_pairs(
    run: Run, pairs: Matches, facts: Mapping[str, Any], table: Table | None = None
) -> Run:
    """Run with the matches of a campaign, fitted and held out as configured.

    Parameters
    ----------
    run : Run
    pairs : Matches
    facts : mapping of str to object
        Section 'matching' of summary.json.
    table : Table, optional
        One row per exposure.
    """
    inputs: CampaignInputs = run.inputs
    pairs = pairs.named_below(str(inputs.base))
    stars, held, exposures = set_aside(inputs.config, pairs, GAUGE_EXPOSURES)
    return run.having(
        stars=stars,
        held_stars=held,
        held_exposures=exposures,
        match_facts=facts,
        match_table=table,
        match_parts={"pairs": MatchedPairs(pairs)},
    )


def affine_model_of(config: CampaignConfig, stars: Matches) -> DistortionModel:
    """Configured polynomial with a free linear part for each exposure.

    It is used to fit look-up tables and errors, because it absorbs all drift and scatter of the
    linear terms.
    """
    return DistortionModel(
        config.model.order,
        config.chips(),
        unit=stars.unit,
        frames="affine",
        exposures=stars.exposure_names,
    )


def load_matched_campaign(run: Run) -> Run:
    """Run with the matches of an earlier stage, from its folder."""
    inputs: CampaignInputs = run.inputs
    pairs = read_matches(run.directory / PAIRS, unit=inputs.catalog.unit)
    # stored with the diagnostics, which do not say in which folder the run is
    pairs = replace(pairs, sources=tuple(f"{PAIRS}/{Path(name).name}" for name in pairs.sources))
    return with_pairs(run, pairs, run.directory.summary.get("matching", {}))


def is_mirrored(facts: Mapping[str, Any]) -> bool:
    """True if u has the opposite sign to that of the catalogue.

    `facts` is the section 'matching' of summary.json.
    """
    return facts.get("parity") == "mirrored"


def overlap_of(run: Run) -> OverlapTest | None:
    """Comparison of two exposures far apart in time; None if there is no such pair."""
    inputs: CampaignInputs = run.inputs
    block = inputs.config.campaign
    initial = open_document(inputs.base / block.initial_distortion)
    return overlap_test(
        run.stars,
        run.posterior,
        known_calibration(initial, block.filter, inputs.config.detector.size),
        run.tables.tables,
        unit_arcsec=inputs.unit_arcsec,
        pixel=inputs.pixel_arcsec,
        rolls={exposure.name: exposure.pa_v3 for exposure in inputs.log},
    )


# Cox & Gilliland (2002, HST Calibration Workshop): the scale varies by up to 5e-5 over an orbit
SWING = 5e-5
PERIOD = 5760.0  # s, of 96 minutes
LONG_EXPOSURE = 1000.0  # s, assumed if the log has no exposure times
PUBLISHED = "published: 5e-5 in an orbit (Cox & Gilliland 2002)"


def scale_error(exptime: float | None) -> float:
    """Relative standard deviation of the scale by aberration that VAFACTOR does not correct.

    `exptime` is the exposure time in seconds; the instant that VAFACTOR refers to is taken as
    uniform within it.  None if VAFACTOR does not include the orbit of the telescope.  A sine of
    amplitude SWING / 2 at a random phase has a standard deviation of amplitude / sqrt(2), and its
    rate of change 2 pi / PERIOD times that.
    """
    spread = SWING / 2 / math.sqrt(2)
    if exptime is None:
        return spread
    return min(spread, spread * 2 * math.pi / PERIOD * exptime / math.sqrt(12))


def aberration_term(
    kinds: Sequence[str], tau: Float, inputs: CampaignInputs, solution: Solution
) -> ScaleError:
    """Scale error by residual velocity aberration, limited to the measured scatter in scale.

    VAFACTOR holds for one instant, but the velocity of a telescope in a low orbit changes direction
    during an exposure.  No log states the instant, which is taken as uniform within the exposure.
    A factor computed from the motion of the Earth alone does not include the orbit at all.  All of
    this makes the scales of exposures scatter.  That scatter is measured, so that the term is a
    part of it.
    """
    source = PUBLISHED
    if inputs.config.campaign.vafactor_source == "earth":
        sigma = scale_error(None)
        source += ", not corrected"
    else:
        times = [exposure.exptime for exposure in inputs.log if exposure.exptime is not None]
        seconds = math.sqrt(np.mean(np.square(times))) if times else LONG_EXPOSURE
        sigma = scale_error(seconds)
        source += f", over {seconds:.0f} s"
        if not times:
            source += " (assumed: the log has no times)"
    if "scale" in kinds:
        scale_draws = tau[:, kinds.index("scale")]
        measured = float(np.sqrt(np.mean(scale_draws**2)))
        if measured < sigma:
            sigma, source = measured, f"{source}, and no more than exposures scatter"
    source = f"{source}; part of {EXPOSURE_SCATTER}"
    return ScaleError(ABERRATION, "scale", sigma, solution, source, in_total=False)
