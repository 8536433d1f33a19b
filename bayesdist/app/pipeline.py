"""Functions of a calibration in Python: the steps of `bayesdist run`, without a run directory.

The steps follow a configuration, and paths in it are relative to `base`::

config, _ = load_config("job/config.toml") base = Path("job") data = fit(match(read(config, base),
config), config, base) posterior = sample(data, config) found = diagnose(posterior, data, config,
base) errors = error_model(posterior, found, data, config) evaluation = evaluate(errors, posterior,
found, data, config, base) export(evaluation, posterior, found, data, config, base,
Path("products"))

The results are identical to those of `bayesdist run` with the same configuration, which calls these
functions in `bayesdist.app.stages.make_stages` and writes their results.  A `report` shows the
`Results` of a run's folder (`bayesdist.app.results`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bayesdist.app.assessment.checks import run_checks
from bayesdist.app.assessment.diagnosing import diagnose_run as diagnose
from bayesdist.app.assessment.error_terms import assessment_rng, evaluation_settings
from bayesdist.app.assessment.error_terms import errors_of_run as error_model
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData, StarReader
from bayesdist.app.kinds.kind import kind_of
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.products.export import export
from bayesdist.app.products.made_files import product_input, solution_of
from bayesdist.app.products.product_terms import file_errors
from bayesdist.app.report import report
from bayesdist.assess import evaluation as assessed
from bayesdist.assess.model import ErrorModel
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior

__all__ = [
    "diagnose",
    "error_model",
    "evaluate",
    "export",
    "fit",
    "match",
    "read",
    "report",
    "sample",
]


def read(config: Config, base: Path) -> Any:
    """Read the inputs of a run, and refuse those that cannot be used.

    Parameters
    ----------
    config : Config
    base : Path
        Folder that file names are relative to.

    Returns
    -------
    Matches or Inputs
        Matched stars, or star lists with their catalogue and log, depending on the kind of run.

    Raises
    ------
    InputError
        If the inputs cannot be read or are inconsistent.
    """
    kind = kind_of(config)
    inputs = kind.read(config, base)
    kind.refuse(inputs)
    return inputs


def match(inputs: Any, config: Config) -> Matched:
    """Match stars, and divide them into fitted and held-out stars.

    Parameters
    ----------
    inputs : Matches or Inputs
        Inputs returned by `read`.
    config : Config

    Returns
    -------
    Matched
    """
    return kind_of(config).match(inputs, config)


def fit(matched: Matched, config: Config, base: Path, reader: StarReader | None = None) -> FitData:
    """Fit by least squares.

    Parameters
    ----------
    matched : Matched
    config : Config
    base : Path
        Folder that file names are relative to.
    reader : StarReader, optional
        Reader that may already hold the stars.

    Returns
    -------
    FitData
        The solution with its stars.
    """
    reader = reader or StarReader(config.resources())
    return FitData(matched, kind_of(config).fit(matched, config, base, reader), reader)


def sample(
    data: FitData,
    config: Config,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample the posterior of a fit.

    Parameters
    ----------
    data : FitData
    config : Config
    folder : Path, optional
        Folder for checkpoints.
    progress : callable, optional
        Called with the number of steps made and the largest number of steps.

    Returns
    -------
    Posterior
    """
    return kind_of(config).sample(data, config, folder=folder, progress=progress)


def evaluate(
    errors: ErrorModel,
    posterior: Posterior,
    found: Diagnostics,
    data: FitData,
    config: Config,
    base: Path,
    *,
    source: str = "",
    series: Mapping[str, Any] | None = None,
) -> assessed.Evaluation:
    """Evaluate maps, budget, margins and validity periods.

    Parameters
    ----------
    errors : ErrorModel
    posterior : Posterior
    found : Diagnostics
    data : FitData
    config : Config
    base : Path
        Folder that file names are relative to.
    source : str
        Origin of the solution that files state; the detector by default.
    series : mapping, optional
        Section 'time_dependence' of summary.json.

    Returns
    -------
    Evaluation
    """
    solution = solution_of(posterior, found, data.fitted)
    product = product_input(solution, data, config, source)
    return assessed.evaluate(
        errors,
        found,
        config.requirements(),
        evaluation_settings(data, config),
        assessment_rng(config),
        fit=data.fit,
        solution=solution,
        checks=run_checks(data, posterior, found, config, series),
        files=file_errors(product, config, base),
        null=kind_of(config).null_space(data),
    )
