"""IDCTAB: the distortion table of HST instruments, as read by stwcs (its distortion/mutil.py).

    Xc ["] = sum CXnj x^j y^(n-j),  Yc ["] = sum CYnj x^j y^(n-j),  x, y from XREF, YREF;  n >= 1

Rows with DIRECTION 'INVERSE' are the inverse: x and y in pixels as polynomials in Xc and Yc in
arcseconds.

Uncertainties are stored in HDUs after the first table, which stwcs does not read:

SIGMA
    Table with the same rows as the coefficient table: its key columns (DETCHIP, DIRECTION,
    filters), and the standard deviations of V2REF, V3REF and every coefficient, under the same
    names. Those of the time-dependent terms are keywords of its header, named as in the primary
    header.
COVAR
    Table with one row for each fitted number of the file: DETCHIP; the filters, if they differ in
    their numbers (those of the first row that has the number); PARAM (name of the column or
    keyword); VALUE; and COV, the covariances with all rows in order. INVERSE rows are derived from
    FORWARD ones and are not included.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.formats.idctab.drift import drift, scheme_of
from bayesdist.model import polynomial_terms
from bayesdist.products.common.cards import named_in
from bayesdist.products.common.coefficients import evaluate
from bayesdist.products.common.content import Hdu, read_hdus, write_hdus
from bayesdist.utils.arrays import Float, Int

Filter = str | Sequence[str] | None  # one filter name, or those in both wheels

FILTER_COLUMNS = ("FILTER1", "FILTER2", "FILTER", "OPT_ELEM")
HIGHEST = 9  # highest order: column names have one digit for each power
# Chip that defines the common zero point of ACS/WFC and of WFC3/UVIS in stwcs.
_REFERENCE = 2
_ANY_CHIP = -999  # stwcs uses such a row for every chip


@dataclass(frozen=True, eq=False)
class IdcTab:
    """IDCTAB file with all its HDUs, and its interpretation.

    Parameters
    ----------
    hdus : tuple of Hdu
        All HDUs; the coefficient table is HDU 1.
    name : str
        Name of the file, for error messages.

    Raises
    ------
    FormatError
        If a keyword or column is missing that stwcs requires.

    Examples
    --------
    >>> from bayesdist.formats import idctab_from_solution
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> camera = {"instrument": "WFC3", "detector": "IR", "scale_arcsec": 0.13}
    >>> tab = idctab_from_solution(fit, **camera, filters=["F160W"])
    >>> len(tab.rows)  # without an inverse
    1
    """

    hdus: tuple[Hdu, ...]
    name: str = "IDCTAB"

    def __post_init__(self) -> None:
        header = self.header
        for keyword in ("INSTRUME", "NORDER"):
            if keyword not in header:
                raise FormatError(
                    "is missing", where=f"{self.name}, keyword {keyword}", do="add the keyword"
                )
        order = header["NORDER"]
        if isinstance(order, bool) or not isinstance(order, int) or not 1 <= order <= HIGHEST:
            raise FormatError(
                f"is {order!r}",
                where=f"{self.name}, keyword NORDER",
                do=f"give an order of 1 to {HIGHEST}",
            )
        if len(self.hdus) < 2:
            raise FormatError("has no table in HDU 1", where=self.name, do="check the file")
        x, y = self.prefixes
        needed = [
            *("XSIZE", "YSIZE", "XREF", "YREF", "SCALE"),
            *(idctab_column(p, i, j) for p in (x, y) for i, j in self.terms if i + j),
        ]
        for column in needed:
            if column not in self.columns:
                raise FormatError(
                    "is missing",
                    where=f"{self.name}, column {column}",
                    do="add it, or lower NORDER",
                )

    # -- content -----------------------------------------------------------------------------------

    @property
    def header(self) -> fits.Header:
        """Primary header; a new copy at each access."""
        return self.hdus[0].header

    @property
    def rows(self) -> NDArray[np.void]:
        """Coefficient table as a structured array; FormatError if HDU 1 is not a table."""
        try:
            return self.hdus[1].rows
        except FormatError as error:
            raise FormatError(error.cause, where=self.name, do=error.do) from error

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        return self.rows.dtype.names or ()

    @property
    def prefixes(self) -> tuple[str, str]:
        """First letters of the coefficient columns: CX, CY, or A, B in very old files."""
        return ("CX", "CY") if "CX10" in self.columns else ("A", "B")

    @cached_property
    def norder(self) -> int:
        """Polynomial order."""
        return int(self.header["NORDER"])

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers (i, j) of x and y, in the order of `coefficients`."""
        return polynomial_terms(self.norder)

    @property
    def instrument(self) -> str:
        """INSTRUME; empty if the file has none."""
        return named_in(self.header, "INSTRUME", self.name)

    @property
    def detector(self) -> str:
        """DETECTOR; empty if the file has none."""
        return named_in(self.header, "DETECTOR", self.name)

    @property
    def is_acs_wfc(self) -> bool:
        """True for ACS/WFC, the only detector for which stwcs reads time-dependent terms."""
        return self.instrument == "ACS" and self.detector == "WFC"

    @cached_property
    def tdd(self) -> dict[str, float]:
        """Values of all keywords of time-dependent terms, which begin with TDD."""
        return {
            k: float(v)
            for k, v in self.header.items()
            if k.startswith("TDD") and isinstance(v, int | float)
        }

    @property
    def tdd_scheme(self) -> str:
        """Scheme of the drift (see `drift.scheme_of`); 'none' for detectors other than ACS/WFC."""
        return scheme_of(self.tdd) if self.is_acs_wfc else "none"

    @property
    def sigma(self) -> NDArray[np.void] | None:
        """Rows of the HDU SIGMA; None if there is no such HDU."""
        return self._rows_of("SIGMA")

    @property
    def covariance(self) -> NDArray[np.void] | None:
        """Rows of the HDU COVAR; None if there is no such HDU."""
        return self._rows_of("COVAR")

    def _rows_of(self, name: str) -> NDArray[np.void] | None:
        return next((hdu.rows for hdu in self.hdus[2:] if hdu.name == name), None)

    @property
    def chips(self) -> tuple[int, ...]:
        """Chip numbers; the first is the chip that defines the common zero point in stwcs."""
        numbers = {1}
        if "DETCHIP" in self.columns:
            numbers = {max(int(n), 1) for n in self.rows["DETCHIP"]}
        return tuple(sorted(numbers, key=lambda n: (n != _REFERENCE, n)))

    @cached_property
    def stated_chips(self) -> tuple[int, ...]:
        """Chip numbers in DETCHIP; empty if the rows are valid for every chip."""
        if "DETCHIP" not in self.columns:
            return ()
        return tuple(sorted({int(n) for n in self.rows["DETCHIP"] if n > 0}))

    @cached_property
    def directions(self) -> NDArray[np.str_]:
        """DIRECTION of every row, in capitals; FORWARD if there is no such column."""
        if "DIRECTION" not in self.columns:
            return np.full(len(self.rows), "FORWARD")
        return np.char.upper(np.char.strip(self.rows["DIRECTION"]))

    # -- one row ---------------------------------------------------------------------------------

    def row(self, chip: int, filter: Filter = None, direction: str = "FORWARD") -> int:
        """Index of the row that stwcs would use.

        Parameters
        ----------
        chip : int
            Chip number.
        filter : str or sequence of str, optional
            One filter name, or those in both wheels; CLEAR1L, CLEAR2L and so on are equivalent. It
            may be omitted if all rows of the chip have the same coefficients.
        direction : str
            "FORWARD" or "INVERSE".

        Returns
        -------
        int
            Row index, counted from 0.

        Raises
        ------
        InputError
            If no row matches, or if rows differ and no filter is given.
        """
        indices = self.matching_rows(chip, filter, direction)
        location = f"{self.name}, chip {chip}, direction {direction}"
        if not indices.size:
            raise InputError(
                f"there is no row for filter {filter!r}" if filter else "there is no row",
                where=location,
                do="see the table's DETCHIP, DIRECTION and filter columns",
            )
        if filter is None and not self._all_equal(indices):
            raise InputError(
                "the coefficients differ from filter to filter",
                where=location,
                do="name the filter",
            )
        return int(indices[0])

    def matching_rows(self, chip: int, filter: Filter = None, direction: str = "FORWARD") -> Int:
        """Indices of all rows of a chip, filter and direction.

        Parameters
        ----------
        chip, filter, direction
            As in `row`.

        Returns
        -------
        ndarray of int
            Row indices, counted from 0; empty if no row matches.
        """
        rows, columns = self.rows, self.columns
        keep = self.directions == direction.upper()
        if "DETCHIP" in columns:
            keep &= np.isin(rows["DETCHIP"].astype(int), (chip, _ANY_CHIP))
        if filter is not None:
            asked = (filter,) if isinstance(filter, str) else tuple(filter)
            keep &= np.array([serves(names, asked) for names in self.filters()], bool)
        return np.flatnonzero(keep)

    def filters(self) -> list[tuple[str, ...]]:
        """Filter names of every row; empty tuples if the table has no filter columns."""
        columns = [c for c in FILTER_COLUMNS if c in self.columns]
        return [tuple(str(row[c]).strip() for c in columns) for row in self.rows]

    def _all_equal(self, found: Int) -> bool:
        names = [c for c in self.columns if c not in (*FILTER_COLUMNS, "DETCHIP", "DIRECTION")]
        return all((self.rows[name][found] == self.rows[name][found[0]]).all() for name in names)

    def coefficients_of_row(self, row: int) -> tuple[Float, Float]:
        """Coefficients of a row, in the form returned by `coefficients`."""
        record = self.rows[row]
        x, y = (
            np.array(
                [
                    float(record[column])
                    if (column := idctab_column(p, i, j)) in self.columns
                    else 0.0
                    for i, j in self.terms
                ]
            )
            for p in self.prefixes
        )
        return x, y

    def coefficients(
        self, chip: int, filter: Filter = None, direction: str = "FORWARD"
    ) -> tuple[Float, Float]:
        """Coefficients of x^i y^j for the powers (i, j) in `terms`.

        Parameters
        ----------
        chip, filter, direction
            As in `row`.

        Returns
        -------
        cx, cy : ndarray, shape (n_terms,)
            Coefficients as stored in the table, in arcseconds per pixel^(i + j), or in pixels per
            arcsecond^(i + j) for INVERSE rows. The first is CX00 or CY00, or 0 if there is no such
            column.

        Raises
        ------
        InputError
            As for `row`.
        """
        return self.coefficients_of_row(self.row(chip, filter, direction))

    def evaluate(
        self,
        chip: int,
        x: ArrayLike,
        y: ArrayLike,
        *,
        filter: Filter = None,
        direction: str = "FORWARD",
        epoch: float | None = None,
    ) -> tuple[Float, Float]:
        """Positions in the frame of the aperture, computed as in stwcs.

        CX00 and CY00 are ignored. Coefficients are multiplied by SCALE if CX11 is exactly 1 and
        SCALE is not.

        Parameters
        ----------
        chip, filter, direction
            As in `row`.
        x, y : array_like
            FITS 1-based pixels.
        epoch : float, optional
            Decimal year for the time-dependent terms of the 2015 scheme, which are omitted by
            default.

        Returns
        -------
        Xc, Yc : ndarray
            Arcseconds from the reference pixel.

        Raises
        ------
        InputError
            As for `row`; also if an epoch is given and an ACS/WFC table has time-dependent terms of
            a scheme other than that of 2015.
        """
        row = self.row(chip, filter, direction)
        record = self.rows[row]
        coefficients = np.stack(self.coefficients_of_row(row))
        coefficients[:, 0] = 0.0
        scale = round(float(record["SCALE"]), 8)
        if coefficients[0, self.terms.index((1, 0))] == 1.0 and scale != 1.0:
            coefficients *= scale
        if epoch is not None and self.is_acs_wfc:
            coefficients += drift(self.tdd, self.terms, chip, epoch, self.name)
        dx = np.asarray(x, float) - float(record["XREF"])
        dy = np.asarray(y, float) - float(record["YREF"])
        u, v = (evaluate(dict(zip(self.terms, c, strict=True)), dx, dy) for c in coefficients)
        return u, v

    def invert(
        self, chip: int, Xc: ArrayLike, Yc: ArrayLike, *, filter: Filter = None
    ) -> tuple[Float, Float]:
        """Pixels at positions in the frame of the aperture, computed from the INVERSE row.

        Parameters
        ----------
        chip, filter
            As in `row`.
        Xc, Yc : array_like
            Arcseconds from the reference pixel, at the reference date of the drift.

        Returns
        -------
        x, y : ndarray
            FITS 1-based pixels.

        Raises
        ------
        InputError
            As for `row`.
        """
        row = self.row(chip, filter, "INVERSE")
        record = self.rows[row]
        Xc, Yc = np.asarray(Xc, float), np.asarray(Yc, float)
        x, y = (
            evaluate(dict(zip(self.terms[1:], c[1:], strict=True)), Xc, Yc)
            for c in self.coefficients_of_row(row)
        )
        return x + float(record["XREF"]), y + float(record["YREF"])


