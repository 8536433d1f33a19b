"""Artefacts of a run: made by its stages, or loaded from its folder when needed."""

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
    assessment_rng,
    errors_of_run,
    evaluation_settings,
)
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData, StarReader, assessment_epoch
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.kind import RunKind, kind_of
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
from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import LinearFit, Posterior, load_posterior
from bayesdist.utils.checks import Check, in_order

T = TypeVar("T")

# in order: each depends on those before it
ARTEFACTS = "inputs matched fitted data posterior stored evaluation products figures".split()


@dataclass(frozen=True, eq=False)
class Results:
    """Artefacts of a run, and quantities derived from them."""

    run: RunDirectory
    reader: StarReader  # cache: the stars are read once for all stages
    # artefacts made by this process, which replace those in the folder
    made: Mapping[str, Any] = field(default_factory=dict)
    # matches in the format of a mission, which may have to be selected before they are read
    source: RunInput | None = None

    def having(self, **artefacts: Any) -> Results:
        """Results with some artefacts replaced; artefacts that depend on them are dropped."""
        first = min(ARTEFACTS.index(name) for name in artefacts)
        available = {**self.made, **vars(self)}
        unaffected = {name: available[name] for name in ARTEFACTS[:first] if name in available}
        return replace(self, made={**unaffected, **artefacts})

    def adopting_inputs(self) -> Results:
        """Results with inputs moved into the run's folder, if they were prepared elsewhere."""
        if self.source is None or not self.source.move_into_run():
            return self
        moved = self.having(inputs=self.source.load())
        self.reader.moved(moved.matched.stars)
        return moved.having(matched=moved.matched).having(fitted=self.fitted)

    def close(self) -> None:
        """Release the stars, and remove their temporary files."""
        self.reader.close()
        if self.source is not None:
            self.source.close()

    # -- artefacts --------------------------------------------------------------------------------

    def _artefact(self, name: str, stage: str, load: Callable[[], T]) -> T:
        """Artefact made by this process, otherwise loaded from the folder if undamaged."""
        if self.made.get(name) is not None:
            artefact: T = self.made[name]
            return artefact
        self.run.refuse_damaged(stage)
        return load()

    @cached_property
    def config(self) -> Config:
        """Resolved configuration."""
        return self.run.config

    @cached_property
    def base(self) -> Path:
        """Folder that file names in the configuration are relative to."""
        return self.run.base

    @cached_property
    def kind(self) -> RunKind[Any, Any, Any]:
        """Kind of the run."""
        return kind_of(self.config)

    @cached_property
    def inputs(self) -> Any:
        """Inputs of the run."""
        if "inputs" in self.made:
            return self.made["inputs"]
        if self.source is not None:
            return self.source.load()
        return self.kind.read(self.config, self.base)

    @cached_property
    def matched(self) -> Matched:
        """Fitted and held-out stars."""

        def load() -> Matched:
            folder, summary = self.run.path, self.run.summary
            matched: Matched = self.kind.load_matched(folder, self.inputs, self.config, summary)
            return matched

        return self._artefact("matched", "match", load)

    @cached_property
    def fitted(self) -> Fitted:
        """Least-squares solution with everything that it depends on."""
        return self._artefact(
            "fitted", "fit", lambda: self.kind.load_fitted(self.run.path, lambda: self.matched)
        )

    @cached_property
    def data(self) -> FitData:
        """The fit and its stars."""
        return self.made.get("data") or FitData(self.matched, self.fitted, self.reader)

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior as sampled."""
        return self._artefact(
            "posterior", "sample", lambda: load_posterior(self.run / "posterior.nc")
        )

    @property
    def is_sampled(self) -> bool:
        """True if there is a posterior."""
        return "posterior" in self.made or (self.run / "posterior.nc").exists()

    @cached_property
    def stored(self) -> Diagnostics | None:
        """Diagnostics stored in the run; None if there are none."""
        return self._artefact(
            "stored", "diagnose", lambda: load_diagnostics(self.run, self.fit, self.posterior)
        )

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Diagnostics stored in the run, otherwise computed now.

        Without a posterior they are those of the fit alone.
        """
        if not self.is_sampled:
            return diagnose_residuals(None, self.data, self.config)
        return self.stored or diagnose_run(self.posterior, self.data, self.config, self.base)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Maps, budget, margins and validity periods."""
        return self._artefact(
            "evaluation", "evaluate", lambda: load_evaluation(self.run, self.fit, self.posterior)
        )

    @property
    def stored_evaluation(self) -> Evaluation | None:
        """Evaluation of this posterior; None if there is none."""
        exists = "evaluation" in self.made or self.run.done("evaluate")
        return self.evaluation if exists else None

    # -- what follows from them -------------------------------------------------------------------

    @property
    def fit(self) -> LinearFit:
        """Least-squares fit."""
        return self.fitted.linear

    @cached_property
    def solution(self) -> Posterior:
        """Posterior with all errors that the diagnostics found; it is exported and shown."""
        return solution_of(self.posterior, self.stored, self.fitted)

    @cached_property
    def errors(self) -> ErrorModel:
        """Error model of positions, with all errors."""
        return errors_of_run(self.posterior, self.diagnostics, self.data, self.config)

    @cached_property
    def settings(self) -> EvaluationSettings:
        """Settings of the evaluation."""
        return evaluation_settings(self.data, self.config)

    @property
    def epoch(self) -> float | None:
        """Epoch of the assessment in decimal years.

        Stars are read only if it is their latest date.
        """
        if self.config.assess.epoch is not None or self.fit.model.time is None:
            return self.config.assess.epoch  # without reading the stars
        return assessment_epoch(self.data, self.config)

    @property
    def product(self) -> ProductInput:
        """Ingredients of the products."""
        return product_of(self.posterior, self.stored, self.data, self.config, self.source_name)

    @property
    def source_name(self) -> str:
        """Name of the run in its products; empty if it has no folder."""
        return "" if self.run.in_memory else str(self.run.path)

    @property
    def series(self) -> Mapping[str, Any]:
        """Section 'time_dependence' of summary.json; empty if there is none."""
        section: Mapping[str, Any] = self.run.summary.get("time_dependence", {})
        return section

    @property
    def checks(self) -> tuple[Check, ...]:
        """All checks except those of an evaluation."""
        posterior = self.posterior if self.is_sampled else None
        run_only = run_checks(self.data, posterior, self.diagnostics, self.config, self.series)
        return in_order((*run_only, *self.diagnostics.checks))


def results_of(run: RunDirectory) -> Results:
    """Results of a run; the caller must close them."""
    return Results(run, StarReader(run.config.resources()), source=input_of_run(run))


@contextmanager
def open_results(run: RunDirectory) -> Iterator[Results]:
    """Open the results of a run, and close them at the end of the context."""
    results = results_of(run)
    try:
        yield results
    finally:
        results.close()


def errors_of(results: Results) -> DrawnErrors:
    """Draws of all position errors, as for budget and margins, including those of products."""
    files = file_errors(results.product, results.config, results.base)
    arguments = results.errors, results.diagnostics, results.settings
    return drawn_errors(*arguments, assessment_rng(results.config), files=files)


def margins_of(results: Results, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run for the given requirements."""
    requirements = results.config.within_field(requirements)
    arguments = results.errors, results.diagnostics, requirements, results.settings
    return judged(*arguments, assessment_rng(results.config), checks=results.checks)


def validity_periods_of(
    results: Results, requirements: Sequence[Requirement]
) -> tuple[ValidityPeriod, ...]:
    """Validity periods of requirements, if anything depends on time."""
    arguments = results.errors, results.diagnostics, requirements, results.settings
    return validity_of(*arguments, assessment_rng(results.config))
