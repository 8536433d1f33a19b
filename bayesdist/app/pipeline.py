"""From stars to files in Python: the functions that the stages of a run call, without a folder.

A configuration says what is asked for, and paths in it are relative to `base`::

    config, _ = load_config("job/config.toml")
    base = Path("job")
    data = fit(match(config, base), config, base)
    posterior = sample(data, config)
    found = diagnose(posterior, data, config, base)
    errors = error_model(posterior, found, data, config)
    evaluation = evaluate(errors, posterior, found, data, config, base)
    export(evaluation, posterior, found, data, config, base, Path("products"))

What `bayesdist run` makes of the same configuration is the same to the last bit.  A report shows
the `Results` of a run's folder (`bayesdist.app.results`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bayesdist.app.assessment.diagnosing import diagnose_run as diagnose
from bayesdist.app.assessment.error_terms import errors_of_run as error_model
from bayesdist.app.assessment.judging import evaluate_run
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.kind import kind_of
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.products.made_files import ProductInput, product_input
from bayesdist.app.stages.export import export_files
from bayesdist.app.stages.report import run_report as report
from bayesdist.assess.error_model import ErrorModel, solution_with_errors
from bayesdist.assess.evaluation import Evaluation
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior

__all__ = [
    "diagnose",
    "error_model",
    "evaluate",
    "export",
    "fit",
    "match",
    "report",
    "sample",
]


def match(config: Config, base: Path) -> Matched:
    """Stars that are fitted and stars that are held out, read or matched.

    Parameters
    ----------
    config : Config
    base : Path
        Folder that its files are relative to.

    Raises
    ------
    BayesdistError
        For files that cannot be read or do not go together.
    """
    kind = kind_of(config)
    inputs = kind.read(config, base)
    kind.refuse(inputs, config, base)
    return kind.match(inputs, config, base)


def fit(matched: Matched, config: Config, base: Path) -> FitData:
    """The least-squares solution with its stars.

    Parameters
    ----------
    matched : Matched
    config, base
        As of `match`.

    Raises
    ------
    BayesdistError
        For parameters that the stars do not determine.
    """
    reader = StarReader(config.resources())
    fitted = kind_of(config).fit(matched, config, base, reader)
    return FitData(matched, fitted, reader)


def sample(
    data: FitData,
    config: Config,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """The posterior of a fit.

    Parameters
    ----------
    data : FitData
    config : Config
    folder : Path, optional
        For checkpoints.
    progress : callable, optional
        Called with (steps made, most steps).
    """
    return kind_of(config).sample(data, config, folder=folder, progress=progress)


def evaluate(
    errors: ErrorModel,
    posterior: Posterior,
    found: Diagnostics,
    data: FitData,
    config: Config,
    base: Path,
) -> Evaluation:
    """Maps, budget, margins and validity periods.

    Parameters
    ----------
    errors : ErrorModel
    posterior : Posterior
    found : Diagnostics
    data : FitData
    config, base
        As of `match`.
    """
    product = _product(posterior, found, data, config)
    return evaluate_run(errors, posterior, found, data, product, config, base)


def export(
    evaluation: Evaluation,
    posterior: Posterior,
    found: Diagnostics,
    data: FitData,
    config: Config,
    base: Path,
    folder: Path,
) -> list[dict[str, Any]]:
    """Write the files that a configuration asks for, and list what is known of each.

    Parameters
    ----------
    evaluation : Evaluation
        With whose budget the errors of the files are compared.
    posterior : Posterior
    found : Diagnostics
    data : FitData
    config, base
        As of `match`.
    folder : Path
        Where the files are written.
    """
    return export_files(
        _product(posterior, found, data, config),
        data.fitted,
        config,
        base,
        folder,
        stars=found.sample,
        budget=evaluation.budget.rows(),
    )


def _product(
    posterior: Posterior, found: Diagnostics, data: FitData, config: Config
) -> ProductInput:
    """What files are made from: the solution with all errors of the parameters."""
    hierarchy = None if data.fitted.scatter is None else data.fit
    solution = solution_with_errors(posterior, found, hierarchy)
    return product_input(solution, data, config, config.detector.name or "solution")
