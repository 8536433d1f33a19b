"""`bayesdist compare`: differences of two calibrations in any files, as text and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table, vstack

from bayesdist.app.calibrations import (
    asks_of,
    calibration_at,
    common_chips,
    on_the_sky,
    positions_on_the_sky,
    refuse_unused_date,
    run_of,
)
from bayesdist.app.store.record import attributes, record_folder, write_table
from bayesdist.assess.comparison.compare import (
    IDENTICAL,
    NOISE_SEED,
    Comparison,
    compare,
    comparison_lines,
    comparison_table,
    difference_table,
    gap_lines,
    gap_table,
    gap_verdict,
    verdict,
)
from bayesdist.assess.comparison.frame import (
    GapDifference,
    gap_difference,
    pair_of_chips,
)
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data.tangent import separation
from bayesdist.errors import InputError
from bayesdist.model.grid import DEFAULT_GRID
from bayesdist.products.common.document import MissingSizeError
from bayesdist.report.drawing import save_figures
from bayesdist.report.figures.commands import difference_vectors


@dataclass(frozen=True)
class SkyDifference:
    """Distances on the sky between the positions of one chip in two calibrations."""

    largest_arcsec: float
    rms_arcsec: float
    largest_pix: float

    @property
    def sentence(self) -> str:
        """Line of text for the report of a comparison."""
        if self.largest_pix < IDENTICAL_SKY:
            return "on the sky A and B have the same positions"
        return (
            f"on the sky A and B are {self.largest_arcsec:.3g} arcsec ({self.largest_pix:.3g} pix) "
            f"apart at most, {self.rms_arcsec:.3g} arcsec rms: shift, rotation and scale count here"
        )


IDENTICAL_SKY = 1e-6  # pixels
SAME_POINT = 1e-6  # arcsec, the distance below which tangent points are the same
SAME_SHAPE = (
    "The calibrations agree to rounding after shift, rotation and scale, and not on the sky."
)


def write_comparison(
    output: Path,
    found: Sequence[Comparison],
    gaps: Sequence[GapDifference],
    command: str,
    sky: Sequence[SkyDifference | None],
) -> None:
    """Write tables, summary and figure of chips and the gaps between them to a new folder."""
    with record_folder(output, "comparison.json", command) as (folder, record):
        write_table(joined(found, comparison_table), folder / "comparison.ecsv")
        write_table(joined(found, difference_table), folder / "difference.ecsv")
        if gaps:
            write_table(gap_table(gaps), folder / "gap.ecsv")
        save_figures({"difference": difference_vectors(found)}, folder / "figures")
        record["chips"] = [
            comparison_summary(item) | {"sky": None if far is None else asdict(far)}
            for item, far in zip(found, sky, strict=True)
        ]
        record["gaps"] = [_gap_summary(item) for item in gaps]


def comparison_summary(found: Comparison) -> dict[str, Any]:
    """Content of comparison.json for one chip."""
    s = found.similarity
    sides = {
        letter: attributes(c, "name unit chip epoch errors notes") | {"order": c.basis.order}
        for letter, c in (("a", found.a), ("b", found.b))
    }
    return {
        **sides,
        "verdict": verdict(found),
        "unit": "pix",
        "pixel_mas": found.frame.pixel_mas,
        "linear": {
            "taken_out": bool(found.frame.taken.shape[1]),
            **attributes(s, "shift sigma_shift scale sigma_scale mirrored"),
            "rotation_rad": s.rotation,
            "sigma_rotation_rad": s.sigma_rotation,
            "comparable": s.alike,
        },
        **attributes(found, "rms noise_rms largest sigma_of_largest position_of_largest"),
        "significance_of": found.errors_of if found.field is not None else "none",
        **attributes(found.field, "chi2 dof p_value"),
        **attributes(found, "largest_z p_largest_z"),
        "p_largest_chi2_on_grid": found.p_largest_chi2,
        "untested_rms": found.unknown_rms,
    }


def _gap_summary(gap: GapDifference) -> dict[str, Any]:
    sigma = (None,) * 4 if gap.sigma is None else gap.sigma.tolist()
    shift_u, shift_v, scale, rotation = gap.values.tolist()
    return {
        **attributes(gap, "chip reference"),
        "verdict": gap_verdict(gap),
        "unit": "pix",
        "shift": [shift_u, shift_v],
        "sigma_shift": None if gap.sigma is None else sigma[:2],
        "scale": scale,
        "sigma_scale": sigma[2],
        "rotation_rad": rotation,
        "sigma_rotation_rad": sigma[3],
        "significance_of": gap.errors_of,
        **attributes(gap.test, "chi2 dof p_value"),
    }


def joined(found: Sequence[Comparison], table_of: Any) -> Table:
    """Tables of all chips combined, with a first column 'chip' if there are several."""
    tables = []
    for comparison in found:
        table = table_of(comparison)
        if len(found) > 1:
            table.add_column([comparison.a.chip] * len(table), name="chip", index=0)
        tables.append(table)
    return vstack(tables, metadata_conflicts="silent")


SKY_GRID = 65  # grid points per axis on which sky positions are compared


def compare_files(
    a: str | Path,
    b: str | Path,
    output: str | Path | None = None,
    *,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    size: tuple[float, float] | None = None,
    keep: bool = False,
    grid: Sequence[int] = DEFAULT_GRID,
    command: str = "",
) -> str:
    """Compare two calibrations; tables, summary and figure are written to a new folder `output`.

    Parameters
    ----------
    a, b : path
        Run directory, posterior.nc, fit.nc, or calibration file of any format.
    output : path, optional
        Folder to create.
    chip : int, optional
        Chip to compare; by default all common chips, one by one.
    filter : str, optional
        Filter or band of a file with several; two for A and B, joined by a colon.
    epoch : float, optional
        Date in decimal years.
    size : tuple of float, optional
        Columns and rows, for files that do not state them.
    keep : bool
        Do not remove shift, rotation and scale.
    grid : sequence of int
        Number of points along x and y.
    command : str
        Command line, for the record.

    Returns
    -------
    str
        Verdicts.
    """
    first, _, second = (filter or "").partition(":")
    calibrations = _read((Path(a), Path(b)), (first or None, second or first or None), size)
    refuse_unused_date(epoch, *calibrations)
    maps = [item.by_chip(epoch) for item in calibrations]
    numbers = _common(calibrations, chip)
    rng = np.random.default_rng(NOISE_SEED)
    nx, ny = grid
    comparisons = [
        compare(maps[0][n], maps[1][m], rng=rng, grid=(nx, ny), keep=keep) for n, m in numbers
    ]
    gaps = _gaps(calibrations, epoch, [n for n, m in numbers if n == m])
    laid = on_the_sky(Path(a), calibrations[0]), on_the_sky(Path(b), calibrations[1])
    sky = [_sky_difference(laid, pair, epoch) for pair in numbers]
    if output is not None:
        write_comparison(Path(output), comparisons, gaps, command, sky)
    runs = [run_of(Path(item)) for item in (a, b)]
    scales = [None if run is None else run.config.detector.scale_mas for run in runs]
    homes = [
        Path(item).resolve() if run is None else run.path.resolve()
        for item, run in zip((a, b), runs, strict=True)
    ]
    related = homes[0] == homes[1]
    text = _text(comparisons, gaps, scales[0] or scales[1], sky, related=related)
    return "\n".join([text, *_planes(laid)])


def _planes(both: tuple[Calibration, Calibration]) -> list[str]:
    """Line on the tangent points of two calibrations, if they differ."""
    a, b = (calibration.plane.point for calibration in both)
    if a is None or b is None:
        return []
    apart = 3600.0 * float(separation(a, *b))
    if apart < SAME_POINT:
        return []
    return [
        f"the tangent points of A and B are {apart:.4g} arcsec apart: u and v of the same position "
        "differ by a shift and a rotation, which are no difference of the distortions"
    ]


def _sky_difference(
    both: tuple[Calibration, Calibration], pair: tuple[int, int], epoch: float | None
) -> SkyDifference | None:
    """Distances on the sky over a grid of one chip; None unless both are on the sky."""
    if any(
        calibration.plane.point is None or calibration.unit not in ARCSEC for calibration in both
    ):
        return None
    x, y = detector_grid(both[0].model.chips[both[0].numbers.index(pair[0])].size, SKY_GRID)
    places = []
    for calibration, number in zip(both, pair, strict=True):
        date = epoch if calibration.model.time is not None else None
        at = calibration.forward(x, y, chip=number, epoch=date)
        places.append(positions_on_the_sky(calibration, at))
    far = 3600.0 * separation(places[0], *places[1])
    linear = both[0].chip(pair[0], epoch if both[0].model.time is not None else None).linear
    pixel = ARCSEC[both[0].unit] * float(np.sqrt(abs(np.linalg.det(linear))))
    rms = float(np.sqrt(np.mean(far**2)))
    return SkyDifference(float(far.max()), rms, float(far.max()) / pixel)


def _read(
    paths: tuple[Path, Path],
    filters: tuple[str | None, str | None],
    size: tuple[float, float] | None,
) -> tuple[Calibration, Calibration]:
    """Both calibrations; a header without a size gets the given size, or that of the other file."""
    asked = [asks_of(path) for path in paths]
    chosen: list[str | None] = list(filters)
    sizes: list[tuple[float, float] | None] = [size, size]
    for k, partner in ((0, 1), (1, 0)):  # options that only one of the files uses are allowed
        if "filter" not in asked[k] and "filter" in asked[partner]:
            chosen[k] = None
        if "size" not in asked[k] and "size" in asked[partner]:
            sizes[k] = None
    for k, partner in ((0, 1), (1, 0)):
        try:
            calibration_at(paths[k], filter=chosen[k], size=sizes[k])
        except MissingSizeError:
            sizes[k] = calibration_at(paths[partner], filter=chosen[partner]).model.chips[0].size
    a, b = (
        calibration_at(path, filter=chosen_filter, size=its)
        for path, chosen_filter, its in zip(paths, chosen, sizes, strict=True)
    )
    return a, b


def _common(both: tuple[Calibration, Calibration], chip: int | None) -> list[tuple[int, int]]:
    """Pairs of chip numbers to compare."""
    if chip is not None:
        return [(_number(both[0], chip), _number(both[1], chip))]
    return common_chips(*both)


def _number(one: Calibration, number: int) -> int:
    if not one.numbered:
        return one.numbers[0]
    if number not in one.numbers:
        raise InputError(
            f"there is no chip {number}",
            where=one.name,
            do=f"choose one of {', '.join(map(str, one.numbers))}",
        )
    return number


def _gaps(
    both: tuple[Calibration, Calibration], epoch: float | None, numbers: list[int]
) -> list[GapDifference]:
    """Differences in position of each other chip relative to the reference chip of A."""
    if len(numbers) < 2:
        return []
    reference = next(n for n in both[0].numbers if n in numbers)
    out = []
    for number in numbers:
        if number == reference:
            continue
        a, b = (pair_of_chips(calibration, reference, number, epoch=epoch) for calibration in both)
        out.append(gap_difference(a, b))
    return out


def _text(
    found: Sequence[Comparison],
    gaps: Sequence[GapDifference],
    scale: float | None,
    sky: Sequence[SkyDifference | None],
    *,
    related: bool,
) -> str:
    lines = []
    for comparison, far in zip(found, sky, strict=True):
        if len(found) > 1:
            lines.append(f"chip {comparison.a.chip}, by itself:")
        apart = far is not None and far.largest_pix > IDENTICAL_SKY
        if apart and comparison.largest < IDENTICAL:
            lines.append(SAME_SHAPE)
        else:
            lines.append(verdict(comparison, scale))
        if far is not None:
            lines.append(far.sentence)
        lines += comparison_lines(comparison)
    for gap in gaps:
        lines += [gap_verdict(gap), *gap_lines(gap)]
    if related and any(comparison.errors_of == "both" for comparison in found):
        lines.append("A and B come from one source: errors that they share make p too large here")
    elif any(comparison.errors_of == "both" for comparison in found):
        lines.append("the errors of A and B are taken as independent")
    return "\n".join(lines)
