"""Look-up tables written to and read from a D2IMFILE (detector) or NPOLFILE (filter).

The tables of a D2IMFILE are pixel shifts before the polynomial, like ours. The table F of a filter
is also added to pixels (x, y) before the polynomial P, but an NPOLFILE holds N, in undistorted
pixels of SCALE along Xc and Yc, which stwcs adds to the value of the polynomial:

    P(x + F(x)) / SCALE = P(x) / SCALE + N(x),     N = J F / SCALE,   J = dP/dx at the node

This neglects the second order in F, and the change of J between nodes, where both sides are
interpolated linearly. For ACS/WFC and shifts of 0.05 px the error is about 5e-5 px; every file
states its error.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError, FormatError, InputError
from bayesdist.formats.lookup.file import (
    ChipTables,
    LookupFile,
    check_kind,
    lookup_file,
    one_per_chip,
    read_lookup_file,
    reference_cards,
    write_lookup_file,
)
from bayesdist.model.lookup import LookupTable
from bayesdist.products.common.cards import number_card
from bayesdist.products.common.coefficients import evaluate
from bayesdist.utils.arrays import Float


def write_d2im(
    tables: Sequence[LookupTable],
    path: str | os.PathLike[str],
    *,
    instrument: str = "ACS",
    detector: str = "WFC",
    size: tuple[int, int] = (4096, 2048),
    description: str = "Pixel-grid distortion with its uncertainty, by bayesdist",
    useafter: str | None = None,
    pedigree: str | None = None,
    history: Sequence[str] = (),
) -> LookupFile:
    """Write the detector's look-up tables as a D2IMFILE, atomically.

    Parameters
    ----------
    tables : sequence of LookupTable
        At most one table per chip, without a filter. If they have standard errors, these are
        written to extensions SIGMA_DX and SIGMA_DY.
    path : path-like
        Output file. Pipelines expect a name that ends in ``_d2i.fits``.
    instrument, detector : str
        INSTRUME and DETECTOR.
    size : tuple of int
        Columns and rows of a chip.
    description : str
        DESCRIP.
    useafter, pedigree : str, optional
        USEAFTER ("Mar 01 2002 00:00:00") and PEDIGREE ("INFLIGHT 01/05/2006"); omitted by default.
    history : sequence of str
        Lines of HISTORY.

    Returns
    -------
    LookupFile
        The written file, in single precision as is usual for these files.

    Raises
    ------
    InputError
        If there is no table, two tables for one chip, or a table of a filter, or if the file cannot
        be written.

    Examples
    --------
    >>> from bayesdist.formats import read_d2im, write_d2im
    >>> tables = [bd.LookupTable(chip, np.full((2, 32, 64), 0.1)) for chip in (1, 2)]
    >>> file = write_d2im(tables, "test_d2i.fits")
    >>> sorted(table.chip for table in read_d2im("test_d2i.fits"))
    [1, 2]
    """
    location = "D2IMFILE"
    for table in tables:
        if table.filter:
            raise InputError(
                f"the look-up table {table.label} is not a table of the detector",
                where=location,
                do="give the tables of filters to write_npol",
            )
    chips, kind = one_per_chip(tables, location), f"{detector} D2I FILE"
    file = lookup_file(
        [ChipTables(t, t.values, t.sigma) for t in chips],
        size=size,
        cards=reference_cards(
            instrument, detector, kind, description, {}, useafter, pedigree, history
        ),
        name=str(path),
    )
    write_lookup_file(file, path)
    return file


def read_d2im(
    path: str | os.PathLike[str], *, first: Sequence[float] | None = None
) -> tuple[LookupTable, ...]:
    """Read the detector's look-up tables from a D2IMFILE.

    Parameters
    ----------
    path : path-like
        D2IMFILE.
    first : sequence of float, optional
        Pixel (x, y) of the first node, overriding the file. It is needed for files without CRPIX
        and CRVAL, which older programs register at pixel 1 and astropy.wcs since 6.1 at pixel 64.

    Returns
    -------
    tuple of LookupTable
        One table per chip, registered as in astropy.wcs.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is not a D2IMFILE, or if its tables are incomplete or not finite.

    Examples
    --------
    >>> from bayesdist.formats import read_d2im, write_d2im
    >>> tables = [bd.LookupTable(chip, np.full((2, 32, 64), 0.1)) for chip in (1, 2)]
    >>> file = write_d2im(tables, "test_d2i.fits")
    >>> sorted(table.chip for table in read_d2im("test_d2i.fits"))
    [1, 2]
    """
    file = read_lookup_file(path)
    check_kind(file, "d2im")
    return tuple(file.table(chip, first=first) for chip in file.chips)


class PolynomialTable(Protocol):
    """Table with the polynomials of the chips, such as an `IdcTab`, as far as it is used."""

    @property
    def name(self) -> str:
        """Name of the file, for error messages."""

    @property
    def instrument(self) -> str:
        """INSTRUME."""

    @property
    def detector(self) -> str:
        """DETECTOR."""

    @property
    def stated_chips(self) -> tuple[int, ...]:
        """Chip numbers; empty if the rows are valid for every chip."""

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Powers of x and y of the coefficients."""

    @property
    def rows(self) -> NDArray[np.void]:
        """Rows with XSIZE, YSIZE, XREF, YREF and SCALE."""

    def row(self, chip: int, filter: tuple[str, ...] | None = None) -> int:
        """Index of the row of a chip and filter."""

    def coefficients_of_row(self, row: int) -> tuple[Float, Float]:
        """Coefficients of Xc and Yc."""

    def evaluate(
        self, chip: int, x: Float, y: Float, *, filter: tuple[str, ...] | None = None
    ) -> tuple[Float, Float]:
        """Xc and Yc at the reference date."""


