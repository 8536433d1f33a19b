"""Content of the report of a campaign, from its results."""

from __future__ import annotations

import numpy as np
from astropy.table import Table

from bayesdist.app.config import CampaignConfig
from bayesdist.app.kinds.campaign.inputs import Inputs
from bayesdist.app.kinds.campaign.matched import affine_model_of
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.store import as_json
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data.preparing import motion_error_line
from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.diagnose.residuals.binned import binned_residuals
from bayesdist.files.tables import read_ecsv
from bayesdist.infer import GaussianPriors, LinearFit, Posterior, fit_linear
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.nodes import corrected_matches, inside_chips, pixel_shifts
from bayesdist.infer.solution.linear import Rejection
from bayesdist.model import DistortionModel
from bayesdist.model.grid import outline_pixels
from bayesdist.report.context import (
    CampaignResults,
    CatalogStars,
    ChipResiduals,
    Detections,
    Footprints,
    LinearSeries,
)

MAX_MARKERS = 20_000  # markers in a figure: more only hide each other
CELL_PIX = 64.0  # pixels: the nodes of ACS ISR 2015-06
MIN_STARS_PER_CELL = 20  # stars that a cell should have at the median
HELD_BY_PRIOR = 0.99  # of the prior's sigma: what narrows it by less is no measurement
WIDEST_CELL = 8  # cells of this many times the size, however few stars there are


def campaign_results(
    run: RunDirectory,
    inputs: Inputs,
    data: FitData,
    posterior: Posterior,
    overlap: OverlapTest | None,
) -> CampaignResults:
    """Content that a campaign adds to the report of its run."""
    model, fitted, matched = posterior.model, data.fitted, data.matched
    matching = read_ecsv(run / "matching.ecsv")
    return CampaignResults(
        summary=dict(run.summary),
        config=as_json(run.config.model_dump(exclude_none=True)),
        filter=matched.filter,
        matching=matching,
        chips=tuple(model.chips),
        unit=model.unit,
        catalog=_catalog_stars(inputs, matching),
        centroids=fitted.errors.by_magnitude,
        detections=_detections(inputs),
        footprints=_footprints(posterior, inputs, matched.mirrored),
        residuals=_residuals(data, inputs.config),
        tables=fitted.tables.tables,
        series=_series(run, fitted.linear.model, matching),
        overlap=overlap,
        held=held_parameters(fitted.linear, fitted.priors),
    )


def held_parameters(fit: LinearFit, priors: GaussianPriors) -> tuple[str, ...]:
    """Coefficients and rates of which the data say nothing beside what a prior does.

    The deviations of single exposures are not among them: their prior is what was found.
    """
    share = fit.sigma * np.sqrt(priors.precision)
    return tuple(
        p.name
        for p, known in zip(fit.model.parameters, share, strict=True)
        if p.kind != "frame" and known > HELD_BY_PRIOR
    )


def _spread_rows(n: int, most: int) -> slice:
    """Evenly spread rows, at most that many: lists come in the order of the field, or in none."""
    return slice(None, None, max(1, -(-n // most)))


def _catalog_stars(inputs: Inputs, matching: Table) -> CatalogStars | None:
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


def _detections(inputs: Inputs) -> Detections | None:
    """Quality against magnitude, of some detections of every exposure."""
    star_lists = inputs.star_lists
    lists, cuts, passed = star_lists.lists, star_lists.cuts, star_lists.passed
    if any(one.mag is None or one.q is None for one in lists):
        return None
    every = max(1, -(-len(star_lists) // MAX_MARKERS))
    mag, q, kept = (
        np.concatenate([np.asarray(a)[::every] for a in columns])
        for columns in ([one.mag for one in lists], [one.q for one in lists], passed)
    )
    edges = () if cuts.mag is None else cuts.mag
    return Detections(
        mag=mag,
        q=q,
        kept=kept.astype(bool),
        n_total=len(star_lists),
        n_kept=int(sum(p.sum() for p in passed)),
        mag_cuts=(*edges, *(() if cuts.saturation is None else (cuts.saturation,))),
        q_max=inputs.config.campaign.q_max,
    )


def _footprints(posterior: Posterior, inputs: Inputs, mirrored: bool) -> Footprints:
    """Outlines of all exposures over the catalogue; `mirrored`: u has the opposite sign there."""
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
def _residuals(data: FitData, config: CampaignConfig) -> tuple[ChipResiduals, ...]:
    """Pairs of each chip without the tables and with them, along the detector's axes."""
    pairs, moved = data.matched.stars, data.stars
    model = affine_model_of(config, pairs)
    tables = data.fitted.tables.tables
    errors, farthest = data.fitted.errors.by_magnitude, config.fit.clip_abs
    plain = pairs if errors is None else pairs.with_errors(errors, in_quadrature=True)
    if any(table.filter for table in tables):  # those of the detector are not of this run
        detector = [table for table in tables if not table.filter]
        plain = corrected_matches(detector, plain)
    # the stars that neither has moved off their chip
    kept = data.fitted.inside(pairs)
    both = kept & inside_chips(plain, model)
    pairs, plain, moved = (
        one if rows.all() else one.select(rows, reason="moved off the chip")
        for one, rows in ((pairs, both), (plain, both), (moved, both[kept]))
    )
    numbers, left = pairs.chip_number, []
    for table in (plain, moved) if tables else (plain,):
        # errors are those of the centroids: beside what the tables take out, chi-square is no guide
        fit = fit_linear(table, model, rejection=Rejection(np.inf, farthest))
        left.append(pixel_shifts(fit, table).shift)
    good = np.all([np.hypot(*r.T) < (farthest or np.inf) for r in left], axis=0)
    out = []
    for chip in model.chips:
        here = good & (numbers == chip.number)
        bins = _cells(chip.size, int(here.sum()))
        x, y = (
            np.clip(a[here], 0.5, n + 0.5)
            for a, n in zip((pairs.x, pairs.y), chip.size, strict=True)
        )
        binned = [binned_residuals(x, y, *r[here].T, bins=bins, size=chip.size) for r in left]
        rows = _spread_rows(int(here.sum()), MAX_MARKERS // (2 * len(model.chips)))
        points = [r[here][rows] for r in left]
        again = (points[-1], binned[-1]) if tables else (None, None)
        out.append(ChipResiduals(chip, points[0], again[0], binned[0], again[1]))
    return tuple(out)


def _cells(size: tuple[float, float], n: int) -> tuple[int, int]:
    """Cells of a chip along x and y: of the tables' size, or wider where stars are few."""
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
