"""The kind of run that begins with star lists and a catalogue."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesdist.app.campaign.check import campaign_lines
from bayesdist.app.campaign.fit import fit_campaign, load_fitted_campaign
from bayesdist.app.campaign.inputs import Inputs, campaign_block, read_inputs
from bayesdist.app.campaign.matched import (
    CampaignMatched,
    campaign_matches,
    load_matched_campaign,
)
from bayesdist.app.campaign.matching import match_lists
from bayesdist.app.campaign.reference import rehearse_references
from bayesdist.app.campaign.soundness import refuse_unsound
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.kinds.stars import sample_stars
from bayesdist.infer import Posterior
from bayesdist.products import read_idctab

__all__ = ["CampaignKind"]


@dataclass(frozen=True)
class CampaignKind:
    """Star lists of exposures, which are matched with a catalogue and fitted jointly."""

    rows: str = "stars"
    chooser: str = "least-squares fit"
    begins_with: str = "match"

    def read(self, config: Config, base: Path) -> Inputs:
        """Catalogue, exposures and star lists."""
        return read_inputs(campaign_block(config), base)

    def refuse(self, inputs: Inputs, config: Config, base: Path) -> None:
        """Refuse what does not go together, and files of others that cannot be used.

        Raises
        ------
        BayesdistError
        """
        refuse_unsound(config, inputs)
        read_idctab(base / campaign_block(config).initial_distortion)
        rehearse_references(config, inputs.catalog.unit, base)
        if config.products.release is not None:
            read_idctab(base / config.products.release.reference)

    def match(self, inputs: Inputs, config: Config, base: Path) -> CampaignMatched:
        """Star lists matched with the catalogue, exposure by exposure."""
        return match_lists(config, base, inputs=inputs)

    def fit(
        self, matched: Matched, config: Config, base: Path, *, reader: StarReader | None = None
    ) -> Fitted:
        """Tables, errors, all exposures jointly, and every one alone."""
        return fit_campaign(campaign_matches(matched), config, base)

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """The posterior of the joint fit, with the chips averaged."""
        return sample_stars(data.fitted, data.shards, config, folder=folder, progress=progress)

    def load_matched(
        self, folder: Path, config: Config, base: Path, inputs: Inputs, summary: Mapping[str, Any]
    ) -> CampaignMatched:
        """The matches of an earlier stage."""
        return load_matched_campaign(folder, config, inputs, summary)

    def load_fitted(
        self,
        folder: Path,
        config: Config,
        matched: Callable[[], Matched],
        summary: Mapping[str, Any],
    ) -> Fitted:
        """The fit of an earlier stage."""
        return load_fitted_campaign(folder, summary)

    def lines(self, inputs: Inputs, config: Config) -> Iterator[str]:
        """Inputs, dates and roll angles."""
        return campaign_lines(inputs, config)
