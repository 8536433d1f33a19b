"""Runs that begin with matched stars."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import cast

from bayesdist.app.artefacts.stars import QUOTED, ErrorLaw, RunInput
from bayesdist.app.artefacts.stored_fit import load_errors
from bayesdist.app.kinds.kind import RunKind
from bayesdist.app.kinds.plausibility import doubt_on_positions, doubts_on_run
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches
from bayesdist.diagnose.checks import frames_doubt
from bayesdist.diagnose.residuals.epoch_shift import epoch_shift
from bayesdist.diagnose.residuals.misfit import majority_sentence
from bayesdist.errors import InputError
from bayesdist.kinds.matches.config import MatchesConfig
from bayesdist.kinds.matches.sources import read_configured, source_of
from bayesdist.kinds.matches.stars import fit_stars, match_stars, read_stars
from bayesdist.utils.checks import LARGER, Check


class MatchesKind(RunKind[MatchesConfig, Matches]):
    """Matched stars, which were matched by another program."""

    measures_centroids = False
    reads_matches = True

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
        for text in doubts_on_run(run):
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

    def checks(self, run: Run) -> tuple[Check, ...]:
        """Check of positions that were probably computed from the pixels; empty if none were."""
        text = doubt_on_positions(run)
        if not text:
            return ()
        return (Check("Matching", "Origin of the positions", "", "", "warn", text, LARGER),)

    def source(self, directory: RunDirectory) -> RunInput | None:
        """Matches in the format of a mission; None for tables."""
        config = cast(MatchesConfig, directory.config)
        source = source_of(config.data.format)
        return None if source is None else source.input_of(directory)

    def read_new_matches(
        self, config: MatchesConfig, files: Path | list[Path], release: Run, *, dated: bool
    ) -> Matches:
        """New matches, read as the section [data] states."""
        data = config.data if dated else config.data.model_copy(update={"epoch": None})
        chips = release.config.chip or config.chip
        matches = read_configured(files, data, size=config.detector.size, chips=chips)
        if data.sigma != "by_magnitude":
            return matches
        errors = load_errors(release.directory.path).by_magnitude
        if errors is None:
            raise InputError(
                "errors by magnitude are requested, but the run has measured none",
                where=", ".join(matches.sources),
                do="give data.sigma another value",
            )
        return matches.with_errors(errors)

    def errors_before_fit(self, run: Run) -> ErrorLaw | None:
        """Errors of stars of a single map at all dates; None if exposures or chips differ."""
        config = cast(MatchesConfig, run.config)
        one_frame = config.model.frames == "none" and config.time() is None
        if len(config.chips()) > 1 or not one_frame:
            return None
        return self.fit(run).errors if config.data.sigma == "by_magnitude" else QUOTED


MATCHES = MatchesKind()
