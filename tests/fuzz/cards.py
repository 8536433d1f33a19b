"""Damage to FITS files: impossible keywords, lost extensions and columns, values that are none."""

from __future__ import annotations

import io
import re
import warnings
from functools import lru_cache

import numpy as np
from astropy.io import fits
from hypothesis import strategies as st

from tests.fuzz.mutation import KNOWABLE, OPEN, changes

BLOCK, CARD = 2880, 80
STRUCTURE = re.compile(rb"(SIMPLE|XTENSION|BITPIX|NAXIS\d*|PCOUNT|GCOUNT|TFIELDS|TFORM\d+|END) ")
IMPOSSIBLE = [
    "-1",
    "0",
    "1",
    "999",
    "100000",
    "2147483648",
    "99999999999999999999",
    "1.5",
    "nan",
    "'abc'",
    "T",
    "",
    "1e400",
    "-64",
    "8",
    "'1QE(9999999999)'",
    "'Q'",
    "'1PD'",
]
CARD_VALUES = [*IMPOSSIBLE, "inf", "-inf", "'nan'", "1e300", "-1e300", "(1,2)", "'", "''", "é"]
COLUMN = st.integers(0, 40)


def _cards(content: bytes) -> list[int]:
    """Where cards with a value begin."""
    out, at = [], 0
    while at + BLOCK <= len(content):
        if content[at : at + 8] in (b"SIMPLE  ", b"XTENSION"):
            while at + CARD <= len(content):
                card = content[at : at + CARD]
                if card[8:10] == b"= ":
                    out.append(at)
                at += CARD
                if card[:8] == b"END     ":
                    break
            at += -at % BLOCK
        else:
            at += BLOCK
    return out


def _of_a_card(structure: bool, **more):
    def arguments(content: bytes):
        found = [
            k
            for k, at in enumerate(_cards(content))
            if bool(STRUCTURE.match(content[at : at + 9].ljust(9))) == structure
        ]
        return st.fixed_dictionaries({"card": st.sampled_from(found), **more}) if found else None

    return arguments


def _with_card(content: bytes, card: int, change) -> bytes:
    found = _cards(content)
    at = found[card % len(found)]
    new = change(content[at : at + CARD])[:CARD].ljust(CARD)
    return content[:at] + new + content[at + CARD :]


def _valued(text: str):
    return lambda card: card[:10] + text.rjust(20).encode("latin-1")


@changes("headers", OPEN, "fits", arguments=_of_a_card(True, text=st.sampled_from(IMPOSSIBLE)))
def structure_is(content, card, text):
    """A keyword that says how the file is laid out."""
    return _with_card(content, card, _valued(text))


@changes("headers", OPEN, "fits", arguments=_of_a_card(False, text=st.sampled_from(CARD_VALUES)))
def keyword_is(content, card, text):
    return _with_card(content, card, _valued(text))


@changes(
    "no number",
    KNOWABLE,
    "fits",
    arguments=_of_a_card(False, text=st.sampled_from(["nan", "inf", "1e400"])),
)
def keyword_not_finite(content, card, text):
    return _with_card(content, card, _valued(text))


@changes("headers", OPEN, "fits", arguments=_of_a_card(False))
def keyword_lost(content, card):
    return _with_card(content, card, lambda _: b"COMMENT")


@changes("headers", OPEN, "fits", arguments=_of_a_card(False, other=st.integers(0, 60)))
def keyword_twice(content, card, other):
    """A card in the place of another, which is lost."""
    found = _cards(content)
    at = found[other % len(found)]
    return _with_card(content, card, lambda _: content[at : at + CARD])


def _opened(content: bytes) -> fits.HDUList:
    return fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False)


def _written(hdus) -> bytes:
    out = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fits.HDUList(list(hdus)).writeto(out, output_verify="silentfix")
    return out.getvalue()


@lru_cache(1)  # many kinds of damage ask for those of one file
def _extensions(content: bytes) -> list[int]:
    with _opened(content) as hdus:
        return [k for k, hdu in enumerate(hdus) if k and hdu.data is not None]


def _of_an_extension(**more):
    def arguments(content: bytes):
        found = _extensions(content)
        return st.fixed_dictionaries({"hdu": st.sampled_from(found), **more}) if found else None

    return arguments


@changes("lost fields", OPEN, "fits", arguments=_of_an_extension())
def extension_lost(content, hdu):
    with _opened(content) as hdus:
        return _written(one for k, one in enumerate(hdus) if k != hdu)


@changes("doubled rows", OPEN, "fits", arguments=_of_an_extension())
def extension_twice(content, hdu):
    with _opened(content) as hdus:
        return _written([*hdus, hdus[min(hdu, len(hdus) - 1)].copy()])


@changes("lost fields", OPEN, "fits", arguments=_of_an_extension(column=COLUMN))
def column_lost(content, hdu, column):
    with _opened(content) as hdus:
        one = hdus[min(hdu, len(hdus) - 1)]
        if not isinstance(one, fits.BinTableHDU):
            return content
        left = [c for k, c in enumerate(one.columns) if k != column % len(one.columns)]
        new = fits.BinTableHDU.from_columns(fits.ColDefs(left), name=one.name)
        return _written(new if k == hdu else h for k, h in enumerate(hdus))


def _set(content: bytes, hdu: int, column: int, row: float, value: float, whole: bool) -> bytes:
    with _opened(content) as hdus:
        data = hdus[min(hdu, len(hdus) - 1)].data
        if data is None:
            return content
        if data.dtype.names:
            names = [n for n in data.dtype.names if data[n].dtype.kind == "f"]
            if not names:
                return content
            data = data[names[column % len(names)]]
        if data.dtype.kind != "f" or not data.size:
            return content
        with np.errstate(over="ignore"):
            if whole:
                data[...] = value
            else:
                flat = np.unravel_index(int(row * (data.size - 1)), data.shape)
                data[flat] = value
        return _written(hdus)


ROW = {"column": COLUMN, "row": st.floats(0, 1)}


@changes(
    "no number",
    KNOWABLE,
    "fits",
    arguments=_of_an_extension(value=st.sampled_from([np.nan, np.inf, -np.inf]), **ROW),
)
def datum_not_finite(content, hdu, column, row, value):
    return _set(content, hdu, column, row, value, whole=False)


@changes(
    "odd numbers",
    OPEN,
    "fits",
    arguments=_of_an_extension(
        value=st.sampled_from([0.0, -1.0, 1e300, -1e300, np.nan, 1e-320]), **ROW
    ),
)
def data_are(content, hdu, column, row, value):
    return _set(content, hdu, column, row, value, whole=True)


@changes("bomb", KNOWABLE, "fits")
def deep_extensions(content):
    """Two thousand empty extensions behind the file's own."""
    empty = fits.ImageHDU().header.tostring().encode()
    return content + empty * 2000
