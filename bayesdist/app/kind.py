"""One kind of run: what differs between matched stars, campaigns and self-calibrations.

Kinds share the sampling of fits with stars at given positions, and the further exposures that
`bayesdist plan` counts.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np

from bayesdist.app.parts import read_stored_fit
from bayesdist.app.run import Run
from bayesdist.app.stars import ErrorLaw, RunInput
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.model import with_diagnosed_errors
from bayesdist.assess.planning import Schedule
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.terms.catalogue import fraction_of_bright
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.data import MagnitudeErrors, Matches, ReferenceCatalog
from bayesdist.diagnose import score_tests
from bayesdist.diagnose.diagnostics import FittedStars
from bayesdist.diagnose.holdout.predictive import Predictive, predictive_of
from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.errors import DegenerateError
from bayesdist.infer import Posterior, sample
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.compare.planning import ExposureContent, exposure_information
from bayesdist.infer.exposures.hierarchy import Settling
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.model.basis import n_terms
from bayesdist.report.run import Terminology
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check

if TYPE_CHECKING:
    from bayesdist.infer.compare.monitoring import NewFit

C = TypeVar("C", contravariant=False)  # configuration
I = TypeVar("I")  # inputs

LATER = 4  # number of dates that represent evenly spread exposures

log = logging.getLogger("bayesdist")

# tests that find displaced stars, best words first
DISPLACED = ("displaced group of stars", "displaced stars", "two cores")
STARS_PER_TERM = 3  # fewest stars per term and axis for which residuals show the errors


@dataclass(frozen=True)
class Outline:
    """Properties of a solution that are known before stars are matched."""

    model: DistortionModel  # without the frames of exposures
    pixel: float  # size of a pixel in the unit of u and v
    filter: str = ""
    tables: tuple[LookupTable, ...] = ()  # with the nodes that the fitted tables will have


@dataclass(frozen=True, eq=False)
class Questions:
    """Properties of the fit of a run that the general diagnostics need."""

    # centroid errors, if the fit has estimated them; else they are the scatter of the residuals
    centroid: MagnitudeErrors | Literal["residuals"] | None = "residuals"
    structure: bool = True  # False if look-up tables were fitted to the structure
    exposures: bool = True  # False if a hierarchy of exposures was fitted
    settling: Settling | None = None  # applied to the shifts of single chips after sampling
    eliminated: FittedStars | None = None  # diagnostics if the positions of stars were fitted


@dataclass(frozen=True)
class EvaluatedExposure:
    """The exposure that errors are evaluated for."""

    aligned: bool = False  # shift and rotation of a new exposure are fitted by its user
    single: bool = False  # the deviation of a single exposure is an error
    frames: bool = False  # errors of the frames are correlated with the measured errors
    structure_left: bool = True  # False if errors of look-up tables include the structure


class RunKind(ABC, Generic[C, I]):
    """One kind of run.

    Methods up to `sample` make a posterior; the others contribute what only this kind has to steps
    that are the same for all kinds.  They take the run with the artefacts of all earlier stages.  A
    kind names itself in `kind` of its configuration.
    """

    words: ClassVar[Terminology] = Terminology()  # words of messages and reports
    # True if the fit estimates the errors of centroids, which then include no other errors
    measures_centroids: ClassVar[bool] = True
    # frames of new exposures that are compared with a solution; None for those of the solution
    new_frames: ClassVar[str | None] = None
    # clause on why orders cannot be compared by held-out stars; empty if they can
    no_order: ClassVar[str] = ""
    # True if errors, requirements and products are tried out with the fit before it is sampled
    rehearses_fit: ClassVar[bool] = False
    # True if new exposures may be given as tables of matches; see `read_new_matches`
    reads_matches: ClassVar[bool] = False
    section: ClassVar[str] = ""  # section of summary.json on the matching
    # True if star positions come from a reference catalogue, whose error the user must state;
    # else `error_terms` include the errors of the reference positions, if there are any
    has_catalogue: ClassVar[bool] = True
    along_detector: ClassVar[bool] = False  # u and v are along the detector axes, not along the sky

    def source(self, directory: RunDirectory) -> RunInput | None:
        """Matches that have to be selected or converted before they are read; usually None."""
        return None

    # -- up to the posterior ----------------------------------------------------------------------

    @abstractmethod
    def read(self, config: C, base: Path) -> I:
        """Inputs of a run; paths are relative to the folder `base`."""

    @abstractmethod
    def match(self, run: Run) -> Run:
        """Run with its stars: artefacts `stars`, `held_stars` and others of the stage 'match'."""

    @abstractmethod
    def fit(self, run: Run) -> Run:
        """Run with its least-squares fit: artefacts `fit`, `errors`, `priors`, `parts`, others."""

    def sample(
        self,
        run: Run,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """Posterior of a fit; checkpoints are written to `folder`."""
        return sample_stars(run, folder=folder, progress=progress)

    def load_matched(self, run: Run) -> Run:
        """Run with the stars of an earlier stage, from its folder and its summary.json."""
        return self.match(run)

    def load_fit(self, run: Run) -> Run:
        """Run with the fit of an earlier stage, from its folder."""
        return run.having(**read_stored_fit(run.directory.path))

    def with_config(self, inputs: I, config: C) -> I:
        """Inputs for another configuration, which differs in the model only."""
        return inputs

    def refuse(self, inputs: I) -> None:
        """Raise InputError if inputs are inconsistent."""

    def lines(self, inputs: I) -> Iterator[str] | None:
        """Lines that the command `check` prints; None to print lines about the fit instead."""
        return None

    def outline(self, inputs: I) -> Outline | None:
        """Shape of the solution, for a trial export of the products before stars are matched.

        None if the fit is used for that.
        """
        return None

    def fit_notes(self, run: Run) -> Iterator[tuple[int, str]]:
        """Level of logging and sentence of each remark on a fit, before it is sampled."""
        yield from ()

    # -- from the posterior on --------------------------------------------------------------------

    def questions(self, run: Run) -> Questions:
        """Properties of a fit that the general diagnostics need."""
        return Questions()

    def overlap(self, run: Run) -> OverlapTest | None:
        """Comparison of two exposures far apart in time; None if it does not apply."""
        return None

    def save_diagnosed(self, run: Run) -> None:
        """Write diagnostics that only this kind has, with their sections of summary.json."""

    def predictive(self, run: Run) -> Predictive:
        """Predictive distribution of the assessed solution for the held-out stars.

        Quoted errors and jitter include the distortion that the model leaves out at a position.
        That error is common to neighbouring stars.
        """
        prediction = predictive_of(with_diagnosed_errors(run.posterior, run.diagnostics))
        correlated = run.diagnostics.correlated
        rows = None if correlated is None else correlated.facts.get("structure")
        if not rows:
            return prediction
        side = max(row["length_pix"] for row in rows)
        settings = run.evaluation_settings
        local = run.error_model.local_tables(settings.grid, settings.epoch)
        return replace(prediction, local=local, cell=(side, side), local_in_noise=True)

    def error_terms(self, run: Run, solution: Solution) -> list[ErrorTerm]:
        """Error terms in addition to those of the solution, by default those stated by the user."""
        return [*run.config.linear_terms(solution), *self.stated_terms(run, solution)]

    def stated_terms(self, run: Run, solution: Solution) -> list[ErrorTerm]:
        """Errors of the catalogue, and those that are stated with one sigma on each axis."""
        config, out = run.config, list[ErrorTerm]()
        if config.catalogue is not None:
            dates = run.dates
            if not dates.size and config.assess.epoch is not None:
                dates = np.array([config.assess.epoch])
            bright = fraction_of_bright(run.sample)
            out.append(config.catalogue.catalogue().term(dates, bright))
        return [*out, *config.user_terms(solution.model.unit)]

    def domain(self, run: Run) -> EvaluatedExposure:
        """The exposure that errors are evaluated for."""
        return EvaluatedExposure(single=run.config.assess.exposure == "single")

    def null_space(self, run: Run) -> Float | None:
        """Directions of the parameters (D, k) that only the gauge fixes; None if there are none."""
        return None

    def checks(self, run: Run) -> tuple[Check, ...]:
        """Checks of matching, exposures and gauge."""
        return ()

    def evaluation_sections(self, run: Run) -> dict[str, Any]:
        """Sections of summary.json about the evaluated solution."""
        return {}

    def held_parameters(self, run: Run) -> frozenset[str]:
        """Names of the parameters that a prior or the gauge alone constrains."""
        return frozenset()

    def report_data(self, run: Run) -> Any:
        """Data that the figures of this kind draw in addition to the artefacts of a run.

        Processes that draw receive it instead of the inputs.
        """
        return None

    def further_exposures(self, run: Run) -> FurtherExposures:
        """Exposures that requirements may need in addition to those of a run."""
        return FurtherExposures(run)

    def fit_of_new_exposures(
        self, release: Run, new: Path
    ) -> tuple[Matches, NewFit, tuple[str, ...]] | None:
        """Fit of new exposures in the file or folder `new`, to test the solution of a run.

        None if new matches are a table that has to be read as those of the run were.

        Returns
        -------
        Matches
            New matches with errors.
        NewFit
            Their fit.
        tuple of str
            Exposures that are left out because the run was made from them.
        """
        return None

    def read_new_matches(
        self, config: C, files: Path | list[Path], release: Run, *, dated: bool
    ) -> Matches:
        """Matches of new exposures with their errors, to test the solution of a run.

        Parameters
        ----------
        config : RunConfig
            Configuration of this kind that says how to read the files.
        files : Path or list of Path
        release : Run
            Run whose solution is tested, of any kind.
        dated : bool
            True if a date in `config` is that of the new exposures; False if it is that of the
            release.
        """
        raise NotImplementedError

    def errors_before_fit(self, run: Run) -> ErrorLaw | None:
        """Errors of stars that are compared with polynomials before a fit.

        None if only a fit can put the stars of all exposures in one frame.
        """
        return None

    # -- stars ------------------------------------------------------------------------------------

    def catalogue(self, run: Run) -> ReferenceCatalog | None:
        """Reference catalogue of the stars; None if only the matches are known."""
        return None

    def star_errors(self, run: Run) -> StarErrors | None:
        """Errors of the catalogue by star code; None if there are none."""
        return None

    def filter(self, run: Run) -> str:
        """Filter of the exposures; empty if it has no name."""
        return ""


class FurtherExposures:
    """Further exposures of a run with a catalogue: each has stars like those of the existing ones.

    `gain` is the information of a further exposure relative to the mean of the existing ones.
    """

    gain = 1.0

    def __init__(self, run: Run) -> None:
        self.run = run

    @property
    def count(self) -> int:
        """Number of exposures of the run."""
        return max(len(self.run.placed.exposure_names), 1)

    @property
    def dateless(self) -> str:
        """Clause on why dates of further exposures do not matter; empty if they do."""
        if self.run.solution.model.time is not None:
            return ""
        return "does not depend on time, so that the dates of further exposures do not matter"

    def sentence(self, content: ExposureContent) -> str:
        """Sentence that states which exposures are assumed."""
        return f"An exposure is taken to hold {content.n_stars:.0f} matched stars as these do."

    def schedules(
        self, requirement: Requirement, content: ExposureContent, epochs: Sequence[float]
    ) -> list[Schedule]:
        """Schedules at relevant dates, or one schedule if dates do not matter."""
        solution, epoch = self.run.solution, self.run.epoch

        def worth(date: float | None) -> Float:
            return exposure_information(solution, content, date)

        if solution.model.time is None or epoch is None:
            return [Schedule("at any date", worth(None))]
        wanted = requirement.epoch or (requirement.epochs or [epoch])[-1]
        last = float(np.max(self.run.diagnostics.sample.table.column("epoch")))
        schedules = [
            Schedule(f"at {date:.2f}", worth(date), single_date=True)
            for date in dict.fromkeys([*epochs, wanted])
        ]
        if wanted > last:
            spread = [worth(float(date)) for date in np.linspace(last, wanted, LATER + 1)[1:]]
            name = f"evenly from {last:.2f} to {wanted:.2f}"
            schedules.append(Schedule(name, np.sum(spread, axis=0) / len(spread)))
        return schedules


def sample_stars(
    run: Run,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample the posterior of a fit; checkpoints are written to `folder`."""
    config = run.config
    for text in doubts_on_numbers(run.sample, run.model):
        log.warning("sample: %s", text)
    with naming_displaced_stars(run):
        return sample(
            run.fit,
            run.shards,
            outliers=config.mixture(run.stars.match_radius),
            priors=run.priors,
            folder=folder,
            progress=progress,
            **config.sampler.model_dump(),
        )


