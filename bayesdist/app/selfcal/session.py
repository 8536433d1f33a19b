"""What the stages of a self-calibration share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesdist.app.discrepancy import RunDiscrepancy, kept_discrepancy
from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.app.selfcal.config import SelfcalBlock
from bayesdist.app.selfcal.fit import load_fitted_selfcal
from bayesdist.app.selfcal.gauge import gauge_words
from bayesdist.app.selfcal.given import Given, read_given
from bayesdist.app.selfcal.inputs import Inputs, selfcal_block
from bayesdist.app.selfcal.matched import SelfcalMatched, load_matched_selfcal
from bayesdist.app.selfcal.solved import SelfCalibrated
from bayesdist.app.session import Session
from bayesdist.assess import StarSample, UncertaintyMap, uncertainty_map
from bayesdist.assess.maps import with_local
from bayesdist.assess.solution import Solution as Assessed
from bayesdist.data import MagnitudeErrors, MatchTable, ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.diagnose import ScoreTest
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.diagnose.selfcal.misfit import dithered_misfit
from bayesdist.diagnose.selfcal.score import selfcal_score_tests
from bayesdist.infer import Matches
from bayesdist.infer.discrepancy import Discrepancy
from bayesdist.infer.selfcal import Gauge, Solution, gauge_free
from bayesdist.infer.selfcal.discrepancy import selfcal_discrepancy
from bayesdist.infer.selfcal.following import taken_by_stars
from bayesdist.infer.selfcal.relative import gauge_free_matrix

__all__ = ["SelfcalSession"]


@dataclass
class SelfcalSession(Session):
    """What the stages share: detections, stars, the solution with its stars, its gauge."""

    things = "detections"

    _given: Given | None = field(default=None, init=False, repr=False)

    @property
    def block(self) -> SelfcalBlock:
        """The self-calibration's part of the configuration."""
        return selfcal_block(self.config)

    @property
    def given(self) -> Given:
        """Detections, and what is known beside them."""
        if self._given is None:
            self._given = read_given(self.config, self.base)
        return self._given

    @property
    def matched(self) -> SelfcalMatched:
        """Detections with their stars, and a first solution."""
        return self._value("matched", self._load_matched)

    def _load_matched(self) -> SelfcalMatched:
        return load_matched_selfcal(self.run.path, self.given, self.run.summary)

    def _load_fitted(self) -> Fitted:
        return load_fitted_selfcal(self.run.path, self.matched, self.run.summary)

    @property
    def _read(self) -> tuple[Matches, ErrorLaw]:
        return self.raw_matches, QUOTED

    @property
    def inputs(self) -> Inputs:
        """Detections that pass the cuts."""
        return self.given.inputs

    @property
    def reference_catalog(self) -> ReferenceCatalog | None:
        """Reference stars, where there are any."""
        return self.given.catalog

    @property
    def detections(self) -> Detections:
        """Detections with their stars and errors, on one tangent plane."""
        return self.matched.detections

    @property
    def _solved(self) -> SelfCalibrated:
        return required(self.fitted.solved, "solution of detections")

    @property
    def solved(self) -> Solution:
        """The solution with its stars."""
        return self._solved.solution

    @property
    def gauge(self) -> Gauge:
        """What the detections leave free, and what fixes it."""
        return self._solved.gauge

    @property
    def fixed(self) -> Mapping[str, str]:
        """What fixes each property of the solution."""
        return self._solved.fixed

    @property
    def raw_matches(self) -> MatchTable:
        """Detections beside their stars, with their errors."""
        return self._solved.matches

    @property
    def centroid(self) -> MagnitudeErrors | None:  # type: ignore[override]
        """The same, less the structure that residuals show."""
        errors, found = self.magnitude_errors, self.discrepancy
        return errors if found is None else found.of_centroids(errors)

    def _sampled(self) -> StarSample:
        sample, solution = super()._sampled(), self.solved
        taken = np.zeros(len(self.detections))
        taken[solution.problem.rows] = taken_by_stars(solution)
        return replace(sample, taken=taken[sample.table.row])

    @cached_property
    def misfits(self) -> tuple[Misfit, ...]:  # type: ignore[override]
        """Structure that the solution leaves, of all chips together: they share stars."""
        return (dithered_misfit(self.solved),)

    def estimate_discrepancy(self) -> Discrepancy:
        """What the model may leave out, from the residuals with the stars eliminated."""
        return selfcal_discrepancy(
            self.solved, rng=self.rng("assess"), priors=self.config.discrepancy.priors()
        )

    @cached_property
    def discrepancy(self) -> RunDiscrepancy | None:
        """What the model may leave out; exposures overlap in part, and their frames follow it."""
        found = kept_discrepancy(self)
        return found and replace(found, frames=True)

    def made_score_tests(self) -> tuple[ScoreTest, ...]:
        """Targeted tests of the residuals for what the model lacks, with the stars eliminated."""
        matches = self.raw_matches
        return selfcal_score_tests(self.solved, mag=matches.mag, epoch=matches.epoch)

    catalogue_stated = None
    motions_stated = None

    @property
    def relative(self) -> Assessed:
        """The solution of relative positions, whatever the gauge."""
        return gauge_free(self.solution, self.gauge.null)

    def relative_map(self, **where: Any) -> UncertaintyMap:
        """Uncertainty of relative positions over a chip, with what the model leaves out."""
        found, local = self.discrepancy, None
        if found is not None:
            S = gauge_free_matrix(self.model, self.solution.mean, self.gauge.null)
            relative = replace(found.moved(S), frames=False)  # of the detector alone
            local = relative.structure_sigma(self._domain(**where))
        return with_local(uncertainty_map(self.relative, **where), local)

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand."""
        return gauge_words(self.gauge, self.fixed, self.model)

    @property
    def doubts(self) -> list[str]:
        """What cannot be known, and what the match found odd."""
        warnings = self.run.summary.get("selfcal", {}).get("warnings", [])
        known = self.given.known_for(self.model).contradictions(self.solved.theta)
        hidden = [
            f"{100 * (1 - one.told):.0f} % of the structure that the model might leave is hidden: "
            "places of stars take it up where dithers are small"
            for one in self.misfits
            if one.hidden
        ]
        return [*self.gauge.sentences, *known, *warnings, *hidden, *super().doubts]
