"""All formats, and functions for a file of any of them.

A format is a module of `bayesdist.products.formats`, or the module `format` of a folder there, that
has a FORMAT: a new one is found by that alone.
"""

from __future__ import annotations

import os
import pkgutil
from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError, required
from bayesdist.files.atomic import refuse_unsafe_name
from bayesdist.products import formats
from bayesdist.products.formats.common.content import Content, read_content, readable
from bayesdist.products.formats.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Document,
    Finding,
    Format,
    FormatSettings,
)
from bayesdist.products.formats.common.read_back import ReadBack, by_calibrations, of_chips

if TYPE_CHECKING:
    from astropy.table import Table


@cache
def all_formats() -> tuple[Format, ...]:
    """Formats in the order in which a file is tried against them."""
    found = []
    for entry in pkgutil.iter_modules(formats.__path__):
        if entry.name == "common":
            continue
        name = f"{formats.__name__}.{entry.name}" + (".format" if entry.ispkg else "")
        one = getattr(import_module(name), "FORMAT", None)
        if one is not None:
            found.append(one)
    return tuple(sorted(found, key=lambda one: one.rank))


def open_document(path: str | os.PathLike[str]) -> Document:
    """Document of a file, whose format is recognized by its content.

    InputError when the file cannot be read or is of no format. FormatError when it is of a format
    and broken.
    """
    return recognized(read_content(path))


def recognized(content: Content) -> Document:
    """Document of content in memory; as `open_document`."""
    for one in all_formats():
        with readable(content.name):
            holds = one.parse(content)
        if holds is not None:
            return Document(content.name, one, holds)
    if content.damage is not None:
        raise content.damage
    *others, last = (one.title for one in all_formats())
    raise InputError(
        "is of no kind that is understood here",
        where=content.name,
        do=f"give {', '.join(others)}, or {last}",
    )


def read_calibration(
    path: str | os.PathLike[str],
    *,
    filter: str | None = None,
    size: tuple[float, float] | None = None,
) -> Calibration:
    """Calibration of a file of any format.

    `filter`, `size`: as in `Choice`. InputError for a file that holds none, a filter or band that
    it does not have or that has to be named, or a SIP header without a size.
    """
    return open_document(path).calibration(Choice(filter, size))


def describe(path: str | os.PathLike[str]) -> str:
    """Text on the content of a calibration file of any format, with its findings.

    Parameters
    ----------
    path : path

    Returns
    -------
    str
        Several lines, as `bayesdist inspect` prints them.

    Raises
    ------
    InputError
        For a file that cannot be read or is of no known format.

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
    """Faults and peculiarities of a calibration file of any format.

    Parameters
    ----------
    path : path

    Returns
    -------
    tuple of Finding
        Each with `level` ('error', 'warning' or 'note'), `where` and `message`.

    Raises
    ------
    InputError
        For a file that cannot be read or is of no known format.

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
    return {one.key: one.settings for one in all_formats() if one.settings is not None}


def format_of(key: str) -> Format:
    """Format of a key that can be built; InputError where there is none."""
    for one in all_formats():
        if one.key == key and one.build is not None:
            return one
    names = sorted(product_settings())
    near = get_close_matches(str(key).lower(), names, n=1, cutoff=0.5)
    meant = f"use {near[0]!r} if that is meant, or " if near else ""
    raise InputError(
        f"there is no format {key!r} that can be built",
        do=f"{meant}choose one of {', '.join(names)}",
    )


def list_formats() -> Table:
    """Formats of calibration files.

    Returns
    -------
    astropy.table.Table
        One row for each format: `name`, as `bayesdist.Calibration.write` takes it; `title`; and
        whether files of it can be `read` as a calibration, `written` from one, and hold look-up
        `tables` and the dependence on `time`.

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
    """Files of a format, built and not written; values that the format cannot hold are refused."""
    one = format_of(key)
    if calibration.model.order > one.highest_order:
        raise InputError(
            f"the order is {calibration.model.order}, and polynomials of {one.title} go "
            f"up to order {one.highest_order}",
            where=f"products.{key}",
            do=f"give order {one.highest_order} (--order of convert), or choose another format",
        )
    if one.holds_tables and not calibration.before:
        calibration = replace(calibration, before=options.tables)
    files = required(one.build, f"files of {one.title} cannot be built")(
        calibration, settings, options
    )
    for file in files:
        refuse_unsafe_name(file.file_name, where=f"products.{key}")
    return files


def read_back(
    key: str, files: Sequence[Built], calibration: Calibration, options: BuildOptions
) -> Sequence[ReadBack]:
    """What files of a format say of positions; they were built of a calibration with options.

    By default files are read as other programs have them, without those that stand beside them for
    their covariance; several files, each of one chip, are one.
    """
    found = format_of(key).read_back
    if found is not None:
        return found(files, calibration, options)
    parts: dict[int, ReadBack] = {}
    for one in files:
        if one.kind == PARAMETERS:
            continue
        document = recognized(Content(one.file_name, one.content))
        used = document.calibration(Choice(as_used=True))
        chips = used.numbers if one.chip is None else (one.chip,)
        part = by_calibrations(one.file_name, [used], calibration.model.time)
        parts |= dict.fromkeys(chips, part)
    return [of_chips(parts)]
