from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data.exposures import (
    Exposure,
    ExposureLog,
    read_exposures,
    write_exposures,
)
from bayesdist.data.sky import velocity_aberration
from bayesdist.errors import InputError

LOG = ExposureLog(
    (
        Exposure("j1", 2003.25, "F606W", 339.0, 1.00001, 12.5, 5.6, -72.1),
        Exposure("j2", 2008.5, "F814W", vafactor=0.99999, ra=5.6, dec=-72.1),
        Exposure("j3", 2011.75, ra=5.6, dec=-72.1),
    )
)


@pytest.mark.parametrize("suffix", [".ecsv", ".csv", ".fits"])
def test_a_log_is_read_as_it_was_written(tmp_path, suffix):
    path = tmp_path / f"log{suffix}"
    write_exposures(LOG, path)
    again = read_exposures(path)
    assert again.exposures == LOG.exposures
    assert again.source == str(path)


def test_what_no_exposure_has_is_no_column(tmp_path):
    path = tmp_path / "log.ecsv"
    write_exposures(ExposureLog((Exposure("a", 2004.0, "F606W"),)), path)
    assert Table.read(path).colnames == ["exposure", "epoch", "filter"]


def test_dates_become_years_and_units_are_heeded(tmp_path):
    t = Table({"exposure": ["a", "b"], "date": ["2004-01-01", "2004-07-01T12:00:00"]})
    t["pa_v3"] = [np.pi, 0.5]
    t["pa_v3"].unit = "rad"
    t.write(tmp_path / "log.ecsv")
    log = read_exposures(tmp_path / "log.ecsv")
    assert log["a"].epoch == pytest.approx(2004.0)
    assert log["b"].epoch == pytest.approx(2004.0 + 182.5 / 366)
    assert log["a"].pa_v3 == pytest.approx(180.0)


def test_selection_and_order():
    assert LOG.filters == ("F606W", "F814W", "")
    assert LOG.names == ("j1", "j2", "j3") and len(LOG) == 3 and "j2" in LOG
    assert LOG.select(filter="F814W").names == ("j2",)
    assert LOG.select(names=["j3", "j1"]).names == ("j1", "j3")
    np.testing.assert_array_equal(LOG.values("pa_v3"), [12.5, np.nan, np.nan])
    with pytest.raises(InputError, match="no exposure has filter F475W"):
        LOG.select(filter="F475W")


def test_what_is_missing_is_named():
    LOG.require("ra", "dec")
    with pytest.raises(InputError, match="exposure j3 has no vafactor"):
        LOG.require("vafactor")
    with pytest.raises(InputError, match="exposure j3 has no filter"):
        LOG.require("filter")
    with pytest.raises(InputError, match="has no exposure 'j9'"):
        LOG["j9"]


def test_aberration_is_filled_in_only_where_it_is_missing():
    full = LOG.with_aberration()
    assert full["j1"] == LOG["j1"] and full["j2"] == LOG["j2"]
    assert full["j3"].vafactor == velocity_aberration(2011.75, 5.6, -72.1)
    full.require("vafactor")
    with pytest.raises(InputError, match="exposure b has neither vafactor nor ra and dec"):
        ExposureLog((Exposure("b", 2004.0),)).with_aberration()


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"exposure": ["a", "a"], "epoch": [2004.0, 2005.0]}, "exposure a occurs twice"),
        ({"exposure": ["a", "b"], "epoch": [2004.0, 1e5]}, r"row 2, column 'epoch': .* not a year"),
        ({"exposure": ["a", "b"]}, "no column for 'epoch'"),
        (
            {"exposure": ["a", "b"], "epoch": [2004.0, 2005.0], "vafactor": [1.0, 5.0]},
            r"row 2, exposure b: vafactor is 5\.0",
        ),
        (
            {"exposure": ["a", "b"], "epoch": [2004.0, 2005.0], "ra": ["", "east"]},
            "row 2, column 'ra': 'east' is not a number",
        ),
    ],
)
def test_wrong_logs_are_named(tmp_path, columns, message):
    Table(columns).write(tmp_path / "log.csv")
    with pytest.raises(InputError, match=message):
        read_exposures(tmp_path / "log.csv")


@pytest.mark.parametrize("suffix", [".csv", ".ecsv", ".fits", ".parquet"])
def test_nan_is_a_missing_value_with_a_warning(tmp_path, caplog, suffix):
    """FITS has no other way to write that a number is missing, and there it is no news."""
    columns = {"exposure": ["a", "b"], "epoch": [2004.0, 2005.0], "exptime": [339.0, np.nan]}
    Table(columns).write(tmp_path / f"log{suffix}")
    log = read_exposures(tmp_path / f"log{suffix}")
    assert [exposure.exptime for exposure in log] == [339.0, None]
    warned = "column 'exptime': NaN in 1 of 2 rows counts as a missing value" in caplog.text
    assert warned == (suffix != ".fits")


def test_a_log_needs_exposures_and_a_known_extension(tmp_path):
    with pytest.raises(InputError, match="holds no exposures"):
        ExposureLog(())
    with pytest.raises(InputError, match=r"extension '\.txt'"):
        write_exposures(LOG, tmp_path / "log.txt")
