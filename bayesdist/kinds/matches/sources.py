"""Reading of the matches of a section [data], in memory or on disk, including mission formats."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

from bayesdist.app.config import ChipBlock
from bayesdist.app.stars import RunInput
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches, input_files, open_matches, read_matches
from bayesdist.data.reading.options import ReadArguments
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import InputError
from bayesdist.kinds.matches.config import Data
from bayesdist.plugin import mission_objects

IN_MEMORY = 1_000_000  # rows of Parquet above which tables stay on disk

PathLike = str | os.PathLike[str]


def load_matches(
    path: PathLike | Sequence[PathLike], *, format: str = "auto", **options: Unpack[ReadArguments]
) -> Matches:
    """Read matches of any known format; large Parquet tables stay on disk.

    Arguments are those of `read_matches`.
    """
    if format in ("auto", "table") and is_large(path):
        if options.pop("not_finite", "refuse") == "reject":
            raise InputError(
                f"rows of tables of more than {IN_MEMORY} rows cannot be left out in reading",
                where="data.not_finite",
                do="write the table without them",
            )
        options.pop("same_position", None)  # equal positions are searched only in memory
        return open_matches(path, **options)
    return read_matches(path, format=format, **options)


def reading_options(data: Data, chips: Sequence[ChipBlock]) -> ReadArguments:
    """Options of `load_matches` from a section [data]; tables may refer to chips by name."""
    return {
        "columns": data.columns,
        "unit": data.unit,
        "sigma": data.sigma,
        "pixel_origin": data.pixel_origin,
        "tangent_point": data.tangent_point,
        "epoch": data.epoch,
        "catalogue_epoch": data.catalogue_epoch,
        "chips": {chip.name: chip.number for chip in chips} or None,
        "not_finite": data.not_finite,
        "same_position": data.same_position,
        "plate_scale": data.plate_scale,
        "motion_prior": data.motion_prior,
    }


def is_large(path: PathLike | Sequence[PathLike]) -> bool:
    """True if the files are in Parquet with too many rows to be held in memory."""
    files = input_files(path)
    if any(file.suffix.lower() != ".parquet" for file in files):
        return False
    return sum(describe_part(file).n_rows for file in files) > IN_MEMORY


Paths = str | Path | Sequence[str | Path]
Template = tuple[int, dict[str, object]]


@dataclass(frozen=True)
class MatchSource:
    """Reader of matches in the format of a mission.

    Parameters
    ----------
    read : callable
        ``read(paths, data, size)`` returns the matches in memory; `data` is the section [data] of
        the mission, `size` the number of columns and rows of the detector.
    input_of : callable
        ``input_of(run)`` returns the `RunInput` of a run directory.
    template : callable
        ``template(path)`` returns the number of matches and their entries in the template of a
        configuration, for `bayesdist init`; None if the files have another format.
    """

    read: Callable[[Paths, Any, tuple[float, float]], Matches]
    input_of: Callable[[RunDirectory], RunInput]
    template: Callable[[str | Path], Template | None]


def source_of(name: str) -> MatchSource | None:
    """Match source of a format; None for formats that are not of a mission."""
    return mission_objects(lambda mission: mission.match_sources, only=name).get(name)


def read_configured(
    path: Paths,
    data: Data,
    *,
    size: tuple[float, float] | None,
    chips: Sequence[ChipBlock],
) -> Matches:
    """Read the matches of a section [data].

    `size` is the number of columns and rows of a detector with a single chip.
    """
    source = source_of(data.format)
    if source is not None and size is not None:
        return source.read(path, data, size)
    return load_matches(path, format=data.format, **reading_options(data, chips))


def mission_template(matches: str | Path) -> Template | None:
    """Number of matches and their part of a template; None if no mission reads the files."""
    for source in mission_objects(lambda mission: mission.match_sources).values():
        template = source.template(matches)
        if template is not None:
            return template
    return None