@contextmanager
def naming_displaced_stars(run: Run) -> Iterator[None]:
    """Add displaced stars, if the residuals of the fit show any, to a DegenerateError as its cause.

    A part of the stars that is displaced as a whole can be described by a scatter of true matches
    as well as by one of false matches, so that the posterior has several modes.
    """
    try:
        yield
    except DegenerateError as error:
        tests = {
            test.name: test
            for test in score_tests(run.sample, run.fit, priors=run.priors)
            if test.significant
        }
        for name in DISPLACED:
            if name in tests:
                raise DegenerateError(
                    f"{error.cause}; a likely cause is that {tests[name].finding}",
                    where=error.where,
                    do=tests[name].remedy,
                ) from error
        raise


def doubts_on_numbers(stars: Matches, model: DistortionModel) -> Iterator[str]:
    """Sentences about chips with fewer than three stars per polynomial term and axis."""
    terms = n_terms(model.order)
    needed = STARS_PER_TERM * terms
    counts = dict(zip(stars.chip_numbers, np.bincount(stars.chip), strict=False))
    for chip in model.chips:
        n_stars = int(counts.get(chip.number, 0))
        if n_stars < needed:
            yield (
                f"chip {chip.name} has {n_stars} stars for {terms} terms on each axis (order "
                f"{model.order}), and {needed} or more are advisable: the posterior may be far "
                "from normal and sampling slow; lower model.order, or add stars"
            )
