"""NPOLFILE: shifts of the pixel before the polynomial, written as shifts after it.

A filter's table F adds pixels to (x, y) before the polynomial P; an NPOLFILE holds N, in
undistorted pixels of SCALE along Xc and Yc, that stwcs adds to the value of the polynomial:

    P(x + F(x)) / SCALE = P(x) / SCALE + N(x),     N = J F / SCALE,   J = dP/dx at the node

Left out are the second order in F and the change of J from node to node, of which both sides make a
straight line.  For ACS/WFC and 0.05 px that is some 5e-5 px; every file states its own value.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from bayesdist.errors import DegenerateError, FormatError, InputError
from bayesdist.model.lookup import LookupTable
from bayesdist.products.formats.common.cards import number_card
from bayesdist.products.formats.common.coefficients import evaluate
from bayesdist.products.formats.idctab.table import IdcTab
from bayesdist.products.formats.lookup.build import (
    Part,
    lookup_file,
    one_per_chip,
    reference_cards,
)
from bayesdist.products.formats.lookup.file import (
    LookupFile,
    check_kind,
    read_lookup_file,
    write_lookup_file,
)
from bayesdist.utils.arrays import Float


def write_npol(
    tables: Sequence[LookupTable],
    path: str | os.PathLike[str],
    *,
    idctab: IdcTab,
    filters: Sequence[str],
    description: str = "Filter-dependent distortion with its uncertainty, by bayesdist",
    useafter: str | None = None,
    pedigree: str | None = None,
    history: Sequence[str] = (),
) -> LookupFile:
    """Write the tables of one filter as an NPOLFILE, whole or not at all.

    Parameters
    ----------
    tables : sequence of LookupTable
        At most one for each chip, all of one filter, in pixels before the polynomial.  A chip of
        the IDCTAB without table gets zeros, since stwcs stops where it finds none.
    path : path-like
        Pipelines want a name that ends in ``_npl.fits``.
    idctab : IdcTab
        The polynomial that the file is used with.
    filters : sequence of str
        FILTER1 and FILTER2 (ACS), or FILTER alone: they choose the row of the IDCTAB.
    description : str
        DESCRIP.
    useafter, pedigree : str, optional
        USEAFTER and PEDIGREE, which only the user knows.
    history : sequence of str
        Lines of HISTORY.

    Returns
    -------
    LookupFile
        Written file: single precision, as these files are.  Keyword BDNPLERR of its primary
        header is the largest difference in mas, over all chips, between the polynomial at the
        shifted pixel and the polynomial plus the stored table: at the nodes, halfway between them
        and at the edges of the detector.

    Raises
    ------
    InputError
        For no table, tables of another filter or of none, two tables of a chip, a chip or filters
        that the IDCTAB has not, or a file that cannot be written.
    DegenerateError
        When the linear part of the IDCTAB is singular.

    Notes
    -----
    The IDCTAB is taken at its own epoch: ten years of drift change an ACS/WFC shift of 0.05 px by
    2e-5 px.

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
    where = "NPOLFILE"
    if len(filters) not in (1, 2):
        raise InputError(
            f"the filter combination {tuple(filters)} has {len(filters)} names",
            where=where,
            do="give one for each wheel",
        )
    wanted = _one_name(filters)
    for table in tables:
        if table.filter != wanted:
            raise InputError(
                f"the look-up table {table.label} is not of {' '.join(filters)}, filter {wanted}",
                where=where,
                do="give the tables of this filter, and those of the detector to write_d2im",
            )
    chosen = one_per_chip(tables, where)
    have = {t.chip for t in chosen}
    for chip in idctab.stated_chips:
        if chip not in have:
            like = chosen[0]
            zeros = np.zeros((2, *like.shape))
            chosen.append(LookupTable(chip, zeros, like.filter, like.first, like.step))
    chosen = one_per_chip(chosen, where)
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
    idctab: IdcTab,
    *,
    first: Sequence[float] | None = None,
) -> tuple[LookupTable, ...]:
    """Tables of an NPOLFILE, in pixels before the polynomial.

    Parameters
    ----------
    path : path-like
    idctab : IdcTab
        The polynomial that the file is used with.
    first : sequence of float, optional
        As in `read_d2im`.

    Returns
    -------
    tuple of LookupTable
        One for each chip; its filter is the name that is no CLEAR (see `filter_name`).

    Raises
    ------
    InputError
        When the file cannot be read, or the IDCTAB has no row for its chips and filters.
    FormatError
        When it is no NPOLFILE, or its tables are incomplete or not finite.
    DegenerateError
        When the linear part of the IDCTAB is singular.

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
    """Filter of a file as data name it: without CLEAR; several are joined by '+'.

    FormatError when the file names no filter at all.
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

    def __init__(self, idctab: IdcTab, chip: int, filters: Sequence[str]) -> None:
        self.idctab, self.chip, self.filters = idctab, chip, tuple(filters) or None
        row = idctab.row(chip, self.filters)
        record = idctab.rows[row]
        self.size = (int(record["XSIZE"]), int(record["YSIZE"]))
        self.reference = (float(record["XREF"]), float(record["YREF"]))
        self.scale = round(float(record["SCALE"]), 8)  # as stwcs keeps it
        self._terms = [
            dict(zip(idctab.terms, c.tolist(), strict=True))
            for c in idctab.coefficients_of_row(row)
        ]
        # stwcs takes a first coefficient of exactly 1 as a sign that all are in units of SCALE
        self._unit = 1.0 if self._terms[0][1, 0] == 1.0 else self.scale
        self.linear = self.jacobian(*(np.array([r]) for r in self.reference))[0]
        if self.scale == 0 or not abs(np.linalg.det(self.linear)) > 0:
            raise DegenerateError(
                "the linear part is singular",
                where=f"{idctab.name}, chip {chip}",
                do="check SCALE, CX10, CX11, CY10 and CY11",
            )

    def jacobian(self, x: Float, y: Float) -> Float:
        """Derivatives (..., 2, 2) of (Xc, Yc) by (x, y) over SCALE, at pixels of any shape."""
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

    def part(self, table: LookupTable) -> Part:
        """Table after the polynomial, as it is stored."""
        jacobian = self._at_nodes(table)
        values = np.einsum("yxab,byx->ayx", jacobian, table.values)
        sigma = None
        if table.sigma is not None:
            sigma = np.sqrt(np.einsum("yxab,byx->ayx", jacobian**2, table.sigma**2))
        return Part(table, values, sigma, np.linalg.inv(self.linear))

    def before(self, stored: LookupTable) -> LookupTable:
        """Table before the polynomial, from the stored one."""
        jacobian = self._at_nodes(stored)
        values = _solve(jacobian, stored.values)
        sigma = None
        if stored.sigma is not None:
            # sigmas of other programs may not come from two independent ones before the polynomial
            sigma = np.sqrt(np.maximum(_solve(jacobian**2, stored.sigma**2), 0.0))
        return LookupTable(stored.chip, values, stored.filter, stored.first, stored.step, sigma)

    def error_mas(self, table: LookupTable, stored: Float) -> float:
        """Largest error of the stored table at nodes, halfway between them and at the edges."""
        axes = []
        for nodes, n in zip(table.nodes(), self.size, strict=True):
            places = np.concatenate([nodes, (nodes[1:] + nodes[:-1]) / 2, [0.5, n + 0.5]])
            axes.append(np.unique(np.clip(places, 0.5, n + 0.5)))
        x, y = (a.ravel() for a in np.meshgrid(*axes))
        shift = table.evaluate(x, y)
        single = stored.astype(np.float32).astype(float)
        after = LookupTable(table.chip, single, table.filter, table.first, table.step)
        both = np.stack(self._position(x + shift[:, 0], y + shift[:, 1]), axis=1) - np.stack(
            self._position(x, y), axis=1
        )
        error = both - self.scale * after.evaluate(x, y)
        return float(np.hypot(*error.T).max()) * 1e3

    def _position(self, x: Float, y: Float) -> tuple[Float, Float]:
        return self.idctab.evaluate(self.chip, x, y, filter=self.filters)


def _solve(matrix: Float, values: Float) -> Float:
    """Solutions (2, ny, nx) of (ny, nx, 2, 2) systems for values (2, ny, nx)."""
    right = np.moveaxis(values, 0, -1)[..., None]
    solved = np.asarray(np.linalg.solve(matrix, right)[..., 0], float)
    return np.moveaxis(solved, -1, 0)
