"""Conversion of table columns to arrays in known units; errors name the file, row and column.

On reading, u and v are converted to one of `UNITS`; a unit that cannot be converted is an error.
"""

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
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import YEARS, scale_advice
from bayesdist.utils.text import number_of, refuse_control_characters

log = logging.getLogger("bayesdist")
Array = TypeVar("Array", Float, Int)
UNITS = ("pix", "arcsec", "mas", "deg")
# spellings of other programs that astropy does not recognise
_SPELLINGS = {
    "pixels": "pix",
    "pixel": "pix",
    "px": "pix",
    "degrees": "deg",
    "degree": "deg",
    "arcseconds": "arcsec",
    "arcsecs": "arcsec",
    "milliarcsec": "mas",
    "none": "",
}


def encoded(values: NDArray[Any], *, ordered: bool = False) -> tuple[Int, tuple[Any, ...]]:
    """Codes (N,) of values, and the distinct values.

    The distinct values are in the order of their first appearance, or sorted if `ordered`.
    """
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
    """Column with few distinct values; each value is parsed only once."""

    codes: Int  # (N,), indices into `labels`
    labels: NDArray[Any]  # (L,), distinct values in the order of their first appearance
    unit: str | None = None

    @property
    def plain(self) -> NDArray[Any]:
        """Value of each row (N,)."""
        return self.labels[self.codes]


