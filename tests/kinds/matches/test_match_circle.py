"""Runs of stars that were matched only in circles about nominal positions."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest

import bayesdist as bd
from bayesdist import load_posterior
from bayesdist.app.config import parse_config
from bayesdist.data.formats import write_matches
from bayesdist.errors import ConfigError
from tests.app.support import (
    CENTRE,
    SIZE,
    as_table,
    config_text,
    good,
    refused,
    simulated,
    summary_of,
    write_job,
)
from tests.reduced import case_in_full, only_in_full

NAMED = {"u_nominal": "u_nominal", "v_nominal": "v_nominal"}
RADIUS = 0.05


def in_circles(n=1500, about=(0.03, -0.02)):
    """Stars within a circle about positions that are off by more than their errors."""
    matches, truth = simulated(n, fraction=0.0, jitter=0.0)
    table = as_table(matches)
    nominal = truth.model.predict(truth.theta, matches.x, matches.y) + np.array(about)
    table["u_nominal"], table["v_nominal"] = nominal.T
    distance = np.hypot(table["u"] - nominal[:, 0], table["v"] - nominal[:, 1])
    return table[np.asarray(distance) < RADIUS], truth


def test_a_run_knows_of_the_circle(tmp_path, no_report):
    table, truth = in_circles()
    outliers = {"model": "none", "match_radius": RADIUS}
    config = write_job(tmp_path, table, stars="stars.parquet", outliers=outliers)
    said = good("check", config).out
    # a side of the distribution is cut off at 0.7 sigma: the variance that is left is half of it
    assert "the match circle cuts the residuals" in said
    assert "posterior accounts for the circle" in said
    run = tmp_path / "run"
    good("run", config, "-o", run)
    summary = summary_of(run)
    assert summary["outliers"]["match_circle"] == RADIUS
    assert not any("quoted errors are too large" in text for text in summary["warnings"])
    # and without the nominal positions: the least-squares answer
    plain = write_job(
        tmp_path / "plain", table, stars="stars.parquet", outliers=outliers,
        data={"matches": "stars.parquet", "columns": {"u_nominal": "", "v_nominal": ""}},
    )  # fmt: skip
    good("run", plain, "-o", tmp_path / "plain" / "run")
    other = summary_of(tmp_path / "plain" / "run")
    assert "match_circle" not in other["outliers"]

    def offset(folder):
        """Mean error in u, in the middle of the detector."""
        p = load_posterior(folder / "posterior.nc")
        centre = np.array([[500.0, 400.0]]).T
        return (p.model.predict(p.mean, *centre) - truth.model.predict(truth.theta, *centre))[0, 0]

    assert abs(offset(run)) < 0.003 < 0.006 < offset(tmp_path / "plain" / "run")


def test_positions_without_a_radius_are_said_to_be_unused(tmp_path):
    config = write_job(tmp_path, in_circles()[0])
    said = good("check", config).out
    assert "outliers.match_radius is not given: the likelihood does not know that they were" in said


def test_a_star_outside_its_circle(tmp_path):
    table, _ = in_circles()
    table["v_nominal"][11] += 1.0
    config = write_job(tmp_path, table, outliers={"match_radius": RADIUS})
    words = ["stars.ecsv, row 12: is ", "outside the match circle of radius 0.05", "match_radius"]
    refused(tmp_path, "check", config, words=words)


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"data": {"sigma": "by_magnitude"}}, ["data.sigma", "give columns of errors"]),
        ({"holdout": {"fraction": 0.1}}, ["[holdout]", "leave [holdout] out"]),
        (
            {"periods": {"centres": [52000.0, 52100.0], "days": 9.0}},
            ["[periods]", "leave [periods] out"],
        ),
        (
            {"data": {"format": "rvb"}},
            ["data.format is 'rvb'", "leave out u_nominal and v_nominal"],
        ),
        ({"data": {"format": "hst1pass"}}, ["data.format is 'hst1pass'"]),
    ],
)
def test_what_cannot_go_with_it(sections, words):
    data = {"matches": "stars.ecsv", "columns": NAMED} | sections.pop("data", {})
    text = config_text(data=data, outliers={"match_radius": RADIUS}, **sections)
    with pytest.raises(ConfigError) as error:
        parse_config(text, "c.toml")
    for word in words:
        assert word in str(error.value)
    # a radius alone is that of uniform outliers
    del data["columns"]
    parse_config(config_text(data=data, outliers={"match_radius": RADIUS}, **sections), "c.toml")


def test_columns_that_were_found_by_name_are_refused_too(tmp_path):
    config = write_job(
        tmp_path, in_circles()[0], outliers={"match_radius": RADIUS}, holdout={"fraction": 0.1}
    )
    refused(tmp_path, "check", config, words=["stars.ecsv", "[holdout]", "nominal positions"])


def test_a_self_calibration_has_none():
    text = config_text(
        data=None, model={"order": 2},
        selfcal={"lists": "*.csv", "exposures": "log.csv", "columns": NAMED},
    )  # fmt: skip
    with pytest.raises(ConfigError, match="nominal positions belong to matches in"):
        parse_config(text, "c.toml")


# -- the radius that stars state ------------------------------------------------------------------

SHORT = {
    "sampler": {"target_ess": 100, "target_rhat": 1.05},
    "assess": {"grid": (5, 5), "draws": 100},
}
# a jitter would be sampled alike, and takes most of the time (`test_calibrate.py`)
NO_JITTER = {"outliers": {"jitter": 0.0}}
FILES = ("stars.ecsv", "stars.parquet", "matches.h5")


@pytest.fixture(scope="module")
def stated():
    """Matches that state the radius in which they were looked for, with magnitudes."""
    table, _ = in_circles(900)
    table["mag"] = np.linspace(12.0, 18.0, len(table))
    return bd.Matches.from_table(table).with_columns(match_radius=RADIUS)


def calibrated(stars, sigma=None, outliers="gaussian"):
    settings = SHORT | NO_JITTER if isinstance(outliers, str) else SHORT
    return bd.calibrate(
        stars, order=2, size=SIZE, reference_pixel=CENTRE, name="A", sigma=sigma,
        outliers=outliers, settings=settings,
    )  # fmt: skip


def written(matches, folder):
    """Paths of the files that hold matches with their radius."""
    folder.mkdir()
    matches.to_table().write(folder / FILES[0])
    matches.to_table().write(folder / FILES[1])
    write_matches(folder / FILES[2], matches)
    return [folder / name for name in FILES]


@pytest.mark.parametrize(
    "sigma", ["columns", case_in_full("by_magnitude", instead="errors in columns are read alike")]
)
def test_object_file_and_command_line_agree_to_the_bit(stated, tmp_path, sigma, no_report):
    run = calibrated(stated, sigma)
    assert run.posterior.mixture.match_radius == RADIUS
    assert run.matches.has_nominal == (sigma == "columns")
    paths = written(stated, tmp_path / "files")
    for path in paths:
        with calibrated(path, sigma) as other:
            np.testing.assert_array_equal(other.posterior.theta, run.posterior.theta)
            assert other.budget().rows() == run.budget().rows()
            assert other.warnings == run.warnings
    config = write_job(
        tmp_path / "job", stated.to_table(), data={"matches": str(paths[0]), "sigma": sigma},
        budget=[], **SHORT, **NO_JITTER,
    )  # fmt: skip
    good("run", config, "-o", tmp_path / "run")
    with bd.open_run(tmp_path / "run") as other:
        np.testing.assert_array_equal(other.posterior.theta, run.posterior.theta)
    assert ("match_circle" in summary_of(tmp_path / "run")["outliers"]) == (sigma == "columns")


def test_a_saved_run_is_calibrated_again_with_the_same_result(stated, tmp_path):
    run = calibrated(stated)
    folder = run.save(tmp_path / "run")
    with bd.open_run(folder) as other:
        np.testing.assert_array_equal(other.posterior.theta, run.posterior.theta)
    with calibrated(folder / "matches.h5") as other:
        np.testing.assert_array_equal(other.posterior.theta, run.posterior.theta)


def test_a_radius_of_the_settings_wins_and_differences_are_reported(stated):
    wider = calibrated(
        stated, outliers=bd.OutlierMixture(match_radius=2 * RADIUS * u.pix, jitter=0.0)
    )
    assert wider.posterior.mixture.match_radius == 2 * RADIUS
    [warning] = [text for text in wider.warnings if "by the settings" in text]
    assert "0.1 pix" in warning and "0.05 pix by the matches" in warning
    default = calibrated(stated, outliers=bd.OutlierMixture(jitter=0.0))
    assert default.posterior.mixture.match_radius == RADIUS
    assert not any("by the settings" in text for text in default.warnings)


@pytest.mark.slow
@only_in_full("bd.calibrate uses the radius by the same functions")
def test_single_steps_use_the_radius_of_the_matches(stated):
    model = bd.build_model(stated, order=2, size=SIZE, reference_pixel=CENTRE)
    fit, posteriors = bd.fit_linear(stated, model), []
    for outliers in (None, bd.OutlierMixture(), bd.OutlierMixture(match_radius=RADIUS)):
        posteriors.append(bd.sample(fit, stated, outliers=outliers, target_ess=50, max_steps=400))
    for posterior in posteriors:
        np.testing.assert_array_equal(posterior.theta, posteriors[0].theta)
    _, by_magnitude, _ = bd.fit_by_magnitude(stated, model)
    assert not by_magnitude.has_nominal and by_magnitude.match_radius == RADIUS


def test_uniform_outliers_take_the_radius_of_the_file(stated, tmp_path):
    path = written(stated.without("u_nominal", "v_nominal"), tmp_path / "files")[0]
    with calibrated(path, outliers="uniform") as run:
        assert run.posterior.mixture.match_radius == RADIUS
    with pytest.raises(bd.InputError, match="need the radius of the match circle"):
        calibrated(stated.with_columns(match_radius=None), outliers="uniform")