def write_npol(
    tables: Sequence[LookupTable],
    path: str | os.PathLike[str],
    *,
    idctab: PolynomialTable,
    filters: Sequence[str],
    description: str = "Filter-dependent distortion with its uncertainty, by bayesdist",
    useafter: str | None = None,
    pedigree: str | None = None,
    history: Sequence[str] = (),
) -> LookupFile:
    """Write the look-up tables of one filter as an NPOLFILE, atomically.

    Parameters
    ----------
    tables : sequence of LookupTable
        At most one table per chip, all for one filter, in pixels before the polynomial. A chip of
        the IDCTAB without a table gets zeros, because stwcs stops if a table is missing.
    path : path-like
        Output file. Pipelines expect a name that ends in ``_npl.fits``.
    idctab : PolynomialTable
        IDCTAB with the polynomial that the file will be used with.
    filters : sequence of str
        FILTER1 and FILTER2 (ACS), or FILTER alone. They select the row of the IDCTAB.
    description : str
        DESCRIP.
    useafter, pedigree : str, optional
        USEAFTER and PEDIGREE; omitted by default.
    history : sequence of str
        Lines of HISTORY.

    Returns
    -------
    LookupFile
        The written file, in single precision as is usual for these files. The keyword BDNPLERR of
        its primary header is the largest difference in mas, over all chips, between the polynomial
        at the shifted pixel and the polynomial plus the stored table: at the nodes, halfway between
        them and at the edges of the detector.

    Raises
    ------
    InputError
        If there is no table, a table of another filter or of none, two tables for one chip, or a
        chip or filter that the IDCTAB does not have, or if the file cannot be written.
    DegenerateError
        If the linear part of the IDCTAB is singular.

    Notes
    -----
    The IDCTAB is evaluated at its reference date: ten years of drift change an ACS/WFC shift of
    0.05 px by 2e-5 px.

    Examples
    --------
    >>> from bayesdist.formats import idctab_from_solution, read_npol, write_npol
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> camera = {"instrument": "WFC3", "detector": "IR", "scale_arcsec": 0.13}
    >>> tab = idctab_from_solution(fit, **camera, filters=["F160W"])
    >>> table = bd.LookupTable(1, np.full((2, 32, 64), 0.1), filter="F160W")
    >>> file = write_npol([table], "test_npl.fits", idctab=tab, filters=("F160W",))
    >>> (back,) = read_npol("test_npl.fits", tab)
    >>> np.allclose(back.values, 0.1)
    True
    """
    location = "NPOLFILE"
    if len(filters) not in (1, 2):
        raise InputError(
            f"the filter combination {tuple(filters)} has {len(filters)} names",
            where=location,
            do="give one for each wheel",
        )
    wanted = _one_name(filters)
    for table in tables:
        if table.filter != wanted:
            raise InputError(
                f"the look-up table {table.label} is not of {' '.join(filters)}, filter {wanted}",
                where=location,
                do="give the tables of this filter, and those of the detector to write_d2im",
            )
    chosen = one_per_chip(tables, location)
    have = {t.chip for t in chosen}
    for chip in idctab.stated_chips:
        if chip not in have:
            like = chosen[0]
            zeros = np.zeros((2, *like.shape))
            chosen.append(LookupTable(chip, zeros, like.filter, like.first, like.step))
    chosen = one_per_chip(chosen, location)
    parts, worst, size = [], 0.0, (0, 0)
    for table in chosen:
        local = _Local(idctab, table.chip, filters)
        size = local.size
        part = local.part(table)
        worst = max(worst, local.error_mas(table, part.values))
        parts.append(part)
    labels = ("FILTER1", "FILTER2") if len(filters) == 2 else ("FILTER",)
    cards = reference_cards(
        idctab.instrument,
        idctab.detector,
        "DXY GRID",
        description,
        dict(zip(labels, filters, strict=False)),
        useafter,
        pedigree,
        history,
    )
    cards.append(number_card("BDNPLERR", worst, "[mas] largest error of the linear form"))
    file = lookup_file(parts, size=size, cards=cards, name=str(path))
    write_lookup_file(file, path)
    return file


