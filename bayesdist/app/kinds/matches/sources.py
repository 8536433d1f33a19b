"""Matches as a section [data] names them, in memory or on disk, those of missions among them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bayesdist.app.config import ChipBlock, Data
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches, input_files, open_matches, read_matches
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import InputError
from bayesdist.mission import load_object, missions
from bayesdist.model import Chip

IN_MEMORY = 1_000_000  # rows of Parquet above which they stay on disk

PathLike = str | os.PathLike[str]


def load_matches(
    path: PathLike | Sequence[PathLike], *, format: str = "auto", **options: Any
) -> Matches:
    """Matches of any known kind, as of `read_matches`; large tables in Parquet stay on disk."""
    if format in ("auto", "table") and is_large(path):
        if options.pop("not_finite", "refuse") == "reject":
            raise InputError(
                f"rows of tables of more than {IN_MEMORY} rows cannot be left out in reading",
                where="data.not_finite",
                do="write the table without them",
            )
        options.pop("same_position", None)  # equal positions are looked for in memory alone
        return open_matches(path, **options)
    return read_matches(path, format=format, **options)


def reading_options(data: Data, chips: Sequence[ChipBlock]) -> dict[str, Any]:
    """Options of `load_matches` that a section [data] gives; chips may be named in tables."""
    names = (
        *("format", "columns", "unit", "sigma", "pixel_origin", "tangent_point"),
        *("epoch", "catalogue_epoch", "not_finite", "same_position", "plate_scale"),
    )
    numbers = {chip.name: chip.number for chip in chips}
    return {name: getattr(data, name) for name in names} | {"chips": numbers or None}


def is_large(path: PathLike | Sequence[PathLike]) -> bool:
    """Truth of files in Parquet with more rows than are taken into memory."""
    files = input_files(path)
    if any(file.suffix.lower() != ".parquet" for file in files):
        return False
    return sum(describe_part(file).n_rows for file in files) > IN_MEMORY


def check_chips(chips: Sequence[Chip], numbers: Sequence[int]) -> None:
    """Refuse a ``[[chip]]`` block without stars, and stars without a block.

    `numbers` are the chips of the matches, (1,) also where they name none; nothing is checked where
    there is no block.
    """
    if not chips:
        return
    # stars that name no chip are on the only one there is, whatever its number
    if len(chips) == 1 and tuple(numbers) in ((1,), (chips[0].number,)):
        return
    known = {c.number for c in chips}
    unknown = [str(n) for n in numbers if n not in known]
    empty = [f"{c.number} ({c.name})" for c in chips if c.number not in set(numbers)]
    if unknown:
        plural = "chips" if len(unknown) > 1 else "chip"
        raise InputError(
            f"there are stars on {plural} {', '.join(unknown)}, which no [[chip]] block describes",
            where="chip",
            do=f"add a block, or leave these stars out (known: "
            f"{', '.join(str(c.number) for c in chips)})",
        )
    if empty:
        plural = "chips" if len(empty) > 1 else "chip"
        raise InputError(
            f"no star lies on {plural} {', '.join(empty)}",
            where="chip",
            do="drop the block, or map column 'chip' in data.columns",
        )


Paths = str | Path | Sequence[str | Path]
Template = tuple[int, dict[str, object]]


class RunInput(Protocol):
    """Matches of a run that may have to be written before they can be used."""

    def load(self) -> Matches:
        """All matches that the configuration selects."""

    def move_into_run(self) -> bool:
        """Truth of matches that were moved into the folder of the run, which has begun."""

    def close(self) -> None:
        """Remove what was not moved."""


@dataclass(frozen=True)
class MatchSource:
    """Reader of the matches of one format."""

    # of paths, the section [data] as the mission has it, and columns and rows of the detector: the
    # matches in memory
    read: Callable[[Paths, Any, tuple[float, float]], Matches]
    input_of: Callable[[RunDirectory], RunInput]  # of the folder of a run: its `RunInput`
    # of a path that `bayesdist init` is given: the number of matches and what they put into the
    # template of a configuration; None where the files are of another format
    template: Callable[[str | Path], Template | None]


def _sources() -> dict[str, str]:
    """Where the sources of all missions are, by the name of the format."""
    return {name: where for one in missions().values() for name, where in one.match_sources.items()}


def _source(name: str) -> MatchSource | None:
    """Source of a format; None for the formats of the core."""
    where = _sources().get(name)
    return None if where is None else load_object(where)


def input_of_run(run: RunDirectory) -> RunInput | None:
    """Input of a run whose format a mission reads; None for all others."""
    data = run.config.data
    source = None if data is None else _source(data.format)
    return None if source is None else source.input_of(run)


def read_configured(
    path: Paths,
    data: Data,
    *,
    size: tuple[float, float] | None,
    chips: Sequence[ChipBlock],
) -> Matches:
    """Matches as a section [data] reads them; `size` is columns and rows of a single chip."""
    source = _source(data.format)
    if source is not None and size is not None:
        return source.read(path, data, size)
    return load_matches(path, **reading_options(data, chips))


def mission_template(matches: str | Path) -> Template | None:
    """Number of matches and their part of a template, where a mission knows the files."""
    for name in _sources():
        source = _source(name)
        found = None if source is None else source.template(matches)
        if found is not None:
            return found
    return None
