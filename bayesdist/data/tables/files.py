"""Table files to an astropy Table; anything wrong with one becomes one clear error."""

from __future__ import annotations

import csv
import gzip
import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits
from astropy.table import Column, MaskedColumn, Table, vstack
from astropy.table.meta import get_header_from_yaml

from bayesdist.data.tables.text import is_text_table, parse_text_table
from bayesdist.errors import FormatError, InputError

if TYPE_CHECKING:
    import pyarrow

__all__ = [
    "TABLE_SUFFIXES",
    "is_binary",
    "is_fits",
    "naming_faults",
    "parquet_column",
    "parquet_units",
    "read_lines",
    "read_table",
    "reading",
]

_FITS = b"SIMPLE  ="


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context of `naming_faults` in which the warnings of readers are silenced.

    Python keeps its rules for warnings once for all threads, so that several threads at a time must
    do without.
    """
    with naming_faults(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # units are checked later, column by column
        warnings.filterwarnings("error", message=".*truncated.*")
        yield


@contextmanager
def naming_faults(path: Path, where: str = "") -> Iterator[None]:
    """Turn any failure while a file is read into an error that names the file, or `where` in it.

    Readers of damaged files raise exceptions of every kind, so all are caught; only our own pass as
    they are.  InputError when the system refuses to read, FormatError when the content is not what
    the format demands.
    """
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError("does not exist", where=str(path), do="check the path") from error
    except (IsADirectoryError, PermissionError) as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=str(path), do="check the path"
        ) from error
    except Exception as error:
        reason = next(iter(str(error).strip().splitlines()), "") or type(error).__name__
        raise FormatError(
            f"cannot be read as {path.suffix.lower() or 'a table'} ({reason[:160].rstrip('.')})",
            where=where or str(path),
            do="it may be truncated or of another format: fetch or write it again",
        ) from error


def read_lines(path: Path) -> list[str]:
    """Lines of a text file, with their ends; a file that is unreadable or no text is refused."""
    with reading(path), path.open(encoding="utf-8", newline="") as stream:
        return stream.readlines()


def _bare_lines(path: Path) -> list[str]:
    """Lines without their ends: as a list, for astropy takes a lone line for the name of a file."""
    return [line.rstrip("\r\n") for line in read_lines(path)]


def _read_ecsv(path: Path) -> Table:
    return Table.read(_bare_lines(path), format="ascii.ecsv")


def _read_text(path: Path) -> Table:
    return parse_text_table(read_lines(path), where=str(path))


def _read_separated(path: Path, *, mark: str, format: str) -> Table:
    lines = _bare_lines(path)
    _refuse_short_rows(lines, mark, path)
    return Table.read(lines, format=format, comment="#", guess=False)


def _refuse_short_rows(lines: list[str], mark: str, path: Path) -> None:
    """Refuse rows with fewer cells than there are names: astropy fills them up in silence."""
    width, row = 0, 0
    for cells in csv.reader((line for line in lines if line[:1] != "#"), delimiter=mark):
        if not cells or cells == [""]:
            continue
        if width and len(cells) < width:
            raise FormatError(
                f"has {len(cells)} of {width} cells",
                where=f"{path}, row {row}",
                do="the table may be truncated: fetch or write it again",
            )
        width, row = width or len(cells), row + 1


def _read_votable(path: Path) -> Table:
    return Table.read(io.BytesIO(path.read_bytes()), format="votable")


def _read_fits(path: Path) -> Table:
    content = path.read_bytes()
    if path.suffix.lower() == ".gz":
        content = gzip.decompress(content)
    # from memory: after a failure astropy leaves a file of its own open
    with fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)]
        objects = [hdu for hdu in tables if hdu.name == "LDAC_OBJECTS"]
        if objects:
            return _ldac(hdus, objects)
        if tables:
            # NaN stays NaN: to call it a missing value would name the wrong fault
            return Table.read(tables[0], format="fits", mask_invalid=False)
    raise FormatError("holds no table extension", where=str(path), do="give a FITS table")


def _ldac(hdus: fits.HDUList, objects: list[fits.BinTableHDU]) -> Table:
    """Objects of a FITS_LDAC catalogue, with the date of the image; several are chips."""
    tables = [Table.read(hdu, format="fits", mask_invalid=False) for hdu in objects]
    heads = [hdu for hdu in hdus if hdu.name == "LDAC_IMHEAD"]
    text = ""
    if heads and heads[0].data is not None:
        text = "".join(str(card) for card in np.ravel(heads[0].data.field(0)))
    image = fits.Header.fromstring(text if len(text) % 80 == 0 else "")
    for number, table in enumerate(tables, 1):
        if len(tables) > 1 and "EXT_NUMBER" not in table.colnames:
            table["EXT_NUMBER"] = number
        table.meta = {}  # settings of SExtractor
    out = vstack(tables, metadata_conflicts="silent") if len(tables) > 1 else tables[0]
    for key in ("MJD-OBS", "DATE-OBS"):
        if key in image:
            out.meta[key] = image[key]
    return out


def _read_parquet(path: Path) -> Table:
    import pyarrow.parquet  # 0.1 s that other formats need not wait for

    stored = pyarrow.parquet.ParquetFile(path)
    units = parquet_units(stored.schema_arrow)
    table = Table()
    for name, column in zip(stored.schema_arrow.names, stored.read().columns, strict=True):
        table[name] = parquet_column(column, units.get(name))
    return table


def parquet_column(values: pyarrow.ChunkedArray, unit: str | None) -> Column:
    """A column of a Parquet file as one of an astropy Table; its nulls are masked."""
    if values.null_count:
        mask = values.is_null().to_numpy()
        return MaskedColumn(values.to_numpy(), mask=mask, unit=unit)
    return Column(values.to_numpy(), unit=unit)


def parquet_units(schema: pyarrow.Schema) -> dict[str, str]:
    """Units of columns: of each field's own metadata, or of the header that astropy stores."""
    units: dict[str, str] = {}
    header = (schema.metadata or {}).get(b"table_meta_yaml")
    if header is not None:
        described = get_header_from_yaml(header.decode().splitlines())["datatype"]
        units = {one["name"]: str(one["unit"]) for one in described if one.get("unit")}
    for one in schema:
        if one.metadata and b"unit" in one.metadata:
            units[one.name] = one.metadata[b"unit"].decode()
    return units


