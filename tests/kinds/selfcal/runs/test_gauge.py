"""What fixes the gauge: offsets, rolls, a scale, reference stars, priors; and what needs none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table, vstack

from bayesdist.assess import uncertainty_map
from bayesdist.infer.solution.transforms import gauge_free
from bayesdist.kinds.selfcal.infer import star_catalogue
from tests.app.support import cli, good, one_sentence
from tests.kinds.selfcal.runs.support import (
    SCALE_MAS,
    commanded,
    directions,
    fitted,
    list_table,
    small,
    write_selfcal,
)
from tests.reduced import only_in_full

SIGMA = 0.3  # pixels, of a commanded offset


@pytest.fixture(scope="module")
def truth():
    return small()


@pytest.fixture(scope="module")
def free(truth, tmp_path_factory):
    """Fixed by convention alone."""
    folder = tmp_path_factory.mktemp("free")
    return fitted(folder / "run", write_selfcal(folder / "input", list_table(truth)))


@pytest.fixture(scope="module")
def offsets(truth, tmp_path_factory):
    """Fixed by commanded offsets."""
    folder = tmp_path_factory.mktemp("offsets")
    config = write_selfcal(folder / "input", list_table(truth), gauge={"offsets": "offsets.ecsv"})
    table = commanded(truth, SIGMA, np.random.default_rng(1))
    table.write(config.parent / "offsets.ecsv")
    return fitted(folder / "run", config), table


@pytest.mark.slow
@only_in_full("other references of the scale are run")
def test_scale_and_rotation_from_offsets(truth, offsets):
    """The errors are those of a regression through the offsets: sigma over their lever arm."""
    run, table = offsets
    found = directions(run)
    at = np.column_stack([table["du"], table["dv"]])
    lever = np.sqrt(((at - at.mean(axis=0)) ** 2).sum())
    for name in ("scale", "rotation"):
        assert found[name]["fixed_by"] == "commanded offsets"
        assert found[name]["state"] == "free"
        # the offsets' own errors, a thousandth of them here, move the lever arm
        assert found[name]["sigma_fixed"] == pytest.approx(SIGMA / lever, rel=5e-3)
    assert found["zero_point_u"]["fixed_by"] == "convention"
    assert run.directory.summary["selfcal"]["gauge"]["held"] == ["u_0_0", "v_0_0"]


def test_offsets_that_contradict_the_detections_are_told(truth, offsets, tmp_path):
    run, table = offsets
    assert not run.parts["solved"].contradictions
    wrong = table.copy()
    wrong["du"][3] += 8 * SIGMA
    config = write_selfcal(tmp_path, list_table(truth), gauge={"offsets": "offsets.ecsv"})
    wrong.write(config.parent / "offsets.ecsv")
    contradictions = fitted(tmp_path / "run", config).parts["solved"].contradictions
    assert any("commanded offsets contradict" in one for one in contradictions)


def test_an_exposure_whose_offset_stands_twice(truth, offsets, tmp_path):
    _, table = offsets
    config = write_selfcal(tmp_path, list_table(truth), gauge={"offsets": "offsets.ecsv"})
    vstack([table, table[2:3]]).write(config.parent / "offsets.ecsv")
    result = cli("check", config)
    assert result.code == 1
    one_sentence(result.err.splitlines()[-1], "offsets.ecsv", str(table["exposure"][2]), "twice")


def test_the_error_of_the_configuration_goes_before_that_of_the_table(truth, offsets, tmp_path):
    run, table = offsets
    gauge = {"offsets": "offsets.ecsv", "offset_sigma": 3 * SIGMA}
    config = write_selfcal(tmp_path, list_table(truth), gauge=gauge)
    table.write(config.parent / "offsets.ecsv")
    found, before = directions(fitted(tmp_path / "run", config)), directions(run)
    ratio = found["scale"]["sigma_fixed"] / before["scale"]["sigma_fixed"]
    assert ratio == pytest.approx(3, rel=0.01)


def test_the_scale_is_that_of_the_offsets(truth, offsets):
    run, _ = offsets
    sigma = directions(run)["scale"]["sigma_fixed"]
    assert abs(_pixel(run) - _pixel_of(truth.model, truth.theta)) < 4 * sigma


def _pixel(run):
    return _pixel_of(run.fit.model, run.parts["solved"].mode.theta)


def _pixel_of(model, theta):
    """Side of a pixel at the reference pixel."""
    basis = model.basis()
    linear = [basis.to_monomials(theta[model.coefficient_slice(1, axis)])[1:3] for axis in (0, 1)]
    return np.sqrt(abs(np.linalg.det(linear)))


@pytest.mark.slow
@only_in_full("tests/kinds/selfcal/infer/test_expected has every gauge")
def test_relative_errors_are_the_same_in_every_gauge(free, offsets):
    """And absolute ones are not: that is what tells them apart."""
    maps = [
        [
            uncertainty_map(one, grid=(9, 9)).radius
            for one in (
                gauge_free(run.fit, run.parts["solved"].gauge.null),
                run.fit,
            )
        ]
        for run in (free, offsets[0])
    ]
    relative, absolute = zip(*maps, strict=True)
    # the two solutions differ by a scale and rotation, and their curvature by the jitter found
    np.testing.assert_allclose(relative[1], relative[0], rtol=2e-3)
    assert np.abs(absolute[1] / absolute[0] - 1).max() > 0.5


def test_a_free_direction_is_no_relative_error(free):
    """Whatever is added along free directions, relative errors stay."""
    fit, null = free.fit, free.parts["solved"].gauge.null
    rng = np.random.default_rng(2)
    move = null @ rng.standard_normal((null.shape[1], 2))
    wider = replace(fit, cov=fit.cov + move @ move.T)
    one, other = (
        uncertainty_map(gauge_free(each, null), grid=(7, 7)).radius for each in (fit, wider)
    )
    np.testing.assert_allclose(other, one, rtol=1e-6)
    assert uncertainty_map(wider, grid=(7, 7)).radius.min() > 10 * one.max()


@pytest.mark.slow
@only_in_full("other references of the scale are run")
def test_the_scale_of_another_detector(truth, tmp_path):
    """The pixel is as large as was said, and as well known."""
    tie = {"mas": 1.001 * SCALE_MAS, "sigma": 3e-5, "detector": "WFC"}
    config = write_selfcal(tmp_path / "input", list_table(truth), gauge={"scale": tie})
    run = fitted(tmp_path / "run", config)
    scale = directions(run)["scale"]
    assert scale["fixed_by"] == "scale of WFC"
    assert scale["sigma_fixed"] == pytest.approx(3e-5, rel=1e-6)
    assert _pixel(run) == pytest.approx(1.001, abs=1e-5)


def test_rolls(tmp_path):
    """Commanded rolls beside offsets say nothing new of what the stars show, and do no harm."""
    truth = small(rolls=(0, 0, 0))
    gauge = {"offsets": "offsets.ecsv", "roll_sigma_deg": 0.01}
    config = write_selfcal(tmp_path / "input", list_table(truth), gauge=gauge)
    commanded(truth, SIGMA, np.random.default_rng(3)).write(config.parent / "offsets.ecsv")
    run = fitted(tmp_path / "run", config)
    found = directions(run)
    assert found["scale"]["fixed_by"] == "commanded offsets"
    # offsets see a skew as they see a scale
    assert found["skew_plus"]["fixed_by"] == "commanded offsets"
    assert len(run.parts["solved"].gauge.held) == 2


def _references(truth, sigma_mas, n, rng):
    """Some stars of the true sky as a catalogue on the sky, with errors."""
    seen = np.unique(truth.detections.star[truth.detections.star >= 0])
    rows = rng.choice(seen, n, replace=False)
    at = (truth.sky[rows] - truth.sky.mean(axis=0)) * SCALE_MAS / 1000
    at = at + sigma_mas / 1000 * rng.standard_normal(at.shape)
    a = np.radians(30.0)  # the sky is turned, and mirrored: xi grows to the east
    turned = at @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) * [-1, 1]
    error = np.full(n, sigma_mas)
    mag = truth.detections.mag[[np.argmax(truth.detections.star == k) for k in rows]]
    return Table(
        {"u": turned[:, 0], "v": turned[:, 1], "sigma_u": error, "sigma_v": error, "mag": mag},
        units={"u": "arcsec", "v": "arcsec", "sigma_u": "mas", "sigma_v": "mas"},
    )


def test_reference_stars(truth, tmp_path):
    """They fix everything: scale by their errors over their lever arm, the places of all stars."""
    config = write_selfcal(
        tmp_path / "input",
        list_table(truth),
        selfcal={"unit": "mas"},
        gauge={"reference": {"catalog": "reference.ecsv"}},
    )
    rng, sigma = np.random.default_rng(4), 1.0
    table = _references(truth, sigma, 150, rng)
    table.write(config.parent / "reference.ecsv")
    run = fitted(tmp_path / "run", config)
    found = directions(run)
    for name in ("zero_point_u", "zero_point_v", "scale", "rotation"):
        assert found[name]["state"] == "free"
        assert found[name]["fixed_by"] == "reference stars"
    assert not run.directory.summary["selfcal"]["gauge"]["held"]
    used = run.parts["solved"].mode.problem.priors.informed
    assert used.sum() > 100
    # the closed form for stars whose own detections have no errors: it is the lower bound
    at = run.parts["solved"].mode.stars[used]
    lever = np.sqrt(((at - at.mean(axis=0)) ** 2).sum())
    scale = found["scale"]["sigma_fixed"]
    assert sigma / lever < scale < 2 * sigma / lever
    stars = star_catalogue(run.parts["solved"].mode)
    # every star, reference star or not, lies where the catalogue's sky has it
    where = np.column_stack([table["u"], table["v"]]) * 1000
    distance = np.sqrt(((stars.values[used, None] - where) ** 2).sum(axis=2)).min(axis=1)
    # of the catalogue's errors, Rayleigh: 99.9 % within 3.7 sigma
    assert np.quantile(distance, 0.99) < 3.7 * sigma
    true = SCALE_MAS * _pixel_of(truth.model, truth.theta)
    assert _pixel(run) == pytest.approx(true, rel=4 * scale)


def test_check_tells_what_fixes_the_scale(truth, offsets, tmp_path):
    run, _ = offsets
    config = run.base / "config.toml"
    out = good("check", config).out
    assert "scale: fixed by commanded offsets, sigma" in out
    assert "2 of them held by convention" in out


def test_a_prior(truth, tmp_path):
    """A prior on a linear coefficient fixes the scale as well as it knows the coefficient."""
    config = write_selfcal(
        tmp_path / "input",
        list_table(truth),
        prior=[{"parameter": "u_1_0", "mean": 512.0, "sigma": 0.05}],
    )
    scale = directions(fitted(tmp_path / "run", config))["scale"]
    assert scale["fixed_by"] == "priors"


@pytest.mark.parametrize(
    ("gauge", "change", "words"),
    [
        ({"roll_sigma_deg": 0.1}, None, ["gauge.offsets", "roll_sigma_deg"]),
        ({"offsets": "offsets.ecsv", "roll_sigma_deg": 0.1}, "roll", ["roll", "offsets.ecsv"]),
        ({"offsets": "offsets.ecsv"}, "sigma", ["sigma", "gauge.offset_sigma"]),
        ({"offsets": "offsets.ecsv"}, "du", ["du", "offsets.ecsv"]),
        ({"offsets": "nowhere.ecsv"}, None, ["nowhere.ecsv"]),
        ({"exposure_scale_sigma": 1e-5}, None, ["selfcal.frames"]),
        ({"offset": "offsets.ecsv"}, None, ["'offset'", "'offsets'"]),
    ],
    ids=["rolls of nothing", "no rolls", "no errors", "one axis", "no file", "scales", "typo"],
)
def test_a_gauge_that_cannot_be(truth, tmp_path, gauge, change, words):
    config = write_selfcal(tmp_path / "input", list_table(truth), gauge=gauge)
    table = commanded(truth, SIGMA, np.random.default_rng(1))
    if change is not None:
        table.remove_column(change)
    table.write(config.parent / "offsets.ecsv")
    result = cli("run", config, "-o", tmp_path / "run")
    assert result.code == 1
    one_sentence(result.err, *words)
    assert not (tmp_path / "run").exists()
