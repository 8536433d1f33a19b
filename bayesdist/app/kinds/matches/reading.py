"""Matches in memory where they are few, left on disk where they are many, and their chips."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from bayesdist.app.config import ChipBlock, Data
from bayesdist.data import Matches, input_files, open_matches, read_matches
from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import InputError
from bayesdist.model import Chip

__all__ = ["IN_MEMORY", "check_chips", "is_large", "load_matches", "reading_options"]

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
        return open_matches(path, **options)
    return read_matches(path, format=format, **options)


def reading_options(data: Data, chips: Sequence[ChipBlock]) -> dict[str, Any]:
    """Options of `load_matches` that a section [data] gives; chips may be named in tables."""
    names = (
        *("format", "columns", "unit", "sigma", "pixel_origin", "tangent_point"),
        *("epoch", "catalogue_epoch", "not_finite"),
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
