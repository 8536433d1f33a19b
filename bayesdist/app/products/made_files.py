"""Calibration files of a solution as configured, and files of a release."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.kind import Outline
from bayesdist.app.products.release_set import release_set
from bayesdist.app.run import Run
from bayesdist.assess.budget import TOTAL
from bayesdist.assess.terms.correlated import DEVIATIONS, STRUCTURE, STRUCTURE_IN_FIT
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.assess.terms.parameters import (
    ABERRATION,
    CATALOGUE,
    COEFFICIENTS,
    EXPOSURE_FRAME,
    MOTIONS,
    TIME_DEPENDENCE,
)
from bayesdist.calibration.calibration import Calibration, GaussianSolution, calibration_of
from bayesdist.calibration.chip_map import FurtherError
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import LookupTable
from bayesdist.products.common.document import BuildOptions, Built
from bayesdist.products.registry import build

# rows of a budget that are included in the covariance of the exported solution, or in another row
IN_COVARIANCE = (
    *(COEFFICIENTS, TIME_DEPENDENCE, EXPOSURE_FRAME, STRUCTURE_IN_FIT, DEVIATIONS),
    *(CATALOGUE, MOTIONS, ABERRATION),
)


REHEARSED_SIGMA = 1e-3  # pixels: assumed error of each coefficient, because files state errors


@dataclass(frozen=True, eq=False)
class ProductInput:
    """Ingredients of the products of a run."""

    solution: Solution  # including the frames of its exposures
    calibration: Calibration  # of the solution, with facts of its run
    options: BuildOptions
    aligned: bool = False  # True if users of a file fit shift and rotation of an exposure


def further_errors(
    budget: Sequence[Mapping[str, Any]], discrepancy: Mapping[str, Any] | None = None
) -> tuple[FurtherError, ...]:
    """Rows of an error budget that the covariance of the exported solution does not include.

    `discrepancy` is the section 'discrepancy' of summary.json, which states the correlation of
    structure between positions.
    """
    correlation = [
        (float(fraction), float(length))
        for fraction, length in (discrepancy or {}).get("structure_correlation", ())
    ]
    return tuple(
        FurtherError(
            str(row["name"]),
            str(row["kind"]),
            float(row["u"]),
            float(row["v"]),
            str(row.get("source", "")),
            tuple(correlation) if row["name"] == STRUCTURE else (),
        )
        for row in budget
        if row["name"] not in IN_COVARIANCE and row["kind"] not in (PRODUCT, TOTAL)
    )


def with_facts_of_run(
    calibration: Calibration,
    config: Config,
    tables: tuple[LookupTable, ...],
    budget: Sequence[Mapping[str, Any]],
    discrepancy: Mapping[str, Any] | None = None,
) -> Calibration:
    """Calibration of the solution of a run with further facts of the run.

    These are the pixel size, the look-up tables, and the rows of the budget that the covariance
    does not include, with the correlation between positions that `discrepancy` states.
    """
    mas, unit = config.detector.scale_mas, calibration.unit
    if unit != "pix" and mas is not None:
        scale = mas / (1000 * ARCSEC[unit])
        calibration = replace(calibration, scale=scale, scale_from="detector.scale_mas")
    further = further_errors(budget, discrepancy)
    return replace(calibration, pixel_mas=mas, before=tables, further=further)


def product_of_run(run: Run, solution: Solution | None = None, source: str = "") -> ProductInput:
    """Ingredients of the products of a run.

    Parameters
    ----------
    run : Run
    solution : Solution, optional
        By default the posterior with all errors of the parameters that were found.
    source : str
        Name of the solution in the files; by default that of the run.
    """
    model, config = run.model, run.config
    solution = run.solution if solution is None else solution
    plane, point = Plane(), run.tangent_point
    if point is not None:
        note = ""
        if model.frames != "none" and len(model.exposures) > 1:
            # exposures have different frames, so that a file on the sky is for one of them
            first = model.exposures[0]
            note = f"On the sky it is exposure {first}: others have frames of their own."
        plane = Plane("sky", point=point, note=note)
    source, tables = source or run.source_name, run.tables.tables
    ingredients = _input_of(solution, config, source, plane, run.filter, run.epoch, tables)
    notes = (run.gauge_words,) if run.gauge_words else ()
    aligned = run.kind.domain(run).aligned
    calibration = replace(ingredients.calibration, notes=notes)
    return replace(ingredients, calibration=calibration, aligned=aligned)


def _input_of(
    solution: Solution,
    config: Config,
    source: str,
    plane: Plane,
    filter: str,
    epoch: float | None,
    tables: tuple[LookupTable, ...],
) -> ProductInput:
    detector = config.detector
    name = source or detector.name or "solution"
    calibration = calibration_of(solution, name, plane=plane, detector=detector.name, filter=filter)
    scale = None if detector.scale_mas is None else detector.scale_mas / 1000
    return ProductInput(solution, calibration, BuildOptions(epoch, scale, tables))


def rehearse_files(product: ProductInput, config: Config) -> None:
    """Make the configured products, with the names of the error terms, without writing them.

    Raises if a format cannot hold the solution.
    """
    rows = tuple(
        FurtherError(block.name, block.kind, 0.0, 0.0, block.source) for block in config.budget
    )
    made_files(replace(product, calibration=replace(product.calibration, further=rows)), config)


def rehearse_outline(outline: Outline, config: Config, base: Path, source: str) -> None:
    """Make all products from a solution of undistorted chips, before stars are matched."""
    model, time = outline.model, outline.model.time
    monomials, mean = np.zeros((2, model.n_terms)), np.zeros(model.n_params)
    monomials[0, 1] = monomials[1, 2] = outline.pixel
    for chip in model.chips:
        coefficients = model.basis(chip.number).from_monomials(monomials)
        for axis in (0, 1):
            mean[model.coefficient_slice(chip.number, axis)] = coefficients[axis]
    small = (REHEARSED_SIGMA * outline.pixel) ** 2
    solution = GaussianSolution(model, mean, small * np.eye(model.n_params))
    epoch = config.assess.epoch
    if epoch is None and time is not None:
        epoch = max((*time.epoch0, *config.products.useafter_years()))
    filter, tables = outline.filter, outline.tables
    rehearse_files(_input_of(solution, config, source, Plane(), filter, epoch, tables), config)
    release = config.products.release
    if release is not None:
        number = config.chips()[0].number
        with TemporaryDirectory() as nowhere:
            write = release_set().write
            write(release, number, base, Path(nowhere), {filter: solution}, tables, ())


def made_files(product: ProductInput, config: Config) -> dict[str, tuple[Built, ...]]:
    """Content of the configured products, by the key of their format."""
    return {
        key: build(key, product.calibration, settings, product.options)
        for key, settings in config.products.asked().items()
    }
