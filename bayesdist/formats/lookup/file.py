"""D2IMFILE and NPOLFILE: look-up tables of the distortion, as stwcs and astropy.wcs read them.

The files have image extensions DX and DY for each chip, identified by CCDCHIP. Node k (from 1) of
axis a is at pixel CRVALa + (k - CRPIXa) CDELTa. Without CRPIX and CRVAL both are taken as 0, so
that the first node is at pixel CDELT (astropy 6.1 and later; at pixel 1 before). `lookup_file`
always writes CRPIX, CRVAL and CDELT.

Files written by bayesdist have further content, which other programs ignore:

SIGMA_DX, SIGMA_DY
    Image extensions of the same shape with the standard error of each node.
BDPAD
    Number of columns at the right end that are padding. stwcs records the maximum of a table, not
    of its absolute value, as the size of the correction, and astropy.wcs ignores a table with a
    negative maximum. If no node is clearly positive, columns are therefore appended at the right
    end: copies of the last column up to the edge of the detector, so that nothing changes there,
    and then one positive column that no pixel reaches.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError, InputError
from bayesdist.model.lookup import LookupTable
from bayesdist.products.common.cards import (
    append_cards,
    named_in,
    node_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.content import Hdu, TablePlane, hdus_of, read_hdus, write_hdus
from bayesdist.utils.arrays import Float

AXES = ("DX", "DY")
_SIGMA = "SIGMA_"
_FILTERS = ("FILTER1", "FILTER2", "FILTER")


@dataclass(frozen=True, eq=False)
class LookupFile:
    """D2IMFILE or NPOLFILE with all its HDUs, and its interpretation.

    Parameters
    ----------
    hdus : tuple of Hdu
        All HDUs of the file.
    name : str
        Name of the file, for error messages.

    Raises
    ------
    FormatError
        If there is no image extension DX or DY, or if these are compressed images.
    """

    hdus: tuple[Hdu, ...]  # all HDUs
    name: str = "look-up tables"  # name of the file in errors

    def __post_init__(self) -> None:
        if not self.planes:
            for hdu in self.hdus:
                hdu.refuse_compressed(self.name)
            raise FormatError(
                "has no image extension DX or DY",
                where=self.name,
                do="give a D2IMFILE or an NPOLFILE with two-dimensional tables",
            )

    @cached_property
    def header(self) -> fits.Header:
        """Primary header."""
        return self.hdus[0].header

    @property
    def kind(self) -> str:
        """'npol' for a file that says so in FILETYPE or names a filter, else 'd2im'."""
        filetype = str(self.header.get("FILETYPE", "")).upper()
        if "D2I" in filetype:
            return "d2im"
        return "npol" if "DXY" in filetype or self.filters else "d2im"

    @property
    def instrument(self) -> str:
        """INSTRUME; empty if the file has none."""
        return named_in(self.header, "INSTRUME", self.name)

    @property
    def detector(self) -> str:
        """DETECTOR; empty if the file has none."""
        return named_in(self.header, "DETECTOR", self.name)

    @property
    def filters(self) -> tuple[str, ...]:
        """Filter names of the primary header, in the order of the wheels."""
        return tuple(named_in(self.header, k, self.name) for k in _FILTERS if k in self.header)

    @cached_property
    def planes(self) -> tuple[TablePlane, ...]:
        """Extensions DX and DY, in the order of the file."""
        return self._planes(AXES)

    @cached_property
    def sigma_planes(self) -> tuple[TablePlane, ...]:
        """Extensions SIGMA_DX and SIGMA_DY."""
        return self._planes(tuple(_SIGMA + a for a in AXES))

    def _planes(self, names: tuple[str, ...]) -> tuple[TablePlane, ...]:
        out = []
        for number, hdu in enumerate(self.hdus[1:], start=1):
            header, name = hdu.header, hdu.name
            image = str(header.get("XTENSION", "")).strip() == "IMAGE" and header["NAXIS"] == 2
            if name in names and image and hdu.data:
                out.append(TablePlane(hdu, name, f"{self.name}, HDU {number} ({name})"))
        return tuple(out)

    @property
    def chips(self) -> tuple[int, ...]:
        """Chip numbers, in the order of the file."""
        return tuple(dict.fromkeys(p.chip for p in self.planes))

    def pair(self, chip: int) -> tuple[TablePlane, TablePlane]:
        """Extensions DX and DY of a chip.

        FormatError if one is missing or repeated, or if their grids differ.
        """
        x, y = (self._one(chip, axis) for axis in AXES)
        if x.grid != y.grid:
            raise FormatError(
                f"DX and DY differ in shape or registration: DX has {x.grid}, DY {y.grid}",
                where=f"{self.name}, chip {chip}",
                do="give both on the same grid",
            )
        return x, y

    def _one(self, chip: int, axis: str) -> TablePlane:
        matching = [p for p in self.planes if p.chip == chip and p.name == axis]
        if len(matching) != 1:
            raise FormatError(
                f"there are {len(matching)} extensions {axis}",
                where=f"{self.name}, chip {chip}",
                do="give exactly one for each chip",
            )
        return matching[0]

    def values(self, chip: int) -> Float:
        """Node values of a chip as stored, shape (2, ny, nx); errors as for `pair`."""
        return np.stack([p.nodes for p in self.pair(chip)])

    def sigma(self, chip: int) -> Float | None:
        """Standard errors of the node values, shape (2, ny, nx); None if the file has none."""
        nodes = {p.name: p.nodes for p in self.sigma_planes if p.chip == chip}
        names = [_SIGMA + a for a in AXES]
        return np.stack([nodes[n] for n in names]) if set(names) <= set(nodes) else None

    def table(
        self,
        chip: int,
        *,
        filter: str = "",
        first: Sequence[float] | None = None,
    ) -> LookupTable:
        """Look-up table of a chip with the values stored in the file.

        Parameters
        ----------
        chip : int
            Chip number.
        filter : str
            Filter that the table is assigned to; empty for the detector.
        first : sequence of float, optional
            Pixel (x, y) of the first node, overriding the file.

        Returns
        -------
        LookupTable
            Shifts along both axes, in the unit of the file, with standard errors if the file has
            them.

        Raises
        ------
        FormatError
            As for `pair`, and for values that `LookupTable` rejects.
        """
        x, _ = self.pair(chip)
        place = x.first if first is None else (float(first[0]), float(first[1]))
        try:
            return LookupTable(chip, self.values(chip), filter, place, x.step, self.sigma(chip))
        except InputError as error:
            raise FormatError(
                error.cause, where=f"{self.name}, {error.where}", do=error.do
            ) from error


def read_lookup_file(path: str | os.PathLike[str]) -> LookupFile:
    """Read a D2IMFILE or NPOLFILE without converting its values.

    Parameters
    ----------
    path : path-like
        D2IMFILE or NPOLFILE.

    Returns
    -------
    LookupFile
        The file, which `write_lookup_file` writes back unchanged.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is not a FITS file, is truncated, or has no tables.
    """
    return LookupFile(read_hdus(path), str(path))


def write_lookup_file(file: LookupFile, path: str | os.PathLike[str]) -> None:
    """Write a D2IMFILE or NPOLFILE atomically; a file that was read is written back unchanged.

    Parameters
    ----------
    file : LookupFile
        File to write.
    path : path-like
        Output file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_hdus(file.hdus, path)


