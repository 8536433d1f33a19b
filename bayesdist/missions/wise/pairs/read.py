"""Read RvB files: pairs of WISE detections and 2MASS stars in one band.

As in WSDC D-T033, section 1, the detections are in raw band-frame pixels, and the reference stars
are transformed to these pixels with the frame solution, without distortion.  Files can be IPAC
tables, any table that `read_matches` supports, or Parquet, which is read in batches.  Positions are
checked to be on the array of the band.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.table import Column, Table

from bayesdist.data.batches import BATCH
from bayesdist.data.formats import input_files
from bayesdist.data.matches import Matches
from bayesdist.data.reading.columns import match_columns
from bayesdist.data.reading.options import ReadOptions, check_sigma, refuse_missing_errors
from bayesdist.data.tables.checks import Place, row_number
from bayesdist.data.tables.column import Quantities, SourceColumn, TableColumns
from bayesdist.data.tables.names import BASIC, find_columns
from bayesdist.data.tables.parquet import ParquetPart, describe_part
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, colour_of
from bayesdist.missions.wise.published import WISE_ARRAYS, WISE_BANDS
from bayesdist.utils.arrays import Bool, Float, Int

__all__ = ["chosen_band", "read_rvb", "rvb_bands", "stream_rvb"]

PathLike = str | os.PathLike[str]

MAGNITUDES = tuple(f"mag_{band.lower()}" for band in WISE_BANDS)

# column names in lower case; the first one that the file has is used
RVB_ALIASES: dict[str, tuple[str, ...]] = {
    **{key: BASIC[key] for key in ("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch", "mag")},
    "exposure": ("frame", "frame_id", "frameset", *BASIC["exposure"]),
    "star": BASIC["star"],
    "band": ("band", "filter", "channel"),
    "mjd": ("mjd", "mjd_obs"),
    "colour": ("colour", "color"),
    **{
        key: (key, f"w{k}mag", f"w{k}_mag", f"w{k}mpro", f"w{k}")
        for k, key in enumerate(MAGNITUDES, 1)
    },
}

IPAC = (".tbl", ".ipac")


def rvb_bands(path: PathLike | Sequence[PathLike]) -> dict[str, int]:
    """Number of pairs by band in files, in the order of wavelength."""
    return _bands_of(open_rvb_files(path, None))


def _bands_of(files: Sequence[RvbFile]) -> dict[str, int]:
    counts = dict.fromkeys(WISE_BANDS, 0)
    for file in files:
        if "band" not in file.found:
            raise InputError(
                "has no column with the band",
                where=file.source,
                do="give the column in the option 'columns', or the band of all pairs",
            )
        for table, _, place in file.blocks(["band"]):
            codes, names = file.bands(table, place)
            for k, name in enumerate(names):
                counts[name] += int((codes == k).sum())
    return {band: n for band, n in counts.items() if n}


def stream_rvb(
    path: PathLike | Sequence[PathLike],
    *,
    band: str | None = None,
    columns: Mapping[str, str] | None = None,
    unit: str = "pix",
    sigma: str | float = "columns",
    pixel_origin: int = 1,
    size: tuple[float, float] | None = None,
    batch: int = BATCH,
) -> Iterator[RvbPairs]:
    """Read the RvB pairs of one band in batches.

    Only one batch is in memory.  Use `write_partitioned` to write the batches to a folder for
    `open_matches`.

    Parameters
    ----------
    path : path-like or sequence of path-like
        Files (.tbl or .ipac for IPAC tables, .parquet, or other tables), patterns, or folders of
        Parquet files; see `read_matches`.
    band : str, optional
        'W1' to 'W4'; not needed if the files contain only one band.
    columns : mapping of str to str, optional
        Column names of the quantities x, y, u, v, sigma_u, sigma_v, epoch, mjd, exposure (the
        frame), mag, star, band, colour, and mag_w1 to mag_w4.  Colours are computed from these
        magnitudes if there is no column colour.  Other quantities are looked for under their usual
        names (`RVB_ALIASES`); an empty name excludes a quantity.  `mjd` is taken as a Modified
        Julian Date even if the column has no unit.
    unit : str, optional
        Unit of u and v.
    sigma : {'columns', 'by_magnitude'} or float, optional
        See `read_matches`.
    pixel_origin : {0, 1}, optional
        Coordinate of the centre of the first pixel in the file.
    size : tuple of float, optional
        Columns and rows of the array; by default those of the band.
    batch : int, optional
        Largest number of rows of a Parquet file that are read together.

    Yields
    ------
    RvbPairs
        Distinct pairs: at most `batch` of a Parquet file, or all of another table.  If the file
        has no other magnitude, that of the band is used, provided that all pairs of the batch
        have one.

    Raises
    ------
    InputError
        If columns are missing, the band is missing or ambiguous, positions are outside of the
        array, all pairs are in the first quarter of the array (so that they are of another array),
        most u and v in pixels are far from x and y, or a row is invalid (see `read_matches`).
    """
    check_sigma(sigma)
    files = open_rvb_files(path, columns)
    band = chosen_band(files, band)
    size = size or WISE_ARRAYS[band].size
    check = ArrayCheck(band, size)
    for file in files:
        for table, first, place in file.blocks(list(RVB_ALIASES), batch):
            selected = np.ones(len(table), bool)
            if "band" in file.found:
                codes, names = file.bands(table, place)
                selected = codes == (names.index(band) if band in names else -1)
            if not selected.any():
                continue
            pairs = _pairs(file, table, first, place, selected, band, unit, sigma, pixel_origin)
            matches = pairs.matches
            check.see(
                matches.x,
                matches.y,
                matches.place,
                reference=(matches.u, matches.v) if matches.unit == "pix" else None,
            )
            yield pairs
    sources = ", ".join(file.source for file in files)
    if not check.n:
        raise InputError("has no rows", where=sources, do="give a table with matched stars")
    check.end(sources)


def read_rvb(
    path: PathLike | Sequence[PathLike],
    **options: Any,
) -> RvbPairs:
    r"""Read the RvB pairs of one band into memory.

    Parameters
    ----------
    path, **options
        See `stream_rvb`.

    Returns
    -------
    RvbPairs

    Raises
    ------
    InputError
        See `stream_rvb`.

    Examples
    --------
    >>> from bayesdist.missions.wise import read_rvb
    >>> from pathlib import Path
    >>> n = Path("pairs.csv").write_text("x,y,u,v\n10,20,10.1,20.2\n900,800,899,799\n")
    >>> pairs = read_rvb("pairs.csv", band="W2", sigma=0.05)
    >>> len(pairs.matches)
    2
    """
    return RvbPairs.concatenate(list(stream_rvb(path, **options)))


def chosen_band(files: Sequence[RvbFile], band: str | None) -> str:
    """Validate the requested band, or determine it if the files contain only one.

    Raises InputError if the band is missing from the files, or several are there and none is
    requested.
    """
    sources = ", ".join(file.source for file in files)
    if band is not None:
        band = band_name(band)
        if not any("band" in file.found for file in files):
            return band
    counts = _bands_of(files)
    listed = ", ".join(f"{name} ({n} pairs)" for name, n in counts.items())
    if not counts:
        raise InputError("has no rows", where=sources, do="give a table with matched stars")
    if band is None:
        if len(counts) > 1:
            raise InputError(
                f"contains several bands: {listed}", where=sources, do="choose one of them"
            )
        return next(iter(counts))
    if band not in counts:
        raise InputError(
            f"does not contain {band}, but {listed}", where=sources, do="choose another band"
        )
    return band


def _pairs(
    file: RvbFile,
    table: TableColumns,
    first: int,
    place: Place,
    which: Bool,
    band: str,
    unit: str,
    sigma: str | float,
    pixel_origin: int,
) -> RvbPairs:
    """Pairs in the rows of a block that are selected by the mask `which`."""
    unread = {"band", "mjd", "colour", *MAGNITUDES}
    if sigma != "columns":
        unread |= {"sigma_u", "sigma_v"}
    plain = {key: name for key, name in file.found.items() if key not in unread}
    quantities = Quantities(table, plain, file.source, place)
    out = match_columns(quantities, ReadOptions(unit=unit, pixel_origin=pixel_origin))
    if "mjd" in file.found and "epoch" not in file.found:
        column = file.column(table, "mjd", place)
        out["epoch"] = SourceColumn(
            Column(column.numbers(), unit="d"), file.source, column.name, place
        ).years()
    magnitudes = {
        key: file.column(table, key, place).known_numbers()[which]
        for key in MAGNITUDES
        if key in file.found
    }
    out = {name: v[which] if isinstance(v, np.ndarray) else v for name, v in out.items()}
    band_magnitude = magnitudes.get(f"mag_{band.lower()}")
    if "mag" not in out and band_magnitude is not None and np.isfinite(band_magnitude).all():
        out["mag"] = band_magnitude
    if "exposure" in out:  # drop the names of frames of other bands
        used, out["exposure"] = np.unique(out["exposure"], return_inverse=True)
        out["exposure_names"] = tuple(out["exposure_names"][k] for k in used)
    matches = Matches(
        **out, filter_names=(band,), row=first + np.flatnonzero(which), sources=(file.source,)
    )
    refuse_missing_errors(sigma, matches.has_sigma, matches.has_mag, where=file.source)
    if not isinstance(sigma, str):
        matches = matches.with_errors(sigma)
    colour = colour_of(list(magnitudes.values())) if len(magnitudes) > 1 else None
    if "colour" in file.found:
        colour = file.column(table, "colour", place).known_numbers()[which]
    return RvbPairs(matches, colour)


def band_name(label: object) -> str:
    """Standard name, 'W1' to 'W4', of a band given as W1, w1 or 1.

    Raises InputError for anything else.
    """
    text = str(label).strip().upper()
    name = text if text.startswith("W") else f"W{text.removesuffix('.0')}"
    if name not in WISE_BANDS:
        raise InputError(f"{label!r} is not a band", do=f"give one of {', '.join(WISE_BANDS)}")
    return name


@dataclass(frozen=True, eq=False)
class RvbFile:
    """File of RvB pairs, and its columns."""

    source: str  # name of the file
    contents: Table | ParquetPart
    found: Mapping[str, str]  # column name by quantity

    def blocks(
        self, keys: Sequence[str], size: int = BATCH
    ) -> Iterator[tuple[TableColumns, int, Place]]:
        """Read some quantities in blocks of at most `size` rows.

        Yields
        ------
        columns : Columns
            Rows of the block.
        first : int
            Number of its first row, counted from 0.
        place : callable
            Function that returns the name of a row for messages.
        """
        if isinstance(self.contents, Table):
            if len(self.contents):
                yield self.contents, 0, row_number
            return
        part = self.contents
        columns = list(dict.fromkeys(self.found[key] for key in keys if key in self.found))
        labels = {self.found[key] for key in ("band", "exposure") if key in self.found}
        labels |= {self.found["epoch"]} & part.texts if "epoch" in self.found else set()
        for block in part.blocks(columns, encoded=labels & set(columns), size=size):
            yield block, block.first, part.place(block.first)

    def column(self, table: TableColumns, key: str, place: Place) -> SourceColumn:
        """Column of a quantity in a block."""
        name = self.found[key]
        return SourceColumn(table[name], self.source, name, place)

    def bands(self, table: TableColumns, place: Place) -> tuple[Int, tuple[str, ...]]:
        """Code (N,) of the band of each row, and the names of the bands."""
        column = self.column(table, "band", place)
        codes, labels = column.labels()
        names: list[str] = []
        for k, label in enumerate(labels):
            try:
                names.append(band_name(label))
            except InputError as error:
                raise column.fail(int(np.argmax(codes == k)), error.cause, error.do) from None
        unique = tuple(dict.fromkeys(names))
        return np.array([unique.index(name) for name in names])[codes], unique


def open_rvb_files(
    path: PathLike | Sequence[PathLike], columns: Mapping[str, str] | None
) -> list[RvbFile]:
    """Open the RvB files of a path, pattern or list, and find their columns."""
    columns = {{"color": "colour"}.get(key, key): name for key, name in (columns or {}).items()}
    out = []
    for file in input_files(path):
        name = file.name.lower()
        parquet = name.endswith(".parquet")
        contents: Table | ParquetPart = describe_part(file) if parquet else read_table(file)
        names = list(contents.colnames)
        column_of = find_columns(names, columns, RVB_ALIASES, source=str(file), needed="xyuv")
        out.append(RvbFile(str(file), contents, column_of))
    return out


# Minimum number of pairs for the check that they fill more than a quarter of the array.  Pairs that
# do not are of a smaller array: the probability by chance is 4^-50.
_ENOUGH = 50
# Largest distance of reference stars from detections, as a fraction of the longer side. Distortion
# and frame solutions cause smaller distances, swapped columns and other units much larger ones.
_NEAR = 0.05


@dataclass
class ArrayCheck:
    """Check, batch by batch, that positions are on the array of a band."""

    band: str
    size: tuple[float, float]  # columns and rows of the array
    n: int = 0  # number of pairs
    n_far: int = 0  # number of pairs with a distant reference star
    reach: Float = field(default_factory=lambda: np.zeros(2))  # largest x and y

    def see(
        self,
        x: Float,
        y: Float,
        where: Callable[[int], str],
        *,
        reference: tuple[Float, Float] | None = None,
    ) -> None:
        """Add a batch of pairs to the check.

        Parameters
        ----------
        x, y : ndarray, shape (N,)
            FITS 1-based pixels.
        where : callable
            Function that maps an index into x and y to the file and row named in messages.
        reference : tuple of ndarray, shape (N,), optional
            u and v, if these are in pixels of the array.

        Raises
        ------
        InputError
            If a detection is outside of the array.
        """
        for name, values, extent in (("x", x, self.size[0]), ("y", y, self.size[1])):
            # tolerance of half a pixel, since centroids may be slightly outside of the array
            outside = (values < 0.0) | (values > extent + 1.0)
            if outside.any():
                bad = int(np.argmax(outside))
                raise InputError(
                    f"value is {values[bad]:g}, outside the {extent:g} pixels of {self.band}'s "
                    f"array, as are {int(outside.sum())} of {len(values)} rows",
                    where=f"{where(bad)}, column {name!r}",
                    do="check the band, the array size and pixel_origin",
                )
        self.n += len(x)
        self.reach = np.maximum(self.reach, [x.max(), y.max()])
        if reference is not None:
            away = np.hypot(reference[0] - x, reference[1] - y)
            self.n_far += int((away > _NEAR * max(self.size)).sum())

    def end(self, sources: str) -> None:
        """Finish the check.

        Raises InputError if all positions are in the first quarter of the array, which means that
        they are of a smaller array, or if most reference stars are far from their detections, which
        means other units or swapped columns.
        """
        if self.n >= _ENOUGH and (self.reach <= np.array(self.size) / 2 + 0.5).all():
            raise InputError(
                f"all {self.n} pairs of {self.band} are within x <= {self.reach[0]:.0f}, y <= "
                f"{self.reach[1]:.0f} of an array of {self.size[0]:g} x {self.size[1]:g}",
                where=sources,
                do="check the band and the size: these are positions of a smaller array",
            )
        if 2 * self.n_far > self.n:
            raise InputError(
                f"in {self.n_far} of {self.n} pairs u, v is more than "
                f"{_NEAR * max(self.size):.0f} pixels from x, y",
                where=sources,
                do="give u and v in pixels of the band frame, and check which column is which",
            )
