"""The matched stars of a campaign: with the lists, catalogue and log that they are from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from bayesdist.app.config import CampaignConfig
from bayesdist.app.kinds.campaign.inputs import Inputs, errors_by_star
from bayesdist.app.kinds.errors import ExposureScatter
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

GAUGE_EXPOSURES = 1  # the first ones, which cannot be held out: they define the gauge


@dataclass(frozen=True, eq=False)
class CampaignMatched(Matched):
    """Raw pixels beside aberration-neutral catalogue positions, with the catalogue's errors."""

    section: ClassVar[str] = "matching"
    along_detector: ClassVar[bool] = True

    inputs: Inputs = field(kw_only=True)  # catalogue, exposures and star lists
    pairs: Matches = field(kw_only=True)  # all matches, fitted or held out

    @cached_property
    def affine_model(self) -> DistortionModel:
        """The configured polynomial with a free linear part of each exposure."""
        return affine_model_of(self.inputs.config, self.stars)

    def of_order(self, order: int) -> Self:
        """Matches to be fitted by polynomials of another order."""
        config = self.inputs.config.of_order(order)
        return replace(self, inputs=replace(self.inputs, config=config))

    @property
    def filter(self) -> str:
        """The one filter of the exposures."""
        return self.inputs.filter

    @property
    def star_errors(self) -> StarErrors | None:
        """Errors of the catalogue by code of the star; None where it has none."""
        return errors_by_star(self.inputs.catalog, self.inputs.largest_vafactor)

    def aberration(self, scatter: ExposureScatter, solution: Solution) -> ScaleError:
        """Error of the scale by velocity aberration, which is among the scatter."""
        return aberration_term(scatter, self.inputs, solution)

    def overlap(self, posterior: Posterior, tables: tuple[LookupTable, ...]) -> OverlapTest | None:
        """Two exposures far apart in time laid on each other; None where none are known so."""
        inputs, block = self.inputs, self.inputs.config.campaign
        return overlap_test(
            self.stars,
            posterior,
            known_calibration(inputs.base / block.initial_distortion, block.filter),
            tables,
            unit_arcsec=inputs.unit_arcsec,
            pixel=inputs.pixel_arcsec,
            rolls={one.name: one.pa_v3 for one in inputs.log},
        )

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        super().save(folder)
        for stale in part_files(folder / PAIRS):
            stale.unlink()
        write_partitioned([self.pairs], folder / PAIRS)


def matched_campaign(pairs: Matches, inputs: Inputs, **more: Any) -> CampaignMatched:
    """Matches of a campaign, with what the configuration holds out set aside."""
    pairs = pairs.named_below(str(inputs.base))
    parts = set_aside(inputs.config, pairs, GAUGE_EXPOSURES)
    return CampaignMatched(*parts, catalogue=inputs.catalog, inputs=inputs, pairs=pairs, **more)


def affine_model_of(config: CampaignConfig, stars: Matches) -> DistortionModel:
    """The configured polynomial with a free linear part of each exposure.

    For tables and errors: whatever drifts or scatters in the linear terms is taken up.
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
    """The matches of an earlier stage."""
    pairs = read_matches(folder / PAIRS, unit=inputs.catalog.unit)
    return matched_campaign(pairs, inputs, facts=summary.get("matching", {}))


# Cox & Gilliland (2002, HST Calibration Workshop): the scale varies by up to 5e-5 over an orbit
SWING = 5e-5
PERIOD = 5760.0  # s, of 96 minutes
LONG_EXPOSURE = 1000.0  # s, where the log has no exposure times
PUBLISHED = "published: 5e-5 in an orbit (Cox & Gilliland 2002)"


def scale_error(exptime: float | None) -> float:
    """Relative standard deviation of the scale.

    Over `exptime` seconds the instant of VAFACTOR is uniform; None where the factor lacks the
    orbit. A sine of amplitude SWING / 2 at any phase has the standard deviation of its amplitude by
    the root of 2, and its rate 2 pi / PERIOD times as much.
    """
    spread = SWING / 2 / math.sqrt(2)
    if exptime is None:
        return spread
    return min(spread, spread * 2 * math.pi / PERIOD * exptime / math.sqrt(12))


def aberration_term(scatter: ExposureScatter, inputs: Inputs, solution: Solution) -> ScaleError:
    """The error of the scale that VAFACTOR leaves, at most as large as exposures scatter.

    The factor holds for an instant, and a telescope in a low orbit turns its velocity while it
    exposes.  At which instant it was computed no log says: it is taken to lie anywhere in the
    exposure.  Computed from the Earth's motion alone it lacks the orbit altogether.  All of it
    makes exposures scatter in scale, and that scatter is measured: the term is a part of it.
    """
    source = PUBLISHED
    if inputs.config.campaign.vafactor_source == "earth":
        sigma = scale_error(None)
        source += ", not corrected"
    else:
        given = [one.exptime for one in inputs.log if one.exptime is not None]
        seconds = math.sqrt(np.mean(np.square(given))) if given else LONG_EXPOSURE
        sigma = scale_error(seconds)
        source += f", over {seconds:.0f} s"
        if not given:
            source += " (assumed: the log has no times)"
    if "scale" in scatter.kinds:
        found = scatter.tau[:, scatter.kinds.index("scale")]
        measured = float(np.sqrt(np.mean(found**2)))
        if measured < sigma:
            sigma, source = measured, f"{source}, and no more than exposures scatter"
    source = f"{source}; part of {EXPOSURE_SCATTER}"
    return ScaleError(ABERRATION, "scale", sigma, solution, source, in_total=False)
