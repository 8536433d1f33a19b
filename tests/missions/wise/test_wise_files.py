"""Sets of WISE pairs of any size: what they hold, and what is written of them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pyarrow.parquet as pq
import pytest
from astropy.table import Table
from scipy import stats

from bayesdist.app.commands.check import check
from bayesdist.data import read_matches
from bayesdist.errors import InputError
from bayesdist.infer import Rejection, fit_linear
from bayesdist.missions.wise.assess.residual_tables import TABLE_5_1, printed_rows
from bayesdist.missions.wise.published import (
    RESIDUAL_SIGMAS,
    SAMPLE_SIZES,
    WISE_BANDS,
)
from bayesdist.missions.wise.simulate import wise_set, write_wise_set
from bayesdist.missions.wise.simulate.sets import WiseSet, match_radius
from bayesdist.missions.wise.simulated_pairs import simulate_sets

COLUMNS = {"sigma_u": "sigma", "sigma_v": "sigma", "exposure": "frame"}


def residuals(one, chunk):
    """Reference positions less those of the truth, without the pattern, (N, 2)."""
    out = np.column_stack([chunk.u, chunk.v]) - one.model.predict(one.theta, chunk.x, chunk.y)
    return out if one.pattern is None else out + one.pattern.offsets(chunk.x, chunk.y)


def scaled_r2(one, chunk):
    """Squared distance from the centre, 1 in the corners."""
    (cx, cy), (nx, ny) = one.array.centre, one.array.size
    return (((chunk.x - cx) / (nx / 2)) ** 2 + ((chunk.y - cy) / (ny / 2)) ** 2) / 2


@pytest.fixture(scope="module")
def many():
    """W1 with many false matches."""
    one = wise_set("W1", pairs=200_000, seed=4, false_fraction=0.2, partition=True)
    return one, one.chunk(0)


def test_the_published_numbers_of_pairs_are_the_default():
    assert {band: wise_set(band).pairs for band in WISE_BANDS} == SAMPLE_SIZES
    assert sum(SAMPLE_SIZES.values()) == 25_645_608


@pytest.mark.parametrize("band", WISE_BANDS)
def test_errors_are_those_of_table_5_1(band):
    """True pairs scatter by their quoted errors, and on the average as the report's pairs do."""
    one = wise_set(band, pairs=150_000, seed=3)
    chunk = one.chunk(0)
    d = residuals(one, chunk)[~chunk.false]
    sigma = chunk.sigma[~chunk.false]
    assert stats.kstest((d / sigma[:, None]).ravel(), "norm").pvalue > 1e-3
    radial = np.hypot(*d.T)
    error = radial.std() / np.sqrt(radial.size)
    printed = printed_rows(TABLE_5_1)[f"{band}/radial"].value["mean"]
    assert abs(radial.mean() - printed) < 4 * error + 5e-5
    # fainter pairs are worse, none better than 2MASS
    order = np.argsort(chunk.mag)
    assert (np.diff(chunk.sigma[order]) >= -1e-12).all()
    assert chunk.sigma.min() > 0.08 / one.array.scale


def test_pairs_cover_the_array_evenly(many):
    _, chunk = many
    for values in (chunk.x, chunk.y):
        assert stats.kstest((values - 0.5) / 1016, "uniform").pvalue > 1e-3


def test_false_matches_fill_the_match_circle(many):
    one, chunk = many
    d = residuals(one, chunk)[chunk.false]
    share = (d**2).sum(axis=1) / match_radius(scaled_r2(one, chunk)[chunk.false]) ** 2
    assert stats.kstest(share, "uniform").pvalue > 1e-3
    angle = np.arctan2(*d.T) / (2 * np.pi) + 0.5
    assert stats.kstest(angle, "uniform").pvalue > 1e-3


def test_false_matches_depend_on_density_and_radius(many):
    """As often as sources without counterpart find a star: 1 - exp(-density pi R^2) of them."""
    one, chunk = many
    r2 = scaled_r2(one, chunk)
    chance = 1 - np.exp(-one.false_matches.density[chunk.frame] * np.pi * match_radius(r2) ** 2)
    odds = one.false_matches.unlisted * chance / (1 - one.false_matches.unlisted)
    p = odds / (1 + odds)
    for of in (r2, one.false_matches.density[chunk.frame]):
        rows = np.array_split(np.argsort(of, kind="stable"), 8)
        found = np.array([chunk.false[k].sum() for k in rows])
        mean = np.array([p[k].sum() for k in rows])
        variance = np.array([(p[k] * (1 - p[k])).sum() for k in rows])
        assert stats.chi2.sf(((found - mean) ** 2 / variance).sum(), 8) > 1e-3
        assert found[-1] > 1.3 * found[0]
    # the share that was asked for
    assert abs(chunk.false.mean() - 0.2) < 5 * np.sqrt(0.16 / len(chunk))


