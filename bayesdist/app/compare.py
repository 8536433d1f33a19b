"""`bayesdist compare`: two calibrations, from whatever files, and how they differ."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bayesdist.app.comparison_files import write_comparison
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.solutions import solution_at
from bayesdist.assess import DEFAULT_GRID
from bayesdist.assess.calibration import Calibration, calibration_of_solution
from bayesdist.assess.comparison import Comparison, compare
from bayesdist.assess.comparison_gap import (
    ChipPair,
    GapDifference,
    gap_difference,
    pair_of_solution,
)
from bayesdist.assess.comparison_verdict import comparison_lines, gap_lines, gap_verdict, verdict
from bayesdist.errors import InputError
from bayesdist.products import read_idctab
from bayesdist.products.calibration_file import read_calibrations
from bayesdist.products.chip_pairs import pair_of_idctab, reference_first
from bayesdist.products.sip_read import holds_sip, read_sip

__all__ = ["calibrations_of", "compare_files"]

SCHEMA = 1
SEED = 20150206  # of the noise fields: the same comparison gives the same numbers

Chips = dict[int | None, Calibration]


def compare_files(
    a: str | Path,
    b: str | Path,
    output: str | Path | None = None,
    *,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    keep: bool = False,
    grid: Sequence[int] = DEFAULT_GRID,
    command: str = "",
) -> str:
    """Compare two calibrations.

    Parameters
    ----------
    a, b : path
        Each a run directory, posterior.nc, fit.nc, IDCTAB, SIP header or WISE meta-data file.
    output : path, optional
        New or empty folder for tables, summary and figure.
    chip : int, optional
        All chips that both have by default, each by itself.
    filter : str, optional
        Of IDCTABs, or the band of WISE meta-data; two, joined by a colon, for A and B.
    epoch : float, optional
        Decimal years, for what depends on time.
    keep : bool
        Leave shift, rotation and scale in the difference.
    grid : sequence of int
        Points on x and y.
    command : str
        For the record.

    Returns
    -------
    str
        What to print.

    Raises
    ------
    InputError
        As `calibrations_of` and `compare`; for files without a common chip.
    """
    first, _, second = (filter or "").partition(":")
    filters = (first or None, second or first or None)
    paths, both, size = (Path(a), Path(b)), dict[int, Chips](), None
    # a SIP header may not say how large the image is: then the other file tells
    for k in sorted((0, 1), key=lambda k: _lacks_size(paths[k])):
        both[k] = calibrations_of(paths[k], filter=filters[k], epoch=epoch, size=size)
        size = next(iter(both[k].values())).basis.size
    rng = np.random.default_rng(SEED)
    nx, ny = grid
    found = [
        compare(one, other, rng=rng, grid=(nx, ny), keep=keep)
        for one, other in _pairs(both[0], both[1], chip, (str(a), str(b)))
    ]
    gaps = _gaps(paths, filters, epoch, [one.a.chip for one in found])
    if output is not None:
        write_comparison(Path(output), found, gaps, command)
    scale = _scale_of(a) or _scale_of(b)
    return _text(found, gaps, scale, related=_home(a) == _home(b))


def _lacks_size(path: Path) -> bool:
    """Whether a file is a SIP header that does not say how large its image is."""
    if not path.is_file() or path.suffix == ".nc" or not holds_sip(path):
        return False
    return read_sip(path).size is None


def _home(path: str | Path) -> Path:
    """The run that a file belongs to, or the file."""
    path = Path(path).resolve()
    return path.parent if (path.parent / "run.json").exists() else path


def _scale_of(path: str | Path) -> float | None:
    """Size of a pixel in mas, as a run was told it."""
    home = _home(path)
    if not (home / "run.json").exists():
        return None
    return RunDirectory(home).config.detector.scale_mas


def calibrations_of(
    path: str | Path,
    *,
    filter: str | None = None,
    epoch: float | None = None,
    size: tuple[float, float] | None = None,
) -> Chips:
    """The chips of a calibration, whatever holds it.

    Parameters
    ----------
    path : path
        A run directory stands for its posterior, or its fit where there is none yet.
    filter, epoch, size
        As of `read_calibrations`.

    Returns
    -------
    dict of int or None to Calibration
        None for a file that knows of no chips.

    Raises
    ------
    InputError
        As `load_posterior`, `load_fit` and `read_calibrations`; for a solution that depends on time
        and no epoch.
    """
    path = Path(path)
    solution = solution_at(path)
    if solution is None:
        if not path.exists():
            raise InputError("there is no such file", where=str(path), do="check the name")
        return dict(read_calibrations(path, filter=filter, epoch=epoch, size=size))
    return {
        one.number: calibration_of_solution(
            solution,
            str(path),
            chip=one.number,
            epoch=epoch if solution.model.time is not None else None,
        )
        for one in solution.model.chips
    }


def _pairs(
    a: Chips, b: Chips, chip: int | None, names: tuple[str, str]
) -> list[tuple[Calibration, Calibration]]:
    """What is compared with what: chips by their numbers, or the single ones of both."""
    if chip is not None:
        return [(_chip(a, chip, names[0]), _chip(b, chip, names[1]))]
    common = [number for number in a if number in b]
    if common:
        return [(a[number], b[number]) for number in common]
    if len(a) == len(b) == 1:
        return [(next(iter(a.values())), next(iter(b.values())))]
    listed = " and ".join(", ".join("none" if n is None else str(n) for n in c) for c in (a, b))
    raise InputError(
        f"their chips are {listed}",
        where=", ".join(names),
        do="choose the chip by --chip, which a file without chip numbers takes for its own",
    )


def _chip(chips: Chips, number: int, name: str) -> Calibration:
    if None in chips:
        return chips[None]
    if number not in chips:
        raise InputError(
            f"there is no chip {number}",
            where=name,
            do=f"choose one of {', '.join(map(str, chips))}",
        )
    return chips[number]


def _gaps(
    paths: tuple[Path, Path],
    filters: tuple[str | None, str | None],
    epoch: float | None,
    numbers: list[int | None],
) -> list[GapDifference]:
    """How every further chip lies against the first one of A, or chip 2 of a table."""
    if len(numbers) < 2:
        return []
    reference = next((n for n in _in_order(paths[0]) if n in numbers), None)
    out = []
    for number in numbers:
        if number is None or reference is None or number == reference:
            continue
        a, b = (
            _chip_pair(path, reference, number, filter=one, epoch=epoch)
            for path, one in zip(paths, filters, strict=True)
        )
        out.append(gap_difference(a, b))
    return out


def _in_order(path: Path) -> list[int]:
    """Chips of a calibration, that first which the others are referred to."""
    solution = solution_at(path)
    if solution is not None:
        return [chip.number for chip in solution.model.chips]
    return reference_first(read_idctab(path))


def _chip_pair(
    path: Path, reference: int, number: int, *, filter: str | None, epoch: float | None
) -> ChipPair:
    """Two chips of whatever holds several: a solution or an IDCTAB."""
    solution = solution_at(path)
    if solution is None:
        return pair_of_idctab(read_idctab(path), reference, number, filter=filter, epoch=epoch)
    date = epoch if solution.model.time is not None else None
    return pair_of_solution(solution, str(path), reference, number, epoch=date)


def _text(
    found: Sequence[Comparison],
    gaps: Sequence[GapDifference],
    scale: float | None,
    *,
    related: bool,
) -> str:
    lines = []
    for one in found:
        if len(found) > 1:
            lines.append(f"chip {one.a.chip}, by itself:")
        lines += [verdict(one, scale), *comparison_lines(one)]
    for gap in gaps:
        lines += [gap_verdict(gap), *gap_lines(gap)]
    if related and any(one.errors_of == "both" for one in found):
        lines.append("A and B come from one source: errors that they share make p too large here")
    elif any(one.errors_of == "both" for one in found):
        lines.append("the errors of A and B are taken as independent")
    return "\n".join(lines)
