"""Files of RvB pairs, by their columns and bands, and whether positions are of the stated array."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from astropy.table import Table

from bayesdist.data.batches import BATCH
from bayesdist.data.formats.files import input_files
from bayesdist.data.tables.checks import Place, row_number
from bayesdist.data.tables.column import Columns, SourceColumn
from bayesdist.data.tables.names import BASIC, find_columns
from bayesdist.data.tables.parquet import ParquetPart, describe_part
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.utils.arrays import Float, Int

PathLike = str | os.PathLike[str]

MAGNITUDES = tuple(f"mag_{band.lower()}" for band in WISE_BANDS)

# lower case; the first that the file has is taken
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
    """'W1' to 'W4' of what a file or a user calls a band: W1, w1, 1.

    InputError for anything else.
    """
    text = str(label).strip().upper()
    name = text if text.startswith("W") else f"W{text.removesuffix('.0')}"
    if name not in WISE_BANDS:
        raise InputError(f"{label!r} is no band", do=f"give one of {', '.join(WISE_BANDS)}")
    return name


@dataclass(frozen=True, eq=False)
class RvbFile:
    """A file and which of its columns is what."""

    source: str
    contents: Table | ParquetPart
    found: Mapping[str, str]

    def blocks(self, keys: Sequence[str]) -> Iterator[tuple[Columns, int, Place]]:
        """Rows of some quantities with the number of the first, counted from 0, and their names."""
        if isinstance(self.contents, Table):
            if len(self.contents):
                yield self.contents, 0, row_number
            return
        part = self.contents
        columns = list(dict.fromkeys(self.found[key] for key in keys if key in self.found))
        labels = {self.found[key] for key in ("band", "exposure") if key in self.found}
        labels |= {self.found["epoch"]} & part.texts if "epoch" in self.found else set()
        for block in part.blocks(columns, encoded=labels & set(columns), size=BATCH):
            yield block, block.first, part.place(block.first)

    def column(self, table: Columns, key: str, place: Place) -> SourceColumn:
        """One quantity of some rows."""
        name = self.found[key]
        return SourceColumn(table[name], self.source, name, place)

    def bands(self, table: Columns, place: Place) -> tuple[Int, tuple[str, ...]]:
        """Code of each row's band, and the bands."""
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
    """RvB files of a path, a pattern or several, each with the columns that were found."""
    columns = {{"color": "colour"}.get(key, key): name for key, name in (columns or {}).items()}
    out = []
    for file in input_files(path):
        name = file.name.lower()
        parquet = name.endswith(".parquet")
        contents: Table | ParquetPart = describe_part(file) if parquet else read_table(file)
        names = list(contents.colnames)
        found = find_columns(names, columns, RVB_ALIASES, source=str(file), needed="xyuv")
        out.append(RvbFile(str(file), contents, found))
    return out


# Pairs that fill no more than a quarter of the array are those of a smaller one: by chance this
# many lie there with a probability of 4^-50.
_ENOUGH = 50
# Of the longer side: reference stars in pixels of the array lie this near to their detections.
# Distortion and frame solutions move them by less; swapped columns and other units by far more.
_NEAR = 0.05


@dataclass
class ArrayCheck:
    """Positions batch by batch against the array of a band."""

    band: str
    size: tuple[float, float]  # columns and rows of the array
    n: int = 0
    n_far: int = 0
    reach: Float = field(default_factory=lambda: np.zeros(2))

    def see(
        self,
        x: Float,
        y: Float,
        where: Callable[[int], str],
        *,
        reference: tuple[Float, Float] | None = None,
    ) -> None:
        """Refuse detections that the array cannot have made.

        `x`, `y`: (N,), FITS 1-based pixels. `where`: names file and row of a position. `reference`:
        (N,), u and v, where these are said to be pixels of the array.
        """
        for name, values, extent in (("x", x, self.size[0]), ("y", y, self.size[1])):
            # half a pixel beyond the edge of the outermost: centroids may fall a little outside
            outside = (values < 0.0) | (values > extent + 1.0)
            if outside.any():
                bad = int(np.argmax(outside))
                raise InputError(
                    f"value is {values[bad]:g}, outside the {extent:g} pixels of {self.band}'s "
                    f"array, as in {int(outside.sum())} of {len(values)} rows",
                    where=f"{where(bad)}, column {name!r}",
                    do="check the band, the array size and pixel_origin",
                )
        self.n += len(x)
        self.reach = np.maximum(self.reach, [x.max(), y.max()])
        if reference is not None:
            away = np.hypot(reference[0] - x, reference[1] - y)
            self.n_far += int((away > _NEAR * max(self.size)).sum())

    def end(self, sources: str) -> None:
        """Refuse positions that all lie in the first quarter, and references far from detections.

        The first are those of another array, the second those of no array, or in swapped columns.
        """
        if self.n >= _ENOUGH and (self.reach <= np.array(self.size) / 2 + 0.5).all():
            raise InputError(
                f"all {self.n} pairs of {self.band} lie within x <= {self.reach[0]:.0f}, y <= "
                f"{self.reach[1]:.0f} of an array of {self.size[0]:g} x {self.size[1]:g}",
                where=sources,
                do="check the band and the size: these are positions of a smaller array",
            )
        if 2 * self.n_far > self.n:
            raise InputError(
                f"in {self.n_far} of {self.n} pairs u, v lies more than "
                f"{_NEAR * max(self.size):.0f} pixels from x, y",
                where=sources,
                do="give u and v in pixels of the band frame, and check which column is which",
            )
