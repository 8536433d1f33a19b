"""The kind of run that begins with matched stars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.kinds.stars import (
    fit_stars,
    load_fitted_stars,
    match_stars,
    read_stars,
    sample_stars,
)
from bayesdist.infer import Posterior
from bayesdist.infer.stars.shards import Matches

__all__ = ["MatchesKind"]


@dataclass(frozen=True)
class MatchesKind:
    """Stars that are matched already: nothing of them is stored, they are read again."""

    rows: str = "stars"
    chooser: str = "least-squares fit"
    begins_with: str = "fit"

    def read(self, config: Config, base: Path) -> Matches:
        """The matched stars that a configuration names."""
        return read_stars(config, base)

    def refuse(self, inputs: Matches, config: Config, base: Path) -> None:
        """Nothing: what is wrong with matched stars shows in their fit."""

    def match(self, inputs: Matches, config: Config, base: Path) -> Matched:
        """Stars that are fitted, and those that are held out."""
        return match_stars(config, base, stars=inputs)

    def fit(
        self, matched: Matched, config: Config, base: Path, *, reader: StarReader | None = None
    ) -> Fitted:
        """The linear fit, with the errors that its residuals ask for."""
        return fit_stars(matched, config, reader=reader)

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """The posterior of the fit."""
        return sample_stars(data.fitted, data.shards, config, folder=folder, progress=progress)

    def load_matched(
        self, folder: Path, config: Config, base: Path, inputs: Matches, summary: Mapping[str, Any]
    ) -> Matched:
        """Stars that are fitted, and those that are held out."""
        return self.match(inputs, config, base)

    def load_fitted(
        self,
        folder: Path,
        config: Config,
        matched: Callable[[], Matched],
        summary: Mapping[str, Any],
    ) -> Fitted:
        """The fit of an earlier stage."""
        return load_fitted_stars(folder, config, summary)

    def lines(self, inputs: Matches, config: Config) -> None:
        """None: all that can be said follows from the fit."""
