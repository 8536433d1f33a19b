"""Runs that begin with star lists and a reference catalogue."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.config import CampaignConfig, Config
from bayesdist.app.kinds.campaign.checks import campaign_checks
from bayesdist.app.kinds.campaign.fit import fit_campaign
from bayesdist.app.kinds.campaign.input_validation import refuse_campaign
from bayesdist.app.kinds.campaign.inputs import Inputs, outline_of_campaign, read_campaign
from bayesdist.app.kinds.campaign.linear_terms import line_sections
from bayesdist.app.kinds.campaign.matched import CampaignMatched, load_matched_campaign
from bayesdist.app.kinds.campaign.matching import campaign_lines, match_lists
from bayesdist.app.kinds.campaign.parts import ExposureScatter
from bayesdist.app.kinds.fit_data import FitData, StarReader, assessment_epoch
from bayesdist.app.kinds.fitted import Fitted, load_fitted
from bayesdist.app.kinds.kind import EvaluationDomain, Questions, RunKind
from bayesdist.app.kinds.matched import Outline
from bayesdist.app.kinds.parts import TABLES, read_tables
from bayesdist.app.kinds.sampling import sample_stars
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.model import ErrorModel, with_diagnosed_errors
from bayesdist.assess.terms.correlated import LocalErrors, interpolation_term
from bayesdist.assess.terms.forms import GIVEN, MEASURED, ErrorTerm
from bayesdist.assess.terms.parameters import ExposureVariation
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.holdout.predictive import ExposureDeviations, Predictive, predictive_of
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_errors import StarInfluence, star_influence
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.checks import Check

SAMPLING = 1  # number of the random stream of the stage 'sample', derived from the seed
TOGETHER = 1.5  # node spacings over which errors of tables are correlated, from their covariance


class CampaignKind(RunKind[CampaignConfig, Inputs, CampaignMatched]):
    """Star lists, which are matched to a reference catalogue; exposures are fitted jointly."""

    def read(self, config: CampaignConfig, base: Path) -> Inputs:
        """Catalogue, exposure log and star lists."""
        return read_campaign(config, base)

    def refuse(self, inputs: Inputs) -> None:
        """Refuse inconsistent inputs, and files of other runs that cannot be used."""
        refuse_campaign(inputs)

    def lines(self, inputs: Inputs) -> Iterator[str]:
        """Lines about the inputs, dates and roll angles."""
        return campaign_lines(inputs)

    def outline(self, inputs: Inputs) -> Outline:
        """Shape of the solution, with its look-up tables."""
        return outline_of_campaign(inputs)

    def match(self, inputs: Inputs, config: CampaignConfig) -> CampaignMatched:
        """Stars that match the catalogue."""
        return match_lists(inputs)

    def load_matched(
        self, folder: Path, inputs: Inputs, config: CampaignConfig, summary: Mapping[str, Any]
    ) -> CampaignMatched:
        """Pairs of an earlier stage."""
        return load_matched_campaign(folder, inputs, summary)

    def fit(
        self, matched: CampaignMatched, config: CampaignConfig, base: Path, reader: StarReader
    ) -> Fitted:
        """Look-up tables, errors, all exposures jointly, and each exposure alone."""
        return fit_campaign(matched)

    def load_fitted(self, folder: Path, matched: Callable[[], CampaignMatched]) -> Fitted:
        """Fit of an earlier stage with its look-up tables."""
        fitted = load_fitted(folder)
        tables = read_tables(folder / TABLES, do="run the stage 'fit' again")
        return replace(fitted, parts={"tables": tables, **fitted.parts})

    def fit_notes(self, data: FitData, config: CampaignConfig) -> Iterator[tuple[int, str]]:
        """Warnings about deviations of the exposures, and the scatter of the exposures."""
        facts = data.fitted.facts
        for text in facts["deviations"]["warnings"]:
            yield logging.WARNING, text
        sizes = ", ".join(f"{name} {term['value']:.2g}" for name, term in facts["scatter"].items())
        yield logging.INFO, f"scatter of the exposures {sizes}"

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """Posterior in which each chip has its mean position over the exposures."""
        posterior = sample_stars(data, config, folder=folder, progress=progress)
        rng = np.random.default_rng([config.sampler.seed, SAMPLING])
        return data.fitted.part(ExposureScatter).averaged(posterior, rng)

    def questions(self, data: FitData, config: CampaignConfig) -> Questions:
        """Structure is tested if no tables were fitted; their errors are in the budget."""
        return Questions(
            centroid=data.fitted.errors.by_magnitude,
            structure=config.tables.method == "none",
            exposures=False,
            settling=data.fitted.part(ExposureScatter).offsets,
        )

    def save_diagnosed(
        self,
        run: RunDirectory,
        data: FitData,
        posterior: Posterior,
        diagnostics: Diagnostics,
        config: CampaignConfig,
    ) -> None:
        """Write the linear terms of the exposures as a function of time."""
        from bayesdist.app.kinds.campaign import series  # slow to import

        series.write_series_tables(run, data.fitted, config)

    def predictive(
        self,
        posterior: Posterior,
        diagnostics: Diagnostics,
        errors: ErrorModel,
        data: FitData,
        settings: EvaluationSettings,
    ) -> Predictive:
        """Prediction with the scatter of exposures, and errors of catalogue and tables."""
        scatter = data.fitted.part(ExposureScatter)
        cell, tables = None, data.fitted.tables.tables
        if tables:
            across, up = tables[0].step
            cell = TOGETHER * across, TOGETHER * up
        return replace(
            predictive_of(with_diagnosed_errors(posterior, diagnostics, data.fit)),
            deviations=ExposureDeviations(scatter.kinds, scatter.tau),
            stars=_reference_stars(data),
            local=errors.local_tables(settings.grid, settings.epoch),
            cell=cell,
        )

    def error_terms(self, solution: Solution, data: FitData, config: Config) -> list[ErrorTerm]:
        """Deviation of a new exposure, errors of the tables, and what the user states.

        The deviation is the measured scatter, which includes velocity aberration.
        """
        scatter = data.fitted.part(ExposureScatter)
        deviation = ExposureVariation(
            solution.model,
            np.asarray(solution.mean, float),
            scatter.kinds,
            scatter.tau,
            aberration=data.matched.aberration(scatter.kinds, scatter.tau, solution),
        )
        stated = config.user_terms(solution.model.unit)
        tables = _table_terms(solution, data, config)
        return [deviation, *config.linear_terms(solution), *tables, *stated]

    def domain(self, data: FitData, config: Config) -> EvaluationDomain:
        """A new exposure, whose user fits shift and rotation."""
        return EvaluationDomain(aligned=True, structure_left=not data.fitted.tables.position_sigma)

    def checks(self, data: FitData, series: Mapping[str, Any]) -> tuple[Check, ...]:
        """Checks of matching, look-up tables and exposures."""
        facts = {data.matched.section: data.matched.facts, **data.fitted.facts}
        return campaign_checks(facts | {"time_dependence": series})

    def evaluation_sections(self, solution: Solution, config: CampaignConfig) -> dict[str, Any]:
        """Linear terms as lines in time."""
        return line_sections(solution, config.chips()[0].number)

    def report_parts(
        self,
        run: RunDirectory,
        data: FitData,
        posterior: Posterior,
        diagnostics: Diagnostics,
        epoch: float | None,
    ) -> dict[str, Any]:
        """Catalogue, matching, tables and series, and the words of a campaign."""
        from bayesdist.app.kinds.campaign.report import report_fields  # needed by one stage

        return report_fields(run, data, posterior, diagnostics.overlap)


def _reference_stars(data: FitData) -> StarInfluence | None:
    """Influence of the catalogue errors on the fit, for stars of exposures held out entirely.

    These stars were fitted in other exposures, which does not show in their residuals.
    """
    errors, held = data.matched.star_errors, data.matched.held
    if errors is None or held is None or held.star is None:
        return None
    is_held = np.isin(held.exposure_names, data.matched.whole)
    codes = np.unique(held.star[is_held[held.exposure]])
    return star_influence(data.fit, data.stars, errors, codes)


def _table_terms(solution: Solution, data: FitData, config: Config) -> tuple[LocalErrors, ...]:
    """Terms for the errors of the tables, and for the distortion between their nodes."""
    stored, block = data.fitted.tables, config.tables
    epoch = assessment_epoch(data, config)
    between = interpolation_term(stored.between, solution, grid=config.assess.grid, epoch=epoch)
    if not stored.position_sigma:
        return between
    source = MEASURED
    if block.detector is not None:
        of_detector = f"{GIVEN}: errors of the detector's tables in {block.detector}"
        source = of_detector if block.method == "none" else f"{MEASURED}, and {of_detector}"
    name = "look-up tables"
    tables = LocalErrors.on_grid(name, stored.position_sigma, solution.model, source)
    return (tables, *between)


CAMPAIGN = CampaignKind()
