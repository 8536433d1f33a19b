"""All file formats, and functions that work on a file of any format.

Formats are those of all installed plugins (`bayesdist.plugin.Plugin.formats`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import cache
from typing import TYPE_CHECKING

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import FormatError, InputError, required
from bayesdist.files.atomic import refuse_unsafe_name
from bayesdist.plugin import objects
from bayesdist.products.common.content import Content, read_content, readable
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Document,
    Finding,
    Format,
    FormatSettings,
    ReadBack,
    by_calibrations,
    of_chips,
)

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.wcs import WCS


@cache
def all_formats() -> tuple[Format, ...]:
    """All formats, in the order in which they are tried on a file."""
    formats = objects(lambda plugin: plugin.formats, flaw=_flaw).values()
    return tuple(sorted(formats, key=lambda format_: (format_.rank, format_.key)))


def _flaw(format_: object) -> str:
    """Why an object cannot be used as a format; empty if it can."""
    if isinstance(format_, Format):
        return ""
    return "it is not a bayesdist.products.common.document.Format"


def open_document(path: str | os.PathLike[str]) -> Document:
    """Open a file and recognize its format by its content.

    Parameters
    ----------
    path : path-like
        File of any format.

    Returns
    -------
    Document
        Parsed file with its format.

    Raises
    ------
    InputError
        If the file cannot be read or is of no known format.
    FormatError
        If the file is of a known format but damaged.
    """
    return recognized(read_content(path))


def recognized(content: Content) -> Document:
    """Document of content in memory; see `open_document`."""
    with readable(content.name):
        if content.is_fits and all(hdu.state == "whole" for hdu in content.hdus):
            content.refuse_rest()
        for hdu in content.hdus:
            if not isinstance(hdu.header.get("EXTNAME", ""), str):
                raise FormatError(
                    f"the name of HDU {hdu.number} (EXTNAME) is not text",
                    where=content.name,
                    do="correct the card, or write the file again",
                )
    for format_ in all_formats():
        with readable(content.name):
            holds = format_.parse(content)
        if holds is not None:
            return Document(content.name, format_, holds)
    if content.damage is not None:
        raise content.damage
    titles = [format_.title for format_ in all_formats()]
    raise InputError(
        "has an unknown format",
        where=content.name,
        do=f"give {', '.join(titles[:-1])}, or {titles[-1]}"
        if titles
        else "install formats: none is installed, or BAYESDIST_PLUGINS excludes them",
    )


def read_calibration(
    path: str | os.PathLike[str],
    *,
    filter: str | None = None,
    size: tuple[float, float] | None = None,
) -> Calibration:
    """Read a calibration from a file of any format.

    Parameters
    ----------
    path : path-like
        File of any format that holds a calibration.
    filter : str, optional
        Filter or band, if the file has several calibrations.
    size : tuple of float, optional
        Columns and rows, for a header that does not state them.

    Returns
    -------
    Calibration
        Calibration with its covariance if the file states one.

    Raises
    ------
    InputError
        If the file holds no calibration, does not have the filter, needs a filter or band, or is a
        SIP header without a size.
    """
    return open_document(path).calibration(Choice(filter, size))


def describe(path: str | os.PathLike[str]) -> str:
    """Text that describes a calibration file of any format, with the findings of its checks.

    Parameters
    ----------
    path : path-like
        File of any format.

    Returns
    -------
    str
        Several lines, as printed by `bayesdist inspect`.

    Raises
    ------
    InputError
        If the file cannot be read or is of no known format.

    Examples
    --------
    >>> from bayesdist.formats import describe
    >>> rng = np.random.default_rng(1)
    >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    >>> model = bd.DistortionModel(1, (chip,), "arcsec")
    >>> stars, _ = bd.simulate_matches(model, [0, 100, 0, 0, 0, 100], 500, sigma=0.01, rng=rng)
    >>> calibration = bd.Calibration.from_solution(bd.fit_linear(stars, model))
    >>> written = calibration.write("parameters", "camera.fits")
    >>> print(describe("camera.fits").splitlines()[0])
    camera.fits: parameters of a calibration, by bayesdist
    """
    return open_document(path).describe()


def lint(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Check a calibration file of any format for errors and peculiarities.

    Parameters
    ----------
    path : path-like
        File of any format.

    Returns
    -------
    tuple of Finding
        Findings, each with `level` ('error', 'warning' or 'note'), `where` and `message`.

    Raises
    ------
    InputError
        If the file cannot be read or is of no known format.

    Examples
    --------
    >>> from bayesdist.formats import lint
    >>> rng = np.random.default_rng(1)
    >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    >>> model = bd.DistortionModel(1, (chip,), "arcsec")
    >>> stars, _ = bd.simulate_matches(model, [0, 100, 0, 0, 0, 100], 500, sigma=0.01, rng=rng)
    >>> calibration = bd.Calibration.from_solution(bd.fit_linear(stars, model))
    >>> written = calibration.write("parameters", "camera.fits")
    >>> lint("camera.fits")
    ()
    """
    return open_document(path).lint()


