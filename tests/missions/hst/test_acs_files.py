"""A campaign as files: what the package's own readers find in them, and the command that writes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.app.cli import main
from bayesdist.data import read_catalog
from bayesdist.data.exposures import read_exposures
from bayesdist.data.starlists import StarCuts, read_star_lists
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.hst.simulate import read_acs, simulate_acs, write_acs
from tests.reduced import only_in_full


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("acs") / "campaign"
    campaign = simulate_acs(n_exposures=4, n_stars=2000, filters=("F606W", "F435W"))
    write_acs(campaign, folder)
    return folder, campaign


def equal(a, b, names):
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_readers_of_the_package_read_it(written):
    folder, campaign = written
    catalog = read_catalog(folder / "catalog.parquet")
    equal(catalog, campaign.catalog, ("u", "v", "sigma_u", "pm_u", "sigma_pm_v", "mag", "star"))
    assert catalog.unit == "pix" and np.all(catalog.epoch == 2004.5)
    for name, expected in (("early", campaign.early), ("late", campaign.late)):
        found = read_catalog(folder / f"catalog_{name}.parquet")
        equal(found, expected, ("u", "v", "sigma_u", "sigma_v", "mag", "epoch", "star"))
        assert found.pm_u is None
    log = read_exposures(folder / "exposures.ecsv")
    assert log.exposures == campaign.log.exposures
    log.require("filter", "exptime", "vafactor", "pa_v3", "ra", "dec")
    lists = read_star_lists(folder / "lists")  # in the order of the names
    assert {one.name for one in lists} == set(log.names)
    by_name = {one.name: one for one in lists}
    for one in campaign.lists:
        equal(by_name[one.name], one, ("x", "y", "chip", "mag", "q"))
    good, rejected = StarCuts(mag=(-14.0, -10.0), q_max=0.1).passed(lists[0])
    assert good.any() and rejected["poor fit"] > 0


def test_the_truth_comes_back(written):
    folder, campaign = written
    back, truth = read_acs(folder).truth, campaign.truth
    assert back.model == truth.model and dict(back.settings) == dict(truth.settings)
    assert list(back.theta) == list(truth.theta)
    for name, theta in truth.theta.items():
        np.testing.assert_array_equal(back.theta[name], theta)
    assert len(back.tables) == len(truth.tables) == 2 * 3
    for a, b in zip(back.tables, truth.tables, strict=True):
        assert (a.chip, a.filter, a.first, a.step) == (b.chip, b.filter, b.first, b.step)
        np.testing.assert_array_equal(a.values, b.values)
    equal(back.stars, truth.stars, ("u", "v", "pm_u", "pm_v", "mag"))
    equal(back.frames, truth.frames, ("centre", "vafactor", "shared", "own", "outlying"))
    for a, b in zip(back.detections, truth.detections, strict=True):
        equal(a, b, ("star", "blended"))
    name = truth.log.names[-1]
    x, y, chip = campaign.lists[-1].x, campaign.lists[-1].y, campaign.lists[-1].chip
    np.testing.assert_allclose(
        back.to_catalog(name, x, y, chip), truth.to_catalog(name, x, y, chip), rtol=0, atol=1e-8
    )


def test_the_file_of_frames_gives_the_linear_terms(written):
    folder, campaign = written
    table = Table.read(folder / "truth" / "exposures.ecsv")
    terms = campaign.truth.linear_terms(table["exposure"][2], 1)
    columns = [f"{name}_WFC1" for name in ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")]
    np.testing.assert_array_equal([table[name][2] for name in columns], terms)


def test_the_readme_names_every_column(written):
    folder, _ = written
    text = (folder / "README.txt").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", text))
    paths = [*folder.glob("*.parquet"), folder / "exposures.ecsv", *folder.glob("truth/*.parquet")]
    for path in [*paths, next(folder.glob("lists/*"))]:
        assert path.parent.name == "lists" or path.name in text, path.name
        assert set(read_table(path).colnames) <= words, path.name
    assert max(len(line) for line in text.splitlines()[2:]) <= 100


def test_nothing_is_replaced_unasked_and_nothing_old_stays(tmp_path):
    first = simulate_acs(n_exposures=3, n_stars=200)
    write_acs(first, tmp_path)
    with pytest.raises(InputError, match="contains a campaign"):
        write_acs(first, tmp_path)
    write_acs(simulate_acs(n_exposures=2, n_stars=200, fine_scale=False), tmp_path, force=True)
    back = read_acs(tmp_path)
    assert len(back.lists) == 2 and back.truth.tables == ()
    assert len(list((tmp_path / "lists").iterdir())) == 2
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_acs(first, tmp_path / "file")


@pytest.mark.slow
@only_in_full("tests/app/campaign simulates by it")
def test_the_command(tmp_path, capsys):
    arguments = ["simulate", "acs", "-o", str(tmp_path / "sim"), "--exposures", "3", "-q"]
    arguments += [
        "--stars",
        "400",
        "--filters",
        "F606W,F814W",
        "--secondary-exposures",
        "2",
        "--seed",
        "7",
    ]
    assert main(arguments) == 0
    out = capsys.readouterr()
    assert re.search(r"F606W +3 ", out.out) and re.search(r"F814W +2 ", out.out) and not out.err
    expected = simulate_acs(
        n_exposures=3, n_stars=400, filters=("F606W", "F814W"), n_other=2, seed=7
    )
    equal(read_acs(tmp_path / "sim").catalog, expected.catalog, ("u", "v"))
    assert main(arguments) == 1
    assert "--force" in capsys.readouterr().err
    assert main([*arguments, "--force", "--cte", "--no-tables"]) == 0
    settings = read_acs(tmp_path / "sim").truth.settings
    assert settings["cte"] and not settings["fine_scale"]
    assert main(["simulate", "acs", "-o", str(tmp_path / "no"), "--filters", "F606"]) == 1
    assert "F606W" in capsys.readouterr().err and not (tmp_path / "no").exists()
