"""`read_matches`: read matches from files of all supported kinds."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from astropy.table import Table

from bayesdist.data.formats import (
    CORR_COLUMNS,
    FORMATS,
    exposure_names,
    input_files,
    kind_of,
    mission_formats,
    read_written_matches,
)
from bayesdist.data.matches import Matches
from bayesdist.data.matching.table import match_table
from bayesdist.data.reading.columns import numbered, text_labels
from bayesdist.data.reading.options import ReadArguments, ReadOptions
from bayesdist.data.reading.table import (
    catalogue_positions,
    is_table,
    match_arguments,
    sky_positions,
)
from bayesdist.data.repeated import star_codes
from bayesdist.data.tables.checks import absent
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import ALIASES, find_columns
from bayesdist.data.tangent import mean_direction
from bayesdist.errors import InputError, required
from bayesdist.files.tables import read_table

PathLike = str | os.PathLike[str]
# other quantities are omitted: 'mag', if present, is the magnitude of the index star
_CORR = dict.fromkeys(ALIASES, "") | CORR_COLUMNS


def read_matches(
    path: PathLike | Sequence[PathLike] | Any,
    *,
    format: str = "auto",
    **options: Unpack[ReadArguments],
) -> Matches:
    r"""Read matched star positions.

    Parameters
    ----------
    path : path-like, sequence of path-like, or table
        A file, a list of files, a pattern, or a folder of Parquet files (parts of one table). If
        there are several files without a column of exposures, each file is one exposure named after
        the file. Objects with columns are passed on to `Matches.from_table`.
    format : str, optional
        'table' (.ecsv, .csv, .fits, .parquet, .vot, .tbl and several kinds of text),
        'astrometry.net' (corr.fits), 'bayesdist' (matches.h5 of a saved run), a format added by a
        mission, or 'auto': recognized by name and content.
    **options
        Fields of `ReadOptions` by name: columns, unit, sigma, pixel_origin, tangent_point, epoch,
        catalogue_epoch, chips, not_finite, same_position, plate_scale,
        motion_prior.

    Returns
    -------
    Matches
        Matches in memory.

    Raises
    ------
    InputError
        If a file or an option is invalid; the message says what to change.

    Examples
    --------
    >>> from pathlib import Path
    >>> n = Path("stars.csv").write_text("x,y,u,v\n10.5,20,0.1,0.2\n900,500,8.9,4.8\n")
    >>> matches = bd.read_matches("stars.csv", unit="arcsec", sigma=0.01, pixel_origin=1)
    >>> matches.x.tolist()
    [10.5, 900.0]
    """
    formats = (*FORMATS, *mission_formats())
    if format not in formats:
        raise InputError(
            f"format is {format!r}", where="data.format", do=f"choose one of {', '.join(formats)}"
        )
    reading = ReadOptions(**options)
    if is_table(path):
        if format not in ("auto", "table"):
            raise InputError(
                f"format is {format!r}, but a table is given instead of a file",
                where="format",
                do="leave it out",
            )
        return Matches(**match_arguments(path, reading)).as_read(reading.plane_sigma)
    files = input_files(path)
    kinds = [kind_of(file, reading.columns) if format == "auto" else format for file in files]
    master_format = next((kind for kind in kinds if _is_of_masters(kind)), None)
    if master_format is not None:
        table = _read_with_master(master_format, files, kinds, reading)
    else:
        in_parts = isinstance(path, str | os.PathLike) and Path(path).is_dir()
        table = _read_plain(files, kinds, reading, in_parts=in_parts)
    return table.as_read(reading.plane_sigma)


def _read_plain(
    files: Sequence[Path], kinds: Sequence[str], options: ReadOptions, *, in_parts: bool
) -> Matches:
    """Matches from files that hold both pixels and reference positions."""
    added_formats = mission_formats()
    table_readers = {
        kind: format_.read for kind, format_ in added_formats.items() if format_.read is not None
    }
    names: Sequence[str | None] = exposure_names(files)
    if in_parts or (len(files) == 1 and kinds[0] in ("table", "bayesdist", *table_readers)):
        names = [None] * len(files)
    tables = {
        file: table_readers.get(kind, read_table)(file)
        for file, kind in zip(files, kinds, strict=True)
        if kind in ("table", "astrometry.net", *table_readers)
    }
    options = _with_common_chips(tables, _with_common_point(tables, kinds, options))
    readers: dict[str, Callable[[Path, str | None], Matches]] = {
        "bayesdist": lambda file, _: _read_record(file, options),
        "astrometry.net": lambda file, name: _read_corr(file, tables[file], name, options),
        "table": lambda file, name: Matches(
            **match_arguments(
                tables[file], options, source=str(file), exposure_name=name, identify=False
            )
        ),
    }
    readers |= dict.fromkeys(table_readers, readers["table"])
    for key in added_formats.keys() - table_readers.keys():
        readers[key] = partial(_read_list, key, options=options)
    matches = Matches.concatenate(
        [readers[kind](file, name) for file, kind, name in zip(files, kinds, names, strict=True)]
    )
    if matches.star is not None or len(tables) < len(files):
        return matches  # lists and records have no reference positions, or have star codes
    corr = "astrometry.net" in set(kinds)
    return _with_stars(matches, tables, _CORR if corr else options.columns, options.same_position)


def _with_stars(
    matches: Matches,
    tables: Mapping[Path, Table],
    columns: Mapping[str, str] | None,
    same_position: str,
) -> Matches:
    """Matches with star codes, if some rows have the same reference position."""
    sky = [catalogue_positions(table, columns, source=str(file)) for file, table in tables.items()]
    at = matches.u, matches.v
    on_sky = [positions for positions in sky if positions is not None]
    if len(on_sky) == len(sky):
        first = np.cumsum([0, *(len(ra) for ra, _ in on_sky)])[matches.source]
        ra, dec = (np.concatenate(axis) for axis in zip(*on_sky, strict=True))
        at = ra[first + matches.row], dec[first + matches.row]
    star, note = star_codes(*at, same_position)
    if star is None:
        return matches
    return matches.with_columns(star=star, notes=(*matches.notes, note))


def _with_common_point(
    tables: Mapping[Path, Table], kinds: Iterable[str], options: ReadOptions
) -> ReadOptions:
    """Options with a tangent point common to all files, which by default have different ones."""
    if options.tangent_point is not None or len(tables) < 2:
        return options
    corr = "astrometry.net" in set(kinds)
    columns = _CORR if corr else options.columns
    sky = [sky_positions(table, columns, source=str(file)) for file, table in tables.items()]
    on_sky = [position for position in sky if position is not None and len(position[0])]
    if not on_sky:
        return options
    ra, dec = (np.concatenate(axis) for axis in zip(*on_sky, strict=True))
    return replace(options, tangent_point=mean_direction(ra, dec))


def _with_common_chips(tables: Mapping[Path, Table], options: ReadOptions) -> ReadOptions:
    """Options with a chip numbering common to all files, if the files have chip names."""
    if options.chips is not None or len(tables) < 2:
        return options
    names: set[str] = set()
    for file, table in tables.items():
        column_names = find_columns(table.colnames, options.columns, ALIASES, source=str(file))
        if "chip" in column_names:
            column = table[column_names["chip"]]
            present = column[~absent(column, not_finite=False)]
            names.update(text_labels(SourceColumn(present, str(file), column_names["chip"])))
    return replace(options, chips=numbered(names)) if names else options


def _is_of_masters(key: str) -> bool:
    """True for a format of catalogues to which lists of another format are matched."""
    format_ = mission_formats().get(key)
    return format_ is not None and format_.master is not None


def _read_list(key: str, file: Path, name: str | None, options: ReadOptions) -> Matches:
    """Matches of a list in a format that fixes its columns."""
    names = "columns tangent_point epoch catalogue_epoch not_finite same_position plate_scale"
    fixed = (*names.split(), "motion_prior", *_other_origin(options))
    options.refuse_fixed(str(file), key, *fixed)
    if options.unit not in (None, "pix"):
        options.refuse_fixed(str(file), key, "unit")
    read = required(mission_formats()[key].matches, f"the format {key!r} has no matches")
    return read(file, name)


def _read_record(file: Path, options: ReadOptions) -> Matches:
    """Matches of a file that bayesdist wrote; it fixes everything that the options could set."""
    names = "columns unit tangent_point epoch catalogue_epoch chips not_finite same_position"
    fixed = (*names.split(), "plate_scale", "motion_prior", *_other_origin(options))
    options.refuse_fixed(str(file), "bayesdist", *fixed)
    return read_written_matches(file)


def _other_origin(options: ReadOptions) -> tuple[str, ...]:
    """Name of the option `pixel_origin`, if it differs from 1, which is fixed by the format."""
    return () if options.pixel_origin == 1 else ("pixel_origin",)


def _read_corr(file: Path, table: Table, name: str | None, options: ReadOptions) -> Matches:
    """Matches from a `corr.fits`, which fixes columns, origin and unit.

    field_x and field_y are FITS 1-based pixels; index_ra and index_dec are projected to the tangent
    plane. Magnitudes are instrumental, -2.5 log10 FLUX, if all fluxes are positive. There are no
    errors.
    """
    options.refuse_fixed(str(file), "astrometry.net", "columns", *_other_origin(options))
    if options.unit not in (None, "arcsec"):
        options.refuse_fixed(str(file), "astrometry.net", "unit")
    options.refuse_fixed(str(file), "astrometry.net", "plate_scale")
    options.refuse(
        str(file),
        "the format astrometry.net has no proper motions and would not use it",
        "epoch",
        "catalogue_epoch",
        "motion_prior",
        do="leave {} out, or set the format to 'table' and name the columns (columns = "
        '{{x = "field_x", y = "field_y", ra = "index_ra", dec = "index_dec"}}, and pm_ra, pm_dec)',
    )
    columns = _CORR | ({"flux": "FLUX"} if "FLUX" in table.colnames else {})
    options = replace(options, columns=columns, unit=None, sigma="by_magnitude")
    return Matches(
        **match_arguments(table, options, source=str(file), exposure_name=name, identify=False)
    )


def _read_with_master(
    key: str, files: Sequence[Path], kinds: Sequence[str], options: ReadOptions
) -> Matches:
    """Matches of star lists with the master of the format `key` that is among the files."""
    format_ = mission_formats()[key]
    masters: list[Path] = []
    lists: list[Path] = []
    for file, kind in zip(files, kinds, strict=True):
        is_master = kind == key and format_.recognizes(file)
        (masters if is_master else lists).append(file)
    if len(masters) != 1 or not lists:
        raise InputError(
            f"{len(masters)} masters of the format {key!r} and {len(lists)} lists are named, but "
            "a master alone has no detector positions",
            where=", ".join(str(file) for file in files),
            do=f"name one master together with the {format_.lists} lists to match with it",
        )
    names = exposure_names(lists)
    detections = Matches.concatenate(
        [
            _read_list(format_.lists, file, name, options)
            for file, name in zip(lists, names, strict=True)
        ]
    )
    read = required(format_.master, f"the format {key!r} has no masters")
    return match_table(detections, read(masters[0]))
