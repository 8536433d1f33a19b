"""Runs that begin with matched stars."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

from bayesdist.app.config import MatchesConfig
from bayesdist.app.kinds.fit_data import FitData, StarReader
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.kind import RunKind
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.matches.added_errors import grouping_sentence
from bayesdist.app.kinds.matches.plausibility import doubts_on_stars
from bayesdist.app.kinds.matches.stars import fit_stars, match_stars, read_stars
from bayesdist.data import Matches
from bayesdist.diagnose.checks import frames_doubt
from bayesdist.diagnose.residuals.epoch_shift import epoch_shift
from bayesdist.diagnose.residuals.misfit import majority_sentence


class MatchesKind(RunKind[MatchesConfig, Matches, Matched]):
    """Matched stars, which were matched by another program."""

    measures_centroids = False

    def read(self, config: MatchesConfig, base: Path) -> Matches:
        """Matched stars of the files that a configuration names."""
        return read_stars(config, base)

    def match(self, inputs: Matches, config: MatchesConfig) -> Matched:
        """Fitted and held-out stars."""
        return match_stars(inputs, config)

    def fit(
        self, matched: Matched, config: MatchesConfig, base: Path, reader: StarReader
    ) -> Fitted:
        """Least-squares solution with errors adjusted to the residuals."""
        return fit_stars(matched, config, base, reader)

    def fit_notes(self, data: FitData, config: MatchesConfig) -> Iterator[tuple[int, str]]:
        """Notes and warnings about the stars."""
        matches, fit = data.placed, data.fit
        for note in matches.notes:
            yield logging.INFO, note
        for reason, count in matches.rejected.items():
            yield logging.INFO, f"{count} rows were left out in reading: {reason}"
        for text in doubts_on_stars(data.sample, data.model, config):
            yield logging.WARNING, text
        shift = epoch_shift(data.sample, fit)
        if shift is not None and shift.significant:
            yield logging.WARNING, shift.sentence
        majority, scale = majority_sentence(fit), data.error_scale_sentence
        if scale:
            yield logging.WARNING, scale
        if text := frames_doubt(fit, data.sample, suspicious=bool(majority or scale)):
            yield logging.WARNING, text
        if data.fitted.grouped is not None:
            yield logging.INFO, grouping_sentence(data.fitted.grouped, fit.unit)
        if majority:
            yield logging.WARNING, majority


MATCHES = MatchesKind()
