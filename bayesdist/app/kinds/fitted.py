"""Artefact of the stage 'fit': the least-squares solution, and what its stars were given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.kinds.errors import ErrorLaw, read_magnitude_errors
from bayesdist.app.kinds.exposures import (
    FIT_AGAIN,
    ExposureScatter,
    read_hierarchy,
    read_series,
    write_hierarchy,
    write_series,
)
from bayesdist.app.kinds.solved import SelfCalibrated
from bayesdist.app.kinds.table_file import StoredLookupTables, read_tables, write_tables
from bayesdist.app.matches.added_errors import grouped_errors_of
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, LinearFit, load_fit, save_fit
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.equations.priors import JointPrior
from bayesdist.infer.nodes import corrected_matches, inside_chips, on_the_chips
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.series import Series
from bayesdist.model import DistortionModel

__all__ = ["Fitted", "load_fitted", "required"]

FIT, TABLES, PRIOR = "fit.nc", "tables.h5", "prior.h5"

SECTIONS = (  # of summary.json, which only the making of the fit knows
    *("gauge", "lines", "tables", "scatter"),
    *("deviations", "exposures_skipped", "exposures_outlying", "selfcal"),
)

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Fitted:
    """A least-squares solution with all that it rests on; what a kind of run lacks is None.

    Parameters
    ----------
    linear : LinearFit
    errors : ErrorLaw
        Of fitted and held-out stars.
    priors : GaussianPriors
    grouped : GroupedErrors or None
        Errors beyond the quoted ones, where groups of stars were compared.
    tables : StoredLookupTables
        Empty where there are none.
    scatter : ExposureScatter or None
        How exposures deviate, where they were fitted jointly.
    alone : Series or None
        Linear terms of exposures that were each fitted alone.
    solved : SelfCalibrated or None
        Solution and gauge of detections whose stars are not known otherwise.
    facts : mapping
        Sections of summary.json that only the making of the fit knows.
    """

    linear: LinearFit
    errors: ErrorLaw
    priors: GaussianPriors
    grouped: GroupedErrors | None = None
    tables: StoredLookupTables = field(default_factory=StoredLookupTables)
    scatter: ExposureScatter | None = None
    alone: Series | None = None
    solved: SelfCalibrated | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand, as a sentence; empty where that is no question."""
        return "" if self.solved is None else self.solved.gauge_words

    def placed(self, stars: Matches) -> Matches:
        """Stars at the pixels that the tables move them to, on their chips, with quoted errors.

        Of a self-calibration they are the detections beside the stars as they were solved.
        """
        if self.solved is not None:
            return self.solved.matches
        if not self.tables.tables or not stars.in_memory:
            return stars
        return on_the_chips(corrected_matches(self.tables.tables, stars), self.linear.model)

    def inside(self, stars: Matches) -> NDArray[np.bool_]:
        """Boolean mask (N,) of the stars that the tables do not move off their chip."""
        if not self.tables.tables:
            return np.ones(len(stars), bool)
        return inside_chips(corrected_matches(self.tables.tables, stars), self.linear.model)

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        write_tables(folder / TABLES, self.tables)
        self.errors.save(folder)
        save_fit(self.linear, folder / FIT)
        if self.scatter is not None:
            write_hierarchy(folder, self.scatter, self.priors)
        if self.priors.joint is not None:
            joint = self.priors.joint
            arrays = {"centre": joint.centre, "precision": joint.precision}
            write_arrays(folder / PRIOR, "", arrays | {"rank": np.array([joint.rank])})
        if self.alone is not None:
            write_series(folder, self.alone)
        if self.solved is not None:
            self.solved.save(folder)


def load_fitted(
    folder: Path,
    summary: Mapping[str, Any],
    *,
    joint: bool = False,
    priors: Callable[[DistortionModel], GaussianPriors] = GaussianPriors.none,
    solved: Callable[[DistortionModel], SelfCalibrated] | None = None,
) -> Fitted:
    """The fit of an earlier stage.

    Parameters
    ----------
    folder : Path
        Of the run.
    summary : mapping
        Content of summary.json.
    joint : bool
        Exposures were fitted jointly.
    priors : callable
        Of the model, where they were not.
    solved : callable, optional
        Of the model: the solution of detections, where the fit has one.

    Raises
    ------
    InputError
        For missing or damaged files.
    """
    linear, known = load_fit(folder / FIT), summary.get("fit", {})
    grouped = grouped_errors_of(known.get("added_errors"))
    scatter, own_priors = read_hierarchy(folder) if joint else (None, priors(linear.model))
    if (folder / PRIOR).exists():
        arrays = read_arrays(folder / PRIOR, "", do=FIT_AGAIN)
        earlier = JointPrior(arrays["centre"], arrays["precision"], int(arrays["rank"][0]))
        own_priors = replace(own_priors, joint=earlier)
    return Fitted(
        linear,
        ErrorLaw(
            float(known.get("error_scale", 1.0)),
            read_magnitude_errors(folder),
            None if grouped is None else grouped.added,
            with_catalogue=joint,
        ),
        own_priors,
        grouped,
        read_tables(folder / TABLES, do=FIT_AGAIN),
        scatter,
        read_series(folder) if joint else None,
        None if solved is None else solved(linear.model),
        {name: summary[name] for name in SECTIONS if name in summary},
    )


def required(part: T | None, what: str) -> T:
    """A part of a fit that its kind of run has.

    Raises
    ------
    InputError
        For a fit of another kind.
    """
    if part is None:
        raise InputError(f"has no {what}", where=FIT, do=FIT_AGAIN)
    return part