def product_settings() -> dict[str, type[FormatSettings]]:
    """Settings of the formats that can be built, by key: the sections of [products]."""
    return {
        format_.key: format_.settings for format_ in all_formats() if format_.settings is not None
    }


def format_of(key: str) -> Format:
    """Format that can be built, by its key.

    Raises InputError if there is none.
    """
    for format_ in all_formats():
        if format_.key == key and format_.build is not None:
            return format_
    names = sorted(product_settings())
    near = get_close_matches(str(key).lower(), names, n=1, cutoff=0.5)
    meant = f"use {near[0]!r} if that is meant, or " if near else ""
    raise InputError(
        f"there is no format {key!r} that can be built",
        do=f"{meant}choose one of {', '.join(names)}",
    )


def fits_wcs(key: str, calibration: Calibration, point: tuple[float, float]) -> WCS:
    """`astropy.wcs.WCS` of a one-chip calibration in a format; see `Format.fits_wcs`."""
    function = required(format_of(key).fits_wcs, f"the format {key!r} is not read by astropy.wcs")
    return function(calibration, point)


def list_formats() -> Table:
    """Table of all calibration file formats.

    Returns
    -------
    astropy.table.Table
        One row per format: `name`, as accepted by `bayesdist.Calibration.write`; `title`; and
        whether files of that format can be `read` as a calibration, `written` from one, and hold
        look-up `tables` and the dependence on `time`.

    Examples
    --------
    >>> from bayesdist.formats import list_formats
    >>> formats = list_formats()
    >>> formats.add_index("name")
    >>> bool(formats.loc["sip"]["read"]), bool(formats.loc["sip"]["written"])
    (True, True)
    """
    from astropy.table import Table

    rows = [
        (
            entry.key,
            entry.title.removeprefix("a ").removeprefix("an "),
            entry.calibration is not None,
            entry.build is not None,
            entry.holds_tables,
            entry.holds_time,
        )
        for entry in sorted(all_formats(), key=lambda entry: entry.key)
    ]
    return Table(rows=rows, names=("name", "title", "read", "written", "tables", "time"))


def build(
    key: str,
    calibration: Calibration,
    settings: FormatSettings,
    options: BuildOptions = BuildOptions(),  # noqa: B008
) -> tuple[Built, ...]:
    """Build the files of a format in memory.

    Raises InputError for a calibration that the format cannot represent.
    """
    format_ = format_of(key)
    if calibration.model.order > format_.highest_order:
        raise InputError(
            f"the order is {calibration.model.order}, but polynomials of {format_.title} are "
            f"limited to order {format_.highest_order}",
            where=f"products.{key}",
            do=f"give order {format_.highest_order} (--order of convert), or choose another format",
        )
    if format_.holds_tables and not calibration.before:
        calibration = replace(calibration, before=options.tables)
    files = required(format_.build, f"files of {format_.title} cannot be built")(
        calibration, settings, options
    )
    for file in files:
        refuse_unsafe_name(file.file_name, where=f"products.{key}")
    return files


def read_back(
    key: str, files: Sequence[Built], calibration: Calibration, options: BuildOptions
) -> Sequence[ReadBack]:
    """Positions computed from the files of a format.

    `calibration` and `options` are those that the files were built from. By default, files are read
    as other programs read them, without their stored parameters, and several files of one chip each
    are combined into one.
    """
    reader = format_of(key).read_back
    if reader is not None:
        return reader(files, calibration, options)
    parts: dict[int, ReadBack] = {}
    for built in files:
        if built.kind == PARAMETERS:
            continue
        document = recognized(Content(built.file_name, built.content))
        used = document.calibration(Choice(as_used=True))
        chips = used.numbers if built.chip is None else (built.chip,)
        part = by_calibrations(built.file_name, [used], calibration.model.time)
        parts |= dict.fromkeys(chips, part)
    return [of_chips(parts)]
