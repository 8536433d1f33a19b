"""Runs that begin with star lists and a reference catalogue."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.app.kind import EvaluatedExposure, Outline, Questions, RunKind, sample_stars
from bayesdist.app.parts import TABLES, read_stored_fit, read_tables
from bayesdist.app.run import Run
from bayesdist.assess.model import with_diagnosed_errors
from bayesdist.assess.terms.correlated import LocalErrors, interpolation_term
from bayesdist.assess.terms.forms import GIVEN, MEASURED, ErrorTerm
from bayesdist.assess.terms.parameters import ExposureVariation
from bayesdist.data import Matches, ReferenceCatalog
from bayesdist.diagnose.holdout.predictive import ExposureDeviations, Predictive, predictive_of
from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.infer import GaussianPriors, LinearFit, Posterior
from bayesdist.infer.catalogue.star_covariance import StarInfluence, star_influence
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.solution.solution import Solution
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.fit import fit_campaign
from bayesdist.kinds.campaign.inputs import (
    CampaignInputs,
    errors_by_star,
    outline_of_campaign,
    read_campaign,
    refuse_campaign,
)
from bayesdist.kinds.campaign.linear_terms import (
    LinearTermScatter,
    line_sections,
    write_series_tables,
)
from bayesdist.kinds.campaign.matching import (
    aberration_term,
    campaign_lines,
    is_mirrored,
    load_matched_campaign,
    match_lists,
    overlap_of,
)
from bayesdist.report.run import Terminology
from bayesdist.utils.checks import COMPLETENESS, FALSE_MATCHES, LARGER, Check, level_of
from bayesdist.utils.text import count, percent

if TYPE_CHECKING:
    from bayesdist.infer.compare.monitoring import NewFit
    from bayesdist.kinds.campaign.report.data import CampaignData

HELD_BY_PRIOR = 0.99  # ratio to the prior sigma above which the data determine nothing
NEW_EXPOSURE = "a new exposure whose shift and rotation are fitted by its user"
SAMPLING = 1  # number of the random stream of the stage 'sample', derived from the seed
TOGETHER = 1.5  # node spacings over which errors of tables are correlated, from their covariance

PAIRED = Terminology(
    prints_data=False,
    whom=f" for {NEW_EXPOSURE}",
    new_exposure=f"For {NEW_EXPOSURE}: what a shift and a rotation of all chips together take up is"
    " no error here.",
    residuals=" These are the residuals of the joint fit, with all tables, in the cells of the test"
    " for structure (see the status).",
)

GROUP = "Campaign"

# sections with warnings for the reader, their titles, and their effect on verdicts; deviations that
# drift with time are not included in the errors drawn for a later exposure
WARNING = {
    "matching": ("Matching", ""),
    "deviations": ("Deviations of the exposures", LARGER),
    "tables": ("Look-up tables", ""),
    "time_dependence": ("Time dependence", ""),
}


class CampaignKind(RunKind[CampaignConfig, CampaignInputs]):
    """Star lists, which are matched to a reference catalogue; exposures are fitted jointly."""

    words = PAIRED
    section = "matching"
    along_detector = True

    def read(self, config: CampaignConfig, base: Path) -> CampaignInputs:
        """Catalogue, exposure log and star lists."""
        return read_campaign(config, base)

    def refuse(self, inputs: CampaignInputs) -> None:
        """Refuse inconsistent inputs, and files of other runs that cannot be used."""
        refuse_campaign(inputs)

    def lines(self, inputs: CampaignInputs) -> Iterator[str]:
        """Lines about the inputs, dates and roll angles."""
        return campaign_lines(inputs)

    def outline(self, inputs: CampaignInputs) -> Outline:
        """Shape of the solution, with its look-up tables."""
        return outline_of_campaign(inputs)

    def with_config(self, inputs: CampaignInputs, config: CampaignConfig) -> CampaignInputs:
        """Inputs for another configuration, which differs in the model only."""
        return replace(inputs, config=config)

    def match(self, run: Run) -> Run:
        """Run with the stars that match the catalogue."""
        return match_lists(run)

    def load_matched(self, run: Run) -> Run:
        """Run with the pairs of an earlier stage."""
        return load_matched_campaign(run)

    def fit(self, run: Run) -> Run:
        """Run with look-up tables, errors, and all exposures fitted jointly and each alone."""
        return fit_campaign(run)

    def load_fit(self, run: Run) -> Run:
        """Run with the fit of an earlier stage and its look-up tables."""
        folder = run.directory.path
        artefacts = read_stored_fit(folder)
        tables = read_tables(folder / TABLES, do="run the stage 'fit' again")
        return run.having(**{**artefacts, "parts": {"tables": tables, **artefacts["parts"]}})

    def fit_notes(self, run: Run) -> Iterator[tuple[int, str]]:
        """Warnings about deviations of the exposures, and the scatter of the exposures."""
        facts = run.fit_facts
        for text in facts["deviations"]["warnings"]:
            yield logging.WARNING, text
        sizes = ", ".join(f"{name} {term['value']:.2g}" for name, term in facts["scatter"].items())
        yield logging.INFO, f"scatter of the exposures {sizes}"

    def sample(
        self,
        run: Run,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """Posterior in which each chip has its mean position over the exposures."""
        posterior = sample_stars(run, folder=folder, progress=progress)
        rng = np.random.default_rng([run.config.sampler.seed, SAMPLING])
        return run.part(LinearTermScatter).averaged(posterior, rng)

    def questions(self, run: Run) -> Questions:
        """Structure is tested if no tables were fitted; their errors are in the budget."""
        return Questions(
            centroid=run.errors.by_magnitude,
            structure=run.config.tables.method == "none",
            exposures=False,
            settling=run.part(LinearTermScatter).offsets,
        )

    def overlap(self, run: Run) -> OverlapTest | None:
        """Comparison of two exposures far apart in time; None if there is no such pair."""
        return overlap_of(run)

    def save_diagnosed(self, run: Run) -> None:
        """Write the linear terms of the exposures as a function of time."""
        write_series_tables(run)

    def predictive(self, run: Run) -> Predictive:
        """Prediction with the scatter of exposures, and errors of catalogue and tables."""
        scatter, settings = run.part(LinearTermScatter), run.evaluation_settings
        cell, tables = None, run.tables.tables
        if tables:
            across, up = tables[0].step
            cell = TOGETHER * across, TOGETHER * up
        return replace(
            predictive_of(with_diagnosed_errors(run.posterior, run.diagnostics, run.fit)),
            deviations=ExposureDeviations(scatter.kinds, scatter.tau),
            stars=_reference_stars(run),
            local=run.error_model.local_tables(settings.grid, settings.epoch),
            cell=cell,
        )

    def error_terms(self, run: Run, solution: Solution) -> list[ErrorTerm]:
        """Deviation of a new exposure, errors of the tables, and what the user states.

        The deviation is the measured scatter, which includes velocity aberration.
        """
        scatter, config = run.part(LinearTermScatter), run.config
        deviation = ExposureVariation(
            solution.model,
            np.asarray(solution.mean, float),
            scatter.kinds,
            scatter.tau,
            aberration=aberration_term(scatter.kinds, scatter.tau, run.inputs, solution),
        )
        stated = self.stated_terms(run, solution)
        tables = _table_terms(run, solution)
        return [deviation, *config.linear_terms(solution), *tables, *stated]

    def domain(self, run: Run) -> EvaluatedExposure:
        """A new exposure, whose user fits shift and rotation."""
        return EvaluatedExposure(aligned=True, structure_left=not run.tables.position_sigma)

    def checks(self, run: Run) -> tuple[Check, ...]:
        """Checks of matching, look-up tables and exposures."""
        facts = {self.section: run.match_facts, **run.fit_facts}
        return campaign_checks(facts | {"time_dependence": run.time_dependence})

    def evaluation_sections(self, run: Run) -> dict[str, Any]:
        """Linear terms as lines in time."""
        return line_sections(run.solution, run.config.chips()[0].number)

    def held_parameters(self, run: Run) -> frozenset[str]:
        """Names of coefficients and rates that their prior determines rather than the data.

        Deviations of single exposures are not included, because their prior is the measured
        scatter.
        """
        return held_by_prior(run.fit, run.priors)

    def report_data(self, run: Run) -> CampaignData:
        """Catalogue, matching, residuals without and with tables, and series."""
        from bayesdist.kinds.campaign.report.prepared import data_of_campaign  # needed by one stage

        return data_of_campaign(run)

    def fit_of_new_exposures(
        self, release: Run, new: Path
    ) -> tuple[Matches, NewFit, tuple[str, ...]]:
        """Fit of new exposures, which scatter as those of the release do."""
        from bayesdist.kinds.campaign.fit import fit_new_exposures  # for one command

        return fit_new_exposures(release, new)

    def catalogue(self, run: Run) -> ReferenceCatalog:
        """Reference catalogue with the stars that are used."""
        inputs: CampaignInputs = run.inputs
        return inputs.catalog

    def star_errors(self, run: Run) -> StarErrors | None:
        """Errors of the catalogue by star code, along u and v; None if there are none."""
        inputs: CampaignInputs = run.inputs
        mirrored = is_mirrored(run.match_facts)
        return errors_by_star(inputs.catalog, inputs.largest_vafactor, mirrored=mirrored)

    def filter(self, run: Run) -> str:
        """Filter of the exposures."""
        inputs: CampaignInputs = run.inputs
        return inputs.filter


def held_by_prior(fit: LinearFit, priors: GaussianPriors) -> frozenset[str]:
    """Names of coefficients and rates that their prior determines rather than the data."""
    share = fit.sigma * np.sqrt(priors.precision)
    return frozenset(
        p.name
        for p, ratio in zip(fit.model.parameters, share, strict=True)
        if p.kind != "frame" and ratio > HELD_BY_PRIOR
    )


def _reference_stars(run: Run) -> StarInfluence | None:
    """Influence of the catalogue errors on the fit, for stars of exposures held out entirely.

    These stars were fitted in other exposures, which does not show in their residuals.
    """
    errors, held = run.kind.star_errors(run), run.held_stars
    if errors is None or held is None or held.star is None:
        return None
    is_held = np.isin(held.exposure_names, run.held_exposures)
    codes = np.unique(held.star[is_held[held.exposure]])
    return star_influence(run.fit, run.matches, errors, codes)


def _table_terms(run: Run, solution: Solution) -> tuple[LocalErrors, ...]:
    """Terms for the errors of the tables, and for the distortion between their nodes."""
    stored, block, grid = run.tables, run.config.tables, run.config.assess.grid
    between = interpolation_term(stored.between, solution, grid=grid, epoch=run.epoch)
    if not stored.position_sigma:
        return between
    source = MEASURED
    if block.detector is not None:
        of_detector = f"{GIVEN}: errors of the detector's tables in {block.detector}"
        source = of_detector if block.method == "none" else f"{MEASURED}, and {of_detector}"
    name = "look-up tables"
    tables = LocalErrors.on_grid(name, stored.position_sigma, solution.model, source)
    return (tables, *between)


def campaign_checks(summary: Mapping[str, Any]) -> tuple[Check, ...]:
    """Checks of matching, tables and series, including warnings of their stages."""
    m, tables, time = (summary.get(k) or {} for k in ("matching", "tables", "time_dependence"))
    lowest = float(m["completeness"]["least"])
    false = float(m["false_fraction"])
    out = [
        Check(
            GROUP,
            "Matching: completeness of the exposures",
            f"{percent(m['completeness']['median'])} at the median, {percent(lowest)} at least",
            f"at least {percent(COMPLETENESS.value, 2)} in each",
            level_of(COMPLETENESS.met_by(lowest), "warn"),
        ),
        Check(
            GROUP,
            "Matching: false pairs expected",
            percent(false, 2),
            f"at most {percent(FALSE_MATCHES.value, 2)}",
            level_of(FALSE_MATCHES.met_by(false), "warn"),
        ),
    ]
    if m.get("left_out"):
        names = "; ".join(m["left_out"])
        out.append(Check(GROUP, "Matching: exposures left out", names, "none", "warn"))
    if "converged" in tables:
        out.append(_converged("Look-up tables converged", tables))
    if "converged" in time:
        out.append(_converged("Series of linear terms converged", time))
        off = len(time.get("outlying_exposures", ()))
        out.append(Check(GROUP, "Exposures that lie off the lines", count(off)))
    for title, key in (
        ("Exposures that went wrong in the joint fit", "exposures_outlying"),
        ("Exposures that could not be fitted alone", "exposures_skipped"),
    ):
        names = ", ".join(str(name) for name in summary.get(key) or ())
        if names:
            out.append(Check(GROUP, title, names, "none", "warn"))
    out += [
        Check(GROUP, name, level="warn", sentence=text, doubt=doubt)
        for part, (name, doubt) in WARNING.items()
        for text in summary.get(part, {}).get("warnings", [])
    ]
    return tuple(out)


CAMPAIGN = CampaignKind()


def _converged(what: str, section: Mapping[str, Any]) -> Check:
    good = bool(section["converged"])
    return Check(GROUP, what, "yes" if good else "NO", "yes", level_of(good, "warn"))
