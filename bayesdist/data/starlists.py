"""Star lists: raw detections of an exposure, and the cuts that select those to be matched."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.formats.hst1pass import Hst1passList, is_hst1pass, read_hst1pass
from bayesdist.data.reading.formats import exposure_names, input_files
from bayesdist.data.tables.checks import check_columns, columns_of, counted
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.files import TABLE_SUFFIXES, read_lines, read_table
from bayesdist.data.tables.names import BASIC, find_columns
from bayesdist.errors import FormatError, InputError

__all__ = ["StarCuts", "StarList", "read_star_lists", "star_list_of_hst1pass"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Limit: TypeAlias = "float | Callable[[Float], ArrayLike]"

_COLUMNS = ("x", "y", "mag", "q", "chip", "row")
_LIST_ALIASES = {key: BASIC[key] for key in ("x", "y", "exposure", "chip", "mag")} | {
    "q": ("q", "qfit", "quality"),
    "epoch": BASIC["epoch"],
}
_LIST_ALIASES["mag"] = (*_LIST_ALIASES["mag"], "m")


@dataclass(frozen=True, eq=False)
class StarList:
    """Raw detections of one exposure, arrays of length N.

    Parameters
    ----------
    exposure : str
    x, y : ndarray
        Raw detector position, FITS 1-based pixels of the chip.
    chip : ndarray of int, optional
        Chip *numbers* (not codes); by default 1.
    mag : ndarray, optional
        Instrumental magnitudes, -2.5 log10(flux / exposure time).
    q : ndarray, optional
        Quality of the PSF fit: 0 is perfect, large is poor.
    epoch : float, optional
        Decimal year of the exposure.
    source : str
        File.
    row : ndarray of int, optional
        0-based row in it.

    Raises
    ------
    InputError
        For no detections, unequal lengths, or values that are not finite.
    """

    exposure: str
    x: Float
    y: Float
    chip: Int = None  # type: ignore[assignment]
    mag: Float | None = None
    q: Float | None = None
    epoch: float | None = None
    source: str = "list"
    row: Int = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        n = np.size(self.x)
        if n == 0:
            raise InputError("holds no detections", where=self._where, do="give a list with stars")
        if self.chip is None:
            object.__setattr__(self, "chip", np.ones(n, np.int64))
        if self.row is None:
            object.__setattr__(self, "row", np.arange(n))
        check_columns(
            self,
            _COLUMNS,
            integers=("chip", "row"),
            where=self._where,
            place=lambda index: f"{self.source}, row {self.row[index] + 1}",
        )

    @property
    def _where(self) -> str:
        return f"{self.source}, exposure {self.exposure}"

    def __len__(self) -> int:
        return len(self.x)

    @property
    def chips(self) -> tuple[int, ...]:
        """Numbers of the chips that have detections."""
        return tuple(np.unique(self.chip).tolist())

    def select(self, which: NDArray[Any]) -> StarList:
        """Detections by mask or indices."""
        columns = columns_of(self, _COLUMNS)
        return replace(self, **{name: values[which] for name, values in columns.items()})


@dataclass(frozen=True)
class StarCuts:
    """Cuts that select the detections to be matched.

    Parameters
    ----------
    mag : tuple of float, optional
        Brightest and faintest instrumental magnitude; for ACS/WFC lists (-14, -10) are the well
        measured stars (ISR 2015-06, Figure 5).
    saturation : float, optional
        Stars brighter than this are saturated.
    q_max : float or callable, optional
        Poorest quality of the fit: a number, or a function of an array of magnitudes.
    """

    mag: tuple[float, float] | None = None
    saturation: float | None = None
    q_max: Limit | None = None

    def __post_init__(self) -> None:
        if self.mag is not None and not self.mag[0] < self.mag[1]:
            raise InputError(
                f"magnitudes from {self.mag[0]} to {self.mag[1]} are none",
                where="cuts",
                do="give the brightest and then the faintest",
            )

    def passed(self, stars: StarList) -> tuple[Bool, dict[str, int]]:
        """Mask of the detections that pass, and counts of the others by reason.

        Parameters
        ----------
        stars : StarList

        Returns
        -------
        good : ndarray of bool, shape (N,)
        rejected : dict of str to int
            Detections that fail, by the first reason.

        Raises
        ------
        InputError
            When the list lacks the magnitudes or qualities that a cut needs.
        """
        where = f"{stars.source}, exposure {stars.exposure}"
        by_mag = self.mag is not None or self.saturation is not None or callable(self.q_max)
        for needed, name in ((by_mag, "mag"), (self.q_max is not None, "q")):
            if needed and getattr(stars, name) is None:
                raise InputError(
                    f"has no column {name!r}, and the cuts need it",
                    where=where,
                    do="name the column, or cut by something else",
                )
        reasons: list[tuple[str, Bool]] = []
        if self.saturation is not None and stars.mag is not None:
            reasons.append(("saturated", stars.mag < self.saturation))
        if self.mag is not None and stars.mag is not None:
            reasons.append(("too bright", stars.mag < self.mag[0]))
            reasons.append(("too faint", stars.mag > self.mag[1]))
        if self.q_max is not None and stars.q is not None:
            limit = self.q_max(stars.mag) if callable(self.q_max) else self.q_max  # type: ignore[arg-type]
            reasons.append(("poor fit", stars.q > np.asarray(limit, float)))
        return counted(reasons, len(stars))


def read_star_lists(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    columns: Mapping[str, str] | None = None,
    *,
    chip: int | None = None,
) -> tuple[StarList, ...]:
    """Raw detections of exposures, read from files.

    Parameters
    ----------
    path : path-like or sequence of path-like
        Files, patterns or a folder of Parquet files: tables (.ecsv, .csv, .fits, .parquet) or lists
        of hst1pass.  A table with a column of exposures may hold several of them; any other file is
        one exposure, named for the file.
    columns : mapping of str to str, optional
        Column of each quantity: x y exposure chip mag q epoch.  Lists of hst1pass know theirs.
    chip : int, optional
        Chip of files that have no such column; by default 1.

    Returns
    -------
    tuple of StarList
        In the order of their first appearance.

    Raises
    ------
    InputError
        For files that cannot be read, missing columns, wrong values, or an exposure that stands in
        two files.
    """
    files = input_files(path)
    out: list[StarList] = []
    for file, name in zip(files, exposure_names(files), strict=True):
        if file.name.lower().removesuffix(".gz").endswith(tuple(TABLE_SUFFIXES)):
            out += _of_table(read_table(file), columns, str(file), name, chip)
            continue
        if not is_hst1pass(read_lines(file)):
            raise FormatError(
                "is neither a table nor a list of hst1pass",
                where=str(file),
                do=f"give a file that ends in {', '.join(TABLE_SUFFIXES)}",
            )
        out.append(
            star_list_of_hst1pass(
                read_hst1pass(file), exposure=name, chip=1 if chip is None else chip
            )
        )
    names = [one.exposure for one in out]
    for k, one in enumerate(out):
        if one.exposure in names[:k]:
            raise InputError(
                f"exposure {one.exposure} stands in {out[names.index(one.exposure)].source}, too",
                where=one.source,
                do="give each exposure in one file",
            )
    return tuple(out)


def _of_table(
    table: Table, columns: Mapping[str, str] | None, source: str, name: str, chip: int | None
) -> list[StarList]:
    """Star lists of the exposures of a table."""
    found = find_columns(table.colnames, columns, _LIST_ALIASES, source=source, needed="xy")
    if not len(table):
        raise InputError("holds no detections", where=source, do="give a list with stars")

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[found[key]], source, found[key])

    values = {key: column(key).numbers() for key in ("x", "y", "mag", "q") if key in found}
    if "chip" in found:
        chips = column("chip").integers()
    else:
        chips = np.full(len(table), 1 if chip is None else chip)
    if "exposure" in found:
        codes, names = column("exposure").labels()
    else:
        codes, names = np.zeros(len(table), np.int64), (name,)
    whole = StarList(
        "",
        values["x"],
        values["y"],
        chips,
        mag=values.get("mag"),
        q=values.get("q"),
        source=source,
    )
    years = column("epoch").years() if "epoch" in found else None
    if len(names) == 1:
        return [replace(whole, exposure=names[0], epoch=_mean(years, slice(None)))]
    order = np.argsort(codes, kind="stable")
    edges = np.searchsorted(codes[order], np.arange(len(names) + 1))
    return [
        replace(whole.select(rows), exposure=one, epoch=_mean(years, rows))
        for one, rows in zip(names, np.split(order, edges[1:-1]), strict=True)
    ]


def _mean(years: Float | None, rows: Any) -> float | None:
    """Mean epoch of an exposure's rows; None without epochs."""
    return None if years is None else float(years[rows].mean())


def star_list_of_hst1pass(
    found: Hst1passList, *, exposure: str | None = None, chip: int = 1
) -> StarList:
    """Raw detections of a list of hst1pass.

    Parameters
    ----------
    found : Hst1passList
    exposure : str, optional
        Name of the exposure; by default that of the list.
    chip : int, optional
        Chip that it is of: one list holds one chip.

    Returns
    -------
    StarList
        X, Y are the raw pixels, M the instrumental magnitudes, q the qualities of the fit.

    Raises
    ------
    FormatError
        When the list lacks X or Y.
    """
    for letter in "XY":
        if letter not in found.columns:
            raise FormatError(
                f"has no column {letter!r} (it has {' '.join(found.columns)})",
                where=found.source,
                do="run hst1pass with OUT=uvwXYMpq",
            )
    n = len(found.columns["X"])
    return StarList(
        exposure=found.name if exposure is None else exposure,
        x=found.columns["X"],
        y=found.columns["Y"],
        chip=np.full(n, chip),
        mag=found.columns.get("M"),
        q=found.columns.get("q"),
        source=found.source,
    )
