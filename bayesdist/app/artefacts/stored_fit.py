"""Least-squares fit of a run with what it depends on, as files in the folder of the run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Required, TypedDict

from astropy.table import Table

from bayesdist.app.artefacts.parts import Part
from bayesdist.app.artefacts.stars import ErrorLaw
from bayesdist.app.store.output import write_table
from bayesdist.errors import InputError
from bayesdist.files.faults import restoring
from bayesdist.files.records import read_record, write_record
from bayesdist.infer import (
    GaussianPriors,
    LinearFit,
    Posterior,
    load_fit,
    load_posterior,
    save_fit,
)
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.plugin import packages

FIT, RECORD, MAGNITUDE_ERRORS = "fit.nc", "fit.h5", "magnitude_errors.ecsv"
# artefacts of the stage 'fit' by their names in fit.h5, which holds parts as well
RECORDED = {
    "errors": "errors",
    "priors": "priors",
    "grouped": "added_errors",
    "facts": "fit_facts",
}
FIT_AGAIN = "run the stage 'fit' again"


class FitArtefacts(TypedDict, total=False):
    """Artefacts of the stage 'fit' by their names; see the members of `bayesdist.Run`."""

    fit: Required[LinearFit]
    errors: ErrorLaw
    priors: GaussianPriors
    added_errors: GroupedErrors | None
    parts: Mapping[str, Part]
    fit_facts: Mapping[str, Any]


def write_stored_fit(
    folder: Path,
    fit: LinearFit,
    errors: ErrorLaw,
    parts: Mapping[str, Part],
    **further: Any,
) -> None:
    """Write a fit, its parts and the other artefacts of its stage to the folder of a run."""
    if errors.by_magnitude is not None:
        write_table(Table(vars(errors.by_magnitude)), folder / MAGNITUDE_ERRORS)
    save_fit(fit, folder / FIT)
    artefacts = {"errors": errors, **further}
    content = {key: artefacts[name] for key, name in RECORDED.items()}
    recorded = {name: part for name, part in parts.items() if part.recorded}
    write_record(folder / RECORD, {**content, "parts": recorded})
    for part in parts.values():
        part.save(folder)


def read_stored_fit(folder: Path) -> FitArtefacts:
    """Artefacts of the stage 'fit', with the parts of fit.h5."""
    record = _read_record(folder)
    return {
        "fit": load_fit(folder / FIT),
        "errors": record["errors"],
        "priors": record["priors"],
        "added_errors": record["grouped"],
        "fit_facts": record["facts"],
        "parts": record["parts"],
    }


def load_errors(folder: Path) -> ErrorLaw:
    """Load the error law of an earlier fit; raises InputError as `read_stored_fit` does."""
    errors: ErrorLaw = _read_record(folder)["errors"]
    return errors


def hierarchy_of(fit: LinearFit, parts: Mapping[str, Part]) -> LinearFit | None:
    """The fit, if its exposures scatter about its solution; else None."""
    return fit if any(part.is_hierarchy for part in parts.values()) else None


def _read_record(folder: Path) -> dict[str, Any]:
    """Content of fit.h5."""
    content = "what a fit rests on"
    record = read_record(folder / RECORD, dict, content, do=FIT_AGAIN, packages=packages())
    with restoring(folder / RECORD, content, do=FIT_AGAIN):
        return {name: record[name] for name in (*RECORDED, "parts")}


def converged_posterior(path: Path, use: str) -> Posterior:
    """Load the posterior of another run, which must have converged.

    Parameters
    ----------
    path : Path
        File of the posterior.
    use : str
        Clause that completes the error message: what the posterior is needed for.

    Raises
    ------
    InputError
        If the run has not converged.
    """
    posterior: Posterior = load_posterior(path)
    if not posterior.convergence.converged:
        raise InputError(
            f"the run has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(path.parent),
            do=f"resume it with more steps before {use}",
        )
    return posterior
