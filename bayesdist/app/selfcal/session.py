"""What the stages of a self-calibration share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config.selfcal import SelfcalBlock
from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.fitted import Fitted, required
from bayesdist.app.selfcal.fit import load_fitted_selfcal
from bayesdist.app.selfcal.gauge import gauge_words
from bayesdist.app.selfcal.given import Given, read_given
from bayesdist.app.selfcal.inputs import Inputs, selfcal_block
from bayesdist.app.selfcal.matched import SelfcalMatched, load_matched_selfcal
from bayesdist.app.selfcal.solved import SelfCalibrated
from bayesdist.app.session import Session
from bayesdist.checks import Check
from bayesdist.data import Matches, ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.infer.selfcal import Gauge, Solution

Float = NDArray[np.float64]

__all__ = ["SelfcalSession"]


@dataclass
class SelfcalSession(Session):
    """What the stages share: detections, stars, the solution with its stars, its gauge."""

    things = "detections"
    chooser = "limits of residuals"

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
    def raw_matches(self) -> Matches:
        """Detections beside their stars, with their errors."""
        return self._solved.matches

    contained = ()  # the errors of the centroids are those that the fit has found

    def diagnosis(self) -> dict[str, Any]:
        """The solution with its stars, which were fitted too."""
        return {"eliminated": self.solved, "centroid": self.magnitude_errors}

    def error_options(self) -> dict[str, Any]:
        """Exposures overlap in part, and their frames follow correlated errors."""
        return super().error_options() | {"frames": True}

    catalogue_stated = None
    motions_stated = None

    @property
    def free_directions(self) -> Float:
        """Directions (D, d) that the detections leave free."""
        return self.gauge.null

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand."""
        return gauge_words(self.gauge, self.fixed, self.model)

    def kind_checks(self, found: Sequence[Check]) -> tuple[Check, ...]:
        """What cannot be known, and what the match found odd."""
        warnings = self.run.summary.get("selfcal", {}).get("warnings", [])
        known = self.given.known_for(self.model).contradictions(self.solved.theta)
        return tuple(
            Check("Gauge", level="warn", sentence=text)
            for text in (*self.gauge.sentences, *known, *warnings)
        )
