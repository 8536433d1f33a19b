"""Matches: detector pixels and reference positions, one row per matched star."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.batches import BATCH, even_edges, every_kth
from bayesdist.data.columns import (
    COLUMNS,
    POSITIONS,
    SIGMAS,
    Labels,
    MatchColumns,
    joined_arguments,
    joined_columns,
    merged_counts,
    refuse_repeated,
)
from bayesdist.data.covariances import covariances_of, errors_of
from bayesdist.data.magnitude_errors import AddedErrors, MagnitudeErrors, no_magnitudes
from bayesdist.data.output import arrow_stream, html_of, table_of
from bayesdist.data.reading.options import (
    ReadArguments,
    ReadOptions,
    option_names,
    refuse_missing_errors,
)
from bayesdist.data.reading.table import match_arguments, sky_table
from bayesdist.data.repeated import check_same_position, error_codes, star_codes
from bayesdist.data.tables.names import ASSUMED, NO_MOTION
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Direction, Epoch, Number, values_in

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable

NEGLIGIBLE_RHO = 1e-12  # of rounded numbers
Errors = MagnitudeErrors | AddedErrors | Number | tuple[ArrayLike, ArrayLike]


class BatchReader(Protocol):
    """Batch of matches that has not been read yet; it can be pickled."""

    def __len__(self) -> int:
        """Number of rows."""

    def load(self) -> Matches:
        """Read the rows into memory, with codes that refer to the names of all batches."""


@dataclass(frozen=True, eq=False, repr=False)
class Matches(MatchColumns):
    """Matched stars, in memory or on disk.

    Stars in memory are one table. Larger tables stay in files, and `batches` yields them one by
    one. Both kinds have the same methods, but accessing a column of stars on disk raises
    InputError. All arrays have length N; they are converted to float64, and codes and rows to
    int64. Quantities are converted to `unit` (x and y to pixels), and rows with a masked value are
    left out and counted in `rejected`. Only x, y, u, v are required.

    Parameters
    ----------
    x, y : ndarray
        Raw detector position, FITS 1-based pixels (centre of the first pixel = 1.0).
    u, v : ndarray
        Reference position, in `unit`.
    sigma_u, sigma_v : ndarray, optional
        Standard errors of the match in `unit`: both or neither. None if they are to be estimated.
    rho_uv : ndarray, optional
        Correlation of the errors in u and in v, between -1 and 1 (both excluded); 0 by default.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    epoch : ndarray, optional
        Decimal years.
    mag : ndarray, optional
        Magnitudes; any zero point.
    colour : ndarray, optional
        Colour indices, in magnitudes; any zero point.
    exposure, chip, filter : ndarray of int, optional
        Codes: indices into `exposure_names`, `chip_numbers` and `filter_names`.
    exposure_names, filter_names : tuple of str
        Names of the exposures and filters.
    chip_numbers : tuple of int
        Numbers of the chips.
    star : ndarray of int, optional
        Code of the reference star of each match, 0 or more. A star may be matched in many
        exposures. None if unknown.
    row : ndarray of int, optional
        Row of the star in its file, counted from 0.
    source : ndarray of int, optional
        Code of that file: index into `sources`.
    sources : tuple of str
        Names of the files.
    n_rows : int, optional
        Number of rows read, including rejected ones.
    rejected : dict of str to int
        Number of rows left out, by reason.
    tangent_point : tuple of float, optional
        RA and Dec of the tangent point in degrees, if u, v were computed from sky positions.
    u_nominal, v_nominal : ndarray, optional
        Position by an earlier solution, in `unit`: both or neither. Matches were searched for
        within a circle around it.
    pm_u, pm_v, sigma_pm_u, sigma_pm_v : ndarray, optional
        Proper motion of the reference star in `unit` per year, and its standard errors, if the
        catalogue has them: both axes or neither. If `notes` state that the stars were moved, u and
        v already include the motion.
    assumed_motion : ndarray of int, optional
        1 for stars whose motion is not measured but assumed, with its error; 0 for others. None if
        no motion is.
    chip_names : tuple of str
        Names of the chips in `chip_numbers`, if the file has names instead of numbers.
    notes : tuple of str
        Clauses on how the rows were treated when they were read.
    match_radius : float, optional
        Largest distance in `unit` of a match from its nominal position, if `match` made the
        matches.

    Raises
    ------
    InputError
        If there are no rows, if lengths are unequal, if values are not finite, if errors are not
        positive, if the unit is unknown, or if a star is repeated.

    Examples
    --------
    >>> x, y = np.array([10.0, 200.0, 900.0]), np.array([20.0, 800.0, 500.0])
    >>> matches = bd.Matches(x, y, x - 508.5, y - 508.5, unit="pix")
    >>> len(matches.with_errors((0.05, 0.05)))
    3
    """

    _readers: tuple[BatchReader, ...] | None = field(default=None, init=False)
    _stored: frozenset[str] = field(default=frozenset(), init=False)  # columns on disk

    def __post_init__(self) -> None:
        self._complete()
        refuse_repeated(self._columns, place=self.place)

    @classmethod
    def of_distinct_rows(cls, **columns: Any) -> Matches:
        """Matches in memory that are known to be distinct.

        As the constructor, but repeated rows are not searched for.

        Parameters
        ----------
        **columns
            Arguments of the constructor.

        Returns
        -------
        Matches
            Matches with these columns.

        Raises
        ------
        InputError
            As for the constructor, except for repeated stars.
        TypeError
            If an argument is unknown, or a position is missing.
        """
        arguments = [argument for argument in fields(cls) if argument.init]
        defaults = {
            argument.name: argument.default
            for argument in arguments
            if argument.default is not MISSING
        }
        values = defaults | {"rejected": {}} | columns
        if values.keys() != {argument.name for argument in arguments}:
            raise TypeError(f"{', '.join(columns)} are not columns of Matches")
        matches = object.__new__(cls)
        for name, value in values.items():
            object.__setattr__(matches, name, value)
        matches._complete()
        return matches

    @classmethod
    def from_table(
        cls,
        table: Any,
        **options: Unpack[ReadArguments],
    ) -> Matches:
        """Matches from any object with columns.

        Columns are recognised by the same names and units as those of files. The rules for proper
        motions, missing values and pixels that count from 0 are also the same: see `read_matches`.

        Parameters
        ----------
        table : table
            An astropy Table or QTable, also with Time and SkyCoord columns; a pandas DataFrame, in
            which NaN is a missing value; an object with an Arrow stream (a polars DataFrame, a
            pyarrow Table, a DuckDB result); a mapping of arrays or lists; or a structured array.
        **options
            Fields of `ReadOptions` by name: columns, unit, sigma, pixel_origin, tangent_point,
            epoch, catalogue_epoch, chips, not_finite, same_position, plate_scale,
            motion_prior.

        Returns
        -------
        Matches
            Matches in memory.

        Raises
        ------
        InputError
            If a column is missing, if a column of numbers contains text, if values are not finite,
            if units are missing or contradictory, if errors are missing, or if there are no rows.

        Examples
        --------
        >>> stars = {"x": [10.5, 900.0], "y": [20.0, 500.0], "u": [0.1, 8.9], "v": [0.2, 4.8]}
        >>> bd.Matches.from_table(stars, unit="arcsec", sigma=0.01)
        <2 matches in memory: 1 exposure, 1 chip, u and v in arcsec, median error 0.01 arcsec>
        """
        with option_names():
            reading = ReadOptions(**options)
            return cls(**match_arguments(table, reading)).as_read(reading.plane_sigma)

    @classmethod
    def from_sky(
        cls,
        x: ArrayLike,
        y: ArrayLike,
        sky: SkyCoord,
        *,
        sigma: Number | ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
        mag: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        chip: ArrayLike | None = None,
        epoch: Epoch | ArrayLike | None = None,
        tangent_point: Direction | None = None,
        pixel_origin: int = 1,
        not_finite: str = "refuse",
    ) -> Matches:
        """Matches of pixels with sky coordinates.

        Coordinates in any frame are transformed to ICRS. If they have proper motions and an
        `obstime`, they are moved to the epoch of the exposures, as for tables.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            Raw detector positions in pixels.
        sky : SkyCoord, shape (N,)
            Reference positions. Distances are not used.
        sigma : float, Quantity, array_like or pair of array_like, optional
            Standard error of the match: one number, one per star, or errors to the east and to the
            north. Plain numbers are in arcsec. By default, errors are estimated from the residuals
            by magnitude, which requires `mag`.
        mag, exposure, chip : array_like, shape (N,), optional
            Magnitudes, names of the exposures, and numbers or names of the chips.
        epoch : float, str, Time, date, Quantity or array_like, optional
            Epoch of the exposures, common to all or one per star.
        tangent_point : SkyCoord, or pair of float or Quantity, optional
            Tangent point. The default is the mean direction of the stars.
        pixel_origin : {0, 1}, optional
            Coordinate of the centre of the first pixel: 1 as in FITS, 0 as in photutils.
        not_finite : {'refuse', 'reject'}, optional
            As for `ReadOptions`.

        Returns
        -------
        Matches
            Matches with u, v on the tangent plane in arcsec.

        Raises
        ------
        InputError
            If lengths are unequal, if coordinates cannot be transformed to ICRS, if units do not
            fit, and for the reasons given in `from_table`.

        Examples
        --------
        >>> from astropy.coordinates import SkyCoord
        >>> sky = SkyCoord([10.0, 10.01], [-30.0, -30.01], unit="deg")
        >>> matches = bd.Matches.from_sky([5.0, 800.0], [7.0, 900.0], sky, sigma=0.01)
        >>> matches.unit
        'arcsec'
        """
        table = sky_table(
            x, y, sky, sigma=sigma, mag=mag, exposure=exposure, chip=chip, epoch=epoch
        )
        dated = "epoch" in table.colnames
        return cls.from_table(
            table,
            sigma="columns" if "sigma_u" in table.colnames else "by_magnitude",
            pixel_origin=pixel_origin,
            tangent_point=tangent_point,
            epoch=None if dated else epoch,
            not_finite=not_finite,
        )

    def as_read(self, sigma: str | Number) -> Matches:
        """These stars with the errors requested by the reading option `sigma`.

        Parameters
        ----------
        sigma : {'columns', 'by_magnitude'}, float or Quantity
            As for `ReadOptions`.

        Returns
        -------
        Matches
            Matches with these errors, or unchanged.

        Raises
        ------
        InputError
            If the stars lack the errors or magnitudes that `sigma` requires.
        """
        location = ", ".join(self.sources)
        if isinstance(sigma, str):
            refuse_missing_errors(sigma, self.has_sigma, self.has_mag, where=location)
            return self
        return self.with_errors(sigma)

    @classmethod
    def from_readers(
        cls, readers: Sequence[BatchReader], labels: Labels, columns: Collection[str]
    ) -> Matches:
        """Matches that stay on disk.

        Parameters
        ----------
        readers : sequence of BatchReader
            Readers of the batches, with codes that refer to `labels`.
        labels : Labels
            Names, counts and notes of the whole table.
        columns : collection of str
            Columns that the batches have.

        Returns
        -------
        Matches
            Matches on disk.
        """
        matches = object.__new__(cls)
        for name, value in labels.arguments().items():
            object.__setattr__(matches, name, value)
        object.__setattr__(matches, "_readers", tuple(readers))
        object.__setattr__(matches, "_stored", frozenset(columns))
        return matches

    def __len__(self) -> int:
        return len(self.x) if self._readers is None else sum(map(len, self._readers))

    def __repr__(self) -> str:
        place = "in memory" if self.in_memory else "on disk"
        return f"<{len(self)} matches {place}: {', '.join(text for _, text in self._facts())}>"

    def _repr_html_(self) -> str:
        place = "memory" if self.in_memory else "disk"
        facts = (*self._facts(), ("files", ", ".join(self.sources)), ("place", place))
        return html_of(len(self), facts)

    def _facts(self) -> tuple[tuple[str, str], ...]:
        """Names and text of the facts that are shown first."""
        n, chips = len(self.exposures), len(self.chip_numbers)
        return (
            ("exposures", f"{n} exposure{'s' if n > 1 else ''}"),
            ("chips", f"{chips} chip{'s' if chips > 1 else ''}"),
            ("unit", f"u and v in {self.unit}"),
            ("errors", self._error_words()),
        )

    def _error_words(self) -> str:
        if not self.has_sigma:
            return "no errors"
        if not self.in_memory or self.sigma_u is None or self.sigma_v is None:
            return "with errors"
        median = float(np.median(np.concatenate([self.sigma_u, self.sigma_v])))
        return f"median error {median:.3g} {self.unit}"

    def to_table(self) -> QTable:
        """These stars as an astropy table.

        Returns
        -------
        QTable
            Table with units. Exposures and filters are given by name, and chips by number or name,
            instead of codes. ``meta["bayesdist"]`` has the tangent point, the match radius, counts
            and notes.

        Raises
        ------
        InputError
            If the stars are on disk and a file cannot be read.

        Examples
        --------
        >>> matches = bd.Matches([1.0, 2.0], [3.0, 4.0], [0.1, 0.2], [0.3, 0.4], unit="arcsec")
        >>> matches.to_table()["u"].to("mas").value.tolist()
        [100.0, 200.0]
        """
        return table_of(self.load())

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Arrow stream of the columns of `to_table`, following the Arrow PyCapsule interface."""
        names = [name for name in COLUMNS if self.has(name)]
        return arrow_stream(self, self.batches(), names).__arrow_c_stream__(requested_schema)

    @property
    def in_memory(self) -> bool:
        """True if the columns are in memory."""
        return self._readers is None

    def digest(self) -> str:
        """SHA-256 of the positions, which identifies these stars.

        Returns
        -------
        str
            Hexadecimal digest; empty for stars on disk.
        """
        if not self.in_memory:
            return ""
        digest = hashlib.sha256()
        for name in POSITIONS:
            digest.update(np.ascontiguousarray(self.column(name)).data)
        return digest.hexdigest()

    def has(self, column: str) -> bool:
        """True if the stars have a column.

        Parameters
        ----------
        column : str
            Name of an optional column.

        Returns
        -------
        bool
            True if the column exists.
        """
        return getattr(self, column) is not None if self.in_memory else column in self._stored

    def column(self, name: str) -> NDArray[Any]:
        """Values of an optional column.

        Parameters
        ----------
        name : str
            Name of the column.

        Returns
        -------
        ndarray, shape (N,)
            Values of the column.

        Raises
        ------
        InputError
            If the stars do not have the column.
        """
        values = getattr(self, name)
        if values is None:
            location = ", ".join(self.sources)
            raise InputError(f"there is no column {name!r}", where=location, do="add or map it")
        return np.asarray(values)

    @property
    def has_sigma(self) -> bool:
        """True if the stars have errors."""
        return self.has("sigma_u")

    @property
    def has_epoch(self) -> bool:
        """True if the stars have epochs."""
        return self.has("epoch")

    @property
    def has_mag(self) -> bool:
        """True if the stars have magnitudes."""
        return self.has("mag")

    @property
    def has_nominal(self) -> bool:
        """True if the stars have nominal positions."""
        return self.has("u_nominal")

    @property
    def exposures(self) -> tuple[str, ...]:
        """Names of the exposures that have stars, in the order of `exposure_names`."""
        if not self.in_memory:
            return self.exposure_names
        return tuple(self.exposure_names[k] for k in np.unique(self.exposure))

    def readers(self, batch_rows: int = BATCH) -> tuple[BatchReader, ...]:
        """Readers of consecutive batches; those on disk are not read yet.

        Parameters
        ----------
        batch_rows : int
            Largest number of rows in a batch. For matches on disk it is that of `open_matches`.

        Returns
        -------
        tuple of BatchReader
            Readers of the batches, which can be sent to other processes.
        """
        if self._readers is not None:
            return self._readers
        return tuple(
            self.with_columns(
                **{name: values[a:b] for name, values in self._columns.items()},
                n_rows=b - a,
                rejected={},
            )
            for a, b in pairwise(even_edges(len(self), batch_rows))
        )

    def batches(self) -> Iterator[Matches]:
        """Iterate over consecutive batches in memory, read one after another.

        Yields
        ------
        Matches
            Batch with codes that refer to the names of the whole table.

        Raises
        ------
        InputError
            If a file is damaged, missing, or has changed since it was opened.
        """
        for reader in self.readers():
            yield reader.load()

    def load(self) -> Matches:
        """Load all stars into memory.

        Returns
        -------
        Matches
            Matches in memory; the object itself if they already are.

        Raises
        ------
        InputError
            As for `batches`.
        """
        return self if self.in_memory else self.sample(len(self))

    def sample(self, n: int) -> Matches:
        """Every k-th row, in memory.

        Parameters
        ----------
        n : int
            Largest number of rows in the sample; k is the smallest number for which this holds.

        Returns
        -------
        Matches
            Sample in the order of the rows; the object itself if it is in memory and has at most n
            rows.

        Raises
        ------
        InputError
            If n is less than one, and as for `batches`.
        """
        k = every_kth(len(self), n)
        if self.in_memory:
            return self if k == 1 else self.select(np.arange(0, len(self), k))
        parts: list[dict[str, Any]] = []
        start = 0
        for reader in self.readers():
            rows = slice(-start % k, None, k)
            start += len(reader)
            if len(range(len(reader))[rows]):
                # copies, because views would keep the whole batch in memory while the next one is
                # read
                parts.append({n: a[rows].copy() for n, a in reader.load()._columns.items()})
        return Matches.of_distinct_rows(**joined_columns(parts), **self.labels.arguments())

    def select(self, which: ArrayLike, *, reason: str | None = None) -> Matches:
        """Select stars by mask or indices.

        Parameters
        ----------
        which : array_like of bool or int
            Mask of length N, or indices without repetition; for stars on disk, a mask.
        reason : str, optional
            Reason under which the other stars are counted in `rejected`.

        Returns
        -------
        Matches
            The selected stars. Names and codes are unchanged, even if a name has no more stars.

        Raises
        ------
        InputError
            If no star is selected, or if an index is repeated.
        """
        which = np.asarray(which)
        if not which.size:  # an empty list has no integer type
            which = which.astype(np.int64)
        if self._readers is not None:
            return self._selected_on_disk(self._readers, which, reason)
        index = np.arange(len(self))[which]
        counts = self._counts_without(len(index), reason)
        columns = {name: values[index] for name, values in self._columns.items()}
        selected = self.with_columns(**columns, rejected=counts)
        # rows of one table are distinct: only a repeated index can repeat a row
        if which.dtype != bool and len(np.unique(index)) < len(index):
            refuse_repeated(selected._columns, place=selected.place)
        return selected

    def _selected_on_disk(
        self, readers: Sequence[BatchReader], which: NDArray[Any], reason: str | None
    ) -> Matches:
        if which.dtype != bool or which.shape != (len(self),):
            raise InputError(
                "stars on disk can only be selected by a mask of all of them",
                where=", ".join(self.sources),
                do="give a mask, or load() them",
            )
        edges = np.cumsum([0, *map(len, readers)])
        parts = [which[a:b] for a, b in pairwise(edges)]
        counts = self._counts_without(int(which.sum()), reason)
        if not which.any():
            raise InputError(
                "holds no rows",
                where=", ".join(self.sources),
                do="give a table with matched stars",
            )
        return Matches.from_readers(
            [
                _Deferred(reader, partial(_by_bits, bits=np.packbits(rows)), int(rows.sum()))
                for reader, rows in zip(readers, parts, strict=True)
                if rows.any()
            ],
            replace(self.labels, rejected=counts),
            self._stored,
        )

    def _counts_without(self, n: int, reason: str | None) -> dict[str, int]:
        """Counts of rejected rows by reason, after a selection that leaves n stars."""
        dropped = {} if reason is None or n == len(self) else {reason: len(self) - n}
        return merged_counts([self.rejected, dropped])

    def mapped(
        self,
        step: Callable[[Matches], Matches],
        *,
        adds: Collection[str] = (),
        drops: Collection[str] = (),
    ) -> Matches:
        """Apply a function that treats each row independently.

        Parameters
        ----------
        step : callable
            ``step(matches)`` takes matches in memory and returns as many, with the same labels. For
            stars on disk it is called when they are read, and it must be picklable.
        adds : collection of str
            Columns that the stars have afterwards, even if they had them before.
        drops : collection of str
            Columns that the function removes.

        Returns
        -------
        Matches
            Result of the function; for stars on disk, the result that reading will give.
        """
        if self._readers is None:
            return step(self)
        readers = [_Deferred(reader, step, len(reader)) for reader in self._readers]
        stored = (self._stored | set(adds)) - set(drops)
        return Matches.from_readers(readers, self.labels, stored)

    def without(self, *columns: str) -> Matches:
        """These stars without the given optional columns.

        Parameters
        ----------
        *columns : str
            Optional columns, such as 'sigma_u' and 'sigma_v'; columns that do not exist are
            ignored.

        Returns
        -------
        Matches
            Matches without these columns.
        """
        if not any(self.has(name) for name in columns):
            return self
        return self.mapped(partial(_without, columns=columns), drops=columns)

    def with_columns(self, **changes: Any) -> Matches:
        """Stars in memory with some columns or labels replaced.

        Parameters
        ----------
        **changes
            Arguments of the constructor. Repeated rows are not searched for.

        Returns
        -------
        Matches
            Matches with these changes.

        Raises
        ------
        InputError
            As for the constructor, and for stars on disk.
        """
        current = {
            argument.name: getattr(self, argument.name)
            for argument in fields(self)
            if argument.init
        }
        return Matches.of_distinct_rows(**(current | changes))

    @cached_property
    def error_codes(self) -> Int | None:
        """Code (N,) of the star, or tight group of stars, that shares a reference error.

        None if each row is a separate star. The stars must be in memory.
        """
        return error_codes(self.u, self.v, self.star)

    def with_star_codes(self, same_position: str = "one_star") -> Matches:
        """These stars with codes assigned by their reference positions.

        Parameters
        ----------
        same_position : {'one_star', 'separate_stars'}, optional
            As for `ReadOptions`.

        Returns
        -------
        Matches
            Matches with star codes; unchanged if they have codes, if no position occurs twice, or
            if they are on disk.

        Raises
        ------
        InputError
            If `same_position` is unknown.
        """
        check_same_position(same_position)
        if not self.in_memory or self.star is not None:
            return self
        star, note = star_codes(self.u, self.v, same_position)
        return self if star is None else self.with_columns(star=star, notes=(*self.notes, note))

    def with_counts(self, n_rows: int, rejected: Mapping[str, int]) -> Matches:
        """These stars with other counts of the rows from which they were selected.

        Parameters
        ----------
        n_rows : int
            Number of rows read.
        rejected : mapping of str to int
            Number of rows left out, by reason.

        Returns
        -------
        Matches
            Matches with these counts.
        """
        if self._readers is None:
            return self.with_columns(n_rows=n_rows, rejected=rejected)
        labels = replace(self.labels, n_rows=n_rows, rejected=dict(rejected))
        return Matches.from_readers(self._readers, labels, self._stored)

    def named_below(self, folder: str) -> Matches:
        """These stars with file names relative to a folder.

        Parameters
        ----------
        folder : str
            Folder; file names that do not begin with it are unchanged.

        Returns
        -------
        Matches
            Matches with these file names.
        """
        names = tuple(name.removeprefix(f"{folder}/") for name in self.sources)
        if self._readers is None:
            return self.with_columns(sources=names)
        step = partial(Matches.named_below, folder=folder)
        readers = [_Deferred(reader, step, len(reader)) for reader in self._readers]
        return Matches.from_readers(readers, replace(self.labels, sources=names), self._stored)

    def with_exposure_names(self, names: tuple[str, ...]) -> Matches:
        """These stars with other exposure names, which must include all present ones.

        Parameters
        ----------
        names : tuple of str
            New exposure names.

        Returns
        -------
        Matches
            Matches with exposure codes that refer to these names.
        """
        if names == self.exposure_names:
            return self
        if self._readers is not None:
            step = partial(Matches.with_exposure_names, names=names)
            readers = [_Deferred(reader, step, len(reader)) for reader in self._readers]
            labels = replace(self.labels, exposure_names=names)
            return Matches.from_readers(readers, labels, self._stored)
        code = {name: k for k, name in enumerate(names)}
        codes = np.array([code.get(name, -1) for name in self.exposure_names], np.int64)
        return self.with_columns(exposure=codes[self.exposure], exposure_names=names)

    def without_assumed_motions(self) -> Matches:
        """These stars without those whose motion is assumed instead of measured.

        The errors of such stars are large and do not depend on their magnitude, so that errors by
        magnitude do not hold for them.

        Returns
        -------
        Matches
            The same object if no motion is assumed. The others are counted in `rejected`.

        Raises
        ------
        InputError
            If no motion is measured, or if the stars are on disk and some motions are assumed.
        """
        if not self.has(ASSUMED):
            return self
        if not self.in_memory:
            raise InputError(
                "stars without a measured motion are to be left out, and the stars are on disk",
                where=", ".join(self.sources),
                do="leave them out of the table, or load() the stars",
            )
        assumed = self.motion_is_assumed
        if assumed.all():
            raise InputError(
                "no star has a measured motion, and errors by magnitude do not hold for others",
                where=", ".join(self.sources),
                do="give measured motions, or errors as columns",
            )
        return self.select(~assumed, reason=NO_MOTION) if assumed.any() else self

    def with_errors(self, errors: Errors, *, in_quadrature: bool = False) -> Matches:
        """These stars with other errors.

        Parameters
        ----------
        errors : MagnitudeErrors, AddedErrors, float, Quantity or pair of array_like
            Errors by magnitude; errors by groups of stars; one error for all; or errors of u and of
            v, each a number or, for stars in memory, an array of shape (N,). Plain numbers are in
            `unit`.
        in_quadrature : bool, optional
            True to add them in quadrature to the present errors, if there are any.

        Returns
        -------
        Matches
            Matches with these errors.

        Raises
        ------
        InputError
            If magnitudes are needed but missing, or if errors are not positive.
        """
        if isinstance(errors, MagnitudeErrors) and not self.has_mag:
            raise no_magnitudes(", ".join(self.sources))
        if not self.in_memory:
            if not isinstance(errors, MagnitudeErrors | AddedErrors):
                errors = _checked_numbers(errors, self.unit)
            step = partial(Matches.with_errors, errors=errors, in_quadrature=in_quadrature)
            return self.mapped(step, adds=SIGMAS)
        sigma_u, sigma_v = self._errors(errors)
        rho = None
        if in_quadrature and self.sigma_u is not None and self.sigma_v is not None:
            sigma_u, sigma_v = np.hypot(sigma_u, self.sigma_u), np.hypot(sigma_v, self.sigma_v)
            if self.rho_uv is not None:
                rho = self.rho_uv * (self.sigma_u / sigma_u) * (self.sigma_v / sigma_v)
        return self.with_columns(sigma_u=sigma_u, sigma_v=sigma_v, rho_uv=rho)

    def _errors(self, errors: Errors) -> tuple[Float, Float]:
        """Errors (N,) of u and of v."""
        if isinstance(errors, MagnitudeErrors):
            return errors.at(self.column("mag"))
        if isinstance(errors, AddedErrors):
            return errors.at(*self.grouped(errors.by))
        pair = errors if isinstance(errors, tuple) else (errors, errors)
        shape = (len(self),)
        u, v = (np.broadcast_to(values_in(value, self.unit, "sigma"), shape) for value in pair)
        return u, v

    def covariances(self) -> Float:
        """Covariances of the errors in u and v.

        Returns
        -------
        ndarray, shape (N, 2, 2)
            In `unit` squared.

        Raises
        ------
        InputError
            If the stars are not in memory, or have no errors.
        """
        rho = 0.0 if self.rho_uv is None else self.rho_uv
        return covariances_of(self.column("sigma_u"), self.column("sigma_v"), rho)

    def with_covariances(self, covariance: Float) -> Matches:
        """These stars with other errors.

        Parameters
        ----------
        covariance : ndarray, shape (N, 2, 2)
            Covariances of the errors in u and v, in `unit` squared.

        Returns
        -------
        Matches
        """
        errors: dict[str, Any] = errors_of(covariance)
        if (np.abs(errors["rho_uv"]) <= NEGLIGIBLE_RHO).all():
            errors["rho_uv"] = None
        return self.with_columns(**errors)

    def with_scaled_errors(self, factor: float) -> Matches:
        """These stars with all errors multiplied by a factor.

        Parameters
        ----------
        factor : float
            Factor for the errors of u and v.

        Returns
        -------
        Matches
            Matches with these errors; unchanged without errors.
        """
        if not self.in_memory:
            return self.mapped(partial(Matches.with_scaled_errors, factor=factor))
        if self.sigma_u is None or self.sigma_v is None:
            return self
        return self.with_columns(sigma_u=factor * self.sigma_u, sigma_v=factor * self.sigma_v)

    @staticmethod
    def concatenate(tables: Sequence[Matches]) -> Matches:
        """Concatenate the stars of several tables.

        Exposures, chips, filters and files with the same name are merged. Star codes are kept and
        must refer to the same catalogue; they are dropped if one of the tables has none.

        Parameters
        ----------
        tables : sequence of Matches
            Tables in memory.

        Returns
        -------
        Matches
            Stars in the order of the tables.

        Raises
        ------
        InputError
            If there are no tables, if units or tangent points differ, or if only some of the tables
            have an optional column.
        """
        if not tables:
            raise InputError("there are no tables to join", do="give at least one")
        return tables[0] if len(tables) == 1 else Matches(**joined_arguments(tables))