TABLE_SUFFIXES: dict[str, Callable[[Path], Table]] = {
    ".ecsv": _read_ecsv,
    ".csv": partial(_read_separated, mark=",", format="ascii.csv"),
    ".tsv": partial(_read_separated, mark="\t", format="ascii.tab"),
    ".fits": _read_fits,
    ".fit": _read_fits,
    ".ldac": _read_fits,
    ".parquet": _read_parquet,
    ".vot": _read_votable,
    ".xml": _read_votable,
    ".tbl": _read_text,
    ".ipac": _read_text,
}


def is_binary(path: Path) -> bool:
    """True where a file is no text; a file that cannot be read is left to its reader."""
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError:
        return False
    return b"\0" in head or head.startswith(_FITS)


def is_fits(path: Path) -> bool:
    """True where a file begins as FITS does."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(_FITS)) == _FITS
    except OSError:
        return False


def read_table(path: Path) -> Table:
    """Table of a file, by its extension; one that is missing, damaged or unknown is refused.

    Known are .ecsv, .csv, .tsv, .fits (first table extension, of FITS_LDAC the objects; also
    .fits.gz), .parquet, .vot or .xml (VOTable), .tbl and .ipac; other names by content: FITS, and
    text as `parse_text_table` knows it.
    """
    name = path.name.lower().removesuffix(".gz")
    reader = next((r for end, r in TABLE_SUFFIXES.items() if name.endswith(end)), None)
    if reader is None and is_fits(path):
        reader = _read_fits
    if reader is None and not is_binary(path) and is_text_table(read_lines(path)):
        reader = _read_text
    if reader is None:
        raise InputError(
            f"extension {path.suffix!r} is not one of a table",
            where=str(path),
            do=f"give a file that ends in {', '.join(TABLE_SUFFIXES)}, or set the format",
        )
    with reading(path):
        return reader(path)