@dataclass(frozen=True, eq=False)
class SourceColumn:
    """Column together with the names that error messages need."""

    values: Any  # (N,): astropy Column, Quantity, Time, `EncodedColumn` or array
    source: str  # name of the file
    name: str  # name of the column
    place: Place = row_number  # name of a row, given its index
    usual_unit: str | None = None  # unit implied by the column name, used if the file states none

    @property
    def where(self) -> str:
        """File and column."""
        return f"{self.source}, column {self.name!r}"

    @property
    def unit(self) -> apu.UnitBase | None:
        """Unit stated in the file, or else the usual unit, or None."""
        stated_unit = unit_of(self.values, where=self.where)
        return apu.Unit(self.usual_unit) if stated_unit is None and self.usual_unit else stated_unit

    def factor(self, unit: str) -> float:
        """Factor from the column's numbers to a unit; 1 if the column has no unit."""
        column_unit = self.unit
        return 1.0 if column_unit is None else conversion(column_unit, unit, where=self.where)

    def fail(self, index: int, cause: str, do: str = "correct the row or drop it") -> InputError:
        """InputError about the value in row `index`, with its `cause` and what to `do` about it."""
        location = f"{self.source}, {self.place(index)}, column {self.name!r}"
        return InputError(cause, where=location, do=do)

    def _plain(self) -> NDArray[Any]:
        """Values as a one-dimensional array; InputError for masked values."""
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
        """Parse the values label by label, and expand them to rows."""
        column = self.values
        try:
            return read(replace(self, values=Column(column.labels, unit=column.unit)))[column.codes]
        except InputError:  # parse row by row, for an error that names the row
            return read(replace(self, values=Column(column.plain, unit=column.unit)))

    def numbers(self) -> Float:
        """Numbers (N,) in the file's unit.

        Raises InputError for text, missing values, NaN or infinity.
        """
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
            raise self.fail(bad, f"value is {out[bad]:g}, but must be finite")
        return out

    def numbers_or(self, value: float) -> Float:
        """Numbers (N,), with `value` where missing or not finite; raises InputError for text."""
        if isinstance(self.values, EncodedColumn):
            return replace(self, values=self.values.plain).numbers_or(value)
        mask = absent(self.values, not_finite=True)
        plain = getattr(self.values, "unmasked", self.values)
        filled = np.array(getattr(plain, "value", plain))
        if mask.any():
            filled[mask] = value
        return replace(self, values=filled).numbers()

    def numbers_if_readable(self, what: str) -> Float | None:
        """Numbers (N,); if they cannot be read, None and a warning that no star has `what`."""
        try:
            return self.numbers()
        except InputError as error:
            log.warning("%s: %s, so that no star has %s", error.where, error.cause, what)
            return None

    def magnitudes_of_fluxes(self) -> Float | None:
        """Magnitudes (N,); None and a warning unless all fluxes are positive numbers."""
        flux = self.numbers_if_readable("a magnitude")
        if flux is None:
            return None
        if (flux > 0).all():
            return np.asarray(-2.5 * np.log10(flux))
        log.warning("%s: not all fluxes are positive, so that no star has a magnitude", self.where)
        return None

    def known(self) -> tuple[Int, SourceColumn]:
        """Indices (n,) of rows with a value (not masked or NaN), and the column of these rows."""
        plain = getattr(self.values, "unmasked", self.values)
        missing = np.array(np.broadcast_to(getattr(self.values, "mask", False), len(plain)))
        if plain.dtype.kind == "f":
            missing |= np.isnan(np.asarray(getattr(plain, "value", plain)))
        rows = np.flatnonzero(~missing)
        named = replace(self, values=plain[rows], place=lambda k: self.place(int(rows[k])))
        return rows, named

    def known_numbers(self) -> Float:
        """Numbers (N,), with NaN where missing; raises InputError for text and infinity."""
        rows, named = self.known()
        out = np.full(len(self.values), np.nan)
        if len(rows):  # a column that holds only nulls has no type
            out[rows] = named.numbers()
        return out

    def _parsed(
        self, texts: NDArray[Any], parse: Callable[[str], Any], wanted: str
    ) -> NDArray[Any]:
        """Parsed strings; InputError for the first one that cannot be parsed."""
        out = []
        for index, text in enumerate(texts):
            try:
                out.append(parse(_text(text)))
            except (ValueError, TypeError):
                raise self.fail(index, f"{_text(text)[:40]!r} is not {wanted}") from None
        return np.array(out)

    def integers(self) -> Int:
        """Integers (N,); raises InputError for any other value."""
        if isinstance(self.values, EncodedColumn):
            return self._by_label(SourceColumn.integers)
        if np.asarray(getattr(self.values, "unmasked", self.values)).dtype.kind == "i":
            # not converted through float64, because identifiers may have 19 digits
            return self._plain().astype(np.int64)
        values = self.numbers()
        is_integer = values == np.rint(values)
        if not is_integer.all():
            bad = int(np.argmin(is_integer))
            raise self.fail(bad, f"value is {values[bad]:g}, but must be a whole number")
        return values.astype(np.int64)

    def labels(self) -> tuple[Int, tuple[str, ...]]:
        """Codes (N,), and their labels in the order of first appearance."""
        if isinstance(self.values, EncodedColumn):
            label_codes, unique = replace(self, values=self.values.labels).labels()
            return label_codes[self.values.codes], unique
        values = self._plain()
        if values.dtype.kind == "O":  # parse each distinct object only once
            code_of_value: dict[tuple[type, Any], int] = {}  # types distinguish 1 from True
            try:
                numbers = [
                    code_of_value.setdefault((type(v), v), len(code_of_value)) for v in values
                ]
            except TypeError:  # Parquet has lists and structures
                index = [isinstance(v, Hashable) for v in values].index(False)
                raise self.fail(index, "there are several values instead of one name") from None
            codes = np.array(numbers, np.int64)
            distinct: Iterable[Any] = [v for _, v in code_of_value]
        else:
            codes, distinct = encoded(values)
        names = [_text(v) for v in distinct]
        refuse_control_characters(names, self.where)
        merged, unique = encoded(np.array(names))  # 'a' and 'a ' are the same label
        return merged[codes], unique

    def years(self) -> Float:
        """Epochs (N,) as decimal years.

        Numbers are years, or Modified Julian Dates if the unit of the column is the day.  Strings
        are such numbers or ISO dates.  Raises InputError for other values, and for years outside
        1800 to 2200.
        """
        if isinstance(self.values, EncodedColumn):
            return self._by_label(SourceColumn.years)
        if isinstance(self.values, Time):
            self._refuse_masked_times()
            out = np.asarray(self.values.decimalyear, float)
        else:
            values = self._plain()
            if values.dtype.kind == "M":
                # a time scale without leap seconds keeps dates as written; convert each distinct
                # date once
                distinct, codes = np.unique(values.astype("datetime64[ns]"), return_inverse=True)
                out = np.asarray(Time(distinct, scale="tt").decimalyear, float)[codes]
            elif values.dtype.kind in "SUO" and not _all_numbers(values):
                out = self._dates(values)
            else:
                out = self._numeric_years()
        good = (out >= YEARS[0]) & (out <= YEARS[1])
        if not good.all():
            bad = int(np.argmin(good))
            raise self.fail(
                bad,
                f"epoch is {out[bad]:g}, which is not a year",
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
                raise self.fail(bad, f"{values[bad]:g} is not a Modified Julian Date")
            distinct, codes = np.unique(values, return_inverse=True)
            return np.asarray(Time(distinct, format="mjd", scale="tt").decimalyear, float)[codes]
        raise InputError(
            f"unit {unit} is not a unit of dates", where=self.where, do="give 'yr', or 'd' for MJD"
        )

    def _dates(self, texts: NDArray[Any]) -> Float:
        # convert each distinct date once
        codes, distinct = encoded(np.array([_text(t) for t in texts]))
        years = []
        for k, text in enumerate(distinct):
            try:
                years.append(self._year(text))
            except (ValueError, TypeError, InputError):
                index = int(np.argmax(codes == k))
                raise self.fail(
                    index, f"{text[:40]!r} is not a date", "write ISO dates or decimal years"
                ) from None
        return np.array(years)[codes]

    def _year(self, text: str) -> float:
        """Decimal year of a date, or of a number in a column of dates."""
        if _all_numbers([text]):
            number = Column([number_of(text)], unit=getattr(self.values, "unit", None))
            return float(replace(self, values=number)._numeric_years()[0])
        return float(Time(text, scale="tt").decimalyear)


def _text(value: Any) -> str:
    """Label as a string without decimals or blanks."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value).strip()


def _all_numbers(texts: Iterable[Any]) -> bool:
    try:
        for text in texts:  # Parquet has lists, structures and objects of several types
            number_of(_text(text))
    except (ValueError, TypeError):
        return False
    return True


class TableColumns(Protocol):
    """Named columns of equal length, as in an astropy Table."""

    @property
    def colnames(self) -> Sequence[str]:
        """Names of the columns."""

    def __len__(self) -> int:
        """Number of rows."""

    def __getitem__(self, name: str) -> Any:
        """Values in a form that `SourceColumn` accepts."""


@dataclass(frozen=True, eq=False)
class Quantities:
    """Columns of a table, accessible by quantity."""

    table: TableColumns
    found: Mapping[str, str]  # column of each quantity
    source: str  # file, for error messages
    place: Place = row_number  # name of a row, given its index
    names: Sequence[str] = ()  # all columns of the file, from which its catalogue is recognised

    def __contains__(self, key: str) -> bool:
        return key in self.found

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, key: str) -> SourceColumn:
        name = self.found[key]
        unit = known_unit(name, self.names or self.table.colnames)
        return SourceColumn(self.table[name], self.source, name, self.place, unit)


def check_unit(unit: str, *, where: str = "unit") -> str:
    """The unit itself if it is one of `UNITS`; otherwise raise InputError."""
    if unit not in UNITS:
        do = length_advice(unit) or f"choose one of {', '.join(UNITS)}"
        raise InputError(f"unit is {unit!r}", where=where, do=do)
    return unit


def length_advice(unit: str) -> str:
    """Advice on positions in a length unit, such as millimetres; empty for other units."""
    import astropy.units as apu  # takes a tenth of a second to import

    parsed = apu.Unit(unit.strip(), parse_strict="silent")
    if parsed.physical_type != "length":
        return ""
    return (
        "give plate_scale, the arcsec in a millimetre of u and v (data.plate_scale); or "
        f"divide u, v and their errors by the size of a pixel in {unit} and call them 'pix'"
    )


def length_in_mm(unit: apu.UnitBase | str | None) -> float | None:
    """Millimetres per unit of length; None for other units, and for None."""
    import astropy.units as apu

    if unit is None:
        return None
    parsed = apu.Unit(unit, parse_strict="silent")
    return float(parsed.to(apu.mm)) if parsed.physical_type == "length" else None


def unit_of(column: Any, *, where: str) -> apu.UnitBase | None:
    """Unit of a table column; None if it has none. Raises InputError for an unknown unit."""
    unit = getattr(column, "unit", None)
    if unit is None:
        return None
    text = _SPELLINGS.get(str(unit).strip().lower(), str(unit).strip())
    if not text:
        return None
    import astropy.units as apu

    parsed = apu.Unit(text, parse_strict="silent")
    if isinstance(parsed, apu.UnrecognizedUnit):
        raise InputError(
            f"unit {text!r} is unknown", where=where, do=f"write one of {', '.join(UNITS)}"
        )
    return None if parsed == apu.dimensionless_unscaled else parsed


def conversion(unit: apu.UnitBase | str, to: str, *, where: str) -> float:
    """Factor that converts values in `unit` to values in `to`.

    Raises InputError if the units are incompatible.
    """
    import astropy.units as apu

    try:
        return float(apu.Unit(unit).to(apu.Unit(to)))
    except apu.UnitConversionError:
        raise InputError(
            f"unit {unit} cannot be converted to {to}",
            where=where,
            do=scale_advice(str(unit), to, "the values")
            or length_advice(str(unit))
            or "correct the unit",
        ) from None


def without_unit(column: Any) -> Any:
    """Numbers of a column without its unit; the mask is kept."""
    if hasattr(column, "to_value"):  # a Quantity, plain or masked
        return column.value
    if isinstance(column, np.ma.MaskedArray):
        return np.ma.MaskedArray(column.data, mask=column.mask)
    return np.asarray(column)
