"""Data of the figures of a campaign, made from the star lists, the catalogue and the fit."""

from __future__ import annotations

import numpy as np
from astropy.table import Table

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data.preparing import motion_error_line
from bayesdist.diagnose.residuals.binned import binned_residuals
from bayesdist.files.tables import read_ecsv
from bayesdist.infer import Posterior, fit_linear
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.nodes import corrected_matches, inside_chips, pixel_shifts
from bayesdist.infer.solution.linear import Rejection
from bayesdist.kinds.campaign.inputs import CampaignInputs
from bayesdist.kinds.campaign.matching import affine_model_of, is_mirrored
from bayesdist.kinds.campaign.report.data import (
    CampaignData,
    CatalogStars,
    DetectionQuality,
    Footprints,
    LinearSeries,
    TableResiduals,
)
from bayesdist.model import DistortionModel
from bayesdist.model.grid import outline_pixels

MAX_MARKERS = 20_000  # markers in a figure: more would only overlap
CELL_PIX = 64.0  # pixels: node spacing of ACS ISR 2015-06
MIN_STARS_PER_CELL = 20  # median number of stars that a cell should have
WIDEST_CELL = 8  # largest factor on the size of cells


def data_of_campaign(run: Run) -> CampaignData:
    """Data of the figures, prepared once, because star lists and catalogue are large."""
    inputs: CampaignInputs = run.inputs
    matching = read_ecsv(run.directory / "matching.ecsv")
    return CampaignData(
        filter=inputs.filter,
        matching=matching,
        catalog=_catalog_stars(inputs, matching),
        detections=_detections(inputs),
        footprints=_footprints(run.posterior, inputs, is_mirrored(run.match_facts)),
        residuals=_residuals(run),
        series=_series(run.directory, run.model, matching),
    )


