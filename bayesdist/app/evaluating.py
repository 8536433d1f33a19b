"""Evaluation of a run: error model, maps, budget, margins, validity periods, and checks.

The error model includes the differences between products as written and the solution.  Each format
reads its files back (`read_back`).  A SIP header holds one chip at one date: drift to other dates
and look-up tables are always left out.  Some formats have axes and a pixel of their own, and are
compared in them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.config.results import ReleaseBlock
from bayesdist.app.products import (
    ProductInput,
    first_segments,
    made_files,
    product_of_run,
    release_set,
)
from bayesdist.app.run import Run
from bayesdist.assess import Margin, Requirement, pixel_scale_of
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.evaluation import (
    Evaluation,
    EvaluationSettings,
    drawn_errors,
    evaluate,
    judged,
    validity_of,
)
from bayesdist.assess.model import ErrorModel, diagnosed_error_model, error_model
from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.assess.requirements.verdict import assumption_checks
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import MEASURED, PRODUCT, Known, Row
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import BayesdistError
from bayesdist.model import corrected
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.products.common.document import Positions, ReadBack, by_calibrations
from bayesdist.products.registry import read_back
from bayesdist.utils import random
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check, in_order

log = logging.getLogger("bayesdist")

FORWARD, INVERSE = "forward", "inverse"
GRID = (33, 33)  # grid on which files are aligned with the solution
ROUNDING = 1e-9  # pixels
SKY_ROUNDING = 2e-9  # arcsec: rounding error of converting to an RA near 360 degrees and back


def evaluation_of_run(run: Run) -> Evaluation:
    """Maps, budget, margins and validity periods of a run that was sampled.

    Diagnostics that the run does not have yet are computed.
    """
    if run.stored_diagnostics is None:
        run = run.having(diagnostics=run.diagnostics)
    config = run.config
    return evaluate(
        run.error_model,
        run.diagnostics,
        config.requirements(),
        run.evaluation_settings,
        assessment_rng(config),
        fit=run.fit,
        solution=run.solution,
        checks=checks_besides_diagnostics(run),
        files=file_errors(product_of_run(run), config, run.base),
        null=run.kind.null_space(run),
    )


def drawn_errors_of_run(run: Run) -> DrawnErrors:
    """Draws of all position errors, as for budget and margins, including those of products."""
    files = file_errors(product_of_run(run), run.config, run.base)
    arguments = run.error_model, run.diagnostics, run.evaluation_settings
    return drawn_errors(*arguments, assessment_rng(run.config), files=files)


def margins_of_run(run: Run, requirements: Sequence[Requirement]) -> tuple[Margin, ...]:
    """Margins of a run for the given requirements."""
    requirements = run.config.within_field(requirements)
    arguments = run.error_model, run.diagnostics, requirements, run.evaluation_settings
    return judged(*arguments, assessment_rng(run.config), checks=run.checks)


def validity_periods_of_run(
    run: Run, requirements: Sequence[Requirement]
) -> tuple[ValidityPeriod, ...]:
    """Validity periods of requirements, if anything depends on time."""
    arguments = run.error_model, run.diagnostics, requirements, run.evaluation_settings
    return validity_of(*arguments, assessment_rng(run.config))


def checks_of_run(run: Run) -> tuple[Check, ...]:
    """Checks of a run that has been sampled, or of a fit alone, including its diagnostics."""
    return in_order((*checks_besides_diagnostics(run), *run.diagnostics.checks))


def checks_besides_diagnostics(run: Run) -> tuple[Check, ...]:
    """Checks of a run that has been sampled, or of a fit alone, in addition to its diagnostics."""
    catalogue = motions = None
    if run.kind.has_catalogue:
        stars = run.catalogue
        states_errors = stars is not None and stars.sigma_u is not None
        states_motion_errors = stars is not None and stars.sigma_pm_u is not None
        catalogue = states_errors or run.config.states_catalogue
        motions = states_motion_errors or run.config.states_motions
    return (
        *run.kind.checks(run),
        *assumption_checks(
            run.posterior if run.is_sampled else None,
            run.diagnostics,
            run.model.time,
            catalogue_stated=catalogue,
            motions_stated=motions,
        ),
    )


def assessment_rng(config: Config) -> np.random.Generator:
    """Random number generator of the assessment, in its initial state."""
    return random.assessment_rng(config.sampler.seed)


def evaluation_settings(run: Run) -> EvaluationSettings:
    """Settings of the evaluation of errors, including the dates of the stars."""
    return replace(rehearsal_settings(run), dates=run.dates)


def rehearsal_settings(run: Run) -> EvaluationSettings:
    """Settings of an evaluation without the dates of the stars, which only verdicts mention."""
    config, measured = run.config, run.kind.measures_centroids
    return EvaluationSettings(
        grid=config.assess.grid,
        epoch=run.epoch,
        draws=config.assess.draws,
        years_ahead=config.assess.years_ahead,
        scale_mas=config.detector.scale_mas,
        single=config.assess.exposure == "single",
        # centroid errors estimated by the fit include no other errors
        contained=() if measured else config.held_in_residuals(run.model.unit),
        given=config.stated_errors,
        field=config.field,
    )


def idle_dates(config: Config, requirements: Sequence[Requirement], where: str = "") -> str:
    """Sentence on dates without effect because the model does not depend on time; empty if none.

    Such dates may document when the data were taken and are therefore not refused. `where` is the
    file of the requirements if it is not the configuration.
    """
    if config.is_dated or config.time() is not None:
        return ""
    named = [f"of {r.where}" for r in requirements if r.epoch is not None]
    if config.assess.epoch is not None and not where:
        named.insert(0, "assess.epoch")
    if not named:
        return ""
    file = f"{where}: " if where else ""
    return (
        f"{file}nothing in the model depends on time, so that the dates given change nothing "
        f"({', '.join(named)})"
    )


def error_model_of_fit(run: Run) -> ErrorModel:
    """Error model of the fit alone, without terms derived from residuals."""
    fit = run.fit
    terms = run.kind.error_terms(run, fit)
    scale = pixel_scale_of(fit, scale_mas=run.config.detector.scale_mas)
    return error_model(fit, terms, pixel_scale=scale)


def error_model_of_run(run: Run) -> ErrorModel:
    """Error model of a posterior, including terms derived from residuals."""
    posterior, domain = run.posterior, run.kind.domain(run)
    return diagnosed_error_model(
        posterior,
        run.diagnostics,
        run.kind.error_terms(run, posterior),
        hierarchy=run.hierarchy,
        catalogue=run.catalogue_name,
        aligned=domain.aligned,
        single=domain.single,
        frames=domain.frames,
        structure_left=domain.structure_left,
        pixel_scale=pixel_scale_of(posterior, scale_mas=run.config.detector.scale_mas),
    )


def product_terms(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """Error terms of the configured products.

    The products are read back from their bytes, so that digits and orders are those of the files;
    the folder of the run is not changed.
    """
    files_read: list[ReadBack] = []
    for key, files in made_files(product, config).items():
        files_read += read_back(key, files, product.calibration, product.options)
    release = config.products.release
    if release is None:
        return tuple(_terms(product, files_read))
    with TemporaryDirectory() as folder:
        number = config.chips()[0].number
        sets = _released(product, release, number, base, Path(folder))
        files_read.append(by_calibrations(release.name, sets, product.solution.model.time))
        return tuple(_terms(product, files_read))


def file_errors(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """As `product_terms`; empty if the files cannot be made, which the export reports."""
    try:
        return product_terms(product, config, base)
    except BayesdistError as error:
        log.warning("evaluate: WARNING: the files were not compared with the solution: %s", error)
        return ()


def _terms(product: ProductInput, files: Sequence[ReadBack]) -> Iterator[Known]:
    """Forward terms against the solution, and the inverse if a file has one."""
    for file in files:
        yield _term(product, file.file, FORWARD, _forward(product, file))
        if file.missed is not None:
            yield _term(product, file.file, INVERSE, _in_unit(product, file.missed))


def _forward(product: ProductInput, file: ReadBack) -> Positions:
    """Difference between the positions of a file and of the solution, as its user sees it."""
    if file.own_axes or product.aligned:
        return _Laid(product, file.forward, scaled=file.own_axes)
    return lambda x, y, c, t: file.forward(x, y, c, t) - _solution(product, x, y, c, t)


def _released(
    product: ProductInput, block: ReleaseBlock, number: int, base: Path, folder: Path
) -> list[Calibration]:
    """Calibrations of a release, one per segment; of several periods of a segment the first."""
    filter = product.calibration.filter
    release = release_set()
    solutions = {filter: product.solution}
    entries = release.write(block, number, base, folder, solutions, product.options.tables, ())
    time = product.solution.model.time
    sets = release.calibrations(entries, folder, filter)
    return first_segments(block, sets, 1 if time is None else time.n_segments)


def _term(product: ProductInput, file: str, direction: str, shift: Positions) -> Known:
    solution = product.solution
    threshold = ROUNDING * solution.model.pixel_size(solution.mean)
    if product.calibration.plane.point is not None:
        threshold = max(threshold, SKY_ROUNDING / ARCSEC[solution.model.unit])
    against = "the solution" if direction == FORWARD else "its forward terms"
    source = f"{MEASURED}: as written, against {against}"

    def rounded(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        # smaller displacements are rounding errors
        displacement = np.asarray(shift(x, y, chip, epoch), float)
        return np.where(np.abs(displacement) < threshold, 0.0, displacement)

    return Known(Row(f"{file}, {direction}", PRODUCT, source, in_total=False), rounded)


def _solution(product: ProductInput, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
    """Positions (N, 2) of the solution: look-up tables, if any, followed by the polynomials."""
    solution = product.solution
    if product.options.tables:
        x, y = corrected(product.options.tables, x, y, chip=chip, filter=product.calibration.filter)
    place = place_of(solution.model, epoch=epoch, chip=chip)
    return np.asarray(place.basis.evaluate(x, y) @ place.polynomial(solution.mean).T)


def _in_unit(product: ProductInput, missed: Positions) -> Positions:
    """Displacements in pixels converted to displacements of positions."""
    solution = product.solution

    def shift(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        place = place_of(solution.model, epoch=epoch, chip=chip)
        P = place.polynomial(solution.mean)
        J = np.stack([d @ P.T for d in place.basis.gradient(x, y)], axis=-1)
        return np.asarray(np.einsum("nab,nb->na", J, missed(x, y, chip, epoch)))

    return shift


class _Laid:
    """Difference between the solution and positions of a file, aligned with it over all chips.

    Parameters
    ----------
    product : ProductInput
    place : callable
        Positions of the file, in an arbitrary unit if `scaled`.
    scaled : bool
        True if the scale of the file is a convention; it is fitted at the date of the assessment.
    """

    def __init__(self, product: ProductInput, place: Positions, *, scaled: bool) -> None:
        self.product, self.place, self.scaled = product, place, scaled
        self._kept: dict[float | None, tuple[complex, complex, bool]] = {}

    def __call__(self, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        zero, factor, mirrored = self._map(epoch)
        w = self.place(x, y, chip, epoch) @ [1, -1j if mirrored else 1j]
        at = zero + factor * w
        return np.stack([at.real, at.imag], axis=-1) - _solution(self.product, x, y, chip, epoch)

    def _map(self, epoch: float | None) -> tuple[complex, complex, bool]:
        if epoch not in self._kept:
            size = 1.0
            date = self.product.options.epoch
            if self.scaled:
                size = abs(self._fitted(epoch)[1] if epoch == date else self._map(date)[1])
            self._kept[epoch] = self._fitted(epoch, size)
        return self._kept[epoch]

    def _fitted(
        self, epoch: float | None, size: float | None = None
    ) -> tuple[complex, complex, bool]:
        """Least-squares shift and factor, of a given size if any, and the better parity.

        The result is complex shift, complex factor, and True if mirrored.
        """
        z, w = [], []
        for chip in self.product.solution.model.chips:
            x, y = mesh(*grid_pixels(chip.size, GRID))
            z.append(_solution(self.product, x, y, chip.number, epoch) @ [1, 1j])
            w.append(self.place(x, y, chip.number, epoch) @ [1, 1j])
        target, positions = np.concatenate(z), np.concatenate(w)
        fits = []
        for mirrored in (False, True):
            v = positions.conj() if mirrored else positions
            factor = np.vdot(v - v.mean(), target) / np.vdot(v - v.mean(), v)
            if size is not None:
                factor *= size / abs(factor)
            zero = (target - factor * v).mean()
            fits.append((float(np.std(target - zero - factor * v)), zero, factor, mirrored))
        _, zero, factor, mirrored = min(fits, key=lambda candidate: candidate[0])
        return complex(zero), complex(factor), mirrored
