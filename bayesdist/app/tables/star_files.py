"""Residuals and memberships of each star: a folder of Parquet files, one for each batch."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.store.rundir import part_files
from bayesdist.data import Matches
from bayesdist.data.storage.write import write_columns
from bayesdist.files import made_folder, remove_leftovers
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.posterior.memberships import memberships_of
from bayesdist.infer.stars.stars import in_table_order, prepare

__all__ = ["FOLDER", "write_star_files"]

FOLDER = "stars"


def write_star_files(matches: Matches, fit: LinearFit, posterior: Posterior, folder: Path) -> None:
    """Write residuals and memberships of each star by batches, in place of parts that are there."""
    made_folder(folder)
    remove_leftovers(folder)
    for path in part_files(folder):
        path.unlink()
    for k, batch in enumerate(matches.batches()):
        _write_part(batch, fit, posterior, folder / f"part-{k:05d}.parquet")


def _write_part(table: Matches, fit: LinearFit, posterior: Posterior, path: Path) -> None:
    stars, order = prepare(posterior.model, table)
    said = memberships_of(posterior, stars).in_table_order(order)
    u, v = in_table_order(stars.residuals(posterior.mean), order).T
    columns = {
        "source": (table.source, table.sources),
        "row": table.row,
        "x": table.x,
        "y": table.y,
        "chip": table.chip_number,
        "residual_u": u,
        "residual_v": v,
        "used": in_table_order(fit.clip.keeps_of(stars), order),
        "outlier_probability": said.outlier_probability,
        "log_likelihood": said.log_likelihood,
        "log_likelihood_variance": said.log_likelihood_variance,
    }
    unit = posterior.unit
    write_columns(path, columns, {"x": "pix", "y": "pix", "residual_u": unit, "residual_v": unit})
