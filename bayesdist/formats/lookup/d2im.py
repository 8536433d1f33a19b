"""D2IMFILE: look-up tables of the detector, in pixels before the polynomial."""

from __future__ import annotations

import os
from collections.abc import Sequence

from bayesdist.errors import InputError
from bayesdist.formats.lookup.build import (
    Part,
    lookup_file,
    one_per_chip,
    reference_cards,
)
from bayesdist.formats.lookup.file import (
    LookupFile,
    check_kind,
    read_lookup_file,
    write_lookup_file,
)
from bayesdist.model.lookup import LookupTable


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
        [Part(t, t.values, t.sigma) for t in chips],
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
