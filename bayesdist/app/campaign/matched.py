"""The matched stars of a campaign: with the lists, catalogue and log that they are from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bayesdist.app.campaign.inputs import Inputs
from bayesdist.app.config import Config
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.split import set_aside
from bayesdist.app.star_files import PAIRS, part_files
from bayesdist.data import read_matches, write_partitioned
from bayesdist.data.matches import Matches
from bayesdist.model import DistortionModel

__all__ = ["CampaignMatched", "load_matched_campaign", "matched_campaign"]

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
