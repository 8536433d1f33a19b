"""Writing of products for pipelines, and comparison with the solution and the stars."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.artefacts.parts import StoredLookupTables
from bayesdist.app.products.made_files import (
    ProductInput,
    further_errors,
    made_files,
    product_of_run,
)
from bayesdist.app.products.release_set import release_set
from bayesdist.app.run import Run
from bayesdist.assess.budget import BudgetEntry, with_product
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data.sky import sky_of_plane
from bayesdist.diagnose.residuals.stars import StarSample, star_sample
from bayesdist.files.atomic import atomic_path, path_within
from bayesdist.model import LookupTable
from bayesdist.products.common.celestial import sky_of_header
from bayesdist.products.registry import format_of, lint
from bayesdist.utils.checks import FILE_ERROR, SKY_CLOSURE

log = logging.getLogger("bayesdist")


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


FALSE = 0.5  # outlier probability above which a match counts as false


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