def _spread_rows(n: int, most: int) -> slice:
    """Slice of evenly spread rows, at most `most` of `n`."""
    return slice(None, None, max(1, -(-n // most)))


def _catalog_stars(inputs: CampaignInputs, matching: Table) -> CatalogStars | None:
    catalog = inputs.whole_catalog
    if catalog.mag is None or (catalog.sigma_u is None and catalog.sigma_pm_u is None):
        return None
    shift = float(np.nan_to_num(np.nanmedian(np.asarray(matching["zero_point"], float))))
    rows = _spread_rows(len(catalog), MAX_MARKERS // 2)
    limit, sigma, motion = None, None, None
    if catalog.sigma_u is not None and catalog.sigma_v is not None:
        sigma = np.hypot(catalog.sigma_u, catalog.sigma_v)[rows]
    if catalog.sigma_pm_u is not None and catalog.sigma_pm_v is not None:
        motion = np.maximum(catalog.sigma_pm_u, catalog.sigma_pm_v)[rows]
        if inputs.config.campaign.pm_selection == "reliable":
            line = motion_error_line(catalog)
            limit = (line.mag - shift, line.sigma)
    return CatalogStars(
        mag=catalog.mag[rows] - shift,
        sigma=sigma,
        sigma_motion=motion,
        limit=limit,
        unit=catalog.unit,
        n_used=len(inputs.catalog),
    )


def _detections(inputs: CampaignInputs) -> DetectionQuality | None:
    """Quality and magnitude of an evenly spread subset of the detections."""
    star_lists = inputs.star_lists
    lists, cuts, passed = star_lists.lists, star_lists.cuts, star_lists.passed
    if any(detections.mag is None or detections.q is None for detections in lists):
        return None
    stride = max(1, -(-len(star_lists) // MAX_MARKERS))
    mag, q, passes = (
        np.concatenate([np.asarray(a)[::stride] for a in columns])
        for columns in (
            [detections.mag for detections in lists],
            [detections.q for detections in lists],
            passed,
        )
    )
    edges = () if cuts.mag is None else cuts.mag
    return DetectionQuality(
        mag=mag,
        q=q,
        kept=passes.astype(bool),
        n_total=len(star_lists),
        n_kept=int(sum(p.sum() for p in passed)),
        mag_cuts=(*edges, *(() if cuts.saturation is None else (cuts.saturation,))),
        q_max=inputs.config.campaign.q_max,
    )


def _footprints(posterior: Posterior, inputs: CampaignInputs, mirrored: bool) -> Footprints:
    """Outlines of all exposures with the stars of the catalogue.

    `mirrored` is True if u has the opposite sign to that of the catalogue.
    """
    model, theta, catalog = posterior.model, posterior.mean, inputs.catalog
    outlines, epochs = [], []
    for name in model.exposures:
        exposure = inputs.log[name]
        for chip in model.chips:
            x, y = outline_pixels(chip.size)
            when = exposure.epoch if model.time is not None else None
            outlines.append(model.predict(theta, x, y, epoch=when, exposure=name, chip=chip.number))
            epochs.append(exposure.epoch)
    rows = _spread_rows(len(catalog), MAX_MARKERS // 2)
    u = -catalog.u if mirrored else catalog.u
    return Footprints(u[rows], catalog.v[rows], tuple(outlines), np.array(epochs), catalog.unit)


@one_thread
def _residuals(run: Run) -> tuple[TableResiduals, ...]:
    """Residuals of each chip without and with the tables, along the detector axes."""
    inputs: CampaignInputs = run.inputs
    pairs, moved, tables = run.stars, run.matches, run.tables.tables
    model = affine_model_of(inputs.config, pairs)
    errors, farthest = run.errors.by_magnitude, inputs.config.fit.clip_abs
    plain = pairs if errors is None else pairs.with_errors(errors, in_quadrature=True)
    if any(table.filter for table in tables):  # the detector's tables are from another run
        detector = [table for table in tables if not table.filter]
        plain = corrected_matches(detector, plain)
    # stars that are on their chip with and without the tables
    inside = np.ones(len(pairs), bool)
    if tables:
        inside = inside_chips(corrected_matches(tables, pairs), run.model)
    common = inside & inside_chips(plain, model)
    pairs, plain, moved = (
        matches if rows.all() else matches.select(rows, reason="moved off the chip")
        for matches, rows in ((pairs, common), (plain, common), (moved, common[inside]))
    )
    numbers, shifts = pairs.chip_number, []
    for table in (plain, moved) if tables else (plain,):
        # errors are those of the centroids, so that chi-square is meaningless without the tables
        fit = fit_linear(table, model, rejection=Rejection(np.inf, farthest))
        shifts.append(pixel_shifts(fit, table).shift)
    good = np.all([np.hypot(*r.T) < (farthest or np.inf) for r in shifts], axis=0)
    out = []
    for chip in model.chips:
        on_chip = good & (numbers == chip.number)
        bins = _cells(chip.size, int(on_chip.sum()))
        x, y = (
            np.clip(a[on_chip], 0.5, n + 0.5)
            for a, n in zip((pairs.x, pairs.y), chip.size, strict=True)
        )
        binned = [binned_residuals(x, y, *r[on_chip].T, bins=bins, size=chip.size) for r in shifts]
        rows = _spread_rows(int(on_chip.sum()), MAX_MARKERS // (2 * len(model.chips)))
        points = [r[on_chip][rows] for r in shifts]
        with_tables = (points[-1], binned[-1]) if tables else (None, None)
        out.append(TableResiduals(chip, points[0], with_tables[0], binned[0], with_tables[1]))
    return tuple(out)


def _cells(size: tuple[float, float], n: int) -> tuple[int, int]:
    """Number of cells of a chip along x and y, of the tables' size or wider if stars are few."""
    for k in (1, 2, 4, WIDEST_CELL):
        nx, ny = (max(1, round(s / (k * CELL_PIX))) for s in size)
        if n >= MIN_STARS_PER_CELL * nx * ny:
            break
    return nx, ny


def _series(run: RunDirectory, model: DistortionModel, matching: Table) -> LinearSeries | None:
    time = model.time
    if time is None or "time_dependence" not in run.summary:
        return None
    exposures = read_ecsv(run / "series.ecsv")
    place = {str(name): k for k, name in enumerate(matching["exposure"])}
    order = [place[str(name)] for name in exposures["exposure"]]
    vafactor, pa_v3 = (
        np.asarray(np.ma.filled(np.ma.asarray(matching[name]), np.nan), float)[order]
        for name in ("vafactor", "pa_v3")
    )
    return LinearSeries(
        exposures=exposures,
        drift=read_ecsv(run / "drift.ecsv"),
        vafactor=vafactor,
        pa_v3=pa_v3,
        breaks=tuple(time.breaks),
    )
