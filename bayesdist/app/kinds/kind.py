"""One kind of run: what differs between matched stars, campaigns and self-calibrations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData, StarReader
from bayesdist.app.kinds.fitted import Fitted, load_fitted
from bayesdist.app.kinds.matched import Matched, Outline
from bayesdist.app.kinds.sampling import sample_stars
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.model import ErrorModel, with_diagnosed_errors
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.data import MagnitudeErrors
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.holdout.predictive import Predictive, predictive_of
from bayesdist.infer import Posterior
from bayesdist.infer.exposures.hierarchy import Settling
from bayesdist.infer.selfcal import SelfCalibrationMode
from bayesdist.infer.solution.solution import Solution
from bayesdist.plugin import load_object
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check

C = TypeVar("C", contravariant=False)  # configuration
I = TypeVar("I")  # inputs
M = TypeVar("M", bound=Matched)  # fitted and held-out stars


@dataclass(frozen=True, eq=False)
class Questions:
    """What the general diagnostics have to know of the fit of a run."""

    # centroid errors, if the fit has estimated them; else they are the scatter of the residuals
    centroid: MagnitudeErrors | Literal["residuals"] | None = "residuals"
    structure: bool = True  # False if look-up tables were fitted to the structure
    exposures: bool = True  # False if a hierarchy of exposures was fitted
    settling: Settling | None = None  # applied to the shifts of single chips after sampling
    eliminated: SelfCalibrationMode | None = None  # solution with the positions of stars


@dataclass(frozen=True)
class EvaluationDomain:
    """The exposure that errors are evaluated for."""

    aligned: bool = False  # shift and rotation of a new exposure are fitted by its user
    single: bool = False  # the deviation of a single exposure is an error
    frames: bool = False  # errors of the frames are correlated with the measured errors
    structure_left: bool = True  # False if errors of look-up tables include the structure


class RunKind(ABC, Generic[C, I, M]):
    """One kind of run.

    Methods up to `sample` make a posterior; the others contribute what only this kind has to steps
    that are the same for all kinds.  A kind names itself in `kind` of its configuration.
    """

    rows: ClassVar[str] = "stars"  # word for the rows of the data
    chooser: ClassVar[str] = "least-squares fit"  # words for the step that rejects outlying rows
    # True if the fit estimates the errors of centroids, which then include no other errors
    measures_centroids: ClassVar[bool] = True
    # frames of new exposures that are compared with a solution; None for those of the solution
    new_frames: ClassVar[str | None] = None
    # clause on why orders cannot be compared by held-out stars; empty if they can
    no_order: ClassVar[str] = ""
    # True if errors, requirements and products are tried out with the fit before it is sampled
    rehearses_fit: ClassVar[bool] = False

    # -- up to the posterior ----------------------------------------------------------------------

    @abstractmethod
    def read(self, config: C, base: Path) -> I:
        """Inputs of a run; paths are relative to the folder `base`."""

    @abstractmethod
    def match(self, inputs: I, config: C) -> M:
        """Fitted and held-out stars."""

    @abstractmethod
    def fit(self, matched: M, config: C, base: Path, reader: StarReader) -> Fitted:
        """Least-squares solution; `reader` may hold the stars."""

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """Posterior of a fit; checkpoints are written to `folder`."""
        return sample_stars(data, config, folder=folder, progress=progress)

    def load_matched(
        self,
        folder: Path,
        inputs: I,
        config: C,
        summary: Mapping[str, Any],
    ) -> M:
        """Matches of an earlier stage, from the folder of a run and its summary.json."""
        return self.match(inputs, config)

    def load_fitted(self, folder: Path, matched: Callable[[], M]) -> Fitted:
        """Fit of an earlier stage; `matched` returns the matches, and is called if they matter."""
        return load_fitted(folder)

    def refuse(self, inputs: I) -> None:
        """Raise InputError if inputs are inconsistent."""

    def lines(self, inputs: I) -> Iterator[str] | None:
        """Lines that the command `check` prints; None if those about the fit say more."""
        return None

    def outline(self, inputs: I) -> Outline | None:
        """Shape of the solution, to make products on trial before stars are matched.

        None if the fit is used for that.
        """
        return None

    def fit_notes(self, data: FitData, config: C) -> Iterator[tuple[int, str]]:
        """Level of logging and sentence of each remark on a fit, before it is sampled."""
        yield from ()

    # -- from the posterior on --------------------------------------------------------------------

    def questions(self, data: FitData, config: C) -> Questions:
        """What the general diagnostics have to know of a fit."""
        return Questions()

    def save_diagnosed(
        self,
        run: RunDirectory,
        data: FitData,
        posterior: Posterior,
        diagnostics: Diagnostics,
        config: C,
    ) -> None:
        """Write diagnostics that only this kind has, with their sections of summary.json."""

    def predictive(
        self,
        posterior: Posterior,
        diagnostics: Diagnostics,
        errors: ErrorModel,
        data: FitData,
        settings: EvaluationSettings,
    ) -> Predictive:
        """Predictive distribution of the assessed solution for the held-out stars.

        Quoted errors and jitter include the distortion that the model leaves out at a position.
        That error is common to neighbouring stars.
        """
        prediction = predictive_of(with_diagnosed_errors(posterior, diagnostics))
        correlated = diagnostics.correlated
        rows = None if correlated is None else correlated.facts.get("structure")
        if not rows:
            return prediction
        side = max(row["length_pix"] for row in rows)
        local = errors.local_tables(settings.grid, settings.epoch)
        return replace(prediction, local=local, cell=(side, side), local_in_noise=True)

    def error_terms(self, solution: Solution, data: FitData, config: Config) -> list[ErrorTerm]:
        """Errors of positions beside those of the solution: those that the user states."""
        return [*config.linear_terms(solution), *config.user_terms(solution.model.unit)]

    def domain(self, data: FitData, config: Config) -> EvaluationDomain:
        """The exposure that errors are evaluated for."""
        return EvaluationDomain(single=config.assess.exposure == "single")

    def null_space(self, data: FitData) -> Float | None:
        """Directions of the parameters (D, k) that only the gauge fixes; None if there are none."""
        return None

    def checks(self, data: FitData, series: Mapping[str, Any]) -> tuple[Check, ...]:
        """Checks of matching, exposures and gauge.

        `series` is the section 'time_dependence' of summary.json.
        """
        return ()

    def evaluation_sections(self, solution: Solution, config: C) -> dict[str, Any]:
        """Sections of summary.json about the evaluated solution."""
        return {}

    def report_parts(
        self,
        run: RunDirectory,
        data: FitData,
        posterior: Posterior,
        diagnostics: Diagnostics,
        epoch: float | None,
    ) -> dict[str, Any]:
        """Fields of the content of the report that only this kind has, by their names."""
        return {}


def kind_of(config: Config) -> RunKind[Any, Any, Any]:
    """Kind of run that a configuration describes; it is imported when it is first used."""
    kind: RunKind[Any, Any, Any] = load_object(config.kind)
    return kind
