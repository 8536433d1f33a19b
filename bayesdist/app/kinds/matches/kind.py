"""Runs that begin with matched stars."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

from bayesdist.app.config import MatchesConfig
from bayesdist.app.kinds.kind import RunKind
from bayesdist.app.kinds.matches.stars import fit_stars, match_stars, read_stars
from bayesdist.app.kinds.plausibility import doubts_on_stars
from bayesdist.app.run import Run
from bayesdist.data import Matches
from bayesdist.diagnose.checks import frames_doubt
from bayesdist.diagnose.residuals.epoch_shift import epoch_shift
from bayesdist.diagnose.residuals.misfit import majority_sentence


class MatchesKind(RunKind[MatchesConfig, Matches]):
    """Matched stars, which were matched by another program."""

    measures_centroids = False

    def read(self, config: MatchesConfig, base: Path) -> Matches:
        """Matched stars of the files that a configuration names."""
        return read_stars(config, base)

    def match(self, run: Run) -> Run:
        """Run with fitted and held-out stars."""
        return match_stars(run)

    def fit(self, run: Run) -> Run:
        """Run with a least-squares solution, whose errors are adjusted to the residuals."""
        return fit_stars(run)

    def fit_notes(self, run: Run) -> Iterator[tuple[int, str]]:
        """Notes and warnings about the stars."""
        matches, fit = run.placed, run.fit
        for note in matches.notes:
            yield logging.INFO, note
        for reason, count in matches.rejected.items():
            yield logging.INFO, f"{count} rows were left out in reading: {reason}"
        for text in doubts_on_stars(run.sample, run.model, run.config):
            yield logging.WARNING, text
        shift = epoch_shift(run.sample, fit)
        if shift is not None and shift.significant:
            yield logging.WARNING, shift.sentence
        majority, scale = majority_sentence(fit), run.error_scale_sentence
        if scale:
            yield logging.WARNING, scale
        if text := frames_doubt(fit, run.sample, suspicious=bool(majority or scale)):
            yield logging.WARNING, text
        if run.added_errors is not None:
            yield logging.INFO, run.added_errors.sentence(fit.unit)
        if majority:
            yield logging.WARNING, majority


MATCHES = MatchesKind()
