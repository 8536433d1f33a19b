"""What the stages of a campaign's run share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.config import CampaignBlock
from bayesdist.app.campaign.fit import load_fitted_campaign
from bayesdist.app.campaign.holdout import predictive_of_campaign
from bayesdist.app.campaign.inputs import Inputs, campaign_block, read_inputs, unit_arcsec_of
from bayesdist.app.campaign.interpolation import interpolation_term
from bayesdist.app.campaign.matched import CampaignMatched, load_matched_campaign
from bayesdist.app.campaign.reference import free_rates
from bayesdist.app.campaign.systematics import (
    errors_by_star,
    kept_covariance,
    systematics_of,
    with_kept_stars,
)
from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.exposures import ExposureScatter
from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.app.session import Session
from bayesdist.app.systematics import Systematics
from bayesdist.assess import SAMPLE, LocalErrors
from bayesdist.assess.terms.forms import GIVEN, MEASURED
from bayesdist.data import MagnitudeErrors, MatchTable
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.infer import Matches, Posterior
from bayesdist.infer.discrepancy import Discrepancy, estimate_discrepancy
from bayesdist.infer.exposures.chip_offsets import Settling
from bayesdist.infer.nodes.alternation import with_columns
from bayesdist.infer.series import Series
from bayesdist.model import DistortionModel, LookupTable

__all__ = ["CampaignSession"]

Float = NDArray[np.float64]


@dataclass
class CampaignSession(Session):
    """What the stages share: pairs as matched, tables, scatter of the exposures, the fit."""

    _inputs: Inputs | None = field(default=None, init=False, repr=False)

    @property
    def block(self) -> CampaignBlock:
        """The campaign's part of the configuration."""
        return campaign_block(self.config)

    @property
    def inputs(self) -> Inputs:
        """Catalogue, exposures and star lists."""
        if self._inputs is None:
            self._inputs = read_inputs(self.block, self.base)
        return self._inputs

    @property
    def matched(self) -> CampaignMatched:
        """Matches of the star lists, fitted and held out."""
        return self._value("matched", self._load_matched)

    def _load_matched(self) -> CampaignMatched:
        run = self.run
        return load_matched_campaign(run.path, self.config, self.inputs, run.summary)

    def _load_fitted(self) -> Fitted:
        return load_fitted_campaign(self.run.path, self.run.summary)

    @property
    def _read(self) -> tuple[Matches, ErrorLaw]:
        return self.matches, QUOTED

    @property
    def reference_chip(self) -> int:
        """Number of the chip whose axes and zero point define the gauge."""
        return self.config.chips()[0].number

    @property
    def unit_arcsec(self) -> float:
        """Size of the catalogue's unit."""
        return unit_arcsec_of(self.inputs.catalog.unit, self.config)

    @property
    def mirrored(self) -> bool:
        """Truth of a u that has the sign opposite to the catalogue's."""
        return self.matched.mirrored

    @property
    def pairs(self) -> MatchTable:
        """Raw pixels beside aberration-neutral catalogue positions, with the catalogue's errors."""
        return self.matched.stars

    @property
    def held_pairs(self) -> MatchTable | None:
        """What is held out, in the same way; None where nothing is."""
        return self.matched.held

    @cached_property
    def raw_matches(self) -> Matches:
        """Pairs at the pixels that the tables have corrected."""
        return self.fitted.placed(self.pairs)

    @property
    def largest_vafactor(self) -> float:
        """By which the catalogue's errors are divided: all factors are nearly the same."""
        return self.inputs.largest_vafactor

    @property
    def plain_model(self) -> DistortionModel:
        """The configured polynomial with a free linear part of each exposure."""
        return self.matched.affine_model(self.config)

    @property
    def tables(self) -> tuple[LookupTable, ...]:
        """Look-up tables: the detector's, and those of the filter."""
        return self.fitted.tables.tables

    @property
    def inside_with_tables(self) -> NDArray[np.bool_]:
        """Boolean mask of the pairs that the tables do not move off their chip."""
        return self.fitted.inside(self.pairs)

    @property
    def scatter(self) -> tuple[tuple[str, ...], Float]:
        """Kinds of deviation of the exposures, and draws (n, k) of their scatter."""
        return self._joint.kinds, self._joint.tau

    @property
    def settling(self) -> Settling:
        """How the constant terms of chips follow from the shifts of single chips."""
        return self._joint.offsets

    @property
    def terms(self) -> Series:
        """Linear terms of the exposures, each fitted by itself."""
        return required(self.fitted.alone, "fits of single exposures")

    @property
    def _joint(self) -> ExposureScatter:
        return required(self.fitted.scatter, "joint fit of exposures")

    @property
    def free_rates(self) -> bool:
        """Truth of a drift that is that of this run's own exposures."""
        return free_rates(self.config)

    @property
    def structure_is_left(self) -> bool:
        """Not where the errors of tables stand for it."""
        return not self.fitted.tables.position_sigma

    @cached_property
    def local_terms(self) -> tuple[LocalErrors, ...]:
        """What the errors of the tables leave of the position, and what lies between nodes."""
        kept, grid = self.fitted.tables, self.config.assess.grid
        between = interpolation_term(kept.between, self.posterior, grid=grid, epoch=self.epoch)
        sigma, block = kept.position_sigma, self.config.tables
        if not sigma:
            return between
        source = MEASURED
        if block.detector is not None:
            given = f"{GIVEN}: errors of the detector's tables in {block.detector}"
            source = given if block.method == "none" else f"{MEASURED}, and {given}"
        tables = LocalErrors.on_grid("look-up tables", sigma, self.posterior.model, source)
        return (tables, *between)

    @property
    def between_nodes(self) -> Mapping[int, BetweenNodes]:
        """What the tables leave between their nodes, by chip, where it has been measured."""
        return self.fitted.tables.between

    @property
    def published_tables(self) -> tuple[LookupTable, ...]:
        """The tables with the errors that a user meets: of the nodes, and of what lies between.

        What is between the nodes of a pattern is at the nodes too: the value of a table there is
        that of the area around.  It counts in the tables that were fitted in this run.
        """
        out, held = [], self.config.tables.detector is not None
        for table in self.tables:
            between = self.between_nodes.get(table.chip)
            if table.sigma is not None and between is not None and bool(table.filter) == held:
                whole = np.sqrt(table.sigma**2 + between.left.mean[:, None, None])
                table = replace(table, sigma=whole)
            out.append(table)
        return tuple(out)

    @property
    def signed(self) -> Posterior:
        """The solution with the errors of the catalogue as `assess` has kept them."""
        posterior, found = with_kept_stars(self), self.discrepancy
        if found is None:
            return posterior
        return found.with_everything(posterior, kept_covariance(self))

    @cached_property
    def solution(self) -> Posterior:  # type: ignore[override]
        """What is exported and shown: all errors of the parameters are in its draws."""
        return self.signed

    @property
    def predictive(self) -> Predictive:
        """The posterior as it predicts what is held out."""
        return predictive_of_campaign(self)

    def estimate_discrepancy(self) -> Discrepancy:
        """What the model may leave out, beyond what the campaign's own hierarchy describes.

        Tables that were fitted in this run have taken the structure; their errors, and what they
        leave between their nodes, are terms of the budget.  The catalogue's errors are counted by
        star where it states them.
        """
        matches = self.matches
        assert isinstance(matches, MatchTable)
        stated = errors_by_star(self.inputs.catalog) is not None
        return estimate_discrepancy(
            self.shards,
            self.posterior,
            rng=self.rng("assess"),
            priors=self.config.discrepancy.priors(),
            parameter_priors=self.priors,
            sample=matches.sample(SAMPLE),
            stars=None if stated else matches,
            structure=self.config.tables.method == "none",
            exposures=False,
            settling=self.settling,
        )

    @property
    def tested_matches(self) -> MatchTable:
        """Matches with what the catalogue states of the motions of their stars."""
        table, catalog = super().tested_matches, self.inputs.catalog
        if table.star is None or catalog.pm_u is None or catalog.sigma_pm_u is None:
            return table
        columns = {}
        for name in ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"):
            by_code = np.zeros(int(catalog.star.max()) + 1)
            by_code[catalog.star] = getattr(catalog, name)
            columns[name] = by_code[table.star]
        return with_columns(table, **columns)

    @property
    def centroid(self) -> MagnitudeErrors | None:  # type: ignore[override]
        """The same: the catalogue's errors have been taken off, and what is left out at a place."""
        found = self.discrepancy
        return self.magnitude_errors if found is None else found.of_centroids(self.magnitude_errors)

    @property
    def catalogue_stated(self) -> bool:
        """Whether the catalogue has errors of its own, or a row of the budget names it."""
        return self.inputs.catalog.sigma_u is not None or bool(super().catalogue_stated)

    @property
    def motions_stated(self) -> bool:
        """Whether the catalogue has errors of its motions, or a row of the budget names them."""
        return self.inputs.catalog.sigma_pm_u is not None or bool(super().motions_stated)

    @property
    def further_caveats(self) -> tuple[str, ...]:
        """Deviations that go with time: no draw of the errors of a later exposure has that."""
        return tuple(self.run.summary.get("deviations", {}).get("warnings", ()))

    @property
    def doubts(self) -> list[str]:
        """What the stages found odd, and what the campaign cannot tell."""
        found = self.run.summary
        parts = ("matching", "deviations", "tables", "time_dependence")
        own = [text for part in parts for text in found.get(part, {}).get("warnings", [])]
        return [*own, *super().doubts]

    @cached_property
    def systematics(self) -> Systematics:
        """The posterior with the errors of the catalogue, and what a new exposure adds."""
        return systematics_of(self)
