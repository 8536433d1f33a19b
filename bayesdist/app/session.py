"""What the stages of one run share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.added_errors import compared_errors, kept_grouped_errors
from bayesdist.app.chips import check_chips
from bayesdist.app.config import CATALOGUE_WORDS, Config
from bayesdist.app.derived import Derived
from bayesdist.app.diagnostics_files import load_diagnostics, save_diagnostics
from bayesdist.app.holdout import predictive_of_run, split_of, whole_exposures
from bayesdist.app.matches import load_matches, reading_options
from bayesdist.app.periods import period_settings
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.rvb import RvbInput
from bayesdist.assess import SAMPLE, pixel_scale_of
from bayesdist.assess.error_model import ErrorModel, error_model, solution_with_errors
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.terms.local import LocalErrors
from bayesdist.checks import Check
from bayesdist.data import MagnitudeErrors, MatchTable
from bayesdist.data.holdout import Split
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose, diagnose_fit, hold_out
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.residuals.quoted import error_scale, error_scale_sentence
from bayesdist.errors import ConfigError, DegenerateError, NotSettledError
from bayesdist.files import atomic_path
from bayesdist.infer import (
    GaussianPriors,
    LinearFit,
    Matches,
    Posterior,
    Shards,
    build_model,
    fit_by_magnitude,
    fit_linear,
    load,
    load_fit,
    load_posterior,
)
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.exposures.frame_choice import FrameChoice, frames_that_help
from bayesdist.infer.linear import Rejection
from bayesdist.model import DistortionModel

Float = NDArray[np.float64]

__all__ = ["ERROR_COLUMNS", "STAGES", "Session", "write_table"]

STAGES = ("match", "fit", "sample", "assess", "export", "report")

ERROR_COLUMNS = ("mag", "sigma_u", "sigma_v", "n", "scatter_u", "scatter_v")


@dataclass
class Session:
    """What the stages of one run share; everything is read when it is first needed.

    Parameters
    ----------
    run : RunDirectory
    progress : callable, optional
        Called with (steps made, most steps) while sampling.
    """

    run: RunDirectory
    progress: Callable[[int, int], None] | None = None
    _derived: Derived = field(default_factory=Derived, init=False, repr=False)

    @cached_property
    def config(self) -> Config:
        """The resolved configuration."""
        return self.run.config

    @cached_property
    def _split(self) -> Split | None:
        """Matches that are fitted and those that are held out, where some are."""
        return None if self.config.holdout is None else split_of(self, self._all_matches)

    @property
    def raw_matches(self) -> Matches:
        """Matches as read, without those that are held out."""
        return self._all_matches if self._split is None else self._split.kept

    things = "stars"  # what a row of the data is, in words
    chooser = "least-squares fit"  # what leaves out rows that are far off
    needed_exposures = 0  # the first ones, which cannot be held out

    @property
    def held_matches(self) -> Matches | None:
        """Those that are held out, with their errors; None where there are none."""
        if self._split is None:
            return None
        held, errors = self._split.held, self.magnitude_errors
        return self.with_added_errors(
            held if errors is None else held.with_errors_by_magnitude(errors)
        )

    @property
    def in_circle(self) -> bool:
        """Whether the likelihood is that of stars matched in circles about nominal positions."""
        if self.config.data is None or self.config.outliers.match_radius is None:
            return False
        return self._all_matches.has_nominal

    @cached_property
    def error_scale(self) -> float:
        """Factor on all quoted errors that the fit found them to need; 1 where they will do."""
        return float(self.run.summary.get("fit", {}).get("error_scale", 1.0))

    @property
    def error_scale_sentence(self) -> str:
        """What was done to quoted errors that are far too small; empty where they will do."""
        if self.error_scale == 1.0:
            return ""
        return error_scale_sentence(
            self.error_scale,
            self.shards.survey.reference_sigma,
            self.model.unit,
            by_magnitude=self.raw_matches.has_mag,
        )

    @cached_property
    def grouped_errors(self) -> GroupedErrors | None:
        """Errors beyond the quoted ones by groups of stars; None where these are not compared."""
        return kept_grouped_errors(self.run.summary.get("fit", {}).get("added_errors"))

    def with_added_errors(self, matches: Matches) -> Matches:
        """Matches with what their group has beyond the quoted errors and the jitter."""
        added = None if self.grouped_errors is None else self.grouped_errors.added
        return matches if added is None else matches.with_added_errors(added)

    @cached_property
    def _all_matches(self) -> Matches:
        """Matches as read, their errors multiplied by `error_scale`."""
        matches = self._read_matches()
        if self.error_scale != 1.0:
            matches = matches.with_errors_times(self.error_scale)
        if matches.has_nominal:
            try:  # columns may be found by their names
                self.config.refuse_circle()
            except ValueError as error:
                cause, _, do = str(error).partition("; ")
                raise ConfigError(cause, where=", ".join(matches.sources), do=do) from None
        return matches

    def _read_matches(self) -> Matches:
        data = self.config.data
        assert data is not None
        if data.format == "rvb":
            return self._rvb.load()
        return load_matches(self.run.matches, **reading_options(data, self.config.chip))

    @cached_property
    def _rvb(self) -> RvbInput:
        """RvB pairs, where the configuration names such."""
        return RvbInput(self.run)

    def begun(self) -> None:
        """Move into the run's folder what was prepared beside it: the run has begun."""
        if "_rvb" in self.__dict__ and self._rvb.settle():
            for name in ("_all_matches", "_split", "matches"):
                self.__dict__.pop(name, None)
            if self.config.compute.engine == "dask":  # workers may read the pairs again
                self.errors_changed()

    @cached_property
    def magnitude_errors(self) -> MagnitudeErrors | None:
        """Errors by magnitude, as the fit left them."""
        assert self.config.data is not None
        return self.kept_errors() if self.config.data.sigma == "by_magnitude" else None

    def kept_errors(self) -> MagnitudeErrors | None:
        """Errors by magnitude that an earlier stage wrote; None where there are none."""
        path = self.run / "magnitude_errors.ecsv"
        if not path.exists():
            return None
        table = Table.read(path)
        return MagnitudeErrors(**{name: np.asarray(table[name]) for name in ERROR_COLUMNS})

    @cached_property
    def matches(self) -> Matches:
        """Matches with their errors."""
        raw, errors = self.raw_matches, self.magnitude_errors
        return self.with_added_errors(
            raw if errors is None else raw.with_errors_by_magnitude(errors)
        )

    @cached_property
    def shards(self) -> Shards:
        """All stars as the passes go over them: they are read once."""
        shards = load(self.model, self.matches, self.config.resources())
        if self.in_circle:  # said before anything is fitted
            shards.survey.check_circle(self.config.outliers.match_radius)
        return shards

    def errors_changed(self) -> None:
        """Forget what rests on the errors of the stars."""
        shards = self.__dict__.get("shards")
        if shards is not None:
            shards.close()
        for name in (
            "matches",
            "magnitude_errors",
            "shards",
            "_sample",
        ):
            self.__dict__.pop(name, None)

    def close(self) -> None:
        """Let go of the data, and of whoever holds them."""
        if "shards" in self.__dict__:
            self.__dict__.pop("shards").close()
        if "_rvb" in self.__dict__:
            self._rvb.close()

    @cached_property
    def model(self) -> DistortionModel:
        """The model that the configuration asks for."""
        config = self.config
        check_chips(config.chips(), self.raw_matches.chip_numbers)
        return build_model(
            self.raw_matches,
            order=config.model.order,
            size=config.detector.size,
            reference_pixel=config.model.reference_pixel,
            name=config.detector.name,
            chips=config.chips(),
            frames=config.model.frames,
            time=config.time(),
        )

    @cached_property
    def priors(self) -> GaussianPriors:
        """Priors of the model's parameters."""
        named = {p.parameter: (p.mean, p.sigma) for p in self.config.prior}
        return GaussianPriors.of(self.model, named)

    def settled(self, posterior: Posterior) -> Posterior:
        """The posterior as the stages that follow take it."""
        return posterior

    @cached_property
    def linear(self) -> tuple[LinearFit, MagnitudeErrors | None]:
        """The linear fit that the configuration asks for, made now; nothing is written.

        Raises
        ------
        InputError
            Where it cannot be made; with the frames of the exposures that would help.
        """
        try:
            return self._linear()
        except (DegenerateError, NotSettledError) as error:
            if self.better_frames is None:
                raise
            do = self.better_frames.sentence
            raise type(error)(error.cause, where=error.where, do=do) from error

    @cached_property
    def better_frames(self) -> FrameChoice | None:
        """Frames with which matches of several exposures scatter far less; None where none do."""
        if self.config.data is None:
            return None
        return frames_that_help(self.raw_matches.sample(SAMPLE), self.model)

    def _linear(self) -> tuple[LinearFit, MagnitudeErrors | None]:
        fit = self.config.fit
        options: dict[str, Any] = {
            "rejection": Rejection(fit.clip_chi2, fit.clip_abs, fit.radial_weight),
            "priors": self.priors,
        }
        if self.config.data is not None and self.config.data.sigma == "by_magnitude":
            options["compute"] = self.config.resources()
            solution, _, errors = fit_by_magnitude(self.raw_matches, self.model, **options)
            return solution, errors
        if self.grouped_errors is not None:  # of a fit that was made before this one
            self.grouped_errors = None
            self.errors_changed()
        solution = fit_linear(self.shards, self.model, **options)
        factor = error_scale(solution, self._sample)
        if factor != 1.0:
            self.error_scale *= factor
            self.__dict__["_all_matches"] = self._all_matches.with_errors_times(factor)
            self.__dict__.pop("_split", None)
            self.errors_changed()
            solution = fit_linear(self.shards, self.model, **options)
        found = self.grouped_errors = compared_errors(self, solution)
        if found is None or found.added is None:
            return solution, None
        self.errors_changed()
        return fit_linear(self.shards, self.model, **options), None

    @cached_property
    def fit(self) -> LinearFit:
        """The linear fit of an earlier stage."""
        return load_fit(self.run / "fit.nc")

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior of an earlier stage."""
        return load_posterior(self.run / "posterior.nc")

    # -- what residuals say, and what errors come to -----------------------------------------------

    @property
    def is_sampled(self) -> bool:
        """Whether there is a posterior."""
        return "posterior" in self.__dict__ or (self.run / "posterior.nc").exists()

    @property
    def stored(self) -> Diagnostics | None:
        """What `assess` has found of this fit and posterior; None before."""
        made_from = self.fit, self.posterior
        return self._derived.get(
            "stored", made_from, lambda: load_diagnostics(self.run, *made_from)
        )

    @property
    def diagnostics(self) -> Diagnostics:
        """What residuals say, as `assess` has found it or found now; less of a fit alone."""
        if not self.is_sampled:
            made_from = self.fit, self.shards
            return self._derived.get("of the fit", made_from, self._of_fit)
        if self.stored is not None:
            return self.stored
        return self._derived.get("diagnostics", (self.fit, self.posterior), self._diagnosed)

    def diagnose(self) -> Diagnostics:
        """What residuals say, found anew and written for the stages that follow."""
        found = self._diagnosed()
        save_diagnostics(self.run, self.fit, self.posterior, found)
        self._derived.put("stored", (self.fit, self.posterior), found)
        return found

    def _of_fit(self) -> Diagnostics:
        options = self.diagnosis()
        known = {key: options[key] for key in ("eliminated", "centroid") if key in options}
        return diagnose_fit(
            self.fit, None, self.matches, self.shards, self._sample, things=self.pairs_word, **known
        )

    def _diagnosed(self) -> Diagnostics:
        found = diagnose(
            self.fit,
            self.posterior,
            self.matches,
            self.shards,
            self._sample,
            rng=self.rng("assess"),
            discrepancy=self.config.discrepancy.priors(),
            priors=self.priors,
            match_radius=self.config.outliers.match_radius,
            periods=period_settings(self),
            things=self.pairs_word,
            **self.diagnosis(),
        )
        held = self.held_matches
        if held is None:
            return found
        whole = whole_exposures(self, held.exposure_names)
        return hold_out(found, self.predictive(found), held, whole)

    def diagnosis(self) -> dict[str, Any]:
        """What runs of one kind have for `diagnose`, beside what all have."""
        return {}

    def predictive(self, found: Diagnostics) -> Predictive:
        """The solution as it predicts stars that are held out."""
        return predictive_of_run(self, found)

    @property
    def pairs_word(self) -> str:
        """What is true or false, in words."""
        return "pairs" if self.things == "stars" else self.things

    @property
    def errors(self) -> ErrorModel:
        """All errors of a position."""
        made_from = self.posterior, self.diagnostics
        return self._derived.get("errors", made_from, lambda: self.errors_from(self.diagnostics))

    def errors_from(
        self, found: Diagnostics | None, solution: Solution | None = None
    ) -> ErrorModel:
        """The error model of the posterior, or of another solution, with what residuals say."""
        posterior = self.posterior if solution is None else solution
        options = {} if found is None else self.error_options()
        return error_model(
            posterior,
            found,
            self.terms_of(posterior, alone=found is None),
            pixel_scale=pixel_scale_of(posterior, scale_mas=self.config.detector.scale_mas),
            **options,
        )

    def error_options(self) -> dict[str, Any]:
        """What `error_model` has to know of a run of this kind."""
        return {"single": self.config.assess.exposure == "single"}

    def terms_of(self, solution: Solution, *, alone: bool) -> tuple[ErrorTerm, ...]:
        """Error terms beside what residuals say; `alone` without those that rest on the fit."""
        config = self.config
        return (*config.linear_terms(solution), *self.local_terms, *config.user_terms())

    @property
    def local_terms(self) -> tuple[LocalErrors, ...]:
        """Errors that were measured beside the solution, and differ from place to place."""
        return ()

    @property
    def hierarchy(self) -> LinearFit | None:
        """The fit of a hierarchy of exposures, where there is one."""
        return None

    @property
    def solution(self) -> Posterior:
        """What is exported and shown: with all errors of the parameters that `assess` has found.

        Neither catalogue nor matches are needed for it.
        """
        made_from = self.posterior, self.stored
        return self._derived.get(
            "solution", made_from, lambda: solution_with_errors(*made_from, self.hierarchy)
        )

    @property
    def free_directions(self) -> Float | None:
        """Directions (D, d) that the gauge decides; None where that is no question."""
        return None

    @property
    def evaluation_settings(self) -> EvaluationSettings:
        """Where and how errors are evaluated."""
        return replace(self.rehearsal_settings, dates=self.dates)

    @property
    def rehearsal_settings(self) -> EvaluationSettings:
        """The same without the dates of the matches, which only verdicts name."""
        config = self.config
        return EvaluationSettings(
            grid=config.assess.grid,
            epoch=self.epoch,
            draws=config.assess.draws,
            years_ahead=config.assess.horizon or 0.0,
            scale_mas=config.detector.scale_mas,
            single=config.assess.exposure == "single",
            contained=self.contained,
            given=tuple(block.name for block in config.budget),
        )

    @property
    def contained(self) -> Sequence[tuple[str, float, float]]:
        """Errors that the residuals are said to hold beside those of the centroids."""
        return self.config.held_in_residuals(self.model.unit)

    @property
    def tested_matches(self) -> MatchTable:
        """Matches that the score tests look at: all, or every k-th."""
        return self._sample

    @property
    def tangent_point(self) -> tuple[float, float] | None:
        """Sky position of (u, v) = (0, 0), degrees; None where u, v are not said to be on the sky.

        Only of matches: in other runs u, v lie along the detector.
        """
        return None if self.config.data is None else self.raw_matches.tangent_point

    @cached_property
    def dates(self) -> Float:
        """Distinct dates of the matches, in decimal years; none where they have none."""
        raw = self.raw_matches
        table = raw if isinstance(raw, MatchTable) else self._sample
        return np.zeros(0) if table.epoch is None else np.unique(table.epoch)

    @property
    def catalogue_stated(self) -> bool | None:
        """Whether an error of the reference catalogue is stated; None without a catalogue."""
        return self.config.states(*CATALOGUE_WORDS)

    @property
    def motions_stated(self) -> bool | None:
        """Whether an error of the catalogue's proper motions is; None without a catalogue."""
        return self.config.states("motion")

    def kind_checks(self, found: Sequence[Check]) -> tuple[Check, ...]:
        """Checks that runs of one kind have, given what tests of the residuals have found."""
        return ()

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand, as a sentence; empty where that is no question."""
        return ""

    @property
    def scale_arcsec(self) -> float | None:
        """Size of a pixel in arcsec, where the configuration gives it."""
        scale = self.config.detector.scale_mas
        return None if scale is None else scale / 1000

    @cached_property
    def _sample(self) -> MatchTable:
        """Some of the matches, or all."""
        return self.matches.sample(SAMPLE)

    @property
    def sampled_matches(self) -> MatchTable:
        """The same: what is estimated from single residuals before anything is sampled."""
        return self._sample

    def rng(self, stage: str) -> np.random.Generator:
        """Random numbers of a stage: all follow from the one seed."""
        return np.random.default_rng([self.config.sampler.seed, STAGES.index(stage) - 1])

    @property
    def epoch(self) -> float | None:
        """Epoch of the assessment; the middle of the data where none is given."""
        if self.config.assess.epoch is not None or self.model.time is None:
            return self.config.assess.epoch
        return self._median_epoch

    @cached_property
    def _median_epoch(self) -> float:
        raw = self.raw_matches
        table = raw if isinstance(raw, MatchTable) else raw.sample(SAMPLE)
        assert table.epoch is not None
        return float(np.median(table.epoch))


def write_table(table: Table, path: Path) -> None:
    with atomic_path(path) as temporary:
        table.write(temporary, format="ascii.ecsv")