@dataclass(frozen=True, eq=False)
class _Deferred:
    """Batch to which a function is applied when it is read."""

    reader: BatchReader
    step: Callable[[Matches], Matches]
    n: int  # rows after the step

    def __len__(self) -> int:
        return self.n

    def load(self) -> Matches:
        """Rows after the function has been applied."""
        return self.step(self.reader.load())


def _without(batch: Matches, columns: Sequence[str]) -> Matches:
    """Stars in memory without some columns."""
    return batch.with_columns(**dict.fromkeys(columns))


def _by_bits(batch: Matches, bits: NDArray[np.uint8]) -> Matches:
    """Rows of a batch for which the bit is set."""
    return batch.select(np.unpackbits(bits, count=len(batch)).astype(bool))


def _checked_numbers(
    errors: Number | tuple[ArrayLike, ArrayLike], unit: str
) -> tuple[float, float]:
    """Errors of u and v in `unit`, each a finite and positive number."""
    pair = errors if isinstance(errors, tuple) else (errors, errors)
    numbers = []
    for name, error in zip(SIGMAS, pair, strict=True):
        sigma = values_in(error, unit, name)
        if sigma.ndim:
            raise InputError(
                "errors of individual stars cannot be given for stars on disk",
                do="write them into the files, or load() the stars",
            )
        if not (np.isfinite(sigma) and sigma > 0):
            raise InputError(
                f"{name} is {sigma:g}, but must be finite and positive", do="give another"
            )
        numbers.append(float(sigma))
    return numbers[0], numbers[1]
