"""What the stages of one run share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.added_errors import knows_circle
from bayesdist.app.config import CATALOGUE_WORDS, Config
from bayesdist.app.derived import Derived
from bayesdist.app.diagnostics_files import load_diagnostics, save_diagnostics
from bayesdist.app.holdout import predictive_of_run
from bayesdist.app.kinds.errors import ErrorLaw
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched, Prepared
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.kinds.stars import load_fitted_stars, match_stars
from bayesdist.app.output import write_table
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
from bayesdist.data import MagnitudeErrors, Matches
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose, diagnose_fit, hold_out
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.residuals.quoted import error_scale_sentence
from bayesdist.infer import GaussianPriors, LinearFit, Posterior, Shards, load_posterior
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.exposures.frame_choice import FrameChoice, frames_that_help
from bayesdist.model import DistortionModel

Float = NDArray[np.float64]

__all__ = ["STAGES", "Session", "write_table"]

STAGES = ("match", "fit", "sample", "assess", "export", "report")

VALUES = ("matched", "fitted", "prepared", "posterior")  # each rests on those before it

T = TypeVar("T")


@dataclass
class Session:
    """What the stages of one run share: a value of each stage, and what follows from them.

    Parameters
    ----------
    run : RunDirectory
    progress : callable, optional
        Called with (steps made, most steps) while sampling.
    """

    run: RunDirectory
    progress: Callable[[int, int], None] | None = None
    _values: dict[str, Any] = field(default_factory=dict, init=False, repr=False)
    _made: set[str] = field(default_factory=set, init=False, repr=False)
    _reader: StarReader | None = field(default=None, init=False, repr=False)
    _rvb: RvbInput | None = field(default=None, init=False, repr=False)
    _derived: Derived = field(default_factory=Derived, init=False, repr=False)

    things = "stars"  # what a row of the data is, in words
    chooser = "least-squares fit"  # what leaves out rows that are far off

    # -- values of the stages ---------------------------------------------------------------------

    def renew(self, name: Literal["matched", "fitted", "posterior"], value: object) -> None:
        """Replace the value of a stage: a new state, without anything that followed from it.

        Parameters
        ----------
        name : str
        value : Matched, Fitted or Posterior
        """
        later = VALUES[VALUES.index(name) :]
        own = {one.name for one in fields(self)}
        for derived in vars(self).keys() - own:
            del vars(self)[derived]
        for one in later:
            self._values.pop(one, None)
        self._made.difference_update(later)
        self._made.add(name)
        self._values[name] = value

    def made(self, name: str) -> bool:
        """Truth of a value that this session made, and did not read from the run's folder."""
        return name in self._made

    def _value(self, name: str, load: Callable[[], T]) -> T:
        """A value that was made in this session, or is loaded now."""
        if name not in self._values:
            self._values[name] = load()
        return cast(T, self._values[name])

    @property
    def matched(self) -> Matched:
        """Stars that are fitted and stars that are held out, as they were read or matched."""
        return self._value("matched", self._load_matched)

    def _load_matched(self) -> Matched:
        stars, data = None, self.config.data
        if data is not None and data.format == "rvb":
            self._rvb = self._rvb or RvbInput(self.run)
            stars = self._rvb.load()
        return match_stars(self.config, self.base, stars=stars)

    @property
    def fitted(self) -> Fitted:
        """The linear fit, with what its stars were given."""
        return self._value("fitted", self._load_fitted)

    def _load_fitted(self) -> Fitted:
        return load_fitted_stars(self.run.path, self.config, self.run.summary)

    @property
    def prepared(self) -> Prepared:
        """Stars as the fit took them."""
        return self._value("prepared", lambda: self.fitted.prepared(self.matched))

    @property
    def posterior(self) -> Posterior:
        """The posterior."""
        return self._value("posterior", lambda: load_posterior(self.run / "posterior.nc"))

    def begun(self) -> None:
        """Move into the run's folder what was prepared beside it: the run has begun."""
        if self._rvb is not None and self._rvb.settle():
            fitted = self.fitted
            self.renew("matched", self._load_matched())
            self.renew("fitted", fitted)
            self.reader.moved(self.matched.stars)

    def close(self) -> None:
        """Let go of the data, and of whoever holds them."""
        for one in (self._reader, self._rvb):
            if one is not None:
                one.close()

    # -- what follows from them -------------------------------------------------------------------

    @cached_property
    def config(self) -> Config:
        """The resolved configuration."""
        return self.run.config

    @property
    def base(self) -> Path:
        """Folder that the configuration's files are relative to."""
        return Path(self.run.record["base"])

    @property
    def raw_matches(self) -> Matches:
        """Matches with their quoted errors, without those that are held out."""
        return self.matched.stars

    @property
    def matches(self) -> Matches:
        """Matches with their errors."""
        return self.prepared.stars

    @property
    def held_matches(self) -> Matches | None:
        """Matches that are held out, with their errors; None where there are none."""
        return self.prepared.held

    @property
    def _read(self) -> tuple[Matches, ErrorLaw]:
        """What the reader is asked for: stars, and by which law they have their errors."""
        return self.matched.stars, self.fitted.errors

    @property
    def reader(self) -> StarReader:
        """Reads stars once for all stages."""
        if self._reader is None:
            self._reader = StarReader(self.config.resources())
        return self._reader

    @property
    def shards(self) -> Shards:
        """All stars as the passes go over them: they are read once."""
        return self.reader.shards(self.model, *self._read)

    @property
    def _sample(self) -> Matches:
        """Some of the matches, or all."""
        return self.reader.sample(*self._read)

    @property
    def in_circle(self) -> bool:
        """Truth of a likelihood of stars that were matched in circles about nominal positions."""
        return knows_circle(self.config) and self.matched.stars.has_nominal

    @property
    def fit(self) -> LinearFit:
        """The linear fit itself."""
        return self.fitted.linear

    @property
    def model(self) -> DistortionModel:
        """The model that was fitted."""
        return self.fit.model

    @property
    def priors(self) -> GaussianPriors:
        """Priors of the model's parameters."""
        return self.fitted.priors

    @property
    def magnitude_errors(self) -> MagnitudeErrors | None:
        """Errors by magnitude, as the fit left them."""
        return self.fitted.errors.by_magnitude

    @property
    def grouped_errors(self) -> GroupedErrors | None:
        """Errors beyond the quoted ones by groups of stars; None where these are not compared."""
        return self.fitted.grouped

    @property
    def error_scale(self) -> float:
        """Factor on all quoted errors that the fit found them to need; 1 where they will do."""
        return self.fitted.errors.factor

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
    def better_frames(self) -> FrameChoice | None:
        """Frames with which matches of several exposures scatter far less; None where none do."""
        if self.config.data is None:
            return None
        return frames_that_help(self.raw_matches.sample(SAMPLE), self.model)

    # -- what residuals say, and what errors come to -----------------------------------------------

    @property
    def is_sampled(self) -> bool:
        """True where there is a posterior."""
        return "posterior" in self._values or (self.run / "posterior.nc").exists()

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
        return hold_out(found, self.predictive(found), held, self.matched.whole)

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
    def tested_matches(self) -> Matches:
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
        table = raw if raw.in_memory else self._sample
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

    @property
    def sampled_matches(self) -> Matches:
        """Some of the matches, or all: for what is estimated from single residuals."""
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
        table = raw if raw.in_memory else raw.sample(SAMPLE)
        assert table.epoch is not None
        return float(np.median(table.epoch))
