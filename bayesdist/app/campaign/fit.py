"""Stage 1 of a campaign: tables, errors, every exposure alone, and all of them jointly."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.campaign.session import HIERARCHY, CampaignSession
from bayesdist.app.session import ERROR_COLUMNS, write_table
from bayesdist.app.stages.fit import summarise_fit
from bayesdist.assess.grid import grid_pixels, mesh
from bayesdist.data import MatchTable, centroid_errors
from bayesdist.infer import fit_by_magnitude, load, save_fit
from bayesdist.infer.checkpoints import write_arrays
from bayesdist.infer.exposures_alone import ExposureSolutions, fit_exposures
from bayesdist.infer.hierarchy import HierarchicalFit, fit_hierarchical, held_in_reference
from bayesdist.infer.nodes import TableFit, fit_with_tables, pixel_jacobian
from bayesdist.infer.series import Series
from bayesdist.infer.views import LinearTerms, lines, reference_gauge, without_frames
from bayesdist.model import corrected

__all__ = ["run_campaign_fit"]

Float = NDArray[np.float64]

log = logging.getLogger("bayesdist")

SERIES = ("A_2", "A_3", "B_2", "B_3")


def run_campaign_fit(session: CampaignSession) -> None:
    tables = _fit_tables(session)
    _fit_errors(session)
    matches = session.matches
    assert isinstance(matches, MatchTable)
    options = {
        "clip_chi2": session.config.fit.clip_chi2,
        "clip_abs": session.config.fit.clip_abs,
    }
    number = session.reference_chip
    drifting = replace(session.plain_model, time=session.config.time())
    model = held_in_reference(matches, drifting, number)
    shards = load(model, matches, session.config.resources())
    joint = fit_hierarchical(shards, model, seed=session.config.sampler.seed, **options)
    shards.close()
    save_fit(joint.fit, session.run / "fit.nc")
    write_arrays(
        session.run / HIERARCHY,
        "",
        {
            "tau_draws": joint.tau_draws,
            "prior_centre": joint.priors.centre,
            "prior_precision": joint.priors.precision,
        },
    )
    session.errors_changed()
    for stale in ("fit", "model", "priors"):
        session.__dict__.pop(stale, None)
    alone = fit_exposures(matches, session.plain_model, chip=number, skip=True, **options)
    session.keep_terms(_series(alone, number))
    summarise_fit(session, joint.fit)
    session.run.summarise(
        tables=_tables_summary(session, tables),
        scatter={name: _scatter(joint, name) for name in joint.tau},
        gauge=_gauge(joint, number),
        lines=_lines(joint, number),
        exposures_skipped=dict(alone.skipped),
    )
    log.info(
        "fit: scatter of the exposures %s",
        ", ".join(f"{name} {tau:.2g}" for name, tau in joint.tau.items()),
    )


def _fit_tables(session: CampaignSession) -> TableFit | None:
    block = session.config.tables
    session.keep_tables(())
    if block.method == "none":
        return None
    pairs = session.pairs
    _, with_errors, _ = fit_by_magnitude(pairs, session.plain_model)
    assert isinstance(with_errors, MatchTable)
    found = fit_with_tables(
        with_errors,
        session.plain_model,
        method=block.method,
        step=block.step,
        rounds=block.rounds,
        report=lambda one: log.info(
            "fit: tables, round %d: moved %.2g px, residuals %.4f px",
            one.number,
            one.moved,
            one.rms,
        ),
    )
    session.keep_tables(found.tables, _table_errors(session, found))
    return found


def _table_errors(session: CampaignSession, found: TableFit) -> dict[int, Float]:
    """Errors (ny, nx, 2) of positions by those of the tables, on the grid of the assessment."""
    part, grid = found.part(), session.config.assess.grid
    sizes = {chip.number: chip.size for chip in session.plain_model.chips}
    out = {}
    for posterior in part.posteriors:
        number = posterior.table.chip
        x, y = mesh(*grid_pixels(sizes[number], grid))
        px, py = corrected(found.tables, x, y, chip=number)
        J = pixel_jacobian(part.fit.model, part.fit.mean, px, py, chip=number)
        variance = posterior.position_sigma(x, y, refitted=True) ** 2
        total = np.einsum("nab,nb->na", J**2, variance)
        out[number] = np.sqrt(total).reshape(grid[1], grid[0], 2)
    return out


def _fit_errors(session: CampaignSession) -> None:
    """Errors of the centroids by magnitude, from the scatter that the tables leave."""
    pairs = session.raw_matches
    assert isinstance(pairs, MatchTable)
    _, _, total = fit_by_magnitude(pairs, session.plain_model)
    errors = centroid_errors(pairs, total)
    table = Table({name: getattr(errors, name) for name in ERROR_COLUMNS})
    write_table(table, session.run / "magnitude_errors.ecsv")
    session.errors_changed()


def _series(alone: ExposureSolutions, reference: int) -> Series:
    """Scales and rotations of all chips, without those that the gauge fixes."""
    labels = [label for label in alone.labels if label.split(".")[-1] in SERIES]
    spread = dict(zip(alone.labels, np.ptp(alone.values, axis=0), strict=True))
    labels = [label for label in labels if spread[label] > 1e-12]
    epoch, values, cov = alone.series(*labels)
    return Series(epoch, values, cov, tuple(labels), alone.names, source="exposures")


# -- summary.json ---------------------------------------------------------------------------------


def _tables_summary(session: CampaignSession, found: TableFit | None) -> dict[str, object]:
    if found is None:
        return {"method": "none"}
    return {
        "method": session.config.tables.method,
        "converged": found.converged,
        "rms_before": found.progress[0].rms,
        "rms_after": found.progress[-1].rms,
        "chips": [
            {
                "chip": table.chip,
                "nodes": list(table.shape),
                "rms": float(np.sqrt((table.values**2).mean())),
                "largest": float(np.hypot(*table.values).max()),
                "sigma_median": None if table.sigma is None else float(np.median(table.sigma)),
            }
            for table in found.tables
        ],
    }


def _scatter(joint: HierarchicalFit, name: str) -> dict[str, object]:
    return {"value": joint.tau[name], "interval_68": list(joint.tau_interval(0.68)[name])}


def _gauge(joint: HierarchicalFit, chip: int) -> dict[str, object]:
    gauge = reference_gauge(without_frames(joint), chip).gauge
    assert gauge is not None
    return {
        "chip": chip,
        "fixed": ["A_1", "B_1", "A_3"],
        "epoch": gauge.epoch,
        "rotation": gauge.rotation,
        "sigma_rotation": gauge.sigma_rotation,
        "shift": list(gauge.shift),
        "sigma_shift": list(gauge.sigma_shift),
    }


def _lines(joint: HierarchicalFit, chip: int) -> list[dict[str, object]]:
    """alpha and beta of the joint fit in the reference gauge, as Tables 1 to 3 of the report."""
    view = reference_gauge(without_frames(joint), chip)
    time = view.model.time
    rows: list[dict[str, object]] = []
    for s in range(1 if time is None else time.n_segments):
        for one in view.model.chips:
            found = lines(view, s, chip=one.number) if time is not None else None
            if found is None:
                continue
            rows += [
                {"segment": s, "chip": one.number, "epoch0": time.epoch0[s]} | row
                for row in _rows(found)
            ]
    return rows


def _rows(found: LinearTerms) -> list[dict[str, object]]:
    values = dict(zip(found.labels, zip(found.values, found.sigma, strict=True), strict=True))
    names = dict.fromkeys(label.split(".")[0] for label in found.labels)
    return [
        {
            "term": name,
            "alpha": float(values[f"{name}.alpha"][0]),
            "sigma_alpha": float(values[f"{name}.alpha"][1]),
            "beta": float(values[f"{name}.beta"][0]),
            "sigma_beta": float(values[f"{name}.beta"][1]),
        }
        for name in names
    ]
