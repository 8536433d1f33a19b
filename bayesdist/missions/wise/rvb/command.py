"""`bayesdist wise rvb`: RvB pairs with transformed reference positions, frame by frame or all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from math import radians
from operator import add
from pathlib import Path

from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.missions.wise.pairs.files import open_rvb_files
from bayesdist.missions.wise.pairs.read import chosen_band, stream_rvb
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs
from bayesdist.missions.wise.pairs.write import write_rvb
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.missions.wise.rvb.linear import fit_transform, linear_moments
from bayesdist.missions.wise.rvb.solutions import read_solutions
from bayesdist.missions.wise.rvb.transform import RvbTransform, rereference, transformed

__all__ = ["rereference_files", "transform_files"]


def transform_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    band: str | None = None,
    columns: Mapping[str, str] | None = None,
    dx: float = 0.0,
    dy: float = 0.0,
    rotation: float = 0.0,
    scale_x: float = 0.0,
    scale_y: float = 0.0,
    fit: bool = False,
) -> str:
    """Pairs with all reference positions moved by one linear transformation.

    `output`: new folder. `band`: needed where the files hold several. `columns`: as `stream_rvb`.
    `dx`, `dy`: pixels. `rotation`: degrees, from x towards y. `scale_x`, `scale_y`: relative to
    one. `fit`: the five parameters are those that bring reference positions to the detections, by
    least squares. Returns the text to print. InputError for no transformation, one that is both
    given and to be fitted, and as `stream_rvb`, `transformed` and `write_rvb`.
    """
    transform = RvbTransform(dx, dy, radians(rotation), scale_x, scale_y)
    if (transform == RvbTransform()) != fit:
        raise InputError(
            "a transformation is given, and one is to be fitted"
            if fit
            else "no transformation is asked for",
            where="bayesdist wise rvb transform",
            do="give --fit, or --dx, --dy, --rotation, --scale-x or --scale-y",
        )
    columns = columns or {}
    band = _band(files, band, columns)
    found = ""
    if fit:
        pieces = stream_rvb(files, band=band, columns=columns)
        best = fit_transform(
            reduce(add, (linear_moments(one.matches, WISE_ARRAYS[band].centre) for one in pieces))
        )
        transform, found = best.transform, f"\n{best.sentence}"
    else:
        transform = replace(transform, centre=WISE_ARRAYS[band].centre)
    written = _written(
        files, output, band, columns, lambda matches: transformed(matches, transform)
    )
    return written + found


def rereference_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    free: str | Path,
    fixed: str | Path,
    band: str | None = None,
    columns: Mapping[str, str] | None = None,
) -> str:
    """Pairs brought from the frame solutions that they were made with to others.

    `output`: new folder. `free`, `fixed`: Tables of solutions: those of the pairs, and those that
    they are brought to. `band`, `columns`: as of `transform_files`. Returns the text to print.
    InputError as `stream_rvb`, `read_solutions`, `rereference` and `write_rvb`.
    """
    columns = columns or {}
    band = _band(files, band, columns)
    old, new = (read_solutions(path, centre=WISE_ARRAYS[band].centre) for path in (free, fixed))
    return _written(files, output, band, columns, lambda matches: rereference(matches, old, new))


def _band(files: Sequence[str | Path], band: str | None, columns: Mapping[str, str]) -> str:
    return chosen_band(open_rvb_files(files, columns), band)


def _written(
    files: Sequence[str | Path],
    output: str | Path,
    band: str,
    columns: Mapping[str, str],
    move: Callable[[Matches], Matches],
) -> str:
    for path in map(Path, files):
        if path.is_dir() and Path(output).resolve().is_relative_to(path.resolve()):
            raise InputError(
                "lies inside the folder of its input",
                where=str(output),
                do="choose a folder outside of it",
            )

    def moved() -> Iterator[RvbPairs]:
        for pairs in stream_rvb(files, band=band, columns=columns):
            yield replace(pairs, matches=move(pairs.matches))

    n = write_rvb(moved(), output)
    return f"{output}: {n} pairs of {band}; calibrate them with data.format = 'rvb'"
