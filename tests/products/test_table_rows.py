"""Rows of binary tables, read here or by astropy: they are the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from bayesdist.products.formats.common import content
from bayesdist.products.formats.common.content import hdus_of

RNG = np.random.default_rng(3)
PLAIN = [
    fits.Column("NAME", "6A", array=["a", "bc  d", ""]),
    fits.Column("ONE", "A", array=["x", "y", "z"]),
    fits.Column("BYTE", "B", array=[0, 7, 255]),
    fits.Column("SHORT", "1I", array=[-3, 0, 32_000]),
    fits.Column("INT", "J", array=[-(2**31), 0, 2**31 - 1]),
    fits.Column("LONG", "K", array=[-(2**62), 0, 2**62]),
    fits.Column("SINGLE", "E", array=[np.nan, -0.0, 1e-30]),
    fits.Column("Double", "1D", array=RNG.normal(size=3)),
    fits.Column("VECTOR", "4D", array=RNG.normal(size=(3, 4))),
]
SPECIAL = {
    "scaled": fits.Column("X", "J", bzero=2**31, array=np.array([0, 5, 2**32 - 1], np.uint32)),
    "logical": fits.Column("X", "L", array=[True, False, True]),
    "matrix": fits.Column("X", "4D", dim="(2,2)", array=RNG.normal(size=(3, 2, 2))),
    "texts": fits.Column("X", "8A", dim="(4,2)", array=[["ab", "c"]] * 3),
}


def same(hdu: fits.BinTableHDU, found: np.ndarray) -> None:
    expected = fits.BinTableHDU.fromstring(hdus_of([fits.PrimaryHDU(), hdu])[1].to_bytes()).data
    assert list(found.dtype.names) == list(expected.names)
    for name in expected.names:
        np.testing.assert_array_equal(found[name], np.asarray(expected[name]))
        assert found.dtype[name].isnative


def test_text_and_numbers_are_those_of_astropy(monkeypatch):
    hdu = fits.BinTableHDU.from_columns(PLAIN, name="ROWS")
    [_, table] = hdus_of([fits.PrimaryHDU(), hdu])
    monkeypatch.setattr(content.fits.BinTableHDU, "fromstring", lambda _: pytest.fail("by astropy"))
    rows = table.rows
    monkeypatch.undo()
    same(hdu, rows)
    assert rows["NAME"].tolist() == ["a", "bc  d", ""]


@pytest.mark.parametrize("kind", SPECIAL)
def test_others_are_read_by_astropy(kind):
    hdu = fits.BinTableHDU.from_columns([*PLAIN, SPECIAL[kind]])
    [_, table] = hdus_of([fits.PrimaryHDU(), hdu])
    assert content._plain_rows(table.cards, table.header, table.data) is None
    same(hdu, table.rows)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("NAXIS1  =                   66", "NAXIS1  =                   67"),
        ("TTYPE3  = 'BYTE    '", "TTYPE4  = 'BYTE    '"),
        ("TFORM3  = 'B       '", "TFORM3  = 'Z       '"),
        ("NAXIS2  =                    3", "NAXIS2  =                  1e9"),
        ("NAXIS2  =                    3", "NAXIS2  =            300000000"),
    ],
)
def test_tables_that_contradict_themselves_are_left_to_astropy(old, new):
    [_, table] = hdus_of([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(PLAIN)])
    cards = tuple(card.replace(old, new) for card in table.cards)
    assert cards != table.cards
    other = replace(table, cards=cards)
    assert content._plain_rows(cards, other.header, other.data) is None