def read_npol(
    path: str | os.PathLike[str],
    idctab: PolynomialTable,
    *,
    first: Sequence[float] | None = None,
) -> tuple[LookupTable, ...]:
    """Read the look-up tables of an NPOLFILE, converted to pixels before the polynomial.

    Parameters
    ----------
    path : path-like
        NPOLFILE.
    idctab : PolynomialTable
        IDCTAB with the polynomial that the file is used with.
    first : sequence of float, optional
        Pixel (x, y) of the first node, as in `read_d2im`.

    Returns
    -------
    tuple of LookupTable
        One table per chip. Its filter is the name that is not CLEAR (see `filter_name`).

    Raises
    ------
    InputError
        If the file cannot be read, or if the IDCTAB has no row for its chips and filters.
    FormatError
        If it is not an NPOLFILE, or if its tables are incomplete or not finite.
    DegenerateError
        If the linear part of the IDCTAB is singular.

    Examples
    --------
    >>> from bayesdist.formats import idctab_from_solution, read_npol, write_npol
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, _ = simulate_wise(500, rng=np.random.default_rng(1))
    >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
    >>> camera = {"instrument": "WFC3", "detector": "IR", "scale_arcsec": 0.13}
    >>> tab = idctab_from_solution(fit, **camera, filters=["F160W"])
    >>> table = bd.LookupTable(1, np.full((2, 32, 64), 0.1), filter="F160W")
    >>> file = write_npol([table], "test_npl.fits", idctab=tab, filters=("F160W",))
    >>> (back,) = read_npol("test_npl.fits", tab)
    >>> np.allclose(back.values, 0.1)
    True
    """
    file = read_lookup_file(path)
    check_kind(file, "npol")
    out = []
    for chip in file.chips:
        stored = file.table(chip, filter=filter_name(file), first=first)
        out.append(_Local(idctab, chip, file.filters).before(stored))
    return tuple(out)


def filter_name(file: LookupFile) -> str:
    """Filter of a file without CLEAR; several filters are joined by '+'.

    FormatError if the file names no filter at all.
    """
    if not file.filters:
        raise FormatError(
            "names no filter", where=file.name, do="add the keywords FILTER1 and FILTER2"
        )
    return _one_name(file.filters)


def _one_name(filters: Sequence[str]) -> str:
    return "+".join(n for n in filters if "CLEAR" not in n.upper()) or filters[0]