def read_idctab(path: str | os.PathLike[str]) -> IdcTab:
    """Read an IDCTAB.

    Parameters
    ----------
    path : path-like
        FITS file, optionally compressed.

    Returns
    -------
    IdcTab
        The file, which `write_idctab` writes back unchanged.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is not a FITS file, is truncated, or lacks a part that an IDCTAB must have.

    Examples
    --------
    >>> from bayesdist.formats import idctab_from_solution, read_idctab, write_idctab
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> camera = {"instrument": "WFC3", "detector": "IR", "scale_arcsec": 0.13}
    >>> tab = idctab_from_solution(fit, **camera, filters=["F160W"])
    >>> write_idctab(tab, "test_idc.fits")
    >>> bool((read_idctab("test_idc.fits").rows == tab.rows).all())
    True
    """
    return IdcTab(read_hdus(path), str(path))


def write_idctab(tab: IdcTab, path: str | os.PathLike[str]) -> None:
    """Write an IDCTAB atomically; a file that was read is written back bit by bit.

    Parameters
    ----------
    tab : IdcTab
        IDCTAB to write.
    path : path-like
        Output file. stwcs expects a name that ends in ``_idc.fits``.

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> from bayesdist.formats import idctab_from_solution, read_idctab, write_idctab
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> camera = {"instrument": "WFC3", "detector": "IR", "scale_arcsec": 0.13}
    >>> tab = idctab_from_solution(fit, **camera, filters=["F160W"])
    >>> write_idctab(tab, "test_idc.fits")
    >>> bool((read_idctab("test_idc.fits").rows == tab.rows).all())
    True
    """
    write_hdus(tab.hdus, path)


