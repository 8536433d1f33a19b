"""Text of all kinds in files of every format: FITS headers hold it in ASCII."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from bayesdist.app.commands.inputs import fits_table
from bayesdist.calibration.chip_map import FurtherError
from bayesdist.errors import InputError
from bayesdist.files.atomic import LONGEST_NAME, refuse_unsafe_name
from bayesdist.model import Chip
from bayesdist.products import registry
from bayesdist.utils.text import ascii_of, refuse_control_characters
from tests.formats.test_formats import OPTIONS, SETTINGS, calibration_for

TEXTS = {
    "accents": "Détecteur nº 2 – «σ»",
    "controls": "a\tb\nc\0d\x1b[2J\x7f",
    "separators": "a\u2028b\u2029c\u202ed",
    "other scripts": "检测器 детектор 😀",
    "quotes": 'it\'s "q" & <b> \\ /',
    "long": "Ünïcode " * 500,
    "blank": "   ",
}
OF_ONE_DETECTOR = ("wise_meta", "jwst", "roman")  # formats that know detectors by name


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
@pytest.mark.parametrize("key", sorted(SETTINGS))
def test_files_of_every_format_hold_any_text(key, text):
    calibration = calibration_for(key)
    hostile = replace(
        calibration,
        name=text,
        detector=calibration.detector if key in OF_ONE_DETECTOR else text,
        filter=text,
        notes=(text,),
        further=(FurtherError(text, "local", 0.1, 0.2, text, ((0.5, 100.0),)),),
        plane=replace(calibration.plane, note=text),
    )
    settings = registry.product_settings()[key](**SETTINGS[key])
    for built in registry.build(key, hostile, settings, OPTIONS):
        if built.content.startswith(b"#ASDF"):  # UTF-8, with escapes
            continue
        if not built.content.startswith(b"SIMPLE"):
            text_of_file = built.content.decode("ascii")
            assert all(line.isprintable() for line in text_of_file.split("\n"))
            continue
        with fits.HDUList.fromstring(built.content) as hdus:
            hdus.verify("exception")
            cards = "".join(hdu.header.tostring() for hdu in hdus)
        assert cards.isascii() and cards.isprintable()


def test_ascii_spells_letters_out_and_marks_what_it_cannot_spell():
    assert ascii_of("Détecteur Ångström – ﬁt, Ωμσ") == "Detecteur Angstrom - fit, Omegamusigma"
    assert ascii_of("a\tb\0c 检") == "a?b?c ?"
    plain = "".join(map(chr, range(32, 127)))
    assert ascii_of(plain) == plain
    every = "".join(map(chr, [*range(0x3000), 0x1F600, 0xD800]))
    assert ascii_of(every).isascii() and ascii_of(every).isprintable()


@pytest.mark.parametrize("name", ["a\0b", "a\nb", "a\tb", "\x1b[2J", "a\x85b", "a\u2028b"])
def test_names_with_control_characters_are_refused(name):
    with pytest.raises(InputError, match=r"control character U\+(00|2028)"):
        refuse_control_characters(["good", name], "column 'exposure'")
    with pytest.raises(InputError, match="chip 1"):
        Chip(1, name, (10, 10), (5.5, 5.5))
    refuse_control_characters(["Détecteur 检测器 😀"], "anywhere")


@pytest.mark.parametrize("name", ["", "a/b", "a\\b", "a\nb", "é" * LONGEST_NAME])
def test_names_that_are_none_of_a_file(name):
    with pytest.raises(InputError, match="cannot be the name of a file"):
        refuse_unsafe_name(name, where="products.idctab")


def test_a_table_is_written_as_fits_in_ascii(tmp_path):
    table = Table(
        {"é": ["σ", "b"], "x": [1.0, 2.0], "m": MaskedColumn(["ü", ""], mask=[False, True])}
    )
    table.meta = {"Détecteur": "é\n", "comments": ["é"]}
    fits_table(table).write(tmp_path / "a.fits")
    back = Table.read(tmp_path / "a.fits")
    assert back.colnames == ["e", "x", "m"]
    assert list(back["e"]) == ["sigma", "b"] and np.ma.getmaskarray(back["m"]).tolist()[1]
    assert back.meta["DETECTEU"] == "e?"
    assert table["é"][0] == "σ"  # the table itself stays as it was
