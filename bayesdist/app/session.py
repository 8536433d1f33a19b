"""What the stages of one run share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.added_errors import knows_circle
from bayesdist.app.config import CATALOGUE_WORDS, Config
from bayesdist.app.discrepancy import RunDiscrepancy, keep_discrepancy, kept_discrepancy
from bayesdist.app.holdout import predictive_of_run
from bayesdist.app.kinds.errors import ErrorLaw
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched, Prepared
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.kinds.stars import load_fitted_stars, match_stars
from bayesdist.app.output import write_table
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.rvb import RvbInput
from bayesdist.app.score_tests import keep_score_tests, kept_score_tests
from bayesdist.app.systematics import Systematics
from bayesdist.assess import (
    SAMPLE,
    BinnedSums,
    Misfit,
    StarSample,
    StarSums,
    misfit_of,
    partitions_for,
    star_sample,
    star_sums,
)
from bayesdist.assess.coverage import Coverage, coverage_of
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.maps import UncertaintyMap, uncertainty_map, with_local
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.centroid import centroid_scatter
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.terms.local import LocalErrors
from bayesdist.data import MagnitudeErrors, MatchTable
from bayesdist.diagnose import ScoreTest, score_tests
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.residuals.epoch_shift import EpochShift, epoch_shift
from bayesdist.diagnose.residuals.majority import majority_sentence
from bayesdist.diagnose.residuals.misfit import MOST_BINS, STARS_PER_BIN, worst_misfit
from bayesdist.diagnose.residuals.quoted import error_scale_sentence
from bayesdist.infer import GaussianPriors, LinearFit, Matches, Posterior, Shards, load_posterior
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.discrepancy import Discrepancy, estimate_discrepancy
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

    things = "stars"  # what a row of the data is, in words

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
    def _sample(self) -> MatchTable:
        """Some of the matches, or all."""
        return self.reader.sample(*self._read)

    @property
    def predictive(self) -> Predictive:
        """The solution as it predicts stars that are held out."""
        return predictive_of_run(self)

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

    @cached_property
    def systematics(self) -> Systematics:
        """The posterior with all that is known of its errors."""
        found = self.discrepancy
        if found is None:
            return Systematics(self.posterior)
        single = self.config.assess.exposure == "single"
        return Systematics(found.with_noise(self.posterior), found.terms(single=single))

    @cached_property
    def discrepancy(self) -> RunDiscrepancy | None:
        """What the model may leave out, as `assess` has estimated it."""
        return kept_discrepancy(self)

    def estimate_discrepancy(self) -> Discrepancy:
        """What the model may leave out, from the residuals of all stars."""
        matches = self.matches
        return estimate_discrepancy(
            self.shards,
            self.posterior,
            rng=self.rng("assess"),
            priors=self.config.discrepancy.priors(),
            parameter_priors=self.priors,
            sample=self._sample,
            stars=matches if isinstance(matches, MatchTable) else None,
        )

    def measure(self) -> None:
        """What the assessment estimates beside the posterior, anew."""
        keep_discrepancy(self, self.estimate_discrepancy)
        keep_score_tests(self.run, self.made_score_tests())
        rest = ("systematics", "solution", "centroid", "local_terms", "score_tests")
        for name in ("discrepancy", *rest):
            self.__dict__.pop(name, None)

    @property
    def tested_matches(self) -> MatchTable:
        """Matches that the score tests look at: all, or every k-th."""
        return self._sample

    def made_score_tests(self) -> tuple[ScoreTest, ...]:
        """Targeted tests of the residuals for what the model lacks."""
        return score_tests(
            self.tested_matches,
            self.posterior,
            priors=self.priors,
            match_radius=self.config.outliers.match_radius,
        )

    @cached_property
    def score_tests(self) -> tuple[ScoreTest, ...]:
        """Those that `assess` has made."""
        return kept_score_tests(self.run)

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
        table = raw if isinstance(raw, MatchTable) else raw.sample(SAMPLE)
        return np.zeros(0) if table.epoch is None else np.unique(table.epoch)

    @property
    def catalogue_stated(self) -> bool | None:
        """Whether an error of the reference catalogue is stated; None without a catalogue."""
        return self.config.states(*CATALOGUE_WORDS)

    @property
    def motions_stated(self) -> bool | None:
        """Whether an error of the catalogue's proper motions is; None without a catalogue."""
        return self.config.states("motion")

    @property
    def single_exposures(self) -> bool:
        """Whether it is known by how much single exposures deviate."""
        linear = None if self.discrepancy is None else self.discrepancy.found.linear
        return self.systematics.aligned or (linear is not None and bool(linear.kinds))

    @cached_property
    def solution(self) -> Posterior:
        """What is exported and shown: all errors of the parameters are in its draws."""
        found = self.discrepancy
        return self.posterior if found is None else found.with_everything(self.posterior)

    def position_map(self, **where: Any) -> UncertaintyMap:
        """Uncertainty of positions over a chip: of coefficients, and of what they leave out.

        Parameters
        ----------
        **where
            As `uncertainty_map`, on the grid and at the epoch of the assessment.
        """
        return with_local(uncertainty_map(self.solution, **where), self.structure_sigma(**where))

    def structure_sigma(self, **where: Any) -> NDArray[np.float64] | None:
        """Standard deviations (N, 2) of what the model leaves out on the grid of a chip, if any."""
        found = self.discrepancy
        if found is None or not self.structure_is_left:
            return None
        return found.structure_sigma(self._domain(**where))

    @property
    def structure_is_left(self) -> bool:
        """Whether what the model leaves out at a position is an error of its own."""
        return True

    def _domain(
        self, *, grid: tuple[int, int], epoch: float | None, chip: int | None = None
    ) -> EvaluationDomain:
        model = self.posterior.model
        number = model.chips[0].number if chip is None else chip
        return EvaluationDomain.of_chips(model, grid, chips=(number,), epoch=epoch)

    @property
    def signed(self) -> Posterior:
        """The same, from what the run's folder holds: data are not needed."""
        return self.solution

    @property
    def error_terms(self) -> tuple[ErrorTerm, ...]:
        """Terms of the error model: those of the run, then those that the user gives."""
        return (*self.systematics.terms, *self.terms_beside(self.systematics.solution))

    def terms_beside(self, solution: Solution) -> tuple[ErrorTerm, ...]:
        """Those of them that do not rest on the run's solution."""
        config = self.config
        return (*config.linear_terms(solution), *self.local_terms, *config.user_terms())

    @cached_property
    def centroid(self) -> MagnitudeErrors | None:
        """Errors of the centroids by magnitude, where the stars have magnitudes."""
        held = self.config.held_in_residuals(self.posterior.model.unit)
        errors = centroid_scatter(self.stars, held, n_params=self.posterior.model.n_params)
        found = self.discrepancy
        return errors if found is None else found.of_centroids(errors)

    @property
    def further_caveats(self) -> tuple[str, ...]:
        """What else keeps verdicts from being given, in runs of one kind."""
        return ()

    @property
    def doubts(self) -> list[str]:
        """What else, beside misfit and errors, a reader of the numbers has to know."""
        return [f"{t.finding}: {t.remedy}" for t in self.score_tests if t.significant]

    @cached_property
    def epoch_shift(self) -> EpochShift | None:
        """Error of the epochs that the residuals of the fit show; None without proper motions."""
        return None if self.config.data is None else epoch_shift(self._sample, self.fit)

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand, as a sentence; empty where that is no question."""
        return ""

    @property
    def relative(self) -> Solution | None:
        """The solution of relative positions, where the gauge is no part of it."""
        return None

    def relative_map(self, **where: Any) -> UncertaintyMap | None:
        """Uncertainty of relative positions, as `position_map`; None without a gauge."""
        return None

    @cached_property
    def local_terms(self) -> tuple[LocalErrors, ...]:
        """Errors that were measured beside the solution, and differ from place to place."""
        return ()

    @property
    def scale_arcsec(self) -> float | None:
        """Size of a pixel in arcsec, where the configuration gives it."""
        scale = self.config.detector.scale_mas
        return None if scale is None else scale / 1000

    @cached_property
    def _partitions(self) -> dict[int, dict[str, tuple[int, int]]]:
        """Bins of each chip, by its number: of the tests for structure, and of the diagram."""
        out = {}
        for chip, found in zip(self.fit.model.chips, self.shards.survey.chips, strict=True):
            n = round(self.fit.n_used * found.n / len(self.shards))
            side = int(np.clip(np.sqrt(n / STARS_PER_BIN), 4, MOST_BINS))
            out[chip.number] = partitions_for(n) | {"shown": (side, side)}
        return out

    @cached_property
    def sums(self) -> StarSums:
        """Residuals of the least-squares fit, summed over all stars."""
        partitions = {
            chip: tuple(dict.fromkeys(bins.values())) for chip, bins in self._partitions.items()
        }
        return self.shards.sum(star_sums, self.fit.mean, self.fit.clip, partitions)

    @property
    def shown_sums(self) -> tuple[BinnedSums, ...]:
        """Those of them that the diagrams of mean residuals show, one for each chip."""
        return tuple(self.sums.binned[c, b["shown"]] for c, b in self._partitions.items())

    @cached_property
    def misfits(self) -> tuple[Misfit, ...]:
        """Structure that the least-squares fit leaves in the residuals of each chip."""
        fit, out = self.fit, []
        for chip, bins in zip(fit.model.chips, self._partitions.values(), strict=True):
            sums = {
                name: self.sums.binned[chip.number, bins[name]] for name in bins if name != "shown"
            }
            found = misfit_of(sums, order=fit.model.order, unit=fit.unit)
            out.append(replace(found, chip=chip) if len(fit.model.chips) > 1 else found)
        return tuple(out)

    @property
    def misfit(self) -> Misfit:
        """The worst of them, its probability corrected for the number of chips."""
        return worst_misfit(self.misfits)

    @property
    def coverages(self) -> tuple[Coverage, ...]:
        """The area of each chip that its stars cover."""
        chips, several = self.fit.model.chips, len(self.fit.model.chips) > 1
        return tuple(
            coverage_of(
                self.sums.binned[chip.number, bins["cells"]], found.corners, chip, several=several
            )
            for chip, bins, found in zip(
                chips, self._partitions.values(), self.shards.survey.chips, strict=True
            )
        )

    @property
    def majority(self) -> str:
        """What it means that most pairs are false; empty where they are not."""
        posterior = self.posterior if self.run.done("sample") else None
        quoted = self.shards.survey.reference_sigma
        things = "pairs" if self.things == "stars" else self.things
        return majority_sentence(self.fit, posterior, quoted=quoted, things=things)

    @cached_property
    def stars(self) -> StarSample:
        """Some stars, or all of them, and what fit and posterior say of each."""
        return self._sampled()

    def _sampled(self) -> StarSample:
        matches = self.matches
        return star_sample(self._sample, len(matches), self.fit, self.posterior)

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
