"""Columns of a table, by quantity, to one array each, or an error of file, row and column."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import astropy.units as apu
import numpy as np
from astropy.table import Column
from astropy.time import Time
from numpy.typing import NDArray

from bayesdist.data.tables.checks import Place, absent, row_number
from bayesdist.data.tables.names import known_unit
from bayesdist.data.tables.units import conversion, unit_of
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import YEARS
from bayesdist.utils.text import number_of, refuse_control_characters

log = logging.getLogger("bayesdist")

Array = TypeVar("Array", Float, Int)


def encoded(values: NDArray[Any], *, ordered: bool = False) -> tuple[Int, tuple[Any, ...]]:
    """Codes (N,) of values, and the values themselves: sorted, or in the order of appearance."""
    unique, first, codes = np.unique(values, return_index=True, return_inverse=True)
    codes = codes.astype(np.int64)
    if not ordered:
        by_appearance = np.argsort(first)
        position = np.empty_like(by_appearance)
        position[by_appearance] = np.arange(len(by_appearance))
        unique, codes = unique[by_appearance], position[codes]
    return codes.astype(np.int64), tuple(unique.tolist())


@dataclass(frozen=True, eq=False)
class EncodedColumn:
    """Column of few different values, each of which is read only once."""

    codes: Int  # (N,), into `labels`
    labels: NDArray[Any]  # (L,), in the order of their first appearance
    unit: str | None = None

    @property
    def plain(self) -> NDArray[Any]:
        """Value of each row (N,)."""
        return self.labels[self.codes]


@dataclass(frozen=True, eq=False)
class SourceColumn:
    """Column with the names that an error needs."""

    values: Any  # (N,): astropy Column, Quantity, Time, `EncodedColumn` or array
    source: str  # file
    name: str  # column
    place: Place = row_number  # name of a row, by its index
    usual_unit: str | None = None  # of columns of this name, where the file gives none

    @property
    def where(self) -> str:
        """File and column."""
        return f"{self.source}, column {self.name!r}"

    @property
    def unit(self) -> apu.UnitBase | None:
        """Unit that the file gives, else the usual one, or None."""
        own = unit_of(self.values, where=self.where)
        return apu.Unit(self.usual_unit) if own is None and self.usual_unit else own

    def factor(self, unit: str) -> float:
        """Factor from the column's numbers to a unit; 1 where the column has none of its own."""
        own = self.unit
        return 1.0 if own is None else conversion(own, unit, where=self.where)

    def fail(self, index: int, cause: str, do: str = "correct the row or drop it") -> InputError:
        """Error about one value."""
        where = f"{self.source}, {self.place(index)}, column {self.name!r}"
        return InputError(cause, where=where, do=do)

    def _plain(self) -> NDArray[Any]:
        """Values as a one-dimensional array without masked ones."""
        mask = np.broadcast_to(getattr(self.values, "mask", False), np.shape(self.values))
        if np.ndim(self.values) != 1:
            raise InputError(
                f"holds arrays of shape {np.shape(self.values)[1:]}",
                where=self.where,
                do="name a column with one value in each row",
            )
        if mask.any():
            raise self.fail(
                int(np.argmax(mask)),
                "value is missing",
                "fill it in, or drop the row or the column",
            )
        plain = getattr(self.values, "unmasked", self.values)
        return np.asarray(getattr(plain, "value", plain))

    def _by_label(self, read: Callable[[SourceColumn], Array]) -> Array:
        """Values that are parsed label by label, for each row."""
        column = self.values
        try:
            return read(replace(self, values=Column(column.labels, unit=column.unit)))[column.codes]
        except InputError:  # again row by row, for an error that names the row
            return read(replace(self, values=Column(column.plain, unit=column.unit)))

    def numbers(self) -> Float:
        """Numbers (N,) in the file's unit; text, a missing value, NaN or infinity is refused."""
        if isinstance(self.values, EncodedColumn):
            return self._by_label(SourceColumn.numbers)
        values = self._plain()
        if values.dtype.kind in "iuf":
            out = values.astype(np.float64)
        elif values.dtype.kind in "SUO":
            out = self._parsed(values, number_of, "a number").astype(np.float64)
        else:
            raise InputError(
                f"holds values of type {values.dtype}, not numbers",
                where=self.where,
                do="name a column of numbers",
            )
        good = np.isfinite(out)
        if not good.all():
            bad = int(np.argmin(good))
            raise self.fail(bad, f"value is {out[bad]:g}, and must be finite")
        return out

    def numbers_or(self, value: float) -> Float:
        """Numbers (N,), with `value` where missing or not finite; text is refused."""
        if isinstance(self.values, EncodedColumn):
            return replace(self, values=self.values.plain).numbers_or(value)
        mask = absent(self.values, not_finite=True)
        plain = getattr(self.values, "unmasked", self.values)
        filled = np.array(getattr(plain, "value", plain))
        if mask.any():
            filled[mask] = value
        return replace(self, values=filled).numbers()

    def numbers_if_readable(self, what: str) -> Float | None:
        """Numbers (N,); None and a warning that no star has `what`, where they cannot be read."""
        try:
            return self.numbers()
        except InputError as error:
            log.warning("%s: %s, so that no star has %s", error.where, error.cause, what)
            return None

    def magnitudes_of_fluxes(self) -> Float | None:
        """Magnitudes (N,), or None and a warning where not all fluxes are positive numbers."""
        flux = self.numbers_if_readable("a magnitude")
        if flux is None:
            return None
        if (flux > 0).all():
            return np.asarray(-2.5 * np.log10(flux))
        log.warning("%s: not all fluxes are positive, so that no star has a magnitude", self.where)
        return None

    def known(self) -> tuple[Int, SourceColumn]:
        """Rows (n,) that have a value, neither masked nor NaN, and the column of these alone."""
        plain = getattr(self.values, "unmasked", self.values)
        missing = np.array(np.broadcast_to(getattr(self.values, "mask", False), len(plain)))
        if plain.dtype.kind == "f":
            missing |= np.isnan(np.asarray(getattr(plain, "value", plain)))
        rows = np.flatnonzero(~missing)
        named = replace(self, values=plain[rows], place=lambda k: self.place(int(rows[k])))
        return rows, named

    def known_numbers(self) -> Float:
        """Numbers (N,), with NaN where they are missing; text and infinity are refused."""
        rows, named = self.known()
        out = np.full(len(self.values), np.nan)
        if len(rows):  # a column of nulls alone has no type
            out[rows] = named.numbers()
        return out

    def _parsed(
        self, texts: NDArray[Any], parse: Callable[[str], Any], wanted: str
    ) -> NDArray[Any]:
        """Parsed texts; the first one that cannot be parsed is refused."""
        out = []
        for index, text in enumerate(texts):
            try:
                out.append(parse(_text(text)))
            except (ValueError, TypeError):
                raise self.fail(
                    index, f"{_text(text)[:40]!r} stands where {wanted} must be"
                ) from None
        return np.array(out)

    def integers(self) -> Int:
        """Whole numbers (N,); anything else is refused."""
        if isinstance(self.values, EncodedColumn):
            return self._by_label(SourceColumn.integers)
        if np.asarray(getattr(self.values, "unmasked", self.values)).dtype.kind == "i":
            return self._plain().astype(np.int64)  # not by way of float64: names may have 19 digits
        values = self.numbers()
        whole = values == np.rint(values)
        if not whole.all():
            bad = int(np.argmin(whole))
            raise self.fail(bad, f"value is {values[bad]:g}, and must be a whole number")
        return values.astype(np.int64)

    def labels(self) -> tuple[Int, tuple[str, ...]]:
        """Codes (N,), and their names in the order of their first appearance."""
        if isinstance(self.values, EncodedColumn):
            own, unique = replace(self, values=self.values.labels).labels()
            return own[self.values.codes], unique
        values = self._plain()
        if values.dtype.kind == "O":  # each object once: most are the same few
            known: dict[tuple[type, Any], int] = {}  # by their types, too: 1 is not True
            try:
                numbers = [known.setdefault((type(v), v), len(known)) for v in values]
            except TypeError:  # Parquet has lists and structures
                index = [isinstance(v, Hashable) for v in values].index(False)
                raise self.fail(index, "several values stand where a name must be") from None
            codes = np.array(numbers, np.int64)
            found: Iterable[Any] = [v for _, v in known]
        else:
            codes, found = encoded(values)
        names = [_text(v) for v in found]
        refuse_control_characters(names, self.where)
        again, unique = encoded(np.array(names))  # 'a' and 'a ' are one name
        return again[codes], unique

    def years(self) -> Float:
        """Epochs (N,) as decimal years; no date, or one outside 1800 to 2200, is refused.

        Numbers are years, or Modified Julian Dates where the column's unit is the day; texts are
        such numbers or ISO dates.
        """
        if isinstance(self.values, EncodedColumn):
            return self._by_label(SourceColumn.years)
        if isinstance(self.values, Time):
            self._refuse_masked_times()
            out = np.asarray(self.values.decimalyear, float)
        else:
            values = self._plain()
            if values.dtype.kind == "M":
                # a time scale without leap seconds: dates stay as written; few dates, many stars
                found, codes = np.unique(values.astype("datetime64[ns]"), return_inverse=True)
                out = np.asarray(Time(found, scale="tt").decimalyear, float)[codes]
            elif values.dtype.kind in "SUO" and not _all_numbers(values):
                out = self._dates(values)
            else:
                out = self._numeric_years()
        good = (out >= YEARS[0]) & (out <= YEARS[1])
        if not good.all():
            bad = int(np.argmin(good))
            raise self.fail(
                bad,
                f"epoch is {out[bad]:g}, which is no year",
                "give decimal years, ISO dates, or MJD with the unit 'd'",
            )
        return np.asarray(out, np.float64)

    def _refuse_masked_times(self) -> None:
        mask = np.broadcast_to(self.values.mask, self.values.shape)
        if mask.any():
            raise self.fail(int(np.argmax(mask)), "value is missing", "fill it in, or drop the row")

    def _numeric_years(self) -> Float:
        unit = self.unit
        values = self.numbers()
        if unit is None or unit == apu.yr:
            return values
        if unit == apu.d:
            inside = np.abs(values) < 1e7
            if not inside.all():
                bad = int(np.argmin(inside))
                raise self.fail(bad, f"{values[bad]:g} is no Modified Julian Date")
            found, codes = np.unique(values, return_inverse=True)
            return np.asarray(Time(found, format="mjd", scale="tt").decimalyear, float)[codes]
        raise InputError(
            f"unit {unit} is not one of dates", where=self.where, do="give 'yr', or 'd' for MJD"
        )

    def _dates(self, texts: NDArray[Any]) -> Float:
        codes, found = encoded(np.array([_text(t) for t in texts]))  # few dates, many stars
        years = []
        for k, text in enumerate(found):
            try:
                years.append(self._year(text))
            except (ValueError, TypeError, InputError):
                index = int(np.argmax(codes == k))
                raise self.fail(
                    index, f"{text[:40]!r} is no date", "write ISO dates or decimal years"
                ) from None
        return np.array(years)[codes]

    def _year(self, text: str) -> float:
        """Decimal year of a date, or of a number that stands among dates."""
        if _all_numbers([text]):
            number = Column([number_of(text)], unit=getattr(self.values, "unit", None))
            return float(replace(self, values=number)._numeric_years()[0])
        return float(Time(text, scale="tt").decimalyear)


def _text(value: Any) -> str:
    """A label as people write it."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value).strip()


def _all_numbers(texts: Iterable[Any]) -> bool:
    try:
        for text in texts:
            number_of(text)
    except (ValueError, TypeError):
        return False
    return True


class Columns(Protocol):
    """Named columns of one length, as an astropy Table has them."""

    @property
    def colnames(self) -> Sequence[str]:
        """Names."""

    def __len__(self) -> int:
        """Rows."""

    def __getitem__(self, name: str) -> Any:
        """Values as `SourceColumn` takes them."""


@dataclass(frozen=True, eq=False)
class Quantities:
    """Columns of a table by quantity."""

    table: Columns
    found: Mapping[str, str]  # column of each quantity
    source: str  # file, for errors
    place: Place = row_number  # name of a row, by its index
    names: Sequence[str] = ()  # all columns of the file: they tell which catalogue it is

    def __contains__(self, key: str) -> bool:
        return key in self.found

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, key: str) -> SourceColumn:
        name = self.found[key]
        unit = known_unit(name, self.names or self.table.colnames)
        return SourceColumn(self.table[name], self.source, name, self.place, unit)
