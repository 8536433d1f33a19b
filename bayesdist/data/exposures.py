"""Logs of exposures: each one's epoch, filter, aberration, roll and target; read and written."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column, MaskedColumn, Table

from bayesdist.data.sky.earth import velocity_aberration
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of, refuse_control_characters

_NUMBERS = ("exptime", "vafactor", "pa_v3", "ra", "dec")
_SLOWEST = 2e-4  # |VAFACTOR - 1| of anything in orbit about the Earth stays below 1.4e-4
_UNITS = {"epoch": "yr", "exptime": "s", "pa_v3": "deg", "ra": "deg", "dec": "deg"}
# plausible values: angles in other units and numbers of another meaning are beyond
_RANGES = {
    "exptime": (0.0, 1e7),
    "pa_v3": (-360.0, 720.0),
    "ra": (-180.0, 360.0),
    "dec": (-90.0, 90.0),
}
_FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits"}
_ALIASES: dict[str, tuple[str, ...]] = {
    "exposure": ("exposure", "name", "rootname"),
    "epoch": ("epoch", "year", "date", "mjd", "expstart"),
    "filter": ("filter", "filt"),
    "exptime": ("exptime", "exposure_time"),
    "vafactor": ("vafactor",),
    "pa_v3": ("pa_v3",),
    "ra": ("ra", "ra_targ"),
    "dec": ("dec", "dec_targ"),
}


@dataclass(frozen=True)
class Exposure:
    """One exposure.

    Parameters
    ----------
    name : str
    epoch : float
        Decimal year of its middle.
    filter : str
        Empty where it is not known.
    exptime : float, optional
        Seconds.
    vafactor : float, optional
        Scale factor of velocity aberration, as the keyword VAFACTOR.
    pa_v3 : float, optional
        Position angle of the V3 axis, degrees.
    ra, dec : float, optional
        Target, degrees.

    Raises
    ------
    InputError
        For an empty name, numbers that are not finite or beyond all that exposures have, or a
        factor that no orbit brings about.
    """

    name: str
    epoch: float
    filter: str = ""
    exptime: float | None = None
    vafactor: float | None = None
    pa_v3: float | None = None
    ra: float | None = None
    dec: float | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("an exposure has no name", do="name it")
        refuse_control_characters((self.name, self.filter), f"exposure {self.name!r:.60}")
        for key in ("epoch", *_NUMBERS):
            value = getattr(self, key)
            if value is not None and not np.isfinite(value):
                raise InputError(
                    f"{key} is {value}, and must be finite",
                    where=f"exposure {self.name}",
                    do="correct it or leave it out",
                )
            if (
                value is not None
                and key in _RANGES
                and not _RANGES[key][0] <= value <= _RANGES[key][1]
            ):
                low, high = _RANGES[key]
                raise InputError(
                    f"{key} is {value:g}, and must be between {low:g} and {high:g}",
                    where=f"exposure {self.name}",
                    do=f"give it in {_UNITS[key]}, or leave it out",
                )
        if self.vafactor is not None and abs(self.vafactor - 1.0) > _SLOWEST:
            raise InputError(
                f"VAFACTOR is {self.vafactor}, and lies within {_SLOWEST:g} of 1 for every orbit",
                where=f"exposure {self.name}",
                do="give the keyword VAFACTOR of the science header",
            )


@dataclass(frozen=True, eq=False)
class ExposureLog:
    """Exposures by name.

    Parameters
    ----------
    exposures : tuple of Exposure
    source : str
        File.

    Raises
    ------
    InputError
        For no exposures, or a repeated one.
    """

    exposures: tuple[Exposure, ...]
    source: str = "exposure log"

    def __post_init__(self) -> None:
        object.__setattr__(self, "exposures", tuple(self.exposures))
        if not self.exposures:
            raise InputError("holds no exposures", where=self.source, do="name at least one")
        names = [one.name for one in self.exposures]
        if len(self._by_name) < len(names):
            again = next(name for k, name in enumerate(names) if name in names[:k])
            raise InputError(
                f"exposure {again} stands twice", where=self.source, do="name each only once"
            )

    @cached_property
    def _by_name(self) -> dict[str, Exposure]:
        return {one.name: one for one in self.exposures}

    def __len__(self) -> int:
        return len(self.exposures)

    def __iter__(self) -> Iterator[Exposure]:
        return iter(self.exposures)

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __getitem__(self, name: str) -> Exposure:
        """The exposure of a name; InputError where there is none."""
        try:
            return self._by_name[name]
        except KeyError:
            raise InputError(
                f"has no exposure {name!r}", where=self.source, do="add it to the log"
            ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the exposures, in their order."""
        return tuple(one.name for one in self.exposures)

    @property
    def filters(self) -> tuple[str, ...]:
        """Filters, in the order of their first appearance."""
        return tuple(dict.fromkeys(one.filter for one in self.exposures))

    def select(
        self,
        *,
        filter: str | Collection[str] | None = None,
        names: Collection[str] | None = None,
    ) -> ExposureLog:
        """Some of the exposures.

        Parameters
        ----------
        filter : str or collection of str, optional
        names : collection of str, optional

        Returns
        -------
        ExposureLog

        Raises
        ------
        InputError
            When none is left.
        """
        filters = (filter,) if isinstance(filter, str) else filter
        chosen = [
            one
            for one in self.exposures
            if (filters is None or one.filter in filters) and (names is None or one.name in names)
        ]
        if not chosen:
            raise InputError(
                f"no exposure has filter {filter}, names {names}",
                where=self.source,
                do="widen the selection",
            )
        return replace(self, exposures=tuple(chosen))

    def require(self, *quantities: str) -> None:
        """Refuse a log in which an exposure lacks a quantity.

        Parameters
        ----------
        *quantities : str
            'filter', 'exptime', 'vafactor', 'pa_v3', 'ra' or 'dec'.

        Raises
        ------
        InputError
            Naming the first exposure that lacks one.
        """
        for one in self.exposures:
            for key in quantities:
                if getattr(one, key) in (None, ""):
                    do = "add it to the log"
                    if key == "vafactor":
                        do += (
                            ", or compute it from epoch, ra and dec "
                            "(campaign.vafactor_source = 'earth')"
                        )
                    raise InputError(f"exposure {one.name} has no {key}", where=self.source, do=do)

    def values(self, quantity: str) -> Float:
        """A number of each exposure, NaN where it is not known.

        Parameters
        ----------
        quantity : {'epoch', 'exptime', 'vafactor', 'pa_v3', 'ra', 'dec'}

        Returns
        -------
        ndarray, shape (number of exposures,)
        """
        found = (getattr(one, quantity) for one in self.exposures)
        return np.array([np.nan if value is None else value for value in found], float)

    def with_aberration(self) -> ExposureLog:
        """Log with VAFACTOR computed where it is missing.

        Only the motion of the Earth counts; the orbit of HST adds up to 2.5e-5.

        Returns
        -------
        ExposureLog

        Raises
        ------
        InputError
            When an exposure has neither the factor nor a target.
        """
        out = []
        for one in self.exposures:
            if one.vafactor is None:
                if one.ra is None or one.dec is None:
                    raise InputError(
                        f"exposure {one.name} has neither vafactor nor ra and dec to compute it",
                        where=self.source,
                        do="add one of them to the log",
                    )
                factor = velocity_aberration(one.epoch, one.ra, one.dec)
                one = replace(one, vafactor=factor)
            out.append(one)
        return replace(self, exposures=tuple(out))