# -- names of columns -----------------------------------------------------------------------------


_COLUMN = re.compile(r"(CX|CY|A|B)(\d)(\d)")


def idctab_column(prefix: str, i: int, j: int) -> str:
    """Column of an IDCTAB that multiplies x^i y^j: ``idctab_column("CX", 1, 0) == "CX11"``."""
    return f"{prefix}{i + j}{i}"


def idctab_powers(column: str) -> tuple[str, int, int] | None:
    """Prefix and powers (i, j) of x and y of an IDCTAB column; None for any other column."""
    match = _COLUMN.fullmatch(column)
    if match is None or match[3] > match[2]:
        return None
    order, i = int(match[2]), int(match[3])
    return match[1], i, order - i


# -- parities and filter wheels of HST detectors, which IDCTABs lack ------------------------------


_PARITY = {
    ("ACS", "WFC"): (1, -1),
    ("ACS", "HRC"): (-1, 1),
    ("ACS", "SBC"): (-1, 1),
    ("WFC3", "UVIS"): (-1, 1),
    ("WFC3", "IR"): (-1, 1),
}

# FILTER1 and FILTER2 in actual IDCTABs; ramp filters (FR...) are all in the second wheel.
_FIRST = (
    "F475W", "F502N", "F550M", "F555W", "F606W", "F625W", "F658N", "F775W", "F850LP", "F892N",
    "G800L", "POL0UV", "POL60UV", "POL120UV",
)  # fmt: skip
_SECOND = ("F435W", "F660N", "F814W", "POL0V", "POL60V", "POL120V")


