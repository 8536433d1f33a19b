"""Matched stars of a campaign, with the lists, catalogue and log that they come from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from bayesdist.app.config import CampaignConfig
from bayesdist.app.kinds.campaign.inputs import Inputs, errors_by_star
from bayesdist.app.kinds.matched import Matched, set_aside
from bayesdist.app.kinds.star_lists import known_calibration
from bayesdist.app.store.rundir import PAIRS, part_files
from bayesdist.assess.terms.parameters import ABERRATION, EXPOSURE_SCATTER, ScaleError
from bayesdist.data import read_matches, write_partitioned
from bayesdist.data.matches import Matches
from bayesdist.diagnose.overlap import OverlapTest, overlap_test
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float

GAUGE_EXPOSURES = 1  # leading exposures that define the gauge and cannot be held out


@dataclass(frozen=True, eq=False)
class CampaignMatched(Matched):
    """Raw pixels matched with aberration-corrected catalogue positions and their errors."""

    section: ClassVar[str] = "matching"
    along_detector: ClassVar[bool] = True

    inputs: Inputs = field(kw_only=True)  # catalogue, exposures and star lists
    pairs: Matches = field(kw_only=True)  # all matches, fitted or held out

    @cached_property
    def affine_model(self) -> DistortionModel:
        """Configured polynomial with a free linear part for each exposure."""
        return affine_model_of(self.inputs.config, self.stars)

    def of_order(self, order: int) -> Self:
        """Matches to be fitted by polynomials of another order."""
        config = self.inputs.config.of_order(order)
        return replace(self, inputs=replace(self.inputs, config=config))

    @property
    def filter(self) -> str:
        """Filter of the exposures."""
        return self.inputs.filter

    @property
    def star_errors(self) -> StarErrors | None:
        """Errors of the catalogue by star code; None if there are none."""
        return errors_by_star(self.inputs.catalog, self.inputs.largest_vafactor)

    def aberration(self, kinds: Sequence[str], tau: Float, solution: Solution) -> ScaleError:
        """Scale error by velocity aberration, which is a part of the exposure scatter."""
        return aberration_term(kinds, tau, self.inputs, solution)

    def overlap(self, posterior: Posterior, tables: tuple[LookupTable, ...]) -> OverlapTest | None:
        """Comparison of two exposures far apart in time; None if there is no such pair."""
        inputs, block = self.inputs, self.inputs.config.campaign
        initial = open_document(inputs.base / block.initial_distortion)
        return overlap_test(
            self.stars,
            posterior,
            known_calibration(initial, block.filter, inputs.config.detector.size),
            tables,
            unit_arcsec=inputs.unit_arcsec,
            pixel=inputs.pixel_arcsec,
            rolls={exposure.name: exposure.pa_v3 for exposure in inputs.log},
        )

    def save(self, folder: Path) -> None:
        """Write the matches to the folder of a run."""
        super().save(folder)
        for stale in part_files(folder / PAIRS):
            stale.unlink()
        write_partitioned([self.pairs], folder / PAIRS)


def matched_campaign(pairs: Matches, inputs: Inputs, **more: Any) -> CampaignMatched:
    """Matches of a campaign, divided into fitted and held-out stars as configured."""
    pairs = pairs.named_below(str(inputs.base))
    parts = set_aside(inputs.config, pairs, GAUGE_EXPOSURES)
    return CampaignMatched(*parts, catalogue=inputs.catalog, inputs=inputs, pairs=pairs, **more)


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


def load_matched_campaign(
    folder: Path, inputs: Inputs, summary: Mapping[str, Any]
) -> CampaignMatched:
    """Load the matches of an earlier stage from the folder of a run."""
    pairs = read_matches(folder / PAIRS, unit=inputs.catalog.unit)
    return matched_campaign(pairs, inputs, facts=summary.get("matching", {}))


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
