"""Stars that occur in several rows: known by their positions where no column names them."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import Matches, read_matches
from bayesdist.data.repeated import (
    position_codes,
    repeated_detections,
    star_codes,
    tight_groups,
)
from bayesdist.errors import InputError


def repeated(n: int, times: int, seed: int = 1) -> dict[str, np.ndarray]:
    """Columns of n stars that are measured several times, in random order."""
    rng = np.random.default_rng(seed)
    u, v = np.tile(rng.uniform(0, 100, (2, n)), times)
    x, y = 10 * u + rng.normal(0, 0.1, u.size), 10 * v + rng.normal(0, 0.1, v.size)
    star, order = np.tile(np.arange(n), times), rng.permutation(n * times)
    columns = {"x": x, "y": y, "u": u, "v": v, "true": star}
    return {name: values[order] for name, values in columns.items()}


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two sets of codes put the same rows together."""
    pairs = len(np.unique(np.column_stack([a, b]), axis=0))
    return pairs == len(np.unique(a)) == len(np.unique(b))


def test_equal_positions_are_one_star():
    columns = repeated(200, 3)
    true = columns.pop("true")
    matches = Matches.from_table(columns, unit="pix", sigma=0.1)
    assert same_partition(matches.star, true)
    assert any("200 reference positions occur 3 times each" in note for note in matches.notes)
    # whatever the order of the rows, so that the same stars are held out
    turned = Matches.from_table({k: v[::-1] for k, v in columns.items()}, unit="pix", sigma=0.1)
    assert (turned.star == matches.star[::-1]).all()


def test_rounding_is_no_difference():
    rng = np.random.default_rng(2)
    u, v = rng.uniform(-2000, 2000, (2, 500))
    again = u * (1 + 1e-15) + 1e-13, v / 3 * 3
    code = position_codes(*(np.concatenate(pair) for pair in zip((u, v), again, strict=True)))
    assert same_partition(code, np.tile(np.arange(500), 2))


def test_separate_stars_and_a_column_of_stars_are_left_alone():
    columns = repeated(50, 2)
    true = columns.pop("true")
    apart = Matches.from_table(columns, unit="pix", sigma=0.1, same_position="separate_stars")
    assert len(np.unique(apart.star)) == 100
    given = Matches.from_table({**columns, "star": true}, unit="pix", sigma=0.1)
    assert (given.star == true).all() and not any("occur" in note for note in given.notes)
    once = Matches.from_table({k: v[:1] for k, v in columns.items()}, unit="pix", sigma=0.1)
    assert once.star is None
    with pytest.raises(InputError, match="same_position is 'two'"):
        Matches.from_table(columns, unit="pix", sigma=0.1, same_position="two")
    stars = Matches(**columns)
    assert same_partition(stars.with_star_codes().star, true)


def on_the_sky(n: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Stars with motions, in three exposures of different dates."""
    rng = np.random.default_rng(3)
    ra, dec = 150.0 + rng.uniform(0, 0.1, n), 40.0 + rng.uniform(0, 0.1, n)
    pm = rng.normal(0, 50.0, (2, n))
    columns = {
        "ra": ra, "dec": dec, "pmra": pm[0], "pmdec": pm[1], "ref_epoch": np.full(n, 2016.0)
    }  # fmt: skip
    columns = {name: np.tile(values, 3) for name, values in columns.items()}
    columns["epoch"] = np.repeat([2005.0, 2015.5, 2024.0], n)
    columns |= dict(zip(("x", "y"), rng.uniform(1, 2000, (2, 3 * n)), strict=True))
    return columns, np.tile(np.arange(n), 3)


def test_motions_do_not_hide_a_star(tmp_path):
    """u and v differ from exposure to exposure; the catalogue's position is one."""
    columns, true = on_the_sky(60)
    table = Table(columns)
    for name, unit in (("ra", "deg"), ("dec", "deg"), ("pmra", "mas/yr"), ("pmdec", "mas/yr")):
        table[name].unit = unit
    matches = Matches.from_table(table, sigma=0.01)
    assert same_partition(matches.star, true)
    assert len(np.unique(matches.u)) == len(matches)
    for k in range(3):
        table[60 * k : 60 * (k + 1)].write(tmp_path / f"exposure{k}.ecsv")
    files = read_matches([tmp_path / f"exposure{k}.ecsv" for k in range(3)], sigma=0.01)
    assert len(files.exposure_names) == 3 and same_partition(files.star, true)


def test_several_detections_in_an_exposure_are_false_matches():
    """89 of 1,099 stars, each with a second detection in the same exposure."""
    rng = np.random.default_rng(4)
    u, v = rng.uniform(0, 100, (2, 1099))
    u, v = (np.concatenate([z, z[:89]]) for z in (u, v))
    exposure = np.zeros(len(u), np.int64)
    star, _ = star_codes(u, v, "one_star")
    assert star is not None
    found = repeated_detections(u, v, exposure, star)
    assert found is not None and (found.stars, found.n_stars, found.rows) == (89, 1099, 178)
    assert "at most one of each star can be right" in found.sentence
    exposure[1099:] = 1
    assert repeated_detections(u, v, exposure, star) is None
    # all twice in what is called one exposure: exposures without a column
    found = repeated_detections(np.tile(u[:99], 2), np.tile(v[:99], 2), exposure[:198] * 0, None)
    assert found is not None and found.unlabelled and "exposure" in found.sentence


@pytest.mark.parametrize("scattered", [False, True])
def test_pinholes_of_a_fiducial_are_a_group(scattered):
    rng = np.random.default_rng(5)
    x, y = (z.ravel() for z in np.meshgrid(np.arange(12) * 150.0, np.arange(12) * 150.0))
    if scattered:
        x, y = rng.uniform(0, 1800, (2, 144))
    fiducial = np.repeat(np.arange(144), 4)
    u = x[fiducial] + np.tile([0.0, 3.0, 0.0, 3.0], 144)
    v = y[fiducial] + np.tile([0.0, 0.0, 3.0, 3.0], 144)
    found = tight_groups(u, v)
    assert found is not None and found.size == 4
    # fiducials that lie on each other by chance are one group
    assert scattered or same_partition(found.code, fiducial)
    together = np.column_stack([found.code, fiducial])
    assert len(np.unique(together, axis=0)) == 144
    assert "column star" in found.sentence("pix")
    # the column that the sentence asks for
    assert tight_groups(u, v, fiducial) is None


def test_stars_are_no_groups():
    """At random, on a grid, in a cluster with a dense core, or repeated by separate stars."""
    rng = np.random.default_rng(6)
    grid = [z.ravel() * 40.0 for z in np.meshgrid(np.arange(30), np.arange(30))]
    radius, angle = 50 * np.sqrt(rng.uniform(size=3000) ** -1.0 - 1), rng.uniform(0, 7, 3000)
    core = [radius * np.cos(angle), radius * np.sin(angle)]
    inside = np.hypot(*core) < 1000
    for u, v in (rng.uniform(0, 2000, (2, 5000)), grid, [z[inside] for z in core]):
        assert tight_groups(np.asarray(u), np.asarray(v)) is None
    u, v = np.tile(rng.uniform(0, 2000, (2, 200)), 3)
    assert tight_groups(u, v, np.arange(600)) is None
