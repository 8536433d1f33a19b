"""Products for pipelines: files as configured, sets of files that a mission releases, and export.

Exported products are compared with the solution and the stars.  A set is released together, for
several filters and periods.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.config.results import ReleaseBlock
from bayesdist.app.kind import Outline
from bayesdist.app.parts import StoredLookupTables
from bayesdist.app.run import Run
from bayesdist.assess.budget import TOTAL, BudgetEntry, with_product
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
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.chip_map import FurtherError
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.data.tangent import sky_of_plane
from bayesdist.diagnose.residuals.stars import StarSample, star_sample
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, path_within
from bayesdist.infer.solution.solution import GaussianSolution, Solution
from bayesdist.model import LookupTable
from bayesdist.plugin import mission_objects
from bayesdist.products.common.celestial import sky_of_header
from bayesdist.products.common.document import BuildOptions, Built
from bayesdist.products.registry import build, format_of, lint
from bayesdist.utils.checks import FILE_ERROR, SKY_CLOSURE

log = logging.getLogger("bayesdist")

# rows of a budget that are included in the covariance of the exported solution, or in another row
IN_COVARIANCE = (
    *(COEFFICIENTS, TIME_DEPENDENCE, EXPOSURE_FRAME, STRUCTURE_IN_FIT, DEVIATIONS),
    *(CATALOGUE, MOTIONS, ABERRATION),
)

REHEARSED_SIGMA = 1e-3  # pixels: assumed error of each coefficient, because files state errors
FALSE = 0.5  # outlier probability above which a match counts as false

Entry = dict[str, Any]  # of a file in summary.json: path, kind, findings and others


def export(run: Run, folder: Path, *, source: str = "") -> list[dict[str, Any]]:
    """Write the configured products and list their properties.

    File errors are compared with the budget of the evaluation, and headers on the sky with the
    stars.  Diagnostics add their errors to those of the parameters.  A run may have neither.

    Parameters
    ----------
    run : Run
        Run that was sampled.
    folder : Path
        Folder to write to.
    source : str
        Name of the solution in the files; by default that of the run.

    Returns
    -------
    list of dict
        One entry per file: path, kind, findings, and other properties.
    """
    config, evaluation, found = run.config, run.stored_evaluation, run.stored_diagnostics
    product = product_of_run(run, source=source)
    budget = [] if evaluation is None else evaluation.budget.rows()
    stars = None
    if product.calibration.plane.point is not None and config.products.asked():
        if found is not None:
            stars = found.sample
        else:
            stars = star_sample(run.sample, len(run.matches), run.fit, run.posterior)
    products: list[dict[str, Any]] = []
    release = config.products.release
    if release is not None:
        held = config.tables.detector is not None
        tables = published_tables(run.tables, held=held)
        number, solutions = config.chips()[0].number, {run.filter: product.solution}
        products += release_set().write(release, number, run.base, folder, solutions, tables, ())
    facts = None if found is None or found.correlated is None else found.correlated.facts
    calibration = replace(product.calibration, further=further_errors(budget, facts))
    product = replace(product, calibration=calibration)
    for key, files in made_files(product, config).items():
        left_out = _left_out(key, product)
        for built in files:
            path = path_within(folder, built.file_name, where="products")
            with atomic_path(path) as temporary:
                temporary.write_bytes(built.content)
            entry: dict[str, Any] = {"path": built.file_name, "kind": built.kind}
            findings = [f"{f.level}: {f.where}: {f.message}" for f in lint(path)]
            if built.chip is not None:
                entry["chip"] = built.chip
                closure = None
                if stars is not None and built.kind == "SIP":
                    closure = sky_closure(product, stars, path, built.chip)
                if closure is not None:
                    entry["sky"], faults = closure
                    findings += faults
            for warning in (*built.warnings, *left_out):
                log.warning("export: WARNING: %s: %s", path.name, warning)
                findings.append(f"warning: {warning}")
            for note in built.notes:
                log.info("export: %s: %s", path.name, note)
                findings.append(f"note: {note}")
            products.append(entry | dict(built.summary) | {"findings": findings})
    for entry_of_file in products:
        _compare(entry_of_file, budget)
    return products


def published_tables(stored: StoredLookupTables, *, held: bool) -> tuple[LookupTable, ...]:
    """Look-up tables with the errors that apply to their user.

    These are the errors at the nodes and the distortion between them, added in quadrature.  The
    same distortion affects the values at the nodes, which are averages over their surroundings.  It
    is added to the tables fitted in this run; `held` is True if the detector's tables are from
    another run.
    """
    out = []
    for table in stored.tables:
        between = stored.between.get(table.chip)
        if table.sigma is not None and between is not None and bool(table.filter) == held:
            total = np.sqrt(table.sigma**2 + between.left.mean[:, None, None])
            table = replace(table, sigma=total)
        out.append(table)
    return tuple(out)


def _left_out(key: str, product: ProductInput) -> tuple[str, ...]:
    """Warning if a format cannot hold the look-up tables of a run."""
    if not product.options.tables or format_of(key).holds_tables:
        return ()
    return (
        "the look-up tables of the run are not in this file, as its row 'forward' in the error "
        "budget says; jwst, roman, cpdis and stdgdc hold them",
    )


def _compare(product: dict[str, Any], budget: Sequence[BudgetEntry]) -> None:
    """Add file errors from the budget to an entry, and the total error for users of the file."""
    for row in budget:
        files, _, direction = row["name"].rpartition(", ")
        path = product["path"]
        if row["kind"] != PRODUCT or not (
            path in files.split(", ") or path.startswith(f"{files}_")
        ):
            continue
        product[f"{direction}_rms"] = row["radial"]
        total = budget[-1]["radial"]
        if direction == "forward":
            product["total_rms"] = with_product(total, row["radial"])
            if row["radial"] > FILE_ERROR.value * total:
                product["findings"].append(
                    f"warning: forward: differs from the solution by {row['radial']:.2g} rms over "
                    f"the detector, whose total error is {total:.2g}"
                )


def sky_closure(
    product: ProductInput, stars: StarSample, path: Path, chip: int
) -> tuple[dict[str, Any], list[str]] | None:
    """Distance of a header as written from stars and solution, for summary.json, and its faults.

    None if the stars are not on the sky or none remain.  If exposures have frames, only the first
    one is compared, because the header is for that exposure.
    """
    point, solution = product.calibration.plane.point, product.solution
    if point is None:
        return None
    from astropy import units as apu
    from astropy.coordinates import SkyCoord
    from astropy.io import fits

    table, model = stars.table, solution.model
    mine = stars.used & (np.array(table.chip_numbers)[table.chip] == chip)
    if model.n_frame:
        first = [name == model.exposures[0] for name in table.exposure_names]
        mine &= np.array(first)[table.exposure]
    if stars.outlier_probability is not None:
        mine &= stars.outlier_probability < FALSE
    if not mine.any():
        return None
    arcsec, (x, y) = ARCSEC[model.unit], (table.x[mine], table.y[mine])
    at = SkyCoord(*sky_of_header(fits.Header.fromtextfile(path), x, y), unit="deg")
    true = SkyCoord(
        *sky_of_plane(table.u[mine] * arcsec, table.v[mine] * arcsec, point), unit="deg"
    )
    when = {} if model.time is None else {"epoch": product.options.epoch}
    uv = model.predict(solution.mean, x, y, chip=chip, **when)
    u, v = uv.T * arcsec
    predicted = SkyCoord(*sky_of_plane(u, v, point), unit="deg")
    east, north = (float(a.to_value(apu.arcsec).mean()) for a in true.spherical_offsets_to(at))
    sky = {
        "n": int(mine.sum()),  # without probable false matches
        "rms_arcsec": float(np.sqrt(np.mean(true.separation(at).arcsec ** 2))),
        # header minus star
        "mean_east_arcsec": east,
        "mean_north_arcsec": north,
        "solution_arcsec": float(predicted.separation(at).arcsec.max()),  # maximum
    }
    far = sky["solution_arcsec"]
    off = far / (model.pixel_size(solution.mean) * arcsec)
    faithful = SKY_CLOSURE.met_by(off)
    log.log(
        logging.INFO if faithful else logging.WARNING,
        f"export: {path.name}: on the sky by astropy.wcs {sky['rms_arcsec']:.4g} arcsec rms from "
        f"RA, Dec of {sky['n']} stars, on average {east:+.2g} east and {north:+.2g} north; "
        f"{far:.2g} arcsec at most from the solution",
    )
    if faithful:
        return sky, []
    return sky, [
        f"error: sky: astropy.wcs puts pixels up to {far:.3g} arcsec ({off:.2g} px) from where the "
        "solution has them"
    ]


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


@dataclass(frozen=True)
class ReleaseSet:
    """Functions that write the files of a release and read them back.

    Parameters
    ----------
    write : callable
        ``write(block, chip, base, folder, solutions, tables, history)`` writes the files to
        `folder` and returns one entry per file: path, kind, findings and, for files of a period,
        'period' and 'lost'. `block` is the section [products.release], `chip` the number of the
        chip whose axes and zero point define the gauge, `base` the folder that file names are
        relative to, `solutions` a mapping of filter to solution with that of the configuration
        first, `tables` the look-up tables, and `history` lines of text for the files.
    calibrations : callable
        ``calibrations(entries, folder, filter)`` reads the files of a filter back, and returns the
        calibrations by the names of the periods.
    kinds : mapping of str to str
        Description of the files in the report, by their kind.
    """

    write: Callable[
        [
            Any,
            int,
            Path,
            Path,
            Mapping[str, Solution],
            Sequence[LookupTable],
            Sequence[str],
        ],
        list[Entry],
    ]
    calibrations: Callable[[Sequence[Entry], Path, str], dict[str, Calibration]]
    kinds: Mapping[str, str]


@cache
def release_set() -> ReleaseSet:
    """Release of the installed missions; InputError if none has one."""
    sets = mission_objects(lambda mission: mission.releases)
    if not sets:
        raise InputError(
            "no installed mission releases files",
            where="products.release",
            do="install a mission that does, or leave the section out",
        )
    if len(sets) > 1:
        raise InputError(
            f"several missions release files: {', '.join(sorted(sets))}",
            where="products.release",
            do="name the plugin of one of them in the environment variable BAYESDIST_PLUGINS",
        )
    found: ReleaseSet = next(iter(sets.values()))
    return found


def first_segments(
    block: ReleaseBlock, sets: Mapping[str, Calibration], n_segments: int
) -> list[Calibration]:
    """Calibrations of a release, one per segment; that of the first period of each segment."""
    segments: dict[int, Calibration] = {}
    for period in block.period:
        segments.setdefault(period.segment, sets[period.name])
    last = segments[min(segments)]
    return [segments.get(k, last) for k in range(n_segments)]
