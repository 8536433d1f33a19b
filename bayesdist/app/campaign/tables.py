"""Look-up tables of a campaign: fitted with the polynomial, kept for the stages that follow."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.session import CampaignSession
from bayesdist.assess.grid import grid_pixels, mesh
from bayesdist.data import MatchTable
from bayesdist.infer import fit_by_magnitude
from bayesdist.infer.nodes import TableFit, fit_with_tables, pixel_jacobian
from bayesdist.model import corrected

__all__ = ["fit_tables", "tables_summary"]

Float = NDArray[np.float64]

log = logging.getLogger("bayesdist")


def fit_tables(session: CampaignSession) -> TableFit | None:
    """Fit the tables that are asked for and keep them; None where none are."""
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


def tables_summary(session: CampaignSession, found: TableFit | None) -> dict[str, object]:
    """What summary.json says of the tables."""
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
