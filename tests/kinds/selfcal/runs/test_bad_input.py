"""Whatever is wrong with the exposures of a self-calibration: one sentence that names them."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table, vstack

from bayesdist.errors import InputError
from bayesdist.kinds.selfcal.matching import refuse_unconnected
from tests.app.support import cli, one_sentence, refused
from tests.kinds.selfcal.dithered_fields import simulate_dithers, smooth_distortion
from tests.kinds.selfcal.infer.fields import SIZE, chips
from tests.kinds.selfcal.runs.support import list_table, small, write_selfcal

SBC = {"instrument": "ACS", "detector": "SBC"}


@pytest.fixture(scope="module")
def truth():
    return small()


def _pointed(offsets, *, n_stars=1500, seed=5, size=3.0):
    """Exposures of one roll at given offsets, in parts of the detector."""
    rng = np.random.default_rng(seed)
    coefficients = smooth_distortion(3, chips(), size, rng)
    return simulate_dithers(
        chips(), coefficients, np.array(offsets) * SIZE[0], np.zeros(len(offsets)),
        n_stars=n_stars, rng=rng, sigma=0.02,
    )  # fmt: skip


def _refused(folder, table, *words, **sections):
    config = write_selfcal(folder / "input", table, **sections)
    refused(folder, "run", config, "-o", folder / "run", words=words)


def _refused_by_the_match(folder, table, *words, **sections):
    """What only the match shows; what was refused must be so by `check`, too."""
    config = write_selfcal(folder / "input", table, **sections)
    for arguments in (("check", config), ("run", config, "-o", folder / "run")):
        result = cli(*arguments)
        assert result.code == 1, result.err
        one_sentence(result.err.splitlines()[-1], *words)


def test_exposures_that_do_not_overlap(tmp_path):
    table = list_table(_pointed([(0, 0), (1.5, 0)]))
    _refused(tmp_path, table, "2 groups", "(e000); (e001)")


def test_detections_off_the_chips(truth, tmp_path):
    """Pixels of a mosaic, and a chip that no block describes."""
    block = {"number": 1, "name": "A", "size": SIZE, "reference_pixel": (512.0, 512.0)}
    given = {"detector": None, "model": {"order": 3}, "chip": [block]}
    moved = list_table(truth)
    moved["x"] += 500.0
    _refused(tmp_path / "moved", moved, "lists.ecsv", "chip A", "outside", "mosaic", **given)
    other = list_table(truth)
    other["chip"] = np.where(np.arange(len(other)) % 9, 1, 3)
    _refused(tmp_path / "other", other, "chip 3", "[[chip]]", "known: 1", **given)


def test_two_groups_of_exposures(tmp_path):
    table = list_table(_pointed([(0, 0), (2.0, 0), (0.1, 0.2), (2.1, 0.1)], n_stars=3000))
    _refused(tmp_path, table, "2 groups", "(e000, e002); (e001, e003)")


def test_stars_that_are_seen_once(truth, tmp_path):
    """With a start that is known no pattern is needed, and no star is found twice."""
    rng = np.random.default_rng(6)
    names = [f"e{k}" for k in range(4)]
    table = Table(
        {
            "x": rng.uniform(1, 1024, 400),
            "y": rng.uniform(1, 1024, 400),
            "exposure": np.repeat(names, 100),
        }
    )
    _refused(tmp_path, table, "4 groups without stars in common", "e0", "e3")


def test_stars_with_too_few_detections(truth, tmp_path):
    table = list_table(truth)
    _refused_by_the_match(
        tmp_path, table, "no star is detected 9 times", selfcal={"min_detections": 9}
    )


def test_an_exposure_turned_by_half_a_turn(tmp_path):
    """Its quadratic terms have the wrong sign, of twenty pixels: nothing settles."""
    offsets = [(0, 0), (0.1, 0.05), (-0.05, 0.2), (0.15, -0.1), (0.02, 0.3)]
    table = list_table(_pointed(offsets, n_stars=400, size=20.0))
    rows = table["exposure"] == "e003"
    table["x"][rows] = SIZE[0] + 1 - table["x"][rows]
    table["y"][rows] = SIZE[1] + 1 - table["y"][rows]
    words = ["e003", "half a turn", "180 degrees"]
    _refused_by_the_match(tmp_path, table, *words, selfcal={"max_iterations": 4})


@pytest.mark.parametrize(
    ("roll", "words"),
    [(180.0, ["half a turn", "180 degrees"]), (40.0, ["10 %", "75 %", "check its pixels"])],
)
def test_an_exposure_that_shares_hardly_a_star(roll, words):
    """Where the rest settles without it, it is named by what it has in common with the others."""
    rolls, shares = np.array([0.0, 0.1, roll, 0.0]), np.array([0.7, 0.8, 0.1, 0.75])
    table = Table({"exposure": list("abcd"), "fraction_common": shares, "rotation": rolls})
    with pytest.raises(InputError, match="exposure c ") as caught:
        refuse_unconnected(table)
    for word in words:
        assert word in str(caught.value)
    refuse_unconnected(table[[0, 1, 3]])


def test_a_duplicated_exposure(truth, tmp_path):
    table = list_table(truth)
    again = table[table["exposure"] == "e002"]
    again["exposure"] = "copy"
    _refused(tmp_path, vstack([table, again]), "e002", "copy", "same detections")


def test_a_single_exposure(truth, tmp_path):
    table = list_table(truth)
    _refused(tmp_path, table[table["exposure"] == "e002"], "one exposure", "e002")


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"selfcal": {"start_radius": 0.1}}, ["start_radius", "match_radius"]),
        ({"selfcal": {"match_radii": 0.1}}, ["'match_radii'", "'match_radius'"]),
        ({"selfcal": {"unit": "arcsec"}, "detector": {"size": SIZE}}, ["detector.scale_mas"]),
        ({"selfcal": {"min_detections": 1}}, ["min_detections"]),
        ({"selfcal": {"motion": "proper_motion"}}, ["dates"]),
        ({"selfcal": {"exposures": "log.ecsv"}}, ["log.ecsv"]),
        ({"selfcal": {"initial_distortion": "nowhere.fits"}}, ["nowhere.fits"]),
        ({"selfcal": {"mag": (30.0, 31.0)}}, ["e000", "cuts"]),
        ({"model": {"order": 3, "frames": "affine"}}, ["model.frames", "selfcal.frames"]),
        ({"fit": {"clip_chi2": 9.0}}, ["fit", "[selfcal]"]),
        ({"outliers": {"match_radius": 1.0}}, ["selfcal.match_radius"]),
        (
            {"selfcal": {"frames": "shift"}, "gauge": {"offsets": "o", "roll_sigma_deg": 0.1}},
            ["gauge.roll_sigma_deg", "selfcal.frames"],
        ),
        ({"outliers": {"model": "gaussian"}}, ["outliers.model", "uniform"]),
        ({"sampler": {"walkers": 40}}, ["sampler.walkers", "[selfcal]"]),
        ({"data": {"matches": "stars.ecsv"}}, ["[data]", "[selfcal]", "give one"]),
        ({"prior": [{"parameter": "u_9_9", "mean": 0.0, "sigma": 1.0}]}, ["'u_9_9'"]),
        ({"products": {"idctab": SBC}, "detector": {"size": SIZE}}, ["scale"]),
        ({"products": {"siaf": {}}}, ["products.siaf", "aperture"]),
        ({"detector": {"size": SIZE, "name": "a\0b"}}, ["detector.name", "U+0000"]),
    ],
)  # fmt: skip
def test_a_configuration_that_cannot_be(truth, tmp_path, sections, words):
    table = list_table(truth)
    config = write_selfcal(tmp_path / "input", table[table["mag"] < 20], **sections)
    result = cli("run", config, "-o", tmp_path / "run")
    assert result.code == 1, result.err
    one_sentence(result.err.splitlines()[-1], *words)
