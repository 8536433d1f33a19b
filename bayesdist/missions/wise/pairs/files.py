"""Files of RvB pairs: columns, bands, and checks that positions are on the array of the band."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from astropy.table import Table

from bayesdist.data.batches import BATCH
from bayesdist.data.formats.files import input_files
from bayesdist.data.tables.checks import Place, row_number
from bayesdist.data.tables.column import SourceColumn, TableColumns
from bayesdist.data.tables.names import BASIC, find_columns
from bayesdist.data.tables.parquet import ParquetPart, describe_part
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.utils.arrays import Float, Int

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
