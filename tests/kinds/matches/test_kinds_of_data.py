"""Other formats, units, exposures, epochs and outliers, through the stages of a run."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS, FITSFixedWarning

from bayesdist.infer import load_fit, load_posterior
from bayesdist.model import TimeDependence
from bayesdist.simulate import simulate_matches
from tests.app.support import (
    SIZE,
    as_table,
    cli,
    good,
    model_of,
    partly_run,
    simulated,
    summary_of,
    truth_of,
    write_config,
    write_job,
)
from tests.reduced import only_in_full

SCALE = 0.05  # arcsec in a pixel
COLUMNS = {"x": "XRAW", "y": "YRAW", "u": "XI", "v": "ETA", "sigma_u": "E_XI", "sigma_v": "E_ETA"}
CRVAL = (150.1, 2.2)


def _arcsec_table() -> tuple[Table, np.ndarray]:
    """Offsets in arcsec under names of their own, without units in the file; and the truth."""
    model = model_of(unit="arcsec")
    theta = truth_of(model, SCALE, offset=False)
    matches, _ = simulate_matches(
        model,
        theta,
        400,
        rng=np.random.default_rng(11),
        sigma=0.02 * SCALE,
        outlier_scale=0.5 * SCALE,
        fraction=0.04,
    )
    table = as_table(matches, unit=None)
    for ours, theirs in COLUMNS.items():
        table.rename_column(ours, theirs)
    table["u"] = 0.0  # not what the mapping says
    return table, theta


@pytest.fixture(scope="module")
def arcsec(tmp_path_factory):
    """The run of a FITS table, with the same data in other formats beside it."""
    folder = tmp_path_factory.mktemp("arcsec")
    table, theta = _arcsec_table()
    for suffix in ("fits", "csv", "parquet"):
        table.write(folder / f"stars.{suffix}")
        config = write_config(
            folder / f"{suffix}.toml",
            data={"matches": f"stars.{suffix}", "columns": COLUMNS, "unit": "arcsec"},
            requirement=[
                {"name": f"in {unit}", "statistic": "p90", "limit": 1.0, "unit": unit}
                for unit in ("pix", "arcsec", "mas")
            ],
            products={"sip": {"linear": "cd", "crval": CRVAL}},
        )
    run = partly_run(
        folder / "run", folder / "fits.toml", "fit", "sample", "assess", "export", "report"
    )
    assert config.exists()
    return folder, run, theta


@pytest.mark.slow
@only_in_full("tests/data reads each format")
def test_formats_hold_the_same_data(arcsec):
    folder, run, _ = arcsec
    one = load_fit(run / "fit.nc")
    for suffix in ("csv", "parquet"):
        other = load_fit(
            partly_run(folder / f"run_{suffix}", folder / f"{suffix}.toml", "fit") / "fit.nc"
        )
        np.testing.assert_allclose(other.mean, one.mean, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(other.cov, one.cov, rtol=1e-9)


def test_parts_of_a_table_are_not_exposures_but_files_are(arcsec):
    folder, run, _ = arcsec
    whole = Table.read(folder / "stars.fits")
    (folder / "parts").mkdir()
    for name, part in (("a", whole[:150]), ("b", whole[150:])):
        part.write(folder / "parts" / f"{name}.parquet")
        part.write(folder / f"part_{name}.fits")
    common = {"columns": COLUMNS, "unit": "arcsec"}
    config = write_config(folder / "parts.toml", data={"matches": "parts"} | common)
    assert "1 exposure(s)" in good("check", config).out
    config.write_text(config.read_text().replace('"parts"', f'"{folder / "parts"}"'))
    other = partly_run(folder / "run_parts", config, "fit", "sample")
    np.testing.assert_array_equal(load_fit(other / "fit.nc").mean, load_fit(run / "fit.nc").mean)
    for matches in ("part_*.fits", ["part_a.fits", "part_b.fits"]):
        config = write_config(folder / "list.toml", data={"matches": matches} | common)
        assert "2 exposure(s)" in good("check", config).out
    # a part that comes later is a change of the input
    whole[:1].write(folder / "parts" / "c.parquet")
    result = cli("stage", "assess", other)
    assert result.code == 1 and "c.parquet" in result.err and "changed" in result.err


def test_angular_truth_is_recovered(arcsec):
    _, run, theta = arcsec
    posterior = load_posterior(run)
    assert posterior.unit == "arcsec" and summary_of(run)["fit"]["unit"] == "arcsec"
    off = posterior.mean - theta
    assert off @ np.linalg.solve(posterior.cov, off) < 35  # 12 degrees of freedom, p = 5e-4
    assert summary_of(run)["fit"]["rms_u"] == pytest.approx(0.02 * SCALE, rel=0.2)


def test_a_requirement_in_pixels_uses_the_scale_of_the_solution(arcsec):
    pix, arcs, mas = (m["value"] for m in summary_of(arcsec[1])["margins"])
    assert mas == pytest.approx(1000 * arcs)
    assert pix == pytest.approx(arcs / SCALE, rel=1e-3)


def test_sip_with_cd_puts_stars_on_the_sky(arcsec, rng):
    _, run, _ = arcsec
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(fits.Header.fromtextfile(run / "sip.hdr"))
    np.testing.assert_allclose(wcs.wcs.crval, CRVAL)
    pixels = 0.5 + rng.uniform(size=(500, 2)) * SIZE
    posterior = load_posterior(run)
    offset = posterior.model.predict(posterior.mean, *pixels.T)
    centre = posterior.model.predict(posterior.mean, *wcs.wcs.crpix[:, None])
    xi, eta = np.deg2rad((offset - centre) / 3600).T
    ra0, dec0 = np.deg2rad(CRVAL)
    # gnomonic projection, inverted by its definition
    bottom = np.cos(dec0) - eta * np.sin(dec0)
    ra = ra0 + np.arctan2(xi, bottom)
    dec = np.arctan2(np.sin(dec0) + eta * np.cos(dec0), np.hypot(xi, bottom))
    found = np.deg2rad(wcs.all_pix2world(pixels, 1)).T
    mas = np.rad2deg(1) * 3.6e6
    np.testing.assert_allclose((found[0] - ra) * np.cos(dec) * mas, 0, atol=1e-5)
    np.testing.assert_allclose((found[1] - dec) * mas, 0, atol=1e-5)


# -- exposures and epochs -------------------------------------------------------------------------


def test_exposures_with_frames(tmp_path):
    names = ("a", "b", "c")
    model = model_of(frames="shift_rotation_scale", exposures=names, origin=(500.0, 400.0))
    theta = truth_of(model)
    theta[model.n_global :] = [3.0, -2.0, 1e-3, 2e-4, -8.0, 5.0, -4e-3, -1e-4]
    matches, _ = simulate_matches(
        model, theta, 900, rng=np.random.default_rng(5), sigma=0.02, outlier_scale=0.5
    )
    config = write_job(
        tmp_path / "job",
        as_table(matches),
        model={"order": 2, "reference_pixel": (500.5, 400.5), "frames": "shift_rotation_scale"},
        data={"matches": "stars.ecsv", "columns": {"exposure": "exposure"}},
        products={"sip": {}},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess", "export")
    posterior = load_posterior(run)
    assert posterior.model.exposures == names and posterior.model.n_params == 20
    # frames turn about an origin of the program's choice: compare what does not depend on it
    x, y = np.array([200.0, 800.0, 500.0]), np.array([700.0, 100.0, 400.0])
    for k in range(3):
        where = np.full(3, k)
        true = model.predict(theta, x, y, exposure=where)
        drawn = posterior.model.predict(posterior.flat[::10], x, y, exposure=where)
        pull = (drawn.mean(axis=0) - true) / drawn.std(axis=0)
        assert np.abs(pull).max() < 4.5
    names = Table.read(run / "coefficients.ecsv")["form"]
    assert (names == "frame").sum() == 8
    assert summary_of(run)["data"]["n_exposures"] == 3
    assert any(r["name"] != "coefficients" for r in summary_of(run)["budget"][:-1])


@pytest.mark.slow
@only_in_full("test_budget_and_validity has a drift")
def test_drift_with_time(tmp_path):
    """Terms that drift: the rate is recovered, and the error grows away from the data."""
    names, epochs = ("a", "b", "c", "d"), (2004.0, 2006.0, 2008.0, 2010.0)
    time = TimeDependence((("u", 1, 0), ("v", 1, 0)), (2004.5,))
    model = model_of(time=time, exposures=names)
    theta = truth_of(model)
    rates = [k for k, name in enumerate(model.names) if "rate" in name]
    theta[rates] = [0.015, -0.008]
    matches, _ = simulate_matches(
        model,
        theta,
        800,
        rng=np.random.default_rng(6),
        sigma=0.02,
        outlier_scale=0.5,
        epochs=epochs,
    )
    requirement = [
        {"name": str(t), "statistic": "p95", "limit": 0.1, "epoch": t} for t in (2007.0, 2040.0)
    ] + [{"name": "of the assessment", "statistic": "p95", "limit": 0.1}]
    config = write_job(
        tmp_path / "job",
        as_table(matches),
        **{"model.tdd": {"epoch0": 2004.5, "terms": [["u", 1, 0], ["v", 1, 0]]}},
        assess={"epoch": 2007.0, "grid": (9, 7), "draws": 400},
        requirement=requirement,
        products={"sip": {}},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess", "export")
    posterior = load_posterior(run)
    pull = (posterior.mean - theta) / posterior.sigma
    assert np.abs(pull).max() < 4.5
    now, later, same = summary_of(run)["margins"]
    assert (now["epoch"], later["epoch"], same["epoch"]) == (2007.0, 2040.0, 2007.0)
    assert later["value"] > 3 * now["value"]
    assert same["value"] == pytest.approx(now["value"])
    assert summary_of(run)["map"]["epoch"] == 2007.0
    assert fits.getheader(run / "maps.fits", "MIX_SIGMA_U")["EPOCH"] == 2007.0
    # the header is that of the assessment's epoch
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        cd = WCS(fits.Header.fromtextfile(run / "sip.hdr")).wcs.cd * 3600
    x, y = np.array([500.5, 501.5]), np.array([400.5, 400.5])
    at = posterior.model.predict(posterior.mean, x, y, epoch=np.full(2, 2007.0))
    assert cd[0, 0] == pytest.approx(at[1, 0] - at[0, 0], abs=2e-5)


# -- outliers -------------------------------------------------------------------------------------


@pytest.mark.slow
@only_in_full("test_match_circle has one")
def test_uniform_outliers_on_the_match_circle(tmp_path):
    matches, truth = simulated(outliers="uniform", outlier_scale=1.0, fraction=0.1, seed=8)
    config = write_job(
        tmp_path / "job", as_table(matches), outliers={"model": "uniform", "match_radius": 1.0}
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    posterior = load_posterior(run)
    assert set(posterior.hyper) == {"j", "f"}
    outliers = summary_of(run)["outliers"]
    assert outliers["model"] == "uniform" and "scale" not in outliers
    share = truth.false.mean()
    assert abs(outliers["fraction"]["mean"] - share) < 3 * outliers["fraction"]["sd"]
    assert abs(outliers["jitter"]["mean"] - truth.jitter) < 4 * outliers["jitter"]["sd"]
    pull = (posterior.mean - truth.theta) / posterior.sigma
    assert np.abs(pull).max() < 4.5


@pytest.mark.slow
@only_in_full("tests/infer/test_closed_form samples it")
def test_without_outliers_and_jitter_it_is_least_squares(tmp_path):
    """The closed form is the oracle: errors known, nothing false."""
    matches, _ = simulated(fraction=0.0, jitter=0.0, seed=9)
    config = write_job(
        tmp_path / "job",
        as_table(matches),
        outliers={"model": "none", "jitter": 0.0},
        fit={"clip_chi2": 1e6},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess", "report")
    fit, posterior = load_fit(run / "fit.nc"), load_posterior(run)
    assert fit.n_used == fit.n_rows == 400 and posterior.hyper == {}
    c = posterior.convergence
    assert (np.abs(posterior.mean - fit.mean) < 4.5 * c.mcse_mean).all()
    assert (np.abs(posterior.sigma - fit.sigma) < 4.5 * np.maximum(c.mcse_sd, 1e-12)).all()
    outliers = summary_of(run)["outliers"]
    assert outliers["fraction"] == {"mean": 0.0, "sd": 0.0} == outliers["jitter"]
    assert outliers["n_flagged"] == 0


def test_errors_by_magnitude(tmp_path):
    """A table without errors: they are estimated, 0.01 px at the bright end, 0.06 at the faint."""

    def quoted(mag):
        sigma = 0.01 * 10 ** (0.13 * (mag - 12.0))
        return sigma, sigma

    n = 4000
    matches, _ = simulated(
        n, seed=10, mag=np.linspace(12, 18, n), sigma=quoted, jitter=0.0, fraction=0.02
    )
    table = as_table(matches)
    table.remove_columns(["sigma_u", "sigma_v"])
    config = write_job(
        tmp_path / "job", table, data={"matches": "stars.ecsv", "sigma": "by_magnitude"}
    )
    run = partly_run(tmp_path / "run", config, "fit")
    errors = Table.read(run / "magnitude_errors.ecsv")
    true = quoted(np.asarray(errors["mag"]))[0]
    np.testing.assert_allclose(errors["sigma_u"], true, rtol=0.25)
    np.testing.assert_allclose(errors["sigma_v"], true, rtol=0.25)
    good("stage", "sample", run)
    good("stage", "assess", run)
    posterior = load_posterior(run)
    assert posterior.n_stars == n
    assert 0.01 < posterior.n_flagged / n < 0.03