@pytest.mark.parametrize("share", [0.001, 0.5, 0.9])
def test_any_share_of_false_matches_is_met(share):
    one = wise_set("W4", pairs=100_000, false_fraction=share)
    n_false = int(one.chunk(0).false.sum())
    assert stats.binomtest(n_false, 100_000, share).pvalue > 1e-4
    assert not wise_set("W4", pairs=1000, false_fraction=0.0).chunk(0).false.any()


def test_colour_favours_stars(many):
    _, chunk = many
    blue = chunk.colour < 1.0
    assert blue[~chunk.false].all()
    assert 0.45 < blue[chunk.false].mean() < 0.55


def test_crowded_frames_have_more_pairs(many):
    one, chunk = many
    found = np.bincount(chunk.frame, minlength=len(one.survey.names))
    expected = len(chunk) * one.survey.share()
    # Pearson's chi-square of 5000 counts of 12 to 180 each
    chi2 = ((found - expected) ** 2 / expected).sum()
    assert abs(chi2 - found.size) < 5 * np.sqrt(2 * found.size)
    assert (np.diff(chunk.frame) >= 0).all() and len(set(one.survey.names)) == 5000
    assert one.survey.density.max() / one.survey.density.min() == pytest.approx(
        0.98 / 0.05, rel=1e-3
    )


@pytest.mark.parametrize(("band", "blocks"), [("W1", 5), ("W3", 2)])
def test_the_pattern_has_the_report_s_size_and_nothing_for_the_polynomial(band, blocks):
    one = wise_set(band, pairs=1, partition=True)
    assert one.pattern.blocks == blocks
    n = one.array.size[0]
    steps = 0.5 + n * (np.arange(600) + 0.5) / 600  # as many in each block
    x, y = (g.ravel() for g in np.meshgrid(steps, steps))
    offsets = one.pattern.offsets(x, y)
    rms = np.sqrt((offsets**2).mean(axis=0))
    np.testing.assert_allclose(rms, RESIDUAL_SIGMAS[band], rtol=1e-3)
    phi = one.model.basis().evaluate(x, y)
    fitted = phi @ np.linalg.lstsq(phi, offsets, rcond=None)[0]
    assert (np.sqrt((fitted**2).mean(axis=0)) < 1e-3 * rms).all()
    # it jumps at the edges of the blocks and nowhere else: second differences along a row
    row = one.pattern.offsets(steps, np.full(600, 100.0))[:, 0]
    jumps = np.flatnonzero(np.abs(np.diff(row, 2)) > 1e-4)
    edges = 600 // blocks * np.arange(1, blocks)
    assert set(jumps) == {e + k for e in edges for k in (-2, -1)}


def test_the_pattern_moves_the_positions_and_nothing_else(many):
    one, chunk = many
    plain = wise_set("W1", pairs=200_000, seed=4, false_fraction=0.2).chunk(0)
    for name in ("x", "y", "mag", "sigma", "colour", "false", "frame"):
        np.testing.assert_array_equal(getattr(chunk, name), getattr(plain, name))
    # what WISE measures is displaced along the pattern: corrected WISE less 2MASS gains it
    moved = np.column_stack([plain.u - chunk.u, plain.v - chunk.v])
    np.testing.assert_allclose(moved, one.pattern.offsets(chunk.x, chunk.y), rtol=0, atol=1e-11)
    assert wise_set("W4", pairs=10, partition=True).pattern is None


@pytest.mark.parametrize("band", WISE_BANDS)
def test_a_fit_finds_the_published_coefficients(tmp_path, band):
    one = wise_set(band, pairs=60_000, seed=6, false_fraction=0.0)
    write_wise_set(one, tmp_path)
    matches = read_matches(tmp_path / band.lower(), columns=COLUMNS | {"exposure": ""})
    fit = fit_linear(matches, one.model, rejection=Rejection(1e9, 1e9))
    off = fit.mean - one.theta
    assert 1e-3 < stats.chi2.sf(off @ np.linalg.solve(fit.cov, off), 30) < 1 - 1e-3
    assert abs(fit.chi2 / fit.dof - 1) < 5 * np.sqrt(2 / fit.dof)


def test_files_hold_the_chunks(tmp_path):
    one = wise_set("W2", pairs=3500, seed=2, false_fraction=0.1, chunk_pairs=1000)
    n_false = write_wise_set(one, tmp_path)
    back = read_matches(tmp_path / "w2", columns=COLUMNS)
    chunks = [one.chunk(k) for k in range(4)]
    for name in ("x", "y", "u", "v", "mag"):
        expected = np.concatenate([getattr(chunk, name) for chunk in chunks])
        assert getattr(back, name).tobytes() == expected.tobytes()
    assert (back.sigma_u == back.sigma_v).all() and back.unit == "pix"
    frame = np.concatenate([chunk.frame for chunk in chunks])
    assert [back.exposure_names[k] for k in back.exposure] == [one.survey.names[k] for k in frame]
    np.testing.assert_array_equal(back.epoch, one.survey.epoch[frame])
    raw = pq.read_table(tmp_path / "w2")
    assert raw.column_names == [
        "x", "y", "u", "v", "sigma", "mag", "colour", "epoch", "frame", "band"
    ]  # fmt: skip
    assert set(raw["band"].to_pylist()) == {"W2"}
    false = np.array(pq.read_table(tmp_path / "truth" / "w2")["false"])
    np.testing.assert_array_equal(false, np.concatenate([chunk.false for chunk in chunks]))
    truth = Table.read(tmp_path / "truth" / "w2.ecsv")
    np.testing.assert_array_equal(truth["value"], one.theta)
    assert truth.meta["false_matches"] == n_false == false.sum() and truth.meta["seed"] == 2


