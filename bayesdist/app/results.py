"""The artefacts of a run: made by its stages, or loaded from its folder when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from bayesdist.app.assessment.checks import run_checks
from bayesdist.app.assessment.diagnosing import diagnose_residuals, diagnose_run
from bayesdist.app.assessment.error_terms import (
    assessment_epoch,
    assessment_rng,
    errors_of_run,
    evaluation_settings,
)
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData, StarReader
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.kind import Kind, kind_of
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.matches.sources import RunInput, input_of_run
from bayesdist.app.products.made_files import ProductInput, product_of, solution_of
from bayesdist.app.products.product_terms import file_errors
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.result_files import load_diagnostics, load_evaluation
from bayesdist.assess import Margin, Requirement
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.evaluation import (
    Evaluation,
    EvaluationSettings,
    drawn_errors,
    judged,
    validity_of,
)
from bayesdist.assess.model import ErrorModel
from bayesdist.assess.requirements.validity import ValidityPeriod
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import LinearFit, Posterior, load_posterior
from bayesdist.utils.checks import Check, in_order

T = TypeVar("T")

# each rests on those before it
ARTEFACTS = "inputs matched fitted data posterior stored evaluation products figures".split()


@dataclass(frozen=True, eq=False)
class Results:
    """The artefacts of a run, and what follows from them."""

    run: RunDirectory
    reader: StarReader  # reads the stars once for all stages
    # artefacts of this process, in place of those in the folder
    made: Mapping[str, Any] = field(default_factory=dict)
    # pairs in RvB files, which may have to be selected before they are read
    source: RunInput | None = None

    def having(self, **artefacts: Any) -> Results:
        """Results with artefacts in place of earlier ones, without any that rested on those."""
        first = min(ARTEFACTS.index(name) for name in artefacts)
        known = {**self.made, **vars(self)}
        kept = {name: known[name] for name in ARTEFACTS[:first] if name in known}
        return replace(self, made={**kept, **artefacts})

    def adopting_inputs(self) -> Results:
        """Results whose inputs lie in the run's folder, where they were prepared beside it."""
        if self.source is None or not self.source.move_into_run():
            return self
        moved = self.having(inputs=self.source.load())
        self.reader.moved(moved.matched.stars)
        return moved.having(matched=moved.matched).having(fitted=self.fitted)

    def close(self) -> None:
        """Let go of the stars, and of what was written of them beside the run's folder."""
        self.reader.close()
        if self.source is not None:
            self.source.close()

    # -- artefacts --------------------------------------------------------------------------------

    def _artefact(self, name: str, stage: str, load: Callable[[], T]) -> T:
        """What this process has made, or what a stage has left in the folder, if undamaged."""
        if self.made.get(name) is not None:
            found: T = self.made[name]
            return found
        self.run.refuse_damaged(stage)
        return load()

    @cached_property
    def config(self) -> Config:
        """The resolved configuration."""
        return self.run.config

    @cached_property
    def base(self) -> Path:
        """Folder that the configuration's files are relative to."""
        return self.run.base

    @cached_property
    def kind(self) -> Kind:
        """Kind of the run, with all that it does in its own way."""
        return kind_of(self.config)

    @cached_property
    def inputs(self) -> Any:
        """All that the run begins with."""
        if "inputs" in self.made:
            return self.made["inputs"]
        if self.source is not None:
            return self.source.load()
        return self.kind.read(self.config, self.base)

    @cached_property
    def matched(self) -> Matched:
        """Stars that are fitted and stars that are held out, as they were read or matched."""

        def load() -> Matched:
            if self.kind.load_matched is None:
                return self.kind.match(self.inputs, self.config)
            return self.kind.load_matched(self.run.path, self.inputs, self.run.summary)

        return self._artefact("matched", "match", load)

    @cached_property
    def fitted(self) -> Fitted:
        """The least-squares solution, with what its stars were given."""
        return self._artefact(
            "fitted", "fit", lambda: self.kind.load_fitted(self.run.path, lambda: self.matched)
        )

    @cached_property
    def data(self) -> FitData:
        """The fit and its stars."""
        return self.made.get("data") or FitData(self.matched, self.fitted, self.reader)

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior as it was sampled."""
        return self._artefact(
            "posterior", "sample", lambda: load_posterior(self.run / "posterior.nc")
        )

    @property
    def is_sampled(self) -> bool:
        """Boolean: there is a posterior."""
        return "posterior" in self.made or (self.run / "posterior.nc").exists()

    @cached_property
    def stored(self) -> Diagnostics | None:
        """Diagnostics as the run has them; None before."""
        return self._artefact(
            "stored", "diagnose", lambda: load_diagnostics(self.run, self.fit, self.posterior)
        )

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Diagnostics as the run has them, or made now; fewer of a fit alone."""
        if not self.is_sampled:
            return diagnose_residuals(None, self.data, self.config)
        return self.stored or diagnose_run(self.posterior, self.data, self.config, self.base)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Maps, budget, margins and validity periods, as the assessment has found them."""
        return self._artefact(
            "evaluation", "evaluate", lambda: load_evaluation(self.run, self.fit, self.posterior)
        )

    @property
    def stored_evaluation(self) -> Evaluation | None:
        """The evaluation, if there is one of this posterior."""
        there = "evaluation" in self.made or self.run.done("evaluate")
        return self.evaluation if there else None

    # -- what follows from them -------------------------------------------------------------------

    @property
    def fit(self) -> LinearFit:
        """The least-squares fit itself."""
        return self.fitted.linear

    @cached_property
    def solution(self) -> Posterior:
        """Posterior that is exported and shown: with all errors that were found."""
        return solution_of(self.posterior, self.stored, self.fitted)

    @cached_property
    def errors(self) -> ErrorModel:
        """All errors of a position."""
        return errors_of_run(self.posterior, self.diagnostics, self.data, self.config)

    @cached_property
    def settings(self) -> EvaluationSettings:
        """Where and how errors are evaluated."""
        return evaluation_settings(self.data, self.config)

    @property
    def epoch(self) -> float | None:
        """Epoch of the assessment, decimal years; stars are read only where it is theirs."""
        if self.config.assess.epoch is not None or self.fit.model.time is None:
            return self.config.assess.epoch  # without reading the stars
        return assessment_epoch(self.data, self.config)

    @property
    def product(self) -> ProductInput:
        """Ingredients of the files of the solution."""
        return product_of(self.posterior, self.stored, self.data, self.config, self.source_name)

    @property
    def source_name(self) -> str:
        """Name of the run in the files of its solution; empty if it has no folder."""
        return "" if self.run.in_memory else str(self.run.path)

    @property
    def series(self) -> Mapping[str, Any]:
        """Linear terms against time: a section of summary.json, empty where it has none."""
        found: Mapping[str, Any] = self.run.summary.get("time_dependence", {})
        return found

    @property
    def checks(self) -> tuple[Check, ...]:
        """All checks but those of an evaluation."""
        posterior = self.posterior if self.is_sampled else None
        own = run_checks(self.data, posterior, self.diagnostics, self.config, self.series)
        return in_order((*own, *self.diagnostics.checks))


def results_of(run: RunDirectory) -> Results:
    """The results of a run, which whoever asks for them closes."""
    return Results(run, StarReader(run.config.resources()), source=input_of_run(run))


@contextmanager
def open_results(run: RunDirectory) -> Iterator[Results]:
    """The results of a run, whose stars are let go of in the end."""
    results = results_of(run)
    try:
        yield results
    finally:
        results.close()


def errors_of(results: Results) -> DrawnErrors:
    """Draws of all errors of a position, as budget and margins have them, and of files."""
    files = file_errors(results.product, results.config, results.base)
    given = results.errors, results.diagnostics, results.settings
    return drawn_errors(*given, assessment_rng(results.config), files=files)


def margins_of(results: Results, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run against requirements."""
    requirements = results.config.within_field(requirements)
    given = results.errors, results.diagnostics, requirements, results.settings
    return judged(*given, assessment_rng(results.config), checks=results.checks)


def validity_periods_of(
    results: Results, requirements: Sequence[Requirement]
) -> tuple[ValidityPeriod, ...]:
    """Until when requirements are met by a run, where something depends on time."""
    given = results.errors, results.diagnostics, requirements, results.settings
    return validity_of(*given, assessment_rng(results.config))
