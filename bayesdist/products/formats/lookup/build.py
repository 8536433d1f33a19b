"""Extensions of a D2IMFILE or NPOLFILE, so that no consumer drops or misplaces a table.

**Registration.** CRPIX, CRVAL and CDELT are always written (see `lookup_file`).

**Padding.** stwcs notes as the size of a correction the maximum of its table, not of the absolute
value, and astropy.wcs leaves out a table whose maximum is below zero.  Where no node is clearly
above zero, columns are added at the right end: copies of the last one until the detector has ended,
so that nothing changes there, then one that is positive and that no pixel reaches.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from astropy.io import fits

from bayesdist.errors import InputError
from bayesdist.model.lookup import LookupTable
from bayesdist.products.formats.common.cards import (
    append_cards,
    node_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.formats.common.content import hdus_of
from bayesdist.products.formats.lookup.file import AXES, LookupFile
from bayesdist.utils.arrays import Float

# A maximum below this fraction of the largest absolute value may turn negative on the way.
_CLEARLY = 0.01


def one_per_chip(tables: Sequence[LookupTable], where: str) -> list[LookupTable]:
    """Tables in the order of the file: the highest chip first, so that EXTVER 1 is chip 2 of ACS.

    InputError when there is none, or two of one chip.
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
class Part:
    """Tables of one chip in the file; the consumer applies `turn` (2, 2) before it takes maxima."""

    table: LookupTable  # for its chip and grid
    values: Float  # (2, ny, nx)
    sigma: Float | None  # (2, ny, nx)
    turn: Float = field(default_factory=lambda: np.eye(2))

    def padding(self, columns: int) -> Float:
        """Columns to be added for a chip of so many columns, shape (2, ny, n); n is often 0."""
        seen = np.einsum("ab,byx->ayx", self.turn, self.values)
        largest = np.abs(seen).max(axis=(1, 2))
        if not (seen.max(axis=(1, 2)) < _CLEARLY * largest).any():
            return self.values[..., :0]
        last = self.table.nodes()[0][-1]
        # half a step more than the detector, since the pixel may have been shifted already
        copies = int(np.ceil((columns + 0.5 - last) / self.table.step[0] + 0.5))
        beyond = np.linalg.solve(self.turn, np.full(2, largest.max()))
        column = np.broadcast_to(beyond[:, None, None], (*self.values.shape[:2], 1))
        same = np.repeat(self.values[..., -1:], max(copies, 1), axis=-1)
        return np.concatenate([same, column], axis=-1)


def lookup_file(
    parts: Sequence[Part], *, size: tuple[int, int], cards: Sequence[str], name: str
) -> LookupFile:
    """File of all its parts, in the order of EXTVER.

    `size` is the columns and rows of a chip, `cards` are of the primary header, `name` is for
    errors.
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
    # stwcs goes through the extensions in turn until it has found its own
    return LookupFile(hdus_of([*hdus, *sigmas]), name)


def _image(name: str, plane: Float, cards: Sequence[str]) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.asarray(plane, np.float32))
    append_cards(hdu, [text_card("EXTNAME", name), *cards])
    return hdu


def _place_cards(table: LookupTable, version: int, size: tuple[int, int]) -> list[str]:
    """Cards of the registration of a table."""
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
    """Cards of a reference file, those of values that only the user knows at the end."""
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
    known = {"USEAFTER": useafter, "PEDIGREE": pedigree}
    texts |= {keyword: text for keyword, text in known.items() if text}
    cards = [text_card(keyword, text) for keyword, text in texts.items()]
    return cards + wrapped_cards("HISTORY", history)