def test_neither_threads_nor_other_bands_change_a_set(tmp_path):
    for folder, threads in (("a", 1), ("b", 3)):
        one = wise_set("W3", pairs=2600, seed=5, chunk_pairs=500)
        write_wise_set(one, tmp_path / folder, threads=threads)
    parts = sorted(path.name for path in (tmp_path / "a" / "w3").iterdir())
    assert len(parts) == 6
    for name in parts:
        a, b = ((tmp_path / folder / "w3" / name).read_bytes() for folder in "ab")
        assert a == b
    x = [wise_set(band, pairs=100, seed=5).chunk(0).x for band in ("W1", "W2")]
    assert not np.isin(x[0], x[1]).any()
    assert not np.isin(x[0], wise_set("W1", pairs=100, seed=6).chunk(0).x).any()


def test_the_pattern_is_written(tmp_path, many):
    one = wise_set("W1", pairs=50, seed=4, partition=True)
    write_wise_set(one, tmp_path)
    table = Table.read(tmp_path / "truth" / "w1_pattern.ecsv")
    assert len(table) == 2 * 25
    row = table[(table["axis"] == "y") & (table["row"] == 2) & (table["column"] == 4)]
    # at the centre of that block all tilts vanish
    x, y = 0.5 + 1016 * 3.5 / 5, 0.5 + 1016 * 1.5 / 5
    smooth = one.model.basis().evaluate([x], [y])[0] @ table.meta["taken_off"]["y"]
    at = one.pattern.offsets(np.array([x]), np.array([y]))[0, 1]
    assert at == pytest.approx(row["offset"][0] - smooth, abs=1e-12)


def simulated(folder, **changes):
    values = {
        "bands": ["W1", "W4"],
        "pairs": 2000,
        "seed": 1,
        "false_fraction": 0.03,
        "partition_pattern": True,
        "force": False,
    }
    return simulate_sets(folder, **values | changes)


def test_the_command_writes_jobs_that_check_accepts(tmp_path):
    text = simulated(tmp_path)
    assert "bayesdist run" in text and "5 x 5" in text and "none" in text
    for name in ("w1", "w4"):
        assert "30 of 30" in check(tmp_path / f"{name}.toml")


def test_what_cannot_be_simulated_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no band 'W9'.*W1"):
        simulated(tmp_path, bands=["W9"])
    with pytest.raises(InputError, match="given twice"):
        simulated(tmp_path, bands=["W1", "W1"])
    with pytest.raises(InputError, match="pairs is 0"):
        simulated(tmp_path, pairs=0)
    for share in (-0.1, 1.0, np.nan):
        with pytest.raises(InputError, match="fraction of false matches"):
            simulated(tmp_path, false_fraction=share)
    assert not list(tmp_path.iterdir())
    simulated(tmp_path, bands=["W4"])
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")}
    with pytest.raises(InputError, match=r"contains w4 already.*--force"):  # before W1 is begun
        simulated(tmp_path)
    with pytest.raises(InputError, match="contains Parquet files already"):
        write_wise_set(wise_set("W4", pairs=10), tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")} == before
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        simulated(tmp_path / "file")


def test_force_leaves_nothing_of_the_set_before(tmp_path):
    new = {"pairs": 900, "partition_pattern": False}
    simulated(tmp_path / "a")
    four_parts = wise_set("W1", pairs=2000, chunk_pairs=500)
    write_wise_set(four_parts, tmp_path / "a", force=True)
    simulated(tmp_path / "a", force=True, **new)
    simulated(tmp_path / "b", **new)
    a, b = (
        {p.relative_to(d): p.read_bytes() for p in d.rglob("*.*")}
        for d in map(tmp_path.joinpath, "ab")
    )
    assert a == b


class BreaksOff(WiseSet):
    """Set that fails at its fifth chunk."""

    def chunk(self, k):
        if k == 4:
            raise InputError("disk is full")
        return super().chunk(k)


def test_what_fails_half_way_leaves_nothing(tmp_path):
    good = wise_set("W1", pairs=1000, chunk_pairs=100)
    broken = BreaksOff(**{field.name: getattr(good, field.name) for field in fields(good)})
    with pytest.raises(InputError, match="disk is full"):
        write_wise_set(broken, tmp_path)
    assert not list(tmp_path.rglob("*.*"))
