"""Runs of stars that were matched only in circles about nominal positions."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist import load_posterior
from bayesdist.app.config import parse_config
from bayesdist.errors import ConfigError
from tests.app.support import (
    as_table,
    config_text,
    good,
    refused,
    simulated,
    summary_of,
    write_job,
)

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
    words = ["stars.ecsv, row 12: lies ", "outside the match circle of radius 0.05", "match_radius"]
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
        ({"data": {"format": "rvb"}}, ["data.format is 'rvb'", "leave u_nominal and v_nominal"]),
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
    with pytest.raises(ConfigError, match="nominal positions are of matches in"):
        parse_config(text, "c.toml")
