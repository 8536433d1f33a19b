"""Division of held-out stars by position, magnitude, date and exposure.

An exposure that was held out entirely is also divided by position: distortions of this exposure
alone may leave its mean unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Float, Int

ALL = "all"
STARS_PER_BIN = 60
MAX_CELLS = 8  # along each side of a chip
MAX_BINS = 8  # of magnitudes, and of dates
MAX_PLACES = 4  # cells along each side of a chip, per exposure
MAX_CELLS_IN_ALL = 512  # total number of cells of all such exposures
# if there are more, only exposures that were held out entirely are tested separately
MAX_EXPOSURES = 60


@dataclass(frozen=True)
class Bin:
    """One part of the held-out stars."""

    words: str  # description as a clause: 'at x 1 to 512, y 1 to 512'
    chip: Chip | None = None  # of a region
    # edges of a region in x and y, pixels; lowest and highest magnitude or date
    limits: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Partition:
    """Bins that contain each star at most once."""

    kind: str  # 'all', 'region', 'magnitude', 'epoch', 'exposure' or 'place in exposure'
    bins: tuple[Bin, ...]
    # function of a table and of rows (n,) that returns their bins (n,), negative for none
    codes: Callable[[Matches, Int], Int]


def partitions_of(
    model: DistortionModel, held: Any, sample: Matches, whole: Sequence[str]
) -> tuple[Partition, ...]:
    """Partitions of the held-out stars that are tested.

    `sample` is an evenly spread sample of the held-out stars that determines the edges of bins;
    `whole` are the names of the exposures that were held out entirely.
    """
    n = len(held)
    out = [Partition(ALL, (Bin("over the whole detector"),), lambda _, rows: rows * 0)]
    out.append(_regions(model, _cells(model, n, MAX_CELLS)))
    share = n // STARS_PER_BIN
    if sample.mag is not None:
        out += _quantiles("magnitude", "mag", sample.mag, min(share, MAX_BINS))
    if sample.epoch is not None:
        out += _quantiles("epoch", "epoch", sample.epoch, min(share, MAX_BINS))
    out += _places(model, sample, n / len(sample), whole)
    names = held.exposure_names
    if len(names) > MAX_EXPOSURES:
        names = tuple(name for name in names if name in set(whole))
    if len(held.exposure_names) > 1 and names:
        out.append(_exposures(names, set(whole)))
    return tuple(out)


def _cells(model: DistortionModel, n: float, most: int) -> int:
    """Number of cells along each side of a chip for `n` stars."""
    return int(np.clip(np.sqrt(n / len(model.chips) / STARS_PER_BIN), 1, most))


def _places(
    model: DistortionModel, sample: Matches, share: float, whole: Sequence[str]
) -> list[Partition]:
    """Cells of each exposure that was held out entirely; empty if there are too few stars."""
    if len(np.unique(sample.exposure)) < 2:
        return []  # these cells would be those of all stars
    names = tuple(name for name in sample.exposure_names if name in set(whole))[:MAX_EXPOSURES]
    if not names:
        return []
    codes = [sample.exposure_names.index(name) for name in names]
    n = min(float((sample.exposure == k).sum()) * share for k in codes)
    side_limit = np.sqrt(MAX_CELLS_IN_ALL / (len(model.chips) * len(names)))
    side = _cells(model, n, min(MAX_PLACES, int(side_limit)))
    if side * len(model.chips) < 2:
        return []
    cells = _regions(model, side)

    def code(table: Matches, rows: Int) -> Int:
        mine = _among(names, table, rows)
        return np.where(mine < 0, -1, mine * len(cells.bins) + cells.codes(table, rows))

    bins = [
        Bin(f"in exposure {name}, held out whole, {cell.words}", cell.chip, cell.limits)
        for name in names
        for cell in cells.bins
    ]
    return [Partition("place in exposure", tuple(bins), code)]


def _regions(model: DistortionModel, side: int) -> Partition:
    several = len(model.chips) > 1
    bins = []
    for chip in model.chips:
        nx, ny = chip.size
        x, y = np.linspace(0.5, nx + 0.5, side + 1), np.linspace(0.5, ny + 0.5, side + 1)
        for j in range(side):
            for i in range(side):
                limits = (x[i], x[i + 1], y[j], y[j + 1])
                words = f"{_place(limits, chip, side)}{f' of {chip.name}' if several else ''}"
                bins.append(Bin(words, chip, limits))

    def code(table: Matches, rows: Int) -> Int:
        out = np.full(len(rows), -1)
        numbers = table.chip_number[rows]
        for c, chip in enumerate(model.chips):
            on_chip = numbers == chip.number
            places = []
            for values, size in (
                (table.x[rows[on_chip]], chip.size[0]),
                (table.y[rows[on_chip]], chip.size[1]),
            ):
                places.append(np.clip(((values - 0.5) / size * side).astype(np.int64), 0, side - 1))
            out[on_chip] = (c * side + places[1]) * side + places[0]
        return out

    return Partition("region", tuple(bins), code)


def _place(limits: tuple[float, ...], chip: Chip, side: int) -> str:
    """Description of a cell."""
    if side == 1:
        return "over the whole detector"
    a, b, c, d = (round(value) for value in limits)
    x = f"x < {b}" if a <= 1 else f"x > {a}" if b >= chip.size[0] else f"x {a} to {b}"
    y = f"y < {d}" if c <= 1 else f"y > {c}" if d >= chip.size[1] else f"y {c} to {d}"
    corner = "to" not in x and "to" not in y
    return f"{'in the corner' if corner else 'at'} {x}, {y}"


def _quantiles(kind: str, name: str, values: Float, n: int) -> list[Partition]:
    """Bins with about equal numbers of stars; empty if all values are equal."""
    if n < 2:
        return []
    edges = np.unique(np.quantile(values, np.linspace(0, 1, n + 1)))
    if len(edges) < 3:
        return []
    inner = edges[1:-1]
    of = "at magnitudes" if kind == "magnitude" else "at epochs"
    digits = 4 if kind == "magnitude" else 7
    bins = tuple(
        Bin(f"{of} {a:.{digits}g} to {b:.{digits}g}", limits=(float(a), float(b)))
        for a, b in pairwise(edges)
    )

    def code(table: Matches, rows: Int) -> Int:
        return np.searchsorted(inner, getattr(table, name)[rows], side="right")

    return [Partition(kind, bins, code)]


def _exposures(names: Sequence[str], whole: set[str]) -> Partition:
    bins = (
        Bin(f"in exposure {name}{', held out whole' if name in whole else ''}") for name in names
    )
    return Partition("exposure", tuple(bins), partial(_among, names))


def _among(names: Sequence[str], table: Matches, rows: Int) -> Int:
    """Index into `names` of the exposure of each row; negative for other exposures."""
    number = {name: k for k, name in enumerate(names)}
    of_code = np.array([number.get(name, -1) for name in table.exposure_names], np.int64)
    return np.asarray(of_code[table.exposure[rows]])
