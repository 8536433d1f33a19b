"""Tables as others have them go through `init`, `check` and `run` without an edit."""

from __future__ import annotations

import tomllib

import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from bayesdist.infer import load_posterior
from tests.app.support import good
from tests.kinds.matches.layouts import field_of, plane_of
from tests.reduced import case_in_full, only_in_full

N = 300
FIELD = field_of(n=N)
EVERY = np.arange(N)


def table(**columns) -> Table:
    """Positions on the plane in arcsec, errors in mas; a column that is None is left out."""
    own = {
        "x": FIELD.x, "y": FIELD.y, "u": FIELD.xi * u.arcsec, "v": FIELD.eta * u.arcsec,
        "sigma_u": np.full(N, 7.0) * u.mas, "sigma_v": np.full(N, 7.0) * u.mas,
    }  # fmt: skip
    return Table({name: one for name, one in (own | columns).items() if one is not None})


def capitals() -> Table:
    out = table(mag=FIELD.mag, exposure=np.array(["a", "b", "c"])[EVERY % 3])
    out.rename_columns(out.colnames, [name.upper() for name in out.colnames])
    return out


BARE = {"sigma_u": None, "sigma_v": None}
SKY = BARE | {"u": None, "v": None, "RA": FIELD.ra * u.deg, "Dec": FIELD.dec * u.deg}
NAN = np.where(EVERY % 25 == 3, np.nan, FIELD.eta)
# name: table, lines of the configuration, words of `check`
CASES = {
    "degrees.ecsv": (table(**SKY), {}, ["300 of 300 rows", "u and v in arcsec"]),
    "mas.fits": (table(), {"sigma": "columns"}, ["median 0.007 arcsec"]),
    "masked.ecsv": (
        table(u=MaskedColumn(FIELD.xi, mask=EVERY % 30 == 0, unit="arcsec")),
        {"sigma": "columns"},
        ["290 of 300 rows", "10 rows: no value in column 'u'"],
    ),
    "nan.fits": (
        table(v=NAN * u.arcsec),
        {"not_finite": "reject"},
        ["288 of 300 rows", "12 rows: no value in column 'v'"],
    ),
    "nan_in_errors.ecsv": (
        table(sigma_v=np.where(EVERY % 25 == 3, np.nan, 7.0) * u.mas),
        {"not_finite": "reject"},
        ["288 of 300 rows", "12 rows: no value in column 'sigma_v'"],
    ),
    "capitals.ecsv": (capitals(), {"sigma": "columns"}, ["3 exposure(s)"]),
    "chips_by_name.fits": (
        table(chip=np.array(["CCD1", "CCD2"])[EVERY % 2]),
        {},
        ["CCD1 150 stars, CCD2 150 stars"],
    ),
    "chips_by_number.parquet": (
        table(chip=np.array(["1", "2"])[EVERY % 2]),
        {},
        ["chip 1 150 stars, chip 2 150 stars"],
    ),
    "errors_too_small.ecsv": (
        table(sigma_u=np.full(N, 0.1) * u.mas, sigma_v=np.full(N, 0.1) * u.mas, mag=FIELD.mag),
        {"sigma": "columns"},
        ["times as widely as the quoted errors say", 'data.sigma = "by_magnitude"'],
    ),
    "no_errors.ecsv": (table(**BARE), {}, ["300 of 300 rows"]),
    "no_errors_but_magnitudes.ecsv": (
        table(mag=FIELD.mag, **BARE),
        {"sigma": "by_magnitude"},
        ["(by magnitude)"],
    ),
}  # fmt: skip
RUN = (
    "errors_too_small.ecsv",
    *(
        case_in_full(name, instead="one table is run, and all are begun")
        for name in ("chips_by_name.fits", "nan.fits", "no_errors.ecsv")
    ),
)


def begun(folder, name):
    """Configuration that `init` has written for a table; it says which rows it left out."""
    CASES[name][0].write(folder / name)
    said = good("init", folder / "my.toml", "--matches", folder / name).err
    for word in CASES[name][2]:
        assert "cannot be stored in TOML" not in word or f"left out {word}" in said
    return folder / "my.toml"


@pytest.mark.parametrize("name", CASES)
def test_from_init_to_check(tmp_path, name):
    config = begun(tmp_path, name)
    _, lines, words = CASES[name]
    assert lines.items() <= tomllib.loads(config.read_text())["data"].items()
    out = good("check", config).out
    for word in words:
        assert word in out
    assert any(line.startswith("rank") for line in out.splitlines())


@only_in_full("tests/kinds/matches/test_layouts runs a layout")
@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("name", RUN)
def test_from_init_to_run(tmp_path, name):
    """Positions agree with the truth that no file holds."""
    good("run", begun(tmp_path, name), "-o", tmp_path / "run", "-q")
    posterior = load_posterior(tmp_path / "run")
    rng = np.random.default_rng(5)
    x, y = rng.uniform(100, 1900, 40), rng.uniform(100, 900, 40)
    true = np.array(plane_of(x, y)).T
    for chip in posterior.model.chips:
        draws = posterior.model.predict(posterior.flat[::10], x, y, chip=chip.number)
        pull = (draws.mean(axis=0) - true) / draws.std(axis=0)
        assert np.sqrt(np.mean(pull**2)) < 2.5
        assert np.abs(draws.mean(axis=0) - true).max() < 0.02  # arcsec; the centroids' are 0.005
