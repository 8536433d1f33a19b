"""Exposure logs: epoch, filter, velocity aberration, roll and target of each exposure."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column, MaskedColumn, Table

from bayesdist.data.sky import velocity_aberration
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of, refuse_control_characters

log = logging.getLogger("bayesdist")

_NUMBERS = ("exptime", "vafactor", "pa_v3", "ra", "dec")
_SLOWEST = 2e-4  # for anything in orbit around the Earth, |factor - 1| is below 1.4e-4
_UNITS = {"epoch": "yr", "exptime": "s", "pa_v3": "deg", "ra": "deg", "dec": "deg"}
# plausible ranges, which exclude angles in other units and unrelated numbers
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
    """One exposure of an exposure log.

    Parameters
    ----------
    name : str
        Name of the exposure.
    epoch : float
        Decimal year of mid-exposure.
    filter : str
        Filter; empty if unknown.
    exptime : float, optional
        Exposure time, seconds.
    vafactor : float, optional
        Scale factor of velocity aberration; larger than 1 if the telescope moves towards the field.
    pa_v3 : float, optional
        Position angle of the V3 axis, degrees.
    ra, dec : float, optional
        Position of the target, degrees.

    Raises
    ------
    InputError
        If the name is empty, if a number is not finite or outside its plausible range, or if
        the factor is too far from 1 for any orbit around the Earth.
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
                    f"{key} is {value}, but must be finite",
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
                    f"{key} is {value:g}, but must be between {low:g} and {high:g}",
                    where=f"exposure {self.name}",
                    do=f"give it in {_UNITS[key]}, or leave it out",
                )
        if self.vafactor is not None and abs(self.vafactor - 1.0) > _SLOWEST:
            raise InputError(
                f"vafactor is {self.vafactor}, but must be within {_SLOWEST:g} of 1 for any orbit",
                where=f"exposure {self.name}",
                do="give the factor of velocity aberration of the science header",
            )


