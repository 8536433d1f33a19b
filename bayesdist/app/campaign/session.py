"""What the stages of a campaign's run share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.aberration import aberration_term
from bayesdist.app.campaign.checks import campaign_checks, campaign_remarks
from bayesdist.app.campaign.fit import load_fitted_campaign
from bayesdist.app.campaign.holdout import predictive_of_campaign
from bayesdist.app.campaign.inputs import (
    Inputs,
    campaign_block,
    errors_by_star,
    known_calibration,
    read_inputs,
    unit_arcsec_of,
)
from bayesdist.app.campaign.interpolation import interpolation_term
from bayesdist.app.campaign.matched import CampaignMatched, load_matched_campaign
from bayesdist.app.campaign.reference import free_rates
from bayesdist.app.config.campaign import CampaignBlock
from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.exposures import ExposureScatter
from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.app.session import Session
from bayesdist.assess import LocalErrors
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.forms import GIVEN, MEASURED, ErrorTerm
from bayesdist.assess.terms.parameters import ExposureVariation
from bayesdist.checks import Check
from bayesdist.data import Matches
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.overlap import overlap_test
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.infer import LinearFit
from bayesdist.infer.catalogue.star_influence import StarErrors
from bayesdist.infer.exposures.chip_offsets import Settling
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
    def pairs(self) -> Matches:
        """Raw pixels beside aberration-neutral catalogue positions, with the catalogue's errors."""
        return self.matched.stars

    @property
    def held_pairs(self) -> Matches | None:
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

    def predictive(self, found: Diagnostics) -> Predictive:
        """The posterior as it predicts what is held out."""
        return predictive_of_campaign(self, found)

    @property
    def hierarchy(self) -> LinearFit:
        """The joint fit of all exposures."""
        return self.fit

    @property
    def catalogue_errors(self) -> StarErrors | None:
        """Errors of the catalogue by code of the star; None where it has none."""
        return errors_by_star(self.inputs.catalog, self.largest_vafactor)

    def diagnosis(self) -> dict[str, Any]:
        """What a campaign has beside: a hierarchy of exposures, tables, a catalogue's errors.

        Tables that were fitted in this run have taken the structure; their errors, and what they
        leave between their nodes, are terms of the budget.  The catalogue's errors are counted by
        star where it states them.
        """
        return {
            "tested": self.tested_matches,
            "structure": self.config.tables.method == "none",
            "exposures": False,
            "settling": self.settling,
            "catalogue": self.catalogue_errors,
            "centroid": self.magnitude_errors,
        }

    def _diagnosed(self) -> Diagnostics:
        overlap = overlap_test(
            self.pairs,
            self.posterior,
            known_calibration(self.base / self.block.initial_distortion, self.block.filter),
            self.tables,
            unit_arcsec=self.unit_arcsec,
            pixel=self.scale_arcsec or 0.05,
            rolls={one.name: one.pa_v3 for one in self.inputs.log},
        )
        return replace(super()._diagnosed(), overlap=overlap)

    contained = ()  # the errors of the centroids are those that the fit has found

    def error_options(self) -> dict[str, Any]:
        """Errors are those in a new exposure, whose shift and rotation its user fits."""
        return {
            "hierarchy": self.fit,
            "catalogue": Path(self.inputs.catalog.source).name,
            "aligned": True,
            # not where the errors of tables stand for it
            "structure_left": not self.fitted.tables.position_sigma,
        }

    def terms_of(self, solution: Solution, *, alone: bool) -> tuple[ErrorTerm, ...]:
        """Error terms beside what residuals say: a new exposure deviates as those at hand."""
        others = super().terms_of(solution, alone=alone)
        if alone:
            return others
        aberration = aberration_term(self, solution)
        mean = np.asarray(solution.mean, float)
        return (
            ExposureVariation(solution.model, mean, *self.scatter, aberration=aberration),
            *others,
        )

    @property
    def tested_matches(self) -> Matches:
        """Matches with what the catalogue states of the motions of their stars."""
        table, catalog = super().tested_matches, self.inputs.catalog
        if table.star is None or catalog.pm_u is None or catalog.sigma_pm_u is None:
            return table
        columns = {}
        for name in ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"):
            by_code = np.zeros(int(catalog.star.max()) + 1)
            by_code[catalog.star] = getattr(catalog, name)
            columns[name] = by_code[table.star]
        return table.with_columns(**columns)

    @property
    def catalogue_stated(self) -> bool:
        """Whether the catalogue has errors of its own, or a row of the budget names it."""
        return self.inputs.catalog.sigma_u is not None or bool(super().catalogue_stated)

    @property
    def motions_stated(self) -> bool:
        """Whether the catalogue has errors of its motions, or a row of the budget names them."""
        return self.inputs.catalog.sigma_pm_u is not None or bool(super().motions_stated)

    def kind_checks(self, found: Sequence[Check]) -> tuple[Check, ...]:
        """Checks of matching, tables and series, and what the stages found odd."""
        remarks = campaign_remarks(self.run.summary)
        return (*remarks, *campaign_checks(self.run.summary, (*remarks, *found)))
