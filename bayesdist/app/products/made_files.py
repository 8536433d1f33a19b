"""Calibration files of a solution as the configuration asks for them; released sets of files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bayesdist.app.assessment.error_terms import assessment_epoch
from bayesdist.app.config import Config
from bayesdist.app.config.products import ReleaseBlock
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Outline
from bayesdist.assess.budget.budget import TOTAL
from bayesdist.assess.model import with_diagnosed_errors
from bayesdist.assess.terms.correlated import DEVIATIONS, STRUCTURE, STRUCTURE_IN_FIT
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.assess.terms.parameters import ABERRATION, CATALOGUE, MOTIONS
from bayesdist.assess.terms.solution import COEFFICIENTS, EXPOSURE_FRAME, TIME_DEPENDENCE
from bayesdist.calibration.calibration import Calibration, GaussianSolution, calibration_of
from bayesdist.calibration.further import FurtherError
from bayesdist.calibration.orientation import lay_on
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior
from bayesdist.infer.selfcal.start import fitted_polynomials, undistorted
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from bayesdist.model import LookupTable
from bayesdist.products import Period, read_calibration, write_release
from bayesdist.products.formats.common.document import BuildOptions, Built
from bayesdist.products.registry import build, lint

# rows of a budget that the covariance of the exported solution holds, or another row
IN_COVARIANCE = (
    *(COEFFICIENTS, TIME_DEPENDENCE, EXPOSURE_FRAME, STRUCTURE_IN_FIT, DEVIATIONS),
    *(CATALOGUE, MOTIONS, ABERRATION),
)


REHEARSED_SIGMA = 1e-3  # pixels, of each coefficient: files state their errors


@dataclass(frozen=True, eq=False)
class ProductInput:
    """Ingredients of the files of a run."""

    solution: Solution  # with the frames of its exposures
    calibration: Calibration  # of it, with what the files say of its run
    options: BuildOptions
    aligned: bool = False  # the user of a file fits shift and rotation of an exposure


def further_errors(
    budget: Sequence[Mapping[str, Any]], discrepancy: Mapping[str, Any] | None = None
) -> tuple[FurtherError, ...]:
    """Rows of a budget of errors that the covariance of the exported solution does not hold.

    `discrepancy` are the facts of the estimated one, by which its structure is correlated between
    positions.
    """
    correlation = tuple((discrepancy or {}).get("structure_correlation", ()))
    return tuple(
        FurtherError(
            str(row["name"]),
            str(row["kind"]),
            float(row["u"]),
            float(row["v"]),
            str(row.get("source", "")),
            tuple((float(part), float(length)) for part, length in correlation)
            if row["name"] == STRUCTURE
            else (),
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
    """Calibration of the solution of a run, with all else that the run knows.

    That is the size of a pixel, the look-up tables, and the rows of the budget that the covariance
    does not hold, correlated between positions as the facts of the `discrepancy` say.
    """
    mas, unit = config.detector.scale_mas, calibration.unit
    if unit != "pix" and mas is not None:
        scale = mas / (1000 * ARCSEC[unit])
        calibration = replace(calibration, scale=scale, scale_from="detector.scale_mas")
    further = further_errors(budget, discrepancy)
    return replace(calibration, pixel_mas=mas, before=tables, further=further)


def product_input(solution: Solution, data: FitData, config: Config, source: str) -> ProductInput:
    """Ingredients of the files of a solution; they say that it is from `source`, or a detector."""
    fitted, model = data.fitted, data.model
    plane, point = Plane(), data.matched.tangent_point
    if point is not None:
        note = ""
        if model.frames != "none" and len(model.exposures) > 1:
            # for which exposure a file is right on the sky, as they differ
            first = model.exposures[0]
            note = f"On the sky it is exposure {first}: others have frames of their own."
        plane = Plane("sky", point=point, note=note)
    epoch, tables = assessment_epoch(data, config), fitted.tables.tables
    found = _input_of(solution, config, source, plane, data.matched.filter, epoch, tables)
    notes = (fitted.gauge_words,) if fitted.gauge_words else ()
    calibration = replace(found.calibration, notes=notes)
    return replace(found, calibration=calibration, aligned=fitted.scatter is not None)


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
    found = calibration_of(solution, name, plane=plane, detector=detector.name, filter=filter)
    scale = None if detector.scale_mas is None else detector.scale_mas / 1000
    return ProductInput(solution, found, BuildOptions(epoch, scale, tables))


def rehearse_files(product: ProductInput, config: Config) -> None:
    """Make the files that the configuration asks for, with the names of its error terms.

    Nothing is written; whatever a format cannot hold is refused.
    """
    rows = tuple(
        FurtherError(block.name, block.kind, 0.0, 0.0, block.source) for block in config.budget
    )
    made_files(replace(product, calibration=replace(product.calibration, further=rows)), config)


def rehearse_outline(outline: Outline, config: Config, base: Path, source: str) -> None:
    """Make all files of a run from a solution of undistorted chips, before stars are matched."""
    model, time = outline.model, outline.model.time
    chips = fitted_polynomials(undistorted(model.chips, outline.pixel), model.chips, model.order)
    mean = np.zeros(model.n_params)
    for chip, coefficients in zip(model.chips, chips, strict=True):
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
            write_files(release, number, base, Path(nowhere), {filter: solution}, tables)


def solution_of(posterior: Posterior, found: Diagnostics | None, fitted: Fitted) -> Posterior:
    """Posterior with all errors of the parameters that were found, as it is exported and shown.

    Neither catalogue nor matches are needed for it.
    """
    return with_diagnosed_errors(
        posterior, found, None if fitted.scatter is None else fitted.linear
    )


def product_of(
    posterior: Posterior, found: Diagnostics | None, data: FitData, config: Config, source: str
) -> ProductInput:
    """Ingredients of the files of a posterior with all errors of the parameters."""
    return product_input(solution_of(posterior, found, data.fitted), data, config, source)


def made_files(product: ProductInput, config: Config) -> dict[str, tuple[Built, ...]]:
    """Files by the key of their format."""
    return {
        key: build(key, product.calibration, settings, product.options)
        for key, settings in config.products.asked().items()
    }


def write_files(
    block: ReleaseBlock,
    chip: int,
    base: Path,
    folder: Path,
    solutions: Mapping[str, Solution],
    tables: Sequence[LookupTable],
    history: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Write the files of one filter or several, as the configuration of one run says.

    `chip`: whose axes and zero point define the gauge. `solutions`: the configuration's own first:
    V2 and V3 lie as the reference says of it. `history`: lines for HISTORY of all files. An entry
    is path, kind, findings, and of an IDCTAB period and lost.
    """
    calibrations = {
        filter: calibration_of(
            reference_gauge(without_frames(solution), chip), filter, filter=filter
        )
        for filter, solution in solutions.items()
    }
    first = next(iter(calibrations.values()))
    time = first.model.time
    orientation = lay_on(
        first,
        read_calibration(base / block.reference),
        chip=chip,
        epoch=None if time is None else time.epoch0[0],
        scale_arcsec=block.scale_arcsec,
    )
    written = write_release(
        folder,
        block.name,
        calibrations,
        orientation,
        [Period(**one.model_dump()) for one in block.period],
        tables=tables,
        instrument=block.instrument,
        detector=block.detector,
        scale_arcsec=block.scale_arcsec,
        limit_mas=block.limit_mas,
        history=history,
    )
    out: list[dict[str, Any]] = []
    for period, path in written.idctabs.items():
        lost = [asdict(one) for one in written.lost.get(period, ())]
        out.append(_entry(path, "IDCTAB") | {"period": period, "lost": lost})
    others = [] if written.d2im is None else [("D2IMFILE", written.d2im)]
    others += [("NPOLFILE", path) for path in written.npol.values()]
    return out + [_entry(path, kind) for kind, path in others]


def _entry(path: Path, kind: str) -> dict[str, Any]:
    findings = [f"{f.level}: {f.where}: {f.message}" for f in lint(path)]
    return {"path": path.name, "kind": kind, "findings": findings}