def read_exposures(path: str | os.PathLike[str]) -> ExposureLog:
    """Read a log of exposures.

    Parameters
    ----------
    path : path-like
        .ecsv, .csv, .fits or .parquet, one row for each exposure, with columns exposure epoch
        filter exptime vafactor pa_v3 ra dec.  The epoch may be a decimal year, an ISO date, or a
        Modified Julian Date with the unit 'd'.  All but exposure and epoch may be missing, in
        single rows, too.

    Returns
    -------
    ExposureLog

    Raises
    ------
    InputError
        For missing columns and values that are wrong, naming the row.
    """
    path = Path(path)
    table = read_table(path)
    needed = ("exposure", "epoch")
    found = find_columns(table.colnames, None, _ALIASES, source=str(path), needed=needed)
    if not len(table):
        raise InputError("holds no exposures", where=str(path), do="name at least one")

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[found[key]], str(path), found[key])

    codes, labels = column("exposure").labels()
    rows: dict[str, list[Any]] = {
        "name": [labels[code] for code in codes],
        "epoch": column("epoch").years().tolist(),
    }
    if "filter" in found:
        rows["filter"] = _filled(column("filter"))
    for key in _NUMBERS:
        if key in found:
            rows[key] = _known_numbers(column(key), _UNITS.get(key))
    exposures = []
    for k in range(len(table)):
        try:
            exposures.append(Exposure(**{key: values[k] for key, values in rows.items()}))
        except InputError as error:
            where = f"{path}, row {k + 1}, {error.where}".rstrip(", ")
            raise InputError(error.cause, where=where, do=error.do) from None
    return ExposureLog(tuple(exposures), source=str(path))


def _filled(column: SourceColumn) -> list[str]:
    """Texts of a column, empty where they are missing."""
    known, named = column.known()
    out = [""] * len(column.values)
    if len(known):
        codes, labels = named.labels()
        for row, code in zip(known, codes, strict=True):
            out[row] = labels[code]
    return out


def _known_numbers(column: SourceColumn, unit: str | None) -> list[float | None]:
    """Numbers of a column, None where they are missing."""
    numbers = column.known_numbers()
    if unit is not None and not np.isnan(numbers).all():
        numbers = numbers * column.factor(unit)
    return [None if np.isnan(value) else value for value in numbers.tolist()]


def write_exposures(log: ExposureLog, path: str | os.PathLike[str]) -> None:
    """Write a log as `read_exposures` reads it.

    Parameters
    ----------
    log : ExposureLog
    path : path-like
        .ecsv, .csv or .fits; replaced atomically.

    Raises
    ------
    InputError
        For another extension, names that are not ASCII in a FITS table, or when the file cannot be
        written.
    """
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(
            f"extension {path.suffix!r} is not one of a log",
            where=str(path),
            do=f"choose one of {', '.join(_FORMATS)}",
        )
    texts = (text for one in log for text in (one.name, one.filter))
    other = next((text for text in texts if ascii_of(text) != text), None)
    if path.suffix.lower() == ".fits" and other is not None:  # lists are found by these names
        raise InputError(
            f"the name {other!r} is not ASCII, which FITS tables hold alone",
            where=str(path),
            do="write .ecsv or .csv",
        )
    table = Table()
    for one in fields(Exposure):
        values = [getattr(exposure, one.name) for exposure in log]
        if one.name in ("name", "filter"):
            table["exposure" if one.name == "name" else one.name] = Column(values, dtype=str)
            continue
        missing = [value is None for value in values]
        if not all(missing):
            numbers = [np.nan if value is None else value for value in values]
            column = MaskedColumn(numbers, mask=missing, unit=_UNITS.get(one.name))
            table[one.name] = column if any(missing) else Column(column)
    with atomic_path(path) as temporary:
        table.write(temporary, format=_FORMATS[path.suffix.lower()])