def parity_of(instrument: str, detector: str) -> tuple[int, int]:
    """Parities (p0, p1) of a detector; InputError if the detector is unknown."""
    try:
        return _PARITY[instrument.strip().upper(), detector.strip().upper()]
    except KeyError:
        detectors = ", ".join(f"{i}/{d}" for i, d in _PARITY)
        raise InputError(
            f"the parity of {instrument}/{detector} is not known",
            where="products.idctab",
            do=f"choose one of {detectors}",
        ) from None


def combination_of(filter: str | tuple[str, ...], instrument: str) -> tuple[str, ...]:
    """Filter names in all wheels, such as ("F606W", "CLEAR2L") for ACS, with unused wheels clear.

    A single name for other instruments; a tuple is returned unchanged. InputError for an ACS filter
    that is in neither wheel.
    """
    if not isinstance(filter, str):
        return tuple(map(str, filter))
    name = filter.strip().upper()
    if instrument != "ACS":
        return (name,)
    if name.startswith("CLEAR"):
        return ("CLEAR1L", "CLEAR2L")
    if name in _FIRST:
        return (name, "CLEAR2L")
    if name in _SECOND or name.startswith("FR"):
        return ("CLEAR1L", name)
    raise InputError(
        f"the filter wheel of {filter!r} is not known",
        where="filters",
        do='name both wheels, as ("F606W", "CLEAR2L")',
    )


def serves(row: tuple[str, ...], asked: tuple[str, ...]) -> bool:
    """True if a row of an IDCTAB with these filters is valid for the requested ones, as in stwcs.

    All CLEAR positions are equivalent; a row without filters is valid for all.
    """
    if not row:
        return True
    row, asked = (
        tuple("CLEAR" if "CLEAR" in name.upper() else name.strip() for name in names)
        for names in (row, asked)
    )
    if len(asked) == len(row):
        return asked == row
    remaining = [name for name in row if name not in asked]
    return set(asked) - {"CLEAR"} <= set(row) and all(
        name in ("CLEAR", "N/A") for name in remaining
    )
