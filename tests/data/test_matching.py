from __future__ import annotations

import time

import numpy as np
import pytest

from bayesdist.data import (
    Matches,
    ReferenceCatalog,
    match_table,
    match_to_catalog,
    read_matches,
)
from bayesdist.errors import InputError
from bayesdist.formats.hst1pass import read_hst1pass, read_matchup

SHIFT = np.array([137.3, -55.1])


def field(rng, n, *, turn=0.0, sigma=0.05, seen=0.8, false=0.2):
    """Catalogue, detections (turned, shifted, blurred, some false), and the true row of each."""
    side = 20 * np.sqrt(n)
    true = rng.uniform(0, side, (n, 2))
    mag = -rng.exponential(1.0, n)
    rows = np.flatnonzero(rng.random(n) < seen)
    M = np.array([[1 + turn, -turn], [turn, 1 + turn]])
    found = true[rows] @ M.T + SHIFT + rng.normal(0, sigma, (len(rows), 2))
    extra = int(false * n)
    found = np.concatenate([found, rng.uniform(0, side, (extra, 2)) + SHIFT])
    truth = np.concatenate([rows, np.full(extra, -1)])
    brightness = np.concatenate([mag[rows], -rng.exponential(1.0, extra)])
    order = rng.permutation(len(found))
    catalog = ReferenceCatalog(u=true[:, 0], v=true[:, 1], mag=mag)
    return catalog, found[order], brightness[order], truth[order], M


