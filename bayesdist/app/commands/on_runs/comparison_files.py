"""The files of a comparison: tables, figure, and the summary that scripts read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from astropy.table import Table, vstack

from bayesdist.app.store.output import record_folder, write_table
from bayesdist.assess.comparison.compare import Comparison
from bayesdist.assess.comparison.gap import GapDifference
from bayesdist.assess.comparison.sentences import gap_verdict, verdict
from bayesdist.assess.comparison.tables import comparison_table, difference_table, gap_table
from bayesdist.report.comparison import difference_vectors
from bayesdist.report.drawing import save_figures

__all__ = ["comparison_summary", "joined", "write_comparison"]


def write_comparison(
    output: Path, found: Sequence[Comparison], gaps: Sequence[GapDifference], command: str
) -> None:
    """Write tables, summary and figure of chips and the gaps between them into a new folder."""
    with record_folder(output, "comparison.json", command) as (folder, record):
        write_table(joined(found, comparison_table), folder / "comparison.ecsv")
        write_table(joined(found, difference_table), folder / "difference.ecsv")
        if gaps:
            write_table(gap_table(gaps), folder / "gap.ecsv")
        save_figures({"difference": difference_vectors(found)}, folder / "figures")
        record["chips"] = [comparison_summary(one) for one in found]
        record["gaps"] = [_gap_summary(one) for one in gaps]


def comparison_summary(found: Comparison) -> dict[str, Any]:
    """Content of comparison.json for one chip."""
    s, field = found.similarity, found.field
    sides = {}
    for letter, c in (("a", found.a), ("b", found.b)):
        sides[letter] = {
            "name": c.name,
            "order": c.basis.order,
            "unit": c.unit,
            "chip": c.chip,
            "epoch": c.epoch,
            "errors": c.errors,
            "notes": list(c.notes),
        }
    return {
        **sides,
        "verdict": verdict(found),
        "unit": "pix",
        "pixel_mas": found.frame.pixel_mas,
        "linear": {
            "taken_out": bool(found.frame.taken.shape[1]),
            "shift": s.shift,
            "sigma_shift": s.sigma_shift,
            "rotation_rad": s.rotation,
            "sigma_rotation_rad": s.sigma_rotation,
            "scale": s.scale,
            "sigma_scale": s.sigma_scale,
            "mirrored": s.mirrored,
            "comparable": s.alike,
        },
        "rms": found.rms,
        "noise_rms": found.noise_rms,
        "largest": found.largest,
        "sigma_of_largest": found.sigma_of_largest,
        "position_of_largest": list(found.position_of_largest),
        "significance_of": found.errors_of if field is not None else "none",
        "chi2": None if field is None else field.chi2,
        "dof": None if field is None else field.dof,
        "p_value": None if field is None else field.p_value,
        "largest_z": found.largest_z,
        "p_largest_z": found.p_largest_z,
        "p_largest_chi2_on_grid": found.p_largest_chi2,
        "untested_rms": found.unknown_rms,
    }


def _gap_summary(gap: GapDifference) -> dict[str, Any]:
    shift, (scale, rotation) = gap.values[:2].tolist(), gap.values[2:].tolist()
    sigma = gap.sigma
    return {
        "chip": gap.chip,
        "reference": gap.reference,
        "verdict": gap_verdict(gap),
        "unit": "pix",
        "shift": shift,
        "sigma_shift": None if sigma is None else sigma[:2].tolist(),
        "scale": scale,
        "sigma_scale": None if sigma is None else float(sigma[2]),
        "rotation_rad": rotation,
        "sigma_rotation_rad": None if sigma is None else float(sigma[3]),
        "significance_of": gap.errors_of,
        "chi2": None if gap.test is None else gap.test.chi2,
        "dof": None if gap.test is None else gap.test.dof,
        "p_value": None if gap.test is None else gap.test.p_value,
    }


def joined(found: Sequence[Comparison], table_of: Any) -> Table:
    """The tables of all chips as one, with the chip in front where there are several.

    `table_of` makes that of one comparison.
    """
    tables = []
    for one in found:
        table = table_of(one)
        if len(found) > 1:
            table.add_column([one.a.chip] * len(table), name="chip", index=0)
        tables.append(table)
    return vstack(tables, metadata_conflicts="silent")
