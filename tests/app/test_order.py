"""`bayesdist select-order`: the order that the data were made with, from what a run would read."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import write_partitioned
from bayesdist.simulate import simulate_matches
from tests.app.support import (
    SIGMA,
    SIZE,
    as_table,
    good,
    model_of,
    refused,
    simulated,
    truth_of,
    write_config,
    write_job,
)

BINS = 31
CHIPS = [
    {"number": n, "name": f"C{n}", "size": SIZE, "reference_pixel": (500.5, 400.5)} for n in (1, 2)
]


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """Pairs of order 2 with equal errors and without false ones; the configuration says 3."""
    matches, _ = simulated(20_000, fraction=0.0, jitter=0.0)
    folder = tmp_path_factory.mktemp("order")
    config = write_job(folder, as_table(matches), stars="stars.parquet", model={"order": 3})
    result = good(
        "select-order",
        config,
        "--orders",
        1,
        4,
        "-o",
        folder / "o.ecsv",
        "--figure",
        folder / "o.png",
    )
    return matches, folder, config, result


def test_the_order_of_the_truth_is_found_and_said(job):
    _, folder, _, result = job
    table = Table.read(folder / "o.ecsv")
    assert table.meta["order"] == 2 and list(table["order"]) == [1, 2, 3, 4]
    assert list(table["terms"]) == [3, 6, 10, 15]
    assert table.meta["verdict"] in result.out
    assert "Order 2 is as good as any up to 4" in result.out
    assert (folder / "o.png").read_bytes().startswith(b"\x89PNG")
    # one table: surfaces and what is held out, the chosen order marked
    line = next(one for one in result.out.splitlines() if one.startswith("2 *"))
    assert "+-" not in line
    assert table["stars"][0] < -5 * table["stars_error"][0] < 0
    assert np.isnan(table["stars"][1]) and table["lost"][-1] == 0


def test_the_surfaces_are_those_of_numpy(job):
    """Means of bins against the means of powers over the same stars; all errors are equal.

    Clipping at 5 sigma leaves out one star in 270 000 of two axes.
    """
    matches, folder, _, _ = job
    table = Table.read(folder / "o.ecsv")
    X, Y = (2 * (z - 0.5) / n - 1 for z, n in zip((matches.x, matches.y), SIZE, strict=True))
    ix, iy = (((z + 1) * BINS / 2).astype(int) for z in (X, Y))
    n = np.bincount(iy * BINS + ix, minlength=BINS**2)
    assert table.meta["n_bins"] == (n > 0).sum()
    for row in table:
        powers = [X**i * Y**j for i in range(row["order"] + 1) for j in range(row["order"] + 1 - i)]
        assert len(powers) == row["terms"]
        for axis, value in (("u", matches.u), ("v", matches.v)):
            A, mean = (
                np.array([np.bincount(iy * BINS + ix, a) / n for a in several])
                for several in (powers, [value])
            )
            root = np.sqrt(n)
            b = mean[0] * root
            left = b - (A.T * root[:, None]) @ np.linalg.lstsq(A.T * root[:, None], b)[0]
            expected = np.sqrt((left**2).sum() / n.sum())
            assert row[f"rms_{axis}"] == pytest.approx(expected, rel=1e-5)


def test_the_configured_order_does_not_matter(job, tmp_path):
    matches, folder, _, _ = job
    table = Table.read(folder / "o.ecsv")
    config = write_job(tmp_path, as_table(matches), model={"order": 1}, fit={"radial_weight": 10.0})
    good("select-order", config, "--orders", 1, 4, "-o", tmp_path / "o.ecsv")
    again = Table.read(tmp_path / "o.ecsv")
    for name in table.colnames:
        np.testing.assert_array_equal(table[name], again[name])


def test_files_on_disk_give_the_same(job, tmp_path):
    matches, folder, _, _ = job
    parts = [matches.select(np.arange(a, b)) for a, b in ((0, 7000), (7000, 20_000))]
    write_partitioned(parts, tmp_path / "stars")
    data = {"matches": "stars", "rows_in_memory": 7000}
    config = write_config(tmp_path / "config.toml", data=data)
    good("select-order", config, "--orders", 1, 4, "-o", tmp_path / "o.ecsv")
    table, again = Table.read(folder / "o.ecsv"), Table.read(tmp_path / "o.ecsv")
    for name in ("rms_u", "rms_v", "F", "stars", "regions"):
        np.testing.assert_allclose(table[name], again[name], rtol=1e-6)


def test_errors_by_magnitude_are_found_on_the_way(tmp_path):
    mag = np.random.default_rng(3).uniform(12, 18, 8000)
    matches, _ = simulated(8000, fraction=0.0, mag=mag, jitter=0.0)
    table = as_table(matches)
    table.remove_columns(["sigma_u", "sigma_v"])
    config = write_job(
        tmp_path, table, stars="stars.parquet", model={"order": 1},
        data={"matches": "stars.parquet", "sigma": "by_magnitude"},
    )  # fmt: skip
    good("select-order", config, "--orders", 1, 4, "-o", tmp_path / "o.ecsv")
    out = Table.read(tmp_path / "o.ecsv")
    assert out.meta["order"] == 2
    # scatter of the highest order, which describes the pairs: errors are right as they are
    assert out.meta["error_scale"] == pytest.approx(1.0, abs=0.05)


def test_an_order_that_cannot_be_fitted_is_a_row_that_says_so(tmp_path):
    """50 stars give 100 numbers: order 8 has 90 coefficients, order 9 has 110."""
    rng = np.random.default_rng(11)
    x, y = (rng.uniform(1, n, 50) for n in SIZE)
    u, v = (z + rng.normal(0, 0.1, 50) for z in (x, y))
    table = Table({"x": x, "y": y, "u": u, "v": v, "su": np.full(50, 0.1), "sv": np.full(50, 0.1)})
    table["u"].unit = table["v"].unit = table["su"].unit = table["sv"].unit = "pix"
    config = write_job(tmp_path, table, model={"order": 2})
    out = good("select-order", config, "--orders", 1, 9, "-o", tmp_path / "o.ecsv").out
    assert "order 9 is not fitted: " in out and "50 stars give 100 numbers" in out
    found = Table.read(tmp_path / "o.ecsv")
    assert list(found["order"]) == list(range(1, 10)) and found["terms"][-1] == 55
    assert np.isnan(found["chi2_u"][-1]) and "fewer than the 110" in found["not_fitted"][-1]
    assert found["not_fitted"].mask[0] and np.isfinite(found["chi2_u"][0])


def test_exposures_with_frames_ask_for_the_order_of_their_polynomials(tmp_path):
    """The exposures are rolled by tens of degrees, which no order could follow without frames."""
    model = model_of(frames="shift_rotation", exposures=("a", "b", "c"))
    theta = truth_of(model)
    for code in (1, 2):
        theta[model.frame_slice(code)] = [40.0, -70.0, 0.4 * code]
    rng = np.random.default_rng(4)
    matches, _ = simulate_matches(model, theta, 9000, rng=rng, fraction=0.0, sigma=SIGMA)
    config = write_job(tmp_path, as_table(matches), model={"order": 3, "frames": "shift_rotation"})
    output = tmp_path / "o.ecsv"
    result = good("select-order", config, "--orders", 1, 4, "-o", output)
    table = Table.read(output)
    assert table.meta["order"] == 2 and "Order 2 is as good" in result.out
    assert table.meta["error_scale"] == pytest.approx(1.0, abs=0.03)
    assert table.meta["n_used"] == 9000


def test_wrong_requests_are_refused(job, tmp_path):
    _, folder, config, _ = job
    refused(
        folder,
        "select-order",
        config,
        "-o",
        folder / "o.ecsv",
        words=("this file exists", "--force"),
    )
    refused(folder, "select-order", config, "--figure", folder / "o.png", words=("o.png",))
    for low, high in ((3, 3), (5, 3), (0, 4), (3, 13)):
        refused(
            folder,
            "select-order",
            config,
            "--orders",
            low,
            high,
            words=(f"go from {low} to {high}",),
        )
    several = write_job(tmp_path, detector=None, model={"order": 2}, chip=CHIPS)
    refused(tmp_path, "select-order", several, words=("2 chips", "--chip"))
    refused(tmp_path, "select-order", several, "--chip", 7, words=("no chip 7", "one of 1, 2"))
    refused(tmp_path, "select-order", tmp_path / "none.toml", words=("none.toml",))
