"""`bayesdist rvb`: RvB pairs with their reference positions transformed, frame by frame or all."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import radians
from pathlib import Path

from bayesdist.data import (
    MatchTable,
    RvbPairs,
    RvbTransform,
    read_solutions,
    rereference,
    stream_rvb,
    transformed,
    write_rvb,
)
from bayesdist.data.rvb import chosen_band
from bayesdist.data.rvb_files import ARRAY_SIZE, open_rvb_files
from bayesdist.errors import InputError

__all__ = ["rereference_files", "transform_files"]


def transform_files(options: argparse.Namespace) -> str:
    """Pairs with all reference positions moved by one linear transformation.

    Parameters
    ----------
    options : argparse.Namespace
        Of the command line: files, output, band, column; dx, dy, rotation in degrees, scale_x,
        scale_y.

    Returns
    -------
    str
        What to print.

    Raises
    ------
    InputError
        For no transformation, and as `stream_rvb`, `transformed` and `write_rvb`.
    """
    transform = RvbTransform(
        options.dx, options.dy, radians(options.rotation), options.scale_x, options.scale_y
    )
    if transform == RvbTransform():
        raise InputError(
            "no transformation is asked for",
            where="bayesdist rvb transform",
            do="give --dx, --dy, --rotation, --scale-x or --scale-y",
        )
    band = _band(options)
    transform = replace(transform, centre=_centre(band))
    return _written(options, band, lambda matches: transformed(matches, transform))


def rereference_files(options: argparse.Namespace) -> str:
    """Pairs brought from the frame solutions that they were made with to others.

    Parameters
    ----------
    options : argparse.Namespace
        Of the command line: files, output, band, column; free, fixed (tables of solutions).

    Returns
    -------
    str
        What to print.

    Raises
    ------
    InputError
        As `stream_rvb`, `read_solutions`, `rereference` and `write_rvb`.
    """
    band = _band(options)
    free, fixed = (
        read_solutions(path, centre=_centre(band)) for path in (options.free, options.fixed)
    )
    return _written(options, band, lambda matches: rereference(matches, free, fixed))


def _columns(options: argparse.Namespace) -> dict[str, str]:
    out = {}
    for text in options.column:
        key, equals, name = text.partition("=")
        if not equals:
            raise InputError(
                f"{text!r} names no column", where="--column", do="give KEY=NAME, as in u=U2MASS"
            )
        out[key] = name
    return out


def _band(options: argparse.Namespace) -> str:
    return chosen_band(open_rvb_files(options.files, _columns(options)), options.band)


def _centre(band: str) -> tuple[float, float]:
    nx, ny = ARRAY_SIZE[band]
    return (nx + 1) / 2, (ny + 1) / 2


def _written(
    options: argparse.Namespace, band: str, move: Callable[[MatchTable], MatchTable]
) -> str:
    output = Path(options.output).resolve()
    for path in map(Path, options.files):
        if path.is_dir() and output.is_relative_to(path.resolve()):
            raise InputError(
                "lies inside the folder of its input",
                where=options.output,
                do="choose a folder outside of it",
            )

    def moved() -> Iterator[RvbPairs]:
        for pairs in stream_rvb(options.files, band=band, columns=_columns(options)):
            yield replace(pairs, matches=move(pairs.matches))

    n = write_rvb(moved(), options.output)
    return f"{options.output}: {n} pairs of {band}; calibrate them with data.format = 'rvb'"
