"""The kind of run that begins with star lists alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.selfcal.check import selfcal_lines
from bayesdist.app.selfcal.fit import fit_selfcal, load_fitted_selfcal, sample_detections
from bayesdist.app.selfcal.given import Given, read_given
from bayesdist.app.selfcal.matched import (
    SelfcalMatched,
    load_matched_selfcal,
    selfcal_matches,
)
from bayesdist.app.selfcal.matching import match_dithers
from bayesdist.infer import Posterior
from bayesdist.products import read_idctab

__all__ = ["SelfcalKind"]


@dataclass(frozen=True)
class SelfcalKind:
    """Star lists of dithered exposures: places of the stars are solved for, too."""

    rows: str = "detections"
    chooser: str = "limits of residuals"
    begins_with: str = "match"

    def read(self, config: Config, base: Path) -> Given:
        """Detections, and what is known beside them."""
        return read_given(config, base)

    def refuse(self, inputs: Given, config: Config, base: Path) -> None:
        """Refuse exposures that cannot be laid onto each other, and a start that cannot be read.

        Raises
        ------
        BayesdistError
        """
        model, _ = inputs.start
        inputs.known_for(model)
        path = base / (inputs.block.initial_distortion or "")
        if path.suffix == ".fits":
            read_idctab(path)

    def match(self, inputs: Given, config: Config, base: Path) -> SelfcalMatched:
        """Detections with their stars, and a first solution."""
        return match_dithers(config, base, given=inputs)

    def fit(
        self, matched: Matched, config: Config, base: Path, *, reader: StarReader | None = None
    ) -> Fitted:
        """Mode and gauge, in one decision."""
        return fit_selfcal(selfcal_matches(matched))

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """The posterior, with the places of the stars eliminated."""
        return sample_detections(data.fitted, config, folder=folder, progress=progress)

    def load_matched(
        self, folder: Path, config: Config, base: Path, inputs: Given, summary: Mapping[str, Any]
    ) -> SelfcalMatched:
        """The detections of an earlier stage."""
        return load_matched_selfcal(folder, inputs, summary)

    def load_fitted(
        self,
        folder: Path,
        config: Config,
        matched: Callable[[], Matched],
        summary: Mapping[str, Any],
    ) -> Fitted:
        """The fit of an earlier stage."""
        return load_fitted_selfcal(folder, selfcal_matches(matched()), summary)

    def lines(self, inputs: Given, config: Config) -> Iterator[str]:
        """Stars and free directions."""
        return selfcal_lines(inputs)