def check_kind(file: LookupFile, kind: str) -> None:
    """Raise FormatError if a D2IMFILE is given in place of an NPOLFILE, or vice versa."""
    if file.kind != kind:
        names = {"d2im": "a D2IMFILE", "npol": "an NPOLFILE"}
        raise FormatError(
            f"is {names[file.kind]}, not {names[kind]}",
            where=file.name,
            do=f"read it with read_{file.kind}",
        )


# Fraction of the largest absolute value; a smaller maximum may become negative in processing.
_CLEARLY = 0.01


def one_per_chip(tables: Sequence[LookupTable], where: str) -> list[LookupTable]:
    """Tables in the order of the file: the highest chip first, so that EXTVER 1 is chip 2 of ACS.

    InputError if there is no table, or if two tables are for the same chip.
    """
    if not tables:
        raise InputError("no look-up table is given", where=where, do="give one for each chip")
    chip, count = Counter(t.chip for t in tables).most_common(1)[0]
    if count > 1:
        raise InputError(
            f"{count} look-up tables of chip {chip}", where=where, do="give one for each chip"
        )
    return sorted(tables, key=lambda table: -table.chip)


@dataclass(frozen=True, eq=False)
class ChipTables:
    """Tables of one chip; the reading program applies `turn` (2, 2) before it takes maxima."""

    table: LookupTable  # defines chip and grid
    values: Float  # (2, ny, nx)
    sigma: Float | None  # (2, ny, nx)
    turn: Float = field(default_factory=lambda: np.eye(2))

    def padding(self, columns: int) -> Float:
        """Columns to append for a chip with this many columns, shape (2, ny, n); n is often 0."""
        transformed = np.einsum("ab,byx->ayx", self.turn, self.values)
        largest = np.abs(transformed).max(axis=(1, 2))
        if not (transformed.max(axis=(1, 2)) < _CLEARLY * largest).any():
            return self.values[..., :0]
        last = self.table.nodes()[0][-1]
        # half a step beyond the detector, because the pixel may already have been shifted
        copies = int(np.ceil((columns + 0.5 - last) / self.table.step[0] + 0.5))
        beyond = np.linalg.solve(self.turn, np.full(2, largest.max()))
        column = np.broadcast_to(beyond[:, None, None], (*self.values.shape[:2], 1))
        copied = np.repeat(self.values[..., -1:], max(copies, 1), axis=-1)
        return np.concatenate([copied, column], axis=-1)


