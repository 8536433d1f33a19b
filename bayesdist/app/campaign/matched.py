"""The matched stars of a campaign: with the lists, catalogue and log that they are from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from bayesdist.app.campaign.inputs import (
    Inputs,
    campaign_block,
    errors_by_star,
    known_calibration,
    unit_arcsec_of,
)
from bayesdist.app.config import Config
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.split import set_aside
from bayesdist.app.store.rundir import PAIRS, part_files
from bayesdist.data import read_matches, write_partitioned
from bayesdist.data.matches import Matches
from bayesdist.diagnose.overlap import OverlapTest, overlap_test
from bayesdist.errors import InputError
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_influence import StarErrors
from bayesdist.model import DistortionModel, LookupTable

__all__ = ["CampaignMatched", "campaign_matches", "load_matched_campaign", "matched_campaign"]

GAUGE_EXPOSURES = 1  # the first ones, which cannot be held out: they define the gauge


@dataclass(frozen=True, eq=False)
class CampaignMatched(Matched):
    """Raw pixels beside aberration-neutral catalogue positions, with the catalogue's errors.

    Parameters
    ----------
    inputs : Inputs
        Catalogue, exposures and star lists.
    pairs : Matches
        All matches, fitted or held out.
    """

    section: ClassVar[str] = "matching"

    stars: Matches
    held: Matches | None = None
    inputs: Inputs = field(kw_only=True)
    pairs: Matches = field(kw_only=True)

    @property
    def mirrored(self) -> bool:
        """Truth of a u that has the sign opposite to the catalogue's."""
        return self.facts.get("parity") == "mirrored"

    def affine_model(self, config: Config) -> DistortionModel:
        """The configured polynomial with a free linear part of each exposure.

        For tables and errors: whatever drifts or scatters in the linear terms is taken up.
        """
        return DistortionModel(
            config.model.order,
            config.chips(),
            unit=self.inputs.catalog.unit,
            frames="affine",
            exposures=self.stars.exposure_names,
        )

    @property
    def tangent_point(self) -> None:
        """None: u and v lie along the detector."""
        return None

    @property
    def filter(self) -> str:
        """The one filter of the exposures."""
        return self.inputs.filter

    @property
    def states_errors(self) -> bool:
        """Boolean: the catalogue has columns of errors."""
        return self.inputs.catalog.sigma_u is not None

    @property
    def states_motion_errors(self) -> bool:
        """Boolean: the catalogue has columns of errors of proper motions."""
        return self.inputs.catalog.sigma_pm_u is not None

    @property
    def star_errors(self) -> StarErrors | None:
        """Errors of the catalogue by code of the star; None where it has none."""
        return errors_by_star(self.inputs.catalog, self.inputs.largest_vafactor)

    @property
    def catalogue_name(self) -> str:
        """Name of the file of the reference catalogue."""
        return Path(self.inputs.catalog.source).name

    def with_motions(self, table: Matches) -> Matches:
        """Matches with what the catalogue states of the motions of their stars."""
        catalog = self.inputs.catalog
        if table.star is None or catalog.pm_u is None or catalog.sigma_pm_u is None:
            return table
        columns = {}
        for name in ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"):
            by_code = np.zeros(int(catalog.star.max()) + 1)
            by_code[catalog.star] = getattr(catalog, name)
            columns[name] = by_code[table.star]
        return table.with_columns(**columns)

    def overlap(
        self, posterior: Posterior, tables: tuple[LookupTable, ...], config: Config, base: Path
    ) -> OverlapTest | None:
        """Two exposures far apart in time laid on each other; None where none are known so."""
        block, mas = campaign_block(config), config.detector.scale_mas
        return overlap_test(
            self.stars,
            posterior,
            known_calibration(base / block.initial_distortion, block.filter),
            tables,
            unit_arcsec=unit_arcsec_of(self.inputs.catalog.unit, config),
            pixel=0.05 if mas is None else mas / 1000,
            rolls={one.name: one.pa_v3 for one in self.inputs.log},
        )

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        super().save(folder)
        for stale in part_files(folder / PAIRS):
            stale.unlink()
        write_partitioned([self.pairs], folder / PAIRS)


def matched_campaign(
    pairs: Matches, config: Config, inputs: Inputs, **more: Any
) -> CampaignMatched:
    """Matches of a campaign, with what the configuration holds out set aside.

    Raises
    ------
    InputError
        As `set_aside`.
    """
    parts = set_aside(config, pairs, GAUGE_EXPOSURES)
    return CampaignMatched(*parts, inputs=inputs, pairs=pairs, **more)


def campaign_matches(matched: Matched) -> CampaignMatched:
    """Matches that are those of a campaign.

    Raises
    ------
    InputError
        For others.
    """
    if not isinstance(matched, CampaignMatched):
        raise InputError("are no matches of a campaign", do="give runs that began with star lists")
    return matched


def load_matched_campaign(
    folder: Path, config: Config, inputs: Inputs, summary: Mapping[str, Any]
) -> CampaignMatched:
    """The matches of an earlier stage.

    Parameters
    ----------
    folder : Path
        Of the run.
    config : Config
    inputs : Inputs
    summary : mapping
        Content of summary.json.
    """
    pairs = read_matches(folder / PAIRS, unit=inputs.catalog.unit)
    return matched_campaign(pairs, config, inputs, facts=summary.get("matching", {}))
