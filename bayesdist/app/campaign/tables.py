"""Look-up tables of a campaign: fitted with the polynomial, kept for the stages that follow."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.interpolation import measured_between
from bayesdist.app.campaign.reference import held_tables
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.data import MatchTable
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.infer import LinearFit
from bayesdist.infer.nodes import Round, TableFit, fit_with_tables, pixel_jacobian
from bayesdist.infer.nodes.table_fit import held_sigma
from bayesdist.model import LookupTable, corrected
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["fit_tables", "tables_summary"]

Float = NDArray[np.float64]

log = logging.getLogger("bayesdist")

ROUGH = 1  # rounds of the tables from whose residuals the errors of the stars are taken


def fit_tables(session: CampaignSession) -> TableFit | None:
    """Fit the tables that are asked for and keep them; None where none are fitted.

    They are the detector's, unless these are taken from another run: then they are the filter's.
    """
    block, base = session.config.tables, session.base
    held = held_tables(block, session.config.chips(), base)
    session.keep_tables(held)
    if block.method == "none":
        if held:
            fit, _, errors = session.errors_by_magnitude(session.raw_matches)
            pairs = session.pairs.with_errors_by_magnitude(errors)
            between = measured_between(pairs, fit, held, filter=session.inputs.filter, fitted=False)
            session.keep_tables(held, _held_errors(session, fit, held), between)
        return None
    pairs = _with_errors(session, held)
    found = fit_with_tables(
        pairs,
        session.plain_model,
        base=session.inputs.filter,
        detector=held,
        method=block.method,
        step=block.step,
        rounds=block.max_iterations,
        report=_say,
    )
    part = found.part()
    if part.posteriors:
        errors = _on_the_grid(session, lambda x, y, chip: found.table_sigma(x, y, chip=chip))
    else:
        errors = _held_errors(session, part.fit, found.tables)
    between = measured_between(
        pairs,
        part.fit,
        found.tables,
        filter=part.filter,
        posteriors=part.posteriors,
        trust=part.trust,
    )
    session.keep_tables(found.tables, errors, between)
    return found


def _with_errors(session: CampaignSession, held: tuple[LookupTable, ...]) -> MatchTable:
    """Pairs with errors by magnitude, free of the pattern that the tables are to describe.

    The scatter of the residuals before any table is twice that of the stars: with errors from
    there the tables would be smoothed too much, and their own errors twice too large.
    """
    pairs, model = session.pairs, session.plain_model
    _, rough_errors, _ = session.errors_by_magnitude(pairs)
    assert isinstance(rough_errors, MatchTable)
    rough = fit_with_tables(
        rough_errors,
        model,
        base=session.inputs.filter,
        detector=held,
        method=session.config.tables.method,
        step=session.config.tables.step,
        rounds=ROUGH,
    )
    _, _, errors = session.errors_by_magnitude(rough.corrected(pairs))
    return pairs.with_errors_by_magnitude(errors)


def _say(one: Round) -> None:
    log.info(
        "fit: tables, round %d: moved %.2g px, residuals %.4f px", one.number, one.moved, one.rms
    )


def _on_the_grid(session, sigma) -> dict[int, Float]:  # type: ignore[no-untyped-def]
    """Errors (ny, nx, 2) of positions on the grid of the assessment, by chip."""
    grid, out = session.config.assess.grid, {}
    for chip in session.plain_model.chips:
        x, y = mesh(*grid_pixels(chip.size, grid))
        out[chip.number] = sigma(x, y, chip.number).reshape(grid[1], grid[0], 2)
    return out


def _held_errors(
    session: CampaignSession, fit: LinearFit, held: tuple[LookupTable, ...]
) -> dict[int, Float]:
    """Errors of positions by those of tables that have no covariance, or are held."""

    def sigma(x: Float, y: Float, chip: int) -> Float:
        px, py = corrected(held, x, y, chip=chip)
        J = pixel_jacobian(fit.model, fit.mean, px, py, chip=chip)
        return np.sqrt(np.einsum("nab,nb->na", J**2, held_sigma(held, x, y, chip=chip) ** 2))

    return _on_the_grid(session, sigma)


def _doubts(session: CampaignSession, found: TableFit | None) -> Iterator[str]:
    """What is to be known of the tables' errors, each as a clause."""
    block = session.config.tables
    if block.detector is not None and any(t.sigma is None for t in session.tables if not t.filter):
        yield "the detector's tables have no errors, and none are counted"
    if session.tables and len(session.between_nodes) < len(session.config.chips()):
        yield (
            "too few stars lie near each other to tell what the look-up tables leave between "
            "their nodes, and no error is counted for it"
        )
    if found is None:
        return
    if block.method == "binned":
        yield (
            "the tables are smoothed bins: their errors are those of the bins; what smoothing "
            "takes off the pattern is among what lies between the nodes"
        )
    if not found.converged:
        yield (
            f"the look-up tables still moved by {found.progress[-1].moved:.2g} pixels in the last "
            f"of {len(found.progress)} rounds"
        )


def tables_summary(session: CampaignSession, found: TableFit | None) -> dict[str, object]:
    """What summary.json says of the tables."""
    out: dict[str, object] = {
        "method": session.config.tables.method,
        "detector": session.config.tables.detector,
        "chips": [_row(table) for table in session.tables],
        "between_nodes": [_between(one) for one in session.between_nodes.values()],
        "warnings": list(_doubts(session, found)),
    }
    if found is not None:
        out |= {
            "converged": found.converged,
            "rms_before": found.progress[0].rms,
            "rms_after": found.progress[-1].rms,
        }
    return out


def _row(table: LookupTable) -> Mapping[str, object]:
    return {
        "chip": table.chip,
        "filter": table.filter or None,
        "nodes": list(table.shape),
        "rms": float(np.sqrt((table.values**2).mean())),
        "largest": float(np.hypot(*table.values).max()),
        "sigma_median": None if table.sigma is None else float(np.median(table.sigma)),
    }


def _between(one: BetweenNodes) -> Mapping[str, object]:
    """Pixels along x and y, as the budget has them, and mean squares as measured."""
    return {
        "chip": one.chip,
        "rms_x": float(one.left.mean[0] ** 0.5),
        "rms_y": float(one.left.mean[1] ** 0.5),
        "square": one.square.tolist(),
        "square_error": one.error.tolist(),
        "n_pairs": one.n_pairs,
    }
