"""Commanded offsets come to the unit of the plane, pixels among them."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.errors import InputError
from bayesdist.kinds.selfcal.inputs import read_commanded


def commanded(folder, given: str, unit: str, scale_mas: float | None):
    table = Table({"exposure": ["a", "b"], "du": [0.0, 10.0], "dv": [0.0, -5.0]})
    table["sigma"] = [1.0, 2.0]
    for name in ("du", "dv", "sigma"):
        table[name].unit = given
    table.write(folder / "commanded.ecsv", overwrite=True)
    return read_commanded(folder / "commanded.ecsv", ["b", "a"], unit, scale_mas, None)


@pytest.mark.parametrize(
    ("given", "unit", "factor"),
    [("pix", "arcsec", 0.05), ("arcsec", "pix", 20.0), ("mas", "arcsec", 1e-3), ("pix", "pix", 1)],
)
def test_offsets_come_to_the_unit_of_the_plane(tmp_path, given, unit, factor):
    found = commanded(tmp_path, given, unit, 50.0)
    np.testing.assert_allclose(found.offsets, factor * np.array([[10.0, -5.0], [0.0, 0.0]]))
    np.testing.assert_allclose(found.sigma, factor * np.array([2.0, 1.0]))


def test_pixels_need_their_size(tmp_path):
    with pytest.raises(InputError, match=r"offsets are in pix, but u and v are in arcsec"):
        commanded(tmp_path, "pix", "arcsec", None)


@pytest.mark.parametrize(("name", "value"), [("du", 1.9e172), ("sigma", 1e9), ("roll", 1e5)])
def test_implausibly_large_numbers_are_refused_by_row(tmp_path, name, value):
    table = Table({"exposure": ["a", "b"], "du": [0.0, 10.0], "dv": [0.0, -5.0]})
    table["sigma"], table["roll"] = 1.0, 90.0
    table[name][1] = value
    table.write(tmp_path / "commanded.csv")
    with pytest.raises(InputError, match=rf"row 2, column '{name}': is implausibly large"):
        read_commanded(tmp_path / "commanded.csv", ["a", "b"], "pix", None, None)