class _Local:
    """Polynomial of one chip and its derivatives, in units of SCALE."""

    def __init__(self, idctab: PolynomialTable, chip: int, filters: Sequence[str]) -> None:
        self.idctab, self.chip, self.filters = idctab, chip, tuple(filters) or None
        row = idctab.row(chip, self.filters)
        record = idctab.rows[row]
        self.size = (int(record["XSIZE"]), int(record["YSIZE"]))
        self.reference = (float(record["XREF"]), float(record["YREF"]))
        self.scale = round(float(record["SCALE"]), 8)  # rounded as in stwcs
        self._terms = [
            dict(zip(idctab.terms, c.tolist(), strict=True))
            for c in idctab.coefficients_of_row(row)
        ]
        # in stwcs, a first coefficient of exactly 1 means that all are in units of SCALE
        self._unit = 1.0 if self._terms[0][1, 0] == 1.0 else self.scale
        self.linear = self.jacobian(*(np.array([r]) for r in self.reference))[0]
        if self.scale == 0 or not abs(np.linalg.det(self.linear)) > 0:
            raise DegenerateError(
                "the linear part is singular",
                where=f"{idctab.name}, chip {chip}",
                do="check SCALE, CX10, CX11, CY10 and CY11",
            )

    def jacobian(self, x: Float, y: Float) -> Float:
        """Derivatives (..., 2, 2) of (Xc, Yc) / SCALE with respect to (x, y)."""
        dx, dy = x - self.reference[0], y - self.reference[1]
        out = np.empty((*x.shape, 2, 2))
        for a, terms in enumerate(self._terms):
            by_x = {(i - 1, j): i * c for (i, j), c in terms.items() if i}
            by_y = {(i, j - 1): j * c for (i, j), c in terms.items() if j}
            out[..., a, 0] = evaluate(by_x, dx, dy) / self._unit
            out[..., a, 1] = evaluate(by_y, dx, dy) / self._unit
        return out

    def _at_nodes(self, table: LookupTable) -> Float:
        return self.jacobian(*np.meshgrid(*table.nodes()))

    def part(self, table: LookupTable) -> ChipTables:
        """Convert a table before the polynomial to the stored form, after it."""
        jacobian = self._at_nodes(table)
        values = np.einsum("yxab,byx->ayx", jacobian, table.values)
        sigma = None
        if table.sigma is not None:
            sigma = np.sqrt(np.einsum("yxab,byx->ayx", jacobian**2, table.sigma**2))
        return ChipTables(table, values, sigma, np.linalg.inv(self.linear))

    def before(self, stored: LookupTable) -> LookupTable:
        """Convert a stored table, after the polynomial, to one before it."""
        jacobian = self._at_nodes(stored)
        values = _solve(jacobian, stored.values)
        sigma = None
        if stored.sigma is not None:
            # sigmas of other programs may not correspond to independent ones before the polynomial
            sigma = np.sqrt(np.maximum(_solve(jacobian**2, stored.sigma**2), 0.0))
        return LookupTable(stored.chip, values, stored.filter, stored.first, stored.step, sigma)

    def error_mas(self, table: LookupTable, stored: Float) -> float:
        """Largest error (mas) of the stored table at nodes, halfway between them and at edges."""
        axes = []
        for nodes, n in zip(table.nodes(), self.size, strict=True):
            places = np.concatenate([nodes, (nodes[1:] + nodes[:-1]) / 2, [0.5, n + 0.5]])
            axes.append(np.unique(np.clip(places, 0.5, n + 0.5)))
        x, y = (a.ravel() for a in np.meshgrid(*axes))
        shift = table.evaluate(x, y)
        single = stored.astype(np.float32).astype(float)
        after = LookupTable(table.chip, single, table.filter, table.first, table.step)
        exact = np.stack(self._position(x + shift[:, 0], y + shift[:, 1]), axis=1) - np.stack(
            self._position(x, y), axis=1
        )
        error = exact - self.scale * after.evaluate(x, y)
        return float(np.hypot(*error.T).max()) * 1e3

    def _position(self, x: Float, y: Float) -> tuple[Float, Float]:
        return self.idctab.evaluate(self.chip, x, y, filter=self.filters)


def _solve(matrix: Float, values: Float) -> Float:
    """Solutions (2, ny, nx) of (ny, nx, 2, 2) systems with right-hand sides (2, ny, nx)."""
    right = np.moveaxis(values, 0, -1)[..., None]
    solved = np.asarray(np.linalg.solve(matrix, right)[..., 0], float)
    return np.moveaxis(solved, -1, 0)