@dataclass(frozen=True, eq=False)
class ExposureLog:
    """Exposures, accessible by name.

    Parameters
    ----------
    exposures : tuple of Exposure
        Exposures in the order of the log.
    source : str
        Name of the file.

    Raises
    ------
    InputError
        If there are no exposures, or if a name is repeated.
    """

    exposures: tuple[Exposure, ...]
    source: str = "exposure log"

    def __post_init__(self) -> None:
        object.__setattr__(self, "exposures", tuple(self.exposures))
        if not self.exposures:
            raise InputError("holds no exposures", where=self.source, do="name at least one")
        names = [exposure.name for exposure in self.exposures]
        if len(self._by_name) < len(names):
            repeated = next(name for k, name in enumerate(names) if name in names[:k])
            raise InputError(
                f"exposure {repeated} occurs twice", where=self.source, do="name each only once"
            )

    @cached_property
    def _by_name(self) -> dict[str, Exposure]:
        return {exposure.name: exposure for exposure in self.exposures}

    def __len__(self) -> int:
        return len(self.exposures)

    def __iter__(self) -> Iterator[Exposure]:
        return iter(self.exposures)

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __getitem__(self, name: str) -> Exposure:
        """Exposure with this name; InputError if there is none."""
        try:
            return self._by_name[name]
        except KeyError:
            raise InputError(
                f"has no exposure {name!r}", where=self.source, do="add it to the log"
            ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the exposures, in the order of the log."""
        return tuple(exposure.name for exposure in self.exposures)

    @property
    def filters(self) -> tuple[str, ...]:
        """Filters, in the order of their first appearance."""
        return tuple(dict.fromkeys(exposure.filter for exposure in self.exposures))

    def select(
        self,
        *,
        filter: str | Collection[str] | None = None,
        names: Collection[str] | None = None,
    ) -> ExposureLog:
        """Select exposures by filter and name.

        Parameters
        ----------
        filter : str or collection of str, optional
            Filters to keep; all by default.
        names : collection of str, optional
            Exposures to keep; all by default.

        Returns
        -------
        ExposureLog
            The selected exposures.

        Raises
        ------
        InputError
            If no exposure is selected.
        """
        filters = (filter,) if isinstance(filter, str) else filter
        chosen = [
            exposure
            for exposure in self.exposures
            if (filters is None or exposure.filter in filters)
            and (names is None or exposure.name in names)
        ]
        if not chosen:
            raise InputError(
                f"no exposure has filter {filter}, names {names}",
                where=self.source,
                do="widen the selection",
            )
        return replace(self, exposures=tuple(chosen))

    def require(self, *quantities: str) -> None:
        """Raise InputError if any exposure lacks a quantity.

        Parameters
        ----------
        *quantities : str
            'filter', 'exptime', 'vafactor', 'pa_v3', 'ra' or 'dec'.

        Raises
        ------
        InputError
            If an exposure lacks one of them; the message names the first such exposure.
        """
        for exposure in self.exposures:
            for key in quantities:
                if getattr(exposure, key) in (None, ""):
                    do = "add it to the log"
                    if key == "vafactor":
                        do += (
                            ", or compute it from epoch, ra and dec "
                            "(campaign.vafactor_source = 'earth')"
                        )
                    raise InputError(
                        f"exposure {exposure.name} has no {key}", where=self.source, do=do
                    )

    def values(self, quantity: str) -> Float:
        """Values of a quantity for all exposures, NaN if unknown.

        Parameters
        ----------
        quantity : {'epoch', 'exptime', 'vafactor', 'pa_v3', 'ra', 'dec'}
            Name of the quantity.

        Returns
        -------
        ndarray, shape (number of exposures,)
            Values in the order of the log.
        """
        stated = (getattr(exposure, quantity) for exposure in self.exposures)
        return np.array([np.nan if value is None else value for value in stated], float)

    def with_aberration(self) -> ExposureLog:
        """Log with factors of velocity aberration computed where they are missing.

        Only the orbital motion of the Earth is included; the orbit of HST adds up to 2.5e-5.

        Returns
        -------
        ExposureLog
            Log in which every exposure has a factor.

        Raises
        ------
        InputError
            If an exposure has neither a factor nor a target.
        """
        out = []
        for exposure in self.exposures:
            if exposure.vafactor is None:
                if exposure.ra is None or exposure.dec is None:
                    raise InputError(
                        f"exposure {exposure.name} has neither vafactor nor ra and dec to "
                        "compute it",
                        where=self.source,
                        do="add one of them to the log",
                    )
                factor = velocity_aberration(exposure.epoch, exposure.ra, exposure.dec)
                exposure = replace(exposure, vafactor=factor)
            out.append(exposure)
        return replace(self, exposures=tuple(out))


def read_exposures(path: str | os.PathLike[str]) -> ExposureLog:
    """Read an exposure log.

    Parameters
    ----------
    path : path-like
        .ecsv, .csv, .fits or .parquet table with one row per exposure and the columns exposure
        epoch filter exptime vafactor pa_v3 ra dec. The epoch may be a decimal year, an ISO date, or
        a Modified Julian Date with the unit 'd'. Columns other than exposure and epoch are optional
        and may have missing values; NaN counts as one, with a warning unless the table is FITS,
        which has no other way to write it.

    Returns
    -------
    ExposureLog
        Exposures in the order of the rows.

    Raises
    ------
    InputError
        If columns are missing or values are invalid; the message names the row.
    """
    path = Path(path)
    table = read_table(path)
    needed = ("exposure", "epoch")
    column_names = find_columns(table.colnames, None, _ALIASES, source=str(path), needed=needed)
    if not len(table):
        raise InputError("holds no exposures", where=str(path), do="name at least one")

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[column_names[key]], str(path), column_names[key])

    codes, labels = column("exposure").labels()
    rows: dict[str, list[Any]] = {
        "name": [labels[code] for code in codes],
        "epoch": column("epoch").years().tolist(),
    }
    is_fits = any(suffix.lower().startswith(".fit") for suffix in path.suffixes)
    if "filter" in column_names:
        rows["filter"] = _filled(column("filter"))
    for key in _NUMBERS:
        if key in column_names:
            rows[key] = _known_numbers(column(key), _UNITS.get(key))
            if not is_fits:
                _warn_of_nan(column(key))
    exposures = []
    for k in range(len(table)):
        try:
            exposures.append(Exposure(**{key: values[k] for key, values in rows.items()}))
        except InputError as error:
            location = f"{path}, row {k + 1}, {error.where}".rstrip(", ")
            raise InputError(error.cause, where=location, do=error.do) from None
    return ExposureLog(tuple(exposures), source=str(path))


def _filled(column: SourceColumn) -> list[str]:
    """Strings of a column; empty if missing."""
    rows, named = column.known()
    out = [""] * len(column.values)
    if len(rows):
        codes, labels = named.labels()
        for row, code in zip(rows, codes, strict=True):
            out[row] = labels[code]
    return out


def _known_numbers(column: SourceColumn, unit: str | None) -> list[float | None]:
    """Numbers of a column; None if missing."""
    numbers = column.known_numbers()
    if unit is not None and not np.isnan(numbers).all():
        numbers = numbers * column.factor(unit)
    return [None if np.isnan(value) else value for value in numbers.tolist()]


def _warn_of_nan(column: SourceColumn) -> None:
    """Warn of NaN, which counts as a missing value but may be a mistake of the program before."""
    plain = getattr(column.values, "unmasked", column.values)
    if plain.dtype.kind != "f":
        return
    masked = np.broadcast_to(getattr(column.values, "mask", False), len(plain))
    n_nan = int((np.isnan(np.asarray(getattr(plain, "value", plain))) & ~masked).sum())
    if n_nan:
        log.warning(
            "%s: NaN in %d of %d rows counts as a missing value", column.where, n_nan, len(plain)
        )


def write_exposures(log: ExposureLog, path: str | os.PathLike[str]) -> None:
    """Write an exposure log that `read_exposures` can read.

    Parameters
    ----------
    log : ExposureLog
        Log to write.
    path : path-like
        .ecsv, .csv or .fits file, which is replaced atomically.

    Raises
    ------
    InputError
        If the extension is not supported, if a FITS table would have names that are not ASCII, or
        if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(
            f"extension {path.suffix!r} is not known for exposure logs",
            where=str(path),
            do=f"choose one of {', '.join(_FORMATS)}",
        )
    texts = (text for exposure in log for text in (exposure.name, exposure.filter))
    not_ascii = next((text for text in texts if ascii_of(text) != text), None)
    # star lists are found by these names
    if path.suffix.lower() == ".fits" and not_ascii is not None:
        raise InputError(
            f"the name {not_ascii!r} is not ASCII, as FITS tables require",
            where=str(path),
            do="write .ecsv or .csv",
        )
    table = Table()
    for field in fields(Exposure):
        values = [getattr(exposure, field.name) for exposure in log]
        if field.name in ("name", "filter"):
            table["exposure" if field.name == "name" else field.name] = Column(values, dtype=str)
            continue
        missing = [value is None for value in values]
        if not all(missing):
            numbers = [np.nan if value is None else value for value in values]
            column = MaskedColumn(numbers, mask=missing, unit=_UNITS.get(field.name))
            table[field.name] = column if any(missing) else Column(column)
    with atomic_path(path) as temporary:
        table.write(temporary, format=_FORMATS[path.suffix.lower()])
