"""MatchTable: detector pixels with reference positions, one row for each matched star."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.added_errors import AddedErrors
from bayesdist.data.labels import merged_codes, merged_counts, merged_optional
from bayesdist.data.magnitude_errors import MagnitudeErrors, no_magnitudes
from bayesdist.data.pieces import PIECE, Piece, TablePiece, even_edges, every_kth
from bayesdist.data.tables.checks import absent, check_values, counted, one_length, refuse_half
from bayesdist.data.tables.repeated import first_duplicate
from bayesdist.data.tables.units import check_unit, conversion, unit_of, without_unit
from bayesdist.errors import InputError

__all__ = ["MatchTable"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_POSITIONS = ("x", "y", "u", "v")
_SIGMAS = ("sigma_u", "sigma_v")
_NOMINAL = ("u_nominal", "v_nominal")
_MOTIONS = ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v")
_OPTIONAL = ("epoch", "mag", "colour", *_NOMINAL, *_MOTIONS)
_CODES = {"exposure": "exposure_names", "chip": "chip_numbers", "filter": "filter_names"}
_INTEGERS = ("row", "source", "star", *_CODES)


@dataclass(frozen=True, eq=False)
class MatchTable:
    """Matched stars.

    All arrays have length N and are float64, codes and rows int64; anything that converts to them
    is taken.  Quantities are converted to `unit` (x and y to pixels), and rows with a masked value
    are left out and counted in `rejected`.  Only x, y, u, v are needed.

    Parameters
    ----------
    x, y : ndarray
        Raw detector position, FITS 1-based pixels (centre of the first pixel = 1.0).
    u, v : ndarray
        Reference position, in `unit`.
    sigma_u, sigma_v : ndarray, optional
        Standard errors of the match in `unit`: both or neither.  None where they are to be
        estimated.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    epoch : ndarray, optional
        Decimal years.
    mag : ndarray, optional
        Magnitudes; any zero point.
    colour : ndarray, optional
        Colour indices, in magnitudes; any zero point.
    exposure, chip, filter : ndarray of int, optional
        Codes into `exposure_names`, `chip_numbers` and `filter_names`.
    exposure_names, filter_names : tuple of str
    chip_numbers : tuple of int
    star : ndarray of int, optional
        Code of the reference star of each match, 0 or more: one star may be matched in many
        exposures.  None where it is not known.
    row : ndarray of int, optional
        0-based row in the file that the star comes from.
    source : ndarray of int, optional
        Code of that file into `sources`.
    sources : tuple of str
        Names of the files.
    n_rows : int, optional
        Rows read, rejected ones included.
    rejected : dict of str to int
        Rows left out, by reason.
    tangent_point : tuple of float, optional
        RA and Dec in degrees of the plane that u, v lie on, where they were made from sky
        positions.
    u_nominal, v_nominal : ndarray, optional
        Position by an earlier solution, in `unit`: both or neither.  The match was looked
        for within a circle about it.
    pm_u, pm_v, sigma_pm_u, sigma_pm_v : ndarray, optional
        Proper motion of the reference star in `unit` per year, and its standard errors, where the
        catalogue gives them: both axes or neither.  u and v include it already where `notes` state
        that they were moved.
    chip_names : tuple of str
        Names of the chips of `chip_numbers`, where the file has names in place of numbers.
    notes : tuple of str
        Treatment in reading, as clauses.

    Raises
    ------
    InputError
        For no rows, unequal lengths, values that are not finite, errors that are not positive, an
        unknown unit, or the same star twice.
    """

    x: Float
    y: Float
    u: Float
    v: Float
    sigma_u: Float | None = None
    sigma_v: Float | None = None
    unit: str = "pix"
    epoch: Float | None = None
    mag: Float | None = None
    colour: Float | None = None
    exposure: Int = None  # type: ignore[assignment]
    exposure_names: tuple[str, ...] = ("1",)
    chip: Int = None  # type: ignore[assignment]
    chip_numbers: tuple[int, ...] = (1,)
    filter: Int = None  # type: ignore[assignment]
    filter_names: tuple[str, ...] = ("",)
    star: Int | None = None
    row: Int = None  # type: ignore[assignment]
    source: Int = None  # type: ignore[assignment]
    sources: tuple[str, ...] = ("table",)
    n_rows: int = None  # type: ignore[assignment]
    rejected: Mapping[str, int] = field(default_factory=dict)
    tangent_point: tuple[float, float] | None = None
    u_nominal: Float | None = None
    v_nominal: Float | None = None
    pm_u: Float | None = None
    pm_v: Float | None = None
    sigma_pm_u: Float | None = None
    sigma_pm_v: Float | None = None
    chip_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self._complete()
        self._check_values()
        self._check_duplicates()

    @classmethod
    def of_distinct_rows(cls, **columns: Any) -> MatchTable:
        """Table of rows that are known to differ, made without a search for repeated rows.

        All is as in the constructor, but repeated rows are not looked for.

        Parameters
        ----------
        **columns
            As the constructor's.

        Returns
        -------
        MatchTable

        Raises
        ------
        InputError
            As the constructor, but for the same star twice.
        """
        table = object.__new__(cls)
        for one in fields(cls):
            if one.name not in columns and one.default is not MISSING:
                columns[one.name] = one.default
        columns.setdefault("rejected", {})
        if set(columns) != {one.name for one in fields(cls)}:
            raise TypeError(f"{', '.join(columns)} are not the columns of a table")
        for name, value in columns.items():
            object.__setattr__(table, name, value)
        table._complete()
        table._check_values()
        return table

    def _with(self, *, distinct: bool = True, **changes: Any) -> MatchTable:
        """Table with other columns."""
        columns = {one.name: getattr(self, one.name) for one in fields(self)} | changes
        return MatchTable.of_distinct_rows(**columns) if distinct else MatchTable(**columns)

    def _complete(self) -> None:
        """Fill in the defaults, and give every array its type."""
        self._without_units()
        self._without_masks()
        n = np.size(self.x)
        if n == 0:
            raise InputError(
                "holds no rows", where=", ".join(self.sources), do="give a table with matched stars"
            )
        for name in ("row", "source", *_CODES):
            if getattr(self, name) is None:
                default = np.arange(n) if name == "row" else np.zeros(n, np.int64)
                object.__setattr__(self, name, default)
        given = {name: getattr(self, name) for name in self._array_names()}
        where = ", ".join(self.sources)
        for name, values in one_length(given, integers=_INTEGERS, where=where).items():
            object.__setattr__(self, name, values)
        object.__setattr__(self, "n_rows", n if self.n_rows is None else int(self.n_rows))
        object.__setattr__(self, "rejected", dict(self.rejected))

    def _without_units(self) -> None:
        """Replace quantities by numbers in `unit`."""
        units = dict.fromkeys(("x", "y"), "pix") | dict.fromkeys(_MOTIONS, f"{self.unit} / yr")
        units |= {"epoch": "yr", "mag": "mag", "colour": "mag"}
        for name in (*_POSITIONS, *_SIGMAS, *_OPTIONAL):
            own = unit_of(getattr(self, name), where=f"column {name!r}")
            if own is None:
                continue
            unit = units.get(name, self.unit)
            factor = conversion(own, unit, where=f"{', '.join(self.sources)}, column {name!r}")
            object.__setattr__(self, name, factor * without_unit(getattr(self, name)))

    def _without_masks(self) -> None:
        """Leave out rows with a masked value, and count them."""
        names = list(self._array_names())
        masked = [name for name in names if hasattr(getattr(self, name), "mask")]
        n, shapes = np.size(self.x), {np.shape(getattr(self, name)) for name in names}
        if not masked or shapes != {(n,)}:
            return  # unequal lengths are refused where they are compared
        reasons = [
            (f"no value in column {name!r}", absent(getattr(self, name), not_finite=False))
            for name in masked
        ]
        stay, counts = counted(reasons, n)
        if not counts:
            return
        if self.row is None:
            object.__setattr__(self, "row", np.arange(n))
            names.append("row")
        for name in names:
            values = getattr(self, name)
            plain = np.asarray(getattr(values, "unmasked", values))
            object.__setattr__(self, name, plain[stay])
        object.__setattr__(self, "n_rows", n if self.n_rows is None else self.n_rows)
        object.__setattr__(self, "rejected", merged_counts([self.rejected, counts]))

    def _array_names(self) -> Iterator[str]:
        for name in (*_POSITIONS, *_SIGMAS, *_OPTIONAL, *_INTEGERS):
            if getattr(self, name) is not None:
                yield name

    def _where(self, index: int, column: str = "") -> str:
        """File, row (from 1) and column of a star, for an error."""
        head = f"{self.sources[self.source[index]]}, row {self.row[index] + 1}"
        return f"{head}, column {column!r}" if column else head

    def _check_values(self) -> None:
        check_unit(self.unit, where=", ".join(self.sources))
        present, where = set(self._array_names()), ", ".join(self.sources)
        refuse_half(_SIGMAS, present, where=where, what="errors")
        refuse_half(_NOMINAL, present, where=where, what="nominal positions")
        names_of = {**_CODES, "source": "sources"}
        for name, labels in names_of.items():
            codes = getattr(self, name)
            if codes.min() < 0 or codes.max() >= len(getattr(self, labels)):
                raise InputError(
                    f"codes in {name!r} point outside {labels!r}",
                    where=", ".join(self.sources),
                    do="give a label for each code",
                )
        if self.star is not None and self.star.min() < 0:
            bad = int(np.argmax(self.star < 0))
            raise InputError(
                f"value is {self.star[bad]}, and must not be negative",
                where=self._where(bad, "star"),
                do="number the reference stars from 0",
            )
        numbers = {name: getattr(self, name) for name in (*_POSITIONS, *_SIGMAS, *_OPTIONAL)}
        given = {name: values for name, values in numbers.items() if values is not None}
        check_values(given, place=self._where, positive=_SIGMAS)

    def _check_duplicates(self) -> None:
        keys = [getattr(self, k) for k in (*_POSITIONS, *_CODES)]
        if self.epoch is not None:
            keys.append(self.epoch)
        pair = first_duplicate(keys)
        if pair is not None:
            first, second = pair
            raise InputError(
                f"repeats {self._where(first)}: the same x, y, u, v, exposure and chip",
                where=self._where(second),
                do="drop one of them",
            )

    def __len__(self) -> int:
        return len(self.x)

    @property
    def has_sigma(self) -> bool:
        """True where the stars have errors."""
        return self.sigma_u is not None

    @property
    def has_epoch(self) -> bool:
        """True where the stars have epochs."""
        return self.epoch is not None

    @property
    def has_mag(self) -> bool:
        """True where the stars have magnitudes."""
        return self.mag is not None

    @property
    def has_nominal(self) -> bool:
        """True where the stars have nominal positions."""
        return self.u_nominal is not None

    @property
    def exposures(self) -> tuple[str, ...]:
        """Names of the exposures that have stars, in the order of `exposure_names`."""
        return tuple(self.exposure_names[k] for k in np.unique(self.exposure))

    @property
    def chip_number(self) -> Int:
        """Number of the chip of each star (N,)."""
        return np.asarray(self.chip_numbers, np.int64)[self.chip]

    def select(self, which: ArrayLike, *, reason: str | None = None) -> MatchTable:
        """Stars by mask or indices.

        Parameters
        ----------
        which : array_like of bool or int
            Mask of length N, or indices without repetition.
        reason : str, optional
            Why the others go; they are counted under it in `rejected`.

        Returns
        -------
        MatchTable
            Codes keep their meaning: names without stars stay.

        Raises
        ------
        InputError
            When no star is left, or when an index is repeated.
        """
        which = np.asarray(which)
        if not which.size:  # an empty list has no integer type of its own
            which = which.astype(np.int64)
        index = np.arange(len(self))[which]
        # rows of one table differ: only a repeated index repeats one
        distinct = which.dtype == bool or len(np.unique(index)) == len(index)
        picked = {name: getattr(self, name)[index] for name in self._array_names()}
        rejected = dict(self.rejected)
        dropped = len(self) - len(index)
        if reason is not None and dropped:
            rejected[reason] = rejected.get(reason, 0) + dropped
        return self._with(distinct=distinct, **picked, rejected=rejected)

    def pieces(self) -> tuple[Piece, ...]:
        """Rows in consecutive pieces of about equal size.

        Returns
        -------
        tuple of Piece
            Of at most `PIECE` rows each.
        """
        edges = even_edges(len(self), PIECE)
        out: list[Piece] = []
        for a, b in pairwise(edges):
            part = {name: getattr(self, name)[a:b] for name in self._array_names()}
            out.append(TablePiece(self._with(**part, n_rows=b - a, rejected={})))
        return tuple(out)

    def sample(self, n: int) -> MatchTable:
        """Every k-th row.

        Parameters
        ----------
        n : int
            Largest number of rows of the sample; k is as small as this allows.

        Returns
        -------
        MatchTable
            In the order of the rows; the table itself where it has no more than `n`.

        Raises
        ------
        InputError
            For less than one row.
        """
        k = every_kth(len(self), n)
        return self if k == 1 else self.select(np.arange(0, len(self), k))

    def with_sigma(self, sigma_u: ArrayLike, sigma_v: ArrayLike) -> MatchTable:
        """These stars with other errors.

        Parameters
        ----------
        sigma_u, sigma_v : array_like, shape () or (N,)
            In `unit`.

        Returns
        -------
        MatchTable
        """
        shape = (len(self),)
        return self._with(
            sigma_u=np.broadcast_to(np.asarray(sigma_u, float), shape),
            sigma_v=np.broadcast_to(np.asarray(sigma_v, float), shape),
        )

    def with_errors_times(self, factor: float) -> MatchTable:
        """These stars with all errors multiplied by a factor.

        Parameters
        ----------
        factor : float

        Returns
        -------
        MatchTable
        """
        if self.sigma_u is None or self.sigma_v is None:
            return self
        return self.with_sigma(factor * self.sigma_u, factor * self.sigma_v)

    def with_added_errors(self, added: AddedErrors) -> MatchTable:
        """These stars with errors added in quadrature.

        Parameters
        ----------
        added : AddedErrors

        Returns
        -------
        MatchTable
        """
        if self.sigma_u is None or self.sigma_v is None:
            return self
        return self.with_sigma(*added.beside(self, self.sigma_u, self.sigma_v))

    def with_errors_by_magnitude(self, errors: MagnitudeErrors) -> MatchTable:
        """These stars with errors by magnitude.

        Parameters
        ----------
        errors : MagnitudeErrors

        Returns
        -------
        MatchTable

        Raises
        ------
        InputError
            Without magnitudes.
        """
        if self.mag is None:
            raise no_magnitudes(", ".join(self.sources))
        return self.with_sigma(*errors.at(self.mag))

    @staticmethod
    def concatenate(tables: Sequence[MatchTable]) -> MatchTable:
        """Stars of several tables, in their order.

        Exposures, chips, filters and files of equal name become one.  Stars keep their codes, which
        must belong to one catalogue; the codes are left out when one of the tables has none.

        Parameters
        ----------
        tables : sequence of MatchTable

        Returns
        -------
        MatchTable

        Raises
        ------
        InputError
            For no tables, different units or tangent points, or an optional column that only some
            have.
        """
        if not tables:
            raise InputError("there are no tables to join", do="give at least one")
        first = tables[0]
        if len(tables) == 1:
            return first
        for other in tables[1:]:
            for name, label in (("unit", "unit"), ("tangent_point", "tangent point")):
                if getattr(other, name) != getattr(first, name):
                    raise InputError(
                        f"{label} is {getattr(other, name)}, but {getattr(first, name)} in "
                        f"{', '.join(first.sources)}",
                        where=", ".join(other.sources),
                        do="bring all files to one",
                    )
        joined: dict[str, object] = {
            name: np.concatenate([getattr(t, name) for t in tables])
            for name in (*_POSITIONS, "row")
        }
        for name in (*_SIGMAS, *_OPTIONAL):
            joined[name] = merged_optional(
                name, [getattr(t, name) for t in tables], [", ".join(t.sources) for t in tables]
            )
        stars = [t.star for t in tables if t.star is not None]
        joined["star"] = np.concatenate(stars) if len(stars) == len(tables) else None
        for name, labels in {**_CODES, "source": "sources"}.items():
            joined[name], joined[labels] = merged_codes(
                [getattr(t, name) for t in tables],
                [getattr(t, labels) for t in tables],
                ordered=name == "chip",
            )
        name_of = {
            number: name
            for t in tables
            for number, name in zip(t.chip_numbers, t.chip_names, strict=False)
        }
        chips = cast("tuple[int, ...]", joined["chip_numbers"])
        if len(name_of) == len(chips):
            joined["chip_names"] = tuple(name_of[number] for number in chips)
        return MatchTable(
            **joined,  # type: ignore[arg-type]
            notes=tuple(dict.fromkeys(note for t in tables for note in t.notes)),
            unit=first.unit,
            tangent_point=first.tangent_point,
            n_rows=sum(t.n_rows for t in tables),
            rejected=merged_counts([t.rejected for t in tables]),
        )
