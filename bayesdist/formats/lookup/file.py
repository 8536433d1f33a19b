"""D2IMFILE and NPOLFILE: look-up tables of the distortion, as stwcs and astropy.wcs read them.

The files have image extensions DX and DY for each chip, identified by CCDCHIP. Node k (from 1) of
axis a is at pixel CRVALa + (k - CRPIXa) CDELTa. Without CRPIX and CRVAL both are taken as 0, so
that the first node is at pixel CDELT (astropy 6.1 and later; at pixel 1 before).

Files written by bayesdist have further content, which other programs ignore:

SIGMA_DX, SIGMA_DY
    Image extensions of the same shape with the standard error of each node.
BDPAD
    Number of columns at the right end that are padding (see
    `bayesdist.formats.lookup.build`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError, InputError
from bayesdist.model.lookup import LookupTable
from bayesdist.products.common.cards import named_in
from bayesdist.products.common.content import Hdu, read_hdus, write_hdus
from bayesdist.products.common.lookup_plane import Plane
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
    def planes(self) -> tuple[Plane, ...]:
        """Extensions DX and DY, in the order of the file."""
        return self._planes(AXES)

    @cached_property
    def sigma_planes(self) -> tuple[Plane, ...]:
        """Extensions SIGMA_DX and SIGMA_DY."""
        return self._planes(tuple(_SIGMA + a for a in AXES))

    def _planes(self, names: tuple[str, ...]) -> tuple[Plane, ...]:
        out = []
        for number, hdu in enumerate(self.hdus[1:], start=1):
            header, name = hdu.header, hdu.name
            image = str(header.get("XTENSION", "")).strip() == "IMAGE" and header["NAXIS"] == 2
            if name in names and image and hdu.data:
                out.append(Plane(hdu, name, f"{self.name}, HDU {number} ({name})"))
        return tuple(out)

    @property
    def chips(self) -> tuple[int, ...]:
        """Chip numbers, in the order of the file."""
        return tuple(dict.fromkeys(p.chip for p in self.planes))

    def pair(self, chip: int) -> tuple[Plane, Plane]:
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

    def _one(self, chip: int, axis: str) -> Plane:
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