@pytest.mark.parametrize("n", [60, 3000])
@pytest.mark.parametrize("turn", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("with_mag", [True, False])
def test_a_known_field_is_found(rng, n, turn, with_mag):
    catalog, found, mag, truth, M = field(rng, n, turn=turn)
    m = match_to_catalog(*found.T, catalog, mag=mag if with_mag else None)
    right = truth[m.index] == m.catalog_index
    real = truth >= 0
    assert right.sum() >= 0.99 * real.sum()
    # 0.05 px over 2000 px: the map inverts the one that made the field
    np.testing.assert_allclose(m.transformation.matrix @ M, np.eye(2), atol=3e-4)
    np.testing.assert_allclose(m.transformation(found[m.index][right]),
        np.column_stack([catalog.u, catalog.v])[m.catalog_index[right]], atol=0.35)  # fmt: skip
    assert len(set(m.index)) == len(set(m.catalog_index)) == len(m)


def test_the_rate_of_false_matches_is_what_happens(rng):
    catalog, found, mag, truth, _ = field(rng, 40_000)
    m = match_to_catalog(*found.T, catalog, mag=mag, radius=4.0)
    unreal = int((truth < 0).sum())
    hits = int((truth[m.index] < 0).sum())
    # mutual neighbours: a false detection may also take a star from a true one that lies further
    # away, and lose one to it; both are rare, so Poisson errors and 5 % for that
    assert hits == pytest.approx(m.false_rate * unreal, rel=0.05, abs=4 * np.sqrt(hits))
    assert hits > 100


def test_a_million_detections_in_seconds(rng, full):
    """Or a fifth of them in a fifth of the time."""
    n = 1_000_000 if full else 200_000
    catalog, found, mag, truth, _ = field(rng, n, turn=1e-5)
    start = time.process_time()
    m = match_to_catalog(*found.T, catalog, mag=mag)
    assert time.process_time() - start < 30.0 * n / 1_000_000
    assert (truth[m.index] == m.catalog_index).sum() > 0.99 * (truth >= 0).sum()


@pytest.mark.parametrize("n", [8, 300, 3000])
@pytest.mark.parametrize("with_mag", [True, False])
def test_another_field_is_refused_with_the_count(rng, n, with_mag):
    catalog, _, _, _, _ = field(rng, n)
    _, other, mag, _, _ = field(rng, n)
    with pytest.raises(InputError, match=r"list\.xym: .* bring together \d+ stars, while chance"):
        match_to_catalog(*other.T, catalog, mag=mag if with_mag else None, source="list.xym")


def test_two_dense_clusters_are_not_one(rng):
    for _ in range(5):
        a, b = 500 + 30 * rng.standard_t(2, (2, 400, 2))
        catalog = ReferenceCatalog(u=a[:, 0], v=a[:, 1])
        with pytest.raises(InputError, match="does not match"):
            match_to_catalog(*b.T, catalog)


def test_lists_are_found_at_any_rotation(rng):
    catalog, found, mag, truth, _ = field(rng, 2000)
    turn = np.radians(40.0)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    m = match_to_catalog(*(found @ R.T).T, catalog, mag=mag)
    assert (truth[m.index] == m.catalog_index).sum() > 0.99 * (truth >= 0).sum()
    np.testing.assert_allclose(m.transformation.matrix, R.T, atol=1e-4)


def test_the_largest_offset_is_kept(rng):
    catalog, found, mag, _, _ = field(rng, 500)
    assert len(match_to_catalog(*found.T, catalog, mag=mag, max_offset=150.0)) > 350
    with pytest.raises(InputError):
        match_to_catalog(*found.T, catalog, mag=mag, max_offset=100.0)


def test_a_table_takes_the_catalogue_at_the_epoch_of_each_exposure(rng):
    n = 300
    uv = rng.uniform(0, 400, (2, n))
    pm = rng.normal(0, 0.05, (2, n))
    catalog = ReferenceCatalog(u=uv[0], v=uv[1], pm_u=pm[0], pm_v=pm[1], epoch=2010.0)
    tables = []
    for name, epoch in (("a", 2004.0), ("b", 2014.0)):
        now = uv + pm * (epoch - 2010.0)
        seen = now + rng.normal(0, 0.01, now.shape) + 3.0
        tables.append(
            Matches(*(seen / 0.05), *seen, epoch=np.full(n, epoch), exposure_names=(name,))
        )
    t = match_table(Matches.concatenate(tables), catalog)
    for code, epoch in enumerate((2004.0, 2014.0)):
        now = t.exposure == code
        rows = t.row[now]
        np.testing.assert_allclose(t.u[now], (uv + pm * (epoch - 2010.0))[0][rows], atol=1e-9)
    assert len(t) + sum(t.rejected.values()) == t.n_rows == 2 * n


def test_the_four_exposures_match_their_master(data_dir):
    folder = data_dir / "hst1pass_uvis"
    published = np.genfromtxt(folder / "hst1pass_uvis_matched.csv", delimiter=",", names=True)
    master = read_matchup(folder / "MATCHUP_XYMEEE_final")
    found = 0
    for frame, path in enumerate(sorted(folder.glob("*.uvwXYMpq")), start=1):
        t = read_hst1pass(path).matches()
        m = match_to_catalog(t.u, t.v, master, mag=t.mag, radius=2.0)
        theirs = {
            (round(p["x_raw"], 4), round(p["y_raw"], 4)): int(p["star"])
            for p in published
            if p["frame"] == frame
        }
        ours = {
            (round(x, 4), round(y, 4)): int(star)
            for x, y, star in zip(t.x[m.index], t.y[m.index], m.catalog_index, strict=True)
        }
        agree = sum(theirs.get(key) == star for key, star in ours.items())
        assert agree >= len(theirs) - 2
        assert len(ours) - agree <= 2
        found += len(m)
    assert abs(found - 6815) <= 5


@pytest.mark.plugins
def test_read_matches_does_the_same_in_one_call(data_dir):
    folder = data_dir / "hst1pass_uvis"
    t = read_matches([folder / "*.uvwXYMpq", folder / "MATCHUP_XYMEEE_final"], sigma="by_magnitude")
    assert abs(len(t) - 6815) <= 15 and t.sigma_u is None
    assert t.n_rows == len(t) + t.rejected["no counterpart in the catalogue"]
    assert len(t.exposure_names) == 4 and t.filter_names == ("F814W",)


def test_three_epochs_close_a_triangle(data_dir):
    # observatory-corrected lists of years apart, at three roll angles: 1 -> 2 -> 3 must be 1 -> 3
    lists = [
        read_matchup(data_dir / "flystar" / f"{day}_F606W_MATCHUP_XYMEEE_final.calib")
        for day in ("2011_10_31", "2012_09_25", "2013_10_24")
    ]

    def to(a, b):
        m = match_to_catalog(a.u, a.v, b, mag=a.mag)
        assert len(m) > 3500
        return m.transformation

    grid = np.stack(np.meshgrid([300.0, 1000.0, 1700.0], [300.0, 1000.0, 1700.0]), -1).reshape(
        -1, 2
    )
    around = to(lists[1], lists[2])(to(lists[0], lists[1])(grid))
    np.testing.assert_allclose(around, to(lists[0], lists[2])(grid), atol=0.05)
