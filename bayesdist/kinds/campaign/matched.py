"""Matched stars of a campaign, and what follows from the lists, catalogue and log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.artefacts.parts import Part
from bayesdist.app.artefacts.stars import set_aside
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import PAIRS, part_files
from bayesdist.assess.terms.parameters import ABERRATION, EXPOSURE_SCATTER, ScaleError
from bayesdist.data import read_matches, write_partitioned
from bayesdist.data.matches import Matches
from bayesdist.diagnose.overlap import OverlapTest, overlap_test
from bayesdist.infer.solution.solution import Solution
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.inputs import Inputs
from bayesdist.kinds.star_lists import known_calibration
from bayesdist.model import DistortionModel
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float

GAUGE_EXPOSURES = 1  # leading exposures that define the gauge and cannot be held out


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
    inputs: Inputs = run.inputs
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
    inputs: Inputs = run.inputs
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
    inputs: Inputs = run.inputs
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
    kinds: Sequence[str], tau: Float, inputs: Inputs, solution: Solution
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
