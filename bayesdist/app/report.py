"""Report of a run: content, figures, and report.html."""

from __future__ import annotations

import logging
import os
import shlex
import sys
from pathlib import Path
from typing import Any

from bayesdist.app.calibrations import difference_from_previous
from bayesdist.app.config import Config
from bayesdist.app.products.made_files import product_of_run
from bayesdist.app.run import Run
from bayesdist.app.store import as_json
from bayesdist.assess.comparison.compare import Comparison
from bayesdist.assess.evaluation import Evaluation
from bayesdist.assess.solution import chip_places, coefficient_table
from bayesdist.assess.vectors import diagram_vectors
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.files.atomic import atomic_path
from bayesdist.infer import Posterior
from bayesdist.report.context import ChipResults, Product, ReportInput
from bayesdist.utils.checks import Check

log = logging.getLogger("bayesdist")


def report(run: Run, *, pdf: bool = False) -> list[str]:
    """Write the report to the folder of the run, and return the names of its figures."""
    # imported here because plotting takes seconds to import
    from bayesdist.report.drawing import save_drawings
    from bayesdist.report.run_report import draw_report, write_report
    from bayesdist.report.sections.run.status import verdict

    inputs, directory = report_input(run), run.directory
    drawings = draw_report(inputs, pdf=pdf, processes=2 if _is_command_line() else 1)
    names = [path.name for path in save_drawings(drawings, directory / "figures")]
    write_report(directory / "report.html", inputs, drawings)
    overall = verdict(inputs)
    directory.summarise(verdict={"level": overall.level, "headline": overall.headline})
    log.info("report: %s", directory / "report.html")
    return names


def write_html_report(run: Run, path: Path) -> None:
    """Write the report of a run to one HTML file.

    Parameters
    ----------
    run : Run
    path : pathlib.Path

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from bayesdist.report.run_report import draw_report, render_report

    inputs = report_input(run)
    text = render_report(inputs, draw_report(inputs))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _is_command_line() -> bool:
    """True if other processes may import the main module; that of a user may be unguarded."""
    path = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    name = path.parent.stem if path.name == "__main__.py" else path.stem
    return name == "bayesdist" and (os.cpu_count() or 1) > 1


def report_input(run: Run) -> ReportInput:
    """Content of the report, from the artefacts of a run."""
    directory, config, solution = run.directory, run.config, run.solution
    diagnostics, evaluation = run.diagnostics, run.evaluation
    facts, folder = directory.facts, directory.path.resolve().name
    products = tuple(
        Product(p["path"], p["kind"], _product_checks(p))
        for p in directory.summary.get("products", [])
    )
    return ReportInput(
        name=title_of(config) or folder,
        config=as_json(config.model_dump(exclude_none=True)),
        stars=diagnostics.sample,
        exposures=diagnostics.sums.exposures,
        fit=run.fit,
        posterior=run.posterior,
        chips=_chip_results(solution, diagnostics, evaluation, run.epoch),
        coefficients=coefficient_table(run.fit, solution),
        previous=_difference_from_previous(run),
        budget=evaluation.budget,
        surface=evaluation.surface,
        margins=evaluation.margins,
        validity=evaluation.validity,
        products=products,
        checks=evaluation.checks,
        score_tests=diagnostics.score_tests,
        periods=diagnostics.periods,
        held_out=diagnostics.holdout,
        magnitude_errors=run.errors.by_magnitude,
        added_errors=run.added_errors,
        flagged=diagnostics.flagged,
        tables=run.tables.tables,
        provenance={"folder": folder}
        | {"command": _without_folders(facts["command"])}
        | {k: facts[k] for k in ("created", "seed", "inputs", "versions")}
        | {"stages": directory.record.stages},
        **run.kind.report_parts(run),
    )


def _without_folders(command: str) -> str:
    """Command line without the folders of absolute paths, which run.json has."""
    try:
        words = shlex.split(command)
    except ValueError:  # it was changed since it was recorded
        return command
    return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words)


def _difference_from_previous(run: Run) -> tuple[Comparison, ...]:
    """Difference from the release that the run replaces, by chip; empty if none is named."""
    previous = run.config.products.previous
    if previous is None:
        return ()
    product = product_of_run(run)
    return difference_from_previous(
        product.calibration, run.base / previous, product.options.epoch, previous
    )


MOST_NAMED = 3  # largest number of chips named in a title


def title_of(config: Config) -> str:
    """Mission, instrument, detector or chips, and filter, as far as they are given."""
    block, names = config.detector, [chip.name for chip in config.chip if chip.name]
    is_short = len(names) <= MOST_NAMED
    detector = block.name or (" and ".join(names) if is_short else f"{names[0]} to {names[-1]}")
    named = " ".join(part for part in (block.mission, block.instrument, detector) if part)
    return ", ".join(part for part in (named, config.filter_name) if part)


def _chip_results(
    solution: Posterior, found: Diagnostics, evaluation: Evaluation, epoch: float | None
) -> tuple[ChipResults, ...]:
    relative = evaluation.relative or (None,) * len(evaluation.maps)
    return tuple(
        ChipResults(
            chip=chip,
            formal_map=formal,
            posterior_map=with_errors,
            displacement=diagram_vectors(solution, chip, part="no_constant", epoch=epoch),
            non_linear=diagram_vectors(solution, chip, part="non_linear", epoch=epoch),
            area=area,
            binned=sums.residuals(),
            place=place,
            relative_map=of_pairs,
        )
        for chip, place, sums, formal, with_errors, area, of_pairs in zip(
            solution.model.chips,
            chip_places(solution, epoch=epoch),
            found.shown,
            evaluation.formal,
            evaluation.maps,
            evaluation.areas,
            relative,
            strict=True,
        )
    )


def _product_checks(product: dict[str, Any]) -> tuple[Check, ...]:
    """Checks of a product after it was written."""
    named = {
        "closure_pix": "worst closure of the inverse (pix)",
        "a_dmax": "A_DMAX (pix)",
        "b_dmax": "B_DMAX (pix)",
    }
    values = {name: product.get(key) for key, name in named.items()}
    if sky := product.get("sky"):
        values[f"rms distance from RA, Dec of {sky['n']} stars (arcsec)"] = sky["rms_arcsec"]
        values["largest distance from the solution (arcsec)"] = sky["solution_arcsec"]
    out = [Check("Products", name, size) for name, size in values.items() if size is not None]
    levels = {"error": "fail", "warning": "warn", "note": "note"}
    for finding in product["findings"]:
        level, _, text = finding.partition(": ")
        # the finding is the sentence, and the headline names the criterion
        name = "reading by other programs"
        out.append(Check("Products", name, text, "", levels.get(level, "note")))
    return tuple(out)
