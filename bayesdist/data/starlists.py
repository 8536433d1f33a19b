"""Reading of star lists, and the cuts that select the detections to be matched."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table

from bayesdist.data.covariances import without_sizes
from bayesdist.data.detections import Detections
from bayesdist.data.formats import exposure_names, input_files, kind_of, mission_formats
from bayesdist.data.reading.centroids import check_ellipses, pixel_covariances, with_variances
from bayesdist.data.reading.columns import CENTROIDS
from bayesdist.data.repeated import first_duplicate
from bayesdist.data.tables.checks import COMPLETED, counted, row_number
from bayesdist.data.tables.column import Quantities, SourceColumn
from bayesdist.data.tables.names import ALIASES, BASIC, find_columns, origin_of
from bayesdist.errors import FormatError, InputError
from bayesdist.files.tables import TABLE_SUFFIXES, read_table
from bayesdist.files.unpacked import without_codec
from bayesdist.utils.arrays import Bool, Float

log = logging.getLogger("bayesdist")


_LIST_ALIASES = {key: BASIC[key] for key in ("exposure", "chip", "epoch")} | {
    "x": ALIASES["x"],
    "y": ALIASES["y"],
    "mag": (*ALIASES["mag"], "m"),
    "flux": ALIASES["flux"],
    "q": ("q", "qfit", "quality"),
    **{key: ALIASES[key] for key in CENTROIDS},
}


@dataclass(frozen=True)
class StarCuts:
    """Cuts that select the detections to be matched.

    Parameters
    ----------
    mag : tuple of float, optional
        Brightest and faintest instrumental magnitude. For star lists of HST, (-14, -10) typically
        selects the well measured stars.
    saturation : float, optional
        Magnitude limit; brighter stars are saturated.
    q_max : float, optional
        Largest (poorest) quality parameter of the PSF fit.

    Raises
    ------
    InputError
        If the range of magnitudes is empty.
    """

    mag: tuple[float, float] | None = None
    saturation: float | None = None
    q_max: float | None = None

    def __post_init__(self) -> None:
        if self.mag is not None and not self.mag[0] < self.mag[1]:
            raise InputError(
                f"magnitudes from {self.mag[0]} to {self.mag[1]} are not a range",
                where="cuts",
                do="give the brightest and then the faintest",
            )

    def passed(self, stars: Detections) -> tuple[Bool, dict[str, int]]:
        """Apply the cuts to detections.

        Parameters
        ----------
        stars : Detections
            Detections of one exposure.

        Returns
        -------
        good : ndarray of bool, shape (N,)
            Mask of the detections that pass.
        rejected : dict of str to int
            Number of detections that fail, by the first reason.

        Raises
        ------
        InputError
            If the list lacks the magnitudes or qualities that a cut needs.
        """
        by_mag = self.mag is not None or self.saturation is not None
        for needed, name in ((by_mag, "mag"), (self.q_max is not None, "q")):
            if needed and getattr(stars, name) is None:
                raise InputError(
                    f"has no column {name!r}, which the cuts need",
                    where=stars.where,
                    do="name the column, or choose other cuts",
                )
        reasons: list[tuple[str, Bool]] = []
        if self.saturation is not None and stars.mag is not None:
            reasons.append(("saturated", stars.mag < self.saturation))
        if self.mag is not None and stars.mag is not None:
            reasons.append(("too bright", stars.mag < self.mag[0]))
            reasons.append(("too faint", stars.mag > self.mag[1]))
        if self.q_max is not None and stars.q is not None:
            reasons.append(("poor fit", stars.q > self.q_max))
        return counted(reasons, len(stars))


def read_star_lists(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    columns: Mapping[str, str] | None = None,
    *,
    errors: bool = False,
) -> tuple[Detections, ...]:
    """Read raw detections of exposures from files.

    Parameters
    ----------
    path : path-like or sequence of path-like
        Files, patterns or a folder of Parquet files: tables as for `read_matches`, or lists in a
        format added by a mission. A table with a column of exposures may hold several of them; any
        other file is one exposure, named after the file.
    columns : mapping of str to str, optional
        Column of each quantity: x y exposure chip mag flux q epoch sigma_x sigma_y rho_xy. Without
        a column of chips, all are chip 1. Formats of missions have fixed columns. Pixels are
        converted if the column names or the header show that they count from 0. Fluxes are
        converted to magnitudes with zero point 0 if there are no magnitudes and all fluxes are
        positive.
    errors : bool, optional
        True to read the errors of x and y, and their correlation if there is such a column. `sigma`
        of the detections is the rms of both errors.

    Returns
    -------
    tuple of Detections
        One entry per exposure, in the order of first appearance.

    Raises
    ------
    InputError
        If a file cannot be read, if columns are missing or values are invalid, if a detection is
        repeated, or if an exposure occurs in two files.
    """
    files = input_files(path)
    out: list[Detections] = []
    for file, name in zip(files, exposure_names(files), strict=True):
        named = without_codec(file.name).endswith(tuple(TABLE_SUFFIXES))
        kind = "table" if named else kind_of(file, columns)
        format_ = mission_formats().get(kind)
        read = None if format_ is None else format_.detections
        if read is not None and not errors:
            out.append(read(file, name))
        elif read is not None:
            raise InputError(
                f"a list of the format {kind!r} has no errors of its pixels",
                where=str(file),
                do="set the errors to be measured by magnitude",
            )
        elif kind == "table":
            out += _of_table(read_table(file), columns, str(file), name, errors)
        else:
            raise FormatError(
                f"has matches or a catalogue ({kind}), but star lists are expected",
                where=str(file),
                do="give star lists, or tables with x, y",
            )
    names = [stars.name for stars in out]
    for k, stars in enumerate(out):
        _refuse_repeated(stars)
        if stars.name in names[:k]:
            raise InputError(
                f"exposure {stars.name} stands in {out[names.index(stars.name)].source}, too",
                where=stars.source,
                do="give each exposure in one file",
            )
    return tuple(out)


def _refuse_repeated(one: Detections) -> None:
    """Raise InputError if a detection is repeated, for instance in a table appended to itself."""
    keys = [one.x, one.y, one.chip] + ([] if one.mag is None else [one.mag])
    pair = first_duplicate(keys)
    if pair is not None:
        first, second = (row_number(k) for k in pair)
        raise InputError(
            f"{second} of exposure {one.name} repeats {first}: the same x, y and magnitude",
            where=one.source,
            do="keep each detection once",
        )


def _of_table(
    table: Table, columns: Mapping[str, str] | None, source: str, name: str, errors: bool
) -> list[Detections]:
    """Detections of each exposure of a table."""
    original = table
    table = with_variances(table) if errors else table
    column_names = find_columns(
        table.colnames,
        columns,
        _LIST_ALIASES,
        source=source,
        pairs=[("x", "y"), ("sigma_x", "sigma_y")],
        needed=("x", "y", "sigma_x", "sigma_y") if errors else ("x", "y"),
    )
    if errors:
        check_ellipses(original, column_names, source)
    if not len(table):
        raise InputError("holds no detections", where=source, do="give a list with stars")

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[column_names[key]], source, column_names[key])

    keys = [key for key in ("x", "y", "mag", "q") if key in column_names]
    values: dict[str, Float] = {key: column(key).numbers() for key in keys}
    if "mag" not in values and "flux" in column_names:
        mag = column("flux").magnitudes_of_fluxes()
        if mag is not None:
            values["mag"] = mag
    if errors:
        covariance = pixel_covariances(Quantities(table, column_names, source))
        sigma, correlations = without_sizes(covariance)
        values["sigma_x"], values["sigma_y"] = sigma.T
        if "rho_xy" in column_names:
            values["rho_xy"] = correlations[:, 0, 1]
    if "exposure" in column_names:
        codes, names = column("exposure").labels()
    else:
        codes, names = np.zeros(len(table), np.int64), (name,)
    origin, why = origin_of(column_names["x"], table.colnames, table.meta)
    if origin == 0:
        log.info("%s: 1 is added to its pixels: %s", source, why)
    detections = Detections(
        values["x"] + (1 - origin),
        values["y"] + (1 - origin),
        chip=column("chip").integers() if "chip" in column_names else COMPLETED,
        mag=values.get("mag"),
        q=values.get("q"),
        sigma_x=values.get("sigma_x"),
        sigma_y=values.get("sigma_y"),
        rho_xy=values.get("rho_xy"),
        source=source,
    )
    years = column("epoch").years() if "epoch" in column_names else None
    order = np.argsort(codes, kind="stable")
    edges = np.searchsorted(codes[order], np.arange(len(names) + 1))
    return [
        replace(
            detections.select(rows),
            exposure_names=(exposure_name,),
            epoch=None if years is None else years[rows].mean(keepdims=True),
        )
        for exposure_name, rows in zip(names, np.split(order, edges[1:-1]), strict=True)
    ]
