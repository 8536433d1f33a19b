"""Extensions of a D2IMFILE or NPOLFILE that no program drops or misplaces.

**Registration.** CRPIX, CRVAL and CDELT are always written (see `lookup_file`).

**Padding.** stwcs records the maximum of a table, not of its absolute value, as the size of the
correction, and astropy.wcs ignores a table with a negative maximum. If no node is clearly positive,
columns are therefore appended at the right end: copies of the last column up to the edge of the
detector, so that nothing changes there, and then one positive column that no pixel reaches.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from astropy.io import fits

from bayesdist.errors import InputError
from bayesdist.formats.lookup.file import AXES, LookupFile
from bayesdist.model.lookup import LookupTable
from bayesdist.products.common.cards import (
    append_cards,
    node_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.content import hdus_of
from bayesdist.utils.arrays import Float

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
class Part:
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
    parts: Sequence[Part], *, size: tuple[int, int], cards: Sequence[str], name: str
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