def lookup_file(
    parts: Sequence[ChipTables], *, size: tuple[int, int], cards: Sequence[str], name: str
) -> LookupFile:
    """File of all parts, in the order of EXTVER.

    `size` is the number of columns and rows of a chip, `cards` are added to the primary header, and
    `name` is for error messages.
    """
    primary = fits.PrimaryHDU()
    append_cards(primary, cards)
    hdus, sigmas = [primary], []
    for version, part in enumerate(parts, start=1):
        extra = part.padding(size[0])
        for axis, name_of_axis in enumerate(AXES):
            place = _place_cards(part.table, version, size)
            if n := extra.shape[-1]:
                place.append(number_card("BDPAD", n, "columns at the end that are no nodes"))
            plane = np.concatenate([part.values[axis], extra[axis]], axis=-1)
            hdus.append(_image(name_of_axis, plane, place))
            if part.sigma is not None:
                place = _place_cards(part.table, version, size)
                sigmas.append(_image(f"SIGMA_{name_of_axis}", part.sigma[axis], place))
    # after the tables: stwcs searches the extensions in order until it finds a table
    return LookupFile(hdus_of([*hdus, *sigmas]), name)


def _image(name: str, plane: Float, cards: Sequence[str]) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.asarray(plane, np.float32))
    append_cards(hdu, [text_card("EXTNAME", name), *cards])
    return hdu


def _place_cards(table: LookupTable, version: int, size: tuple[int, int]) -> list[str]:
    """Cards that register a table on the detector."""
    return [
        number_card("EXTVER", version),
        number_card("CCDCHIP", table.chip, "chip of the table"),
        number_card("ONAXIS1", int(size[0]), "columns of the chip"),
        number_card("ONAXIS2", int(size[1]), "rows of the chip"),
        *node_cards(table),
        text_card("BUNIT", "pixel"),
    ]


def reference_cards(
    instrument: str,
    detector: str,
    filetype: str,
    description: str,
    filters: Mapping[str, str],
    useafter: str | None,
    pedigree: str | None,
    history: Sequence[str],
) -> list[str]:
    """Header cards of a reference file; values that only the user knows come last."""
    texts = {
        "TELESCOP": "HST",
        "INSTRUME": instrument,
        "DETECTOR": detector,
        "FILETYPE": filetype,
        "OBSTYPE": "IMAGING",
        "DESCRIP": description,
        "CREATOR": "bayesdist",
        **filters,
    }
    user_values = {"USEAFTER": useafter, "PEDIGREE": pedigree}
    texts |= {keyword: text for keyword, text in user_values.items() if text}
    cards = [text_card(keyword, text) for keyword, text in texts.items()]
    return cards + wrapped_cards("HISTORY", history)
