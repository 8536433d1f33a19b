"""`fit.skew`: what it tells is the angle between the axes, and it moves nothing."""

from __future__ import annotations

import numpy as np
import pytest
from lxml import html as lxml_html
from scipy import stats

from bayesdist.infer import Rejection, fit_linear, load_fit, load_posterior
from bayesdist.infer.solution.geometry import skew_of
from bayesdist.report.sections.fit import fit_tables
from tests.app.support import (
    CENTRE,
    as_table,
    model_of,
    partly_run,
    refused,
    simulated,
    summary_of,
    truth_of,
    write_job,
)
from tests.reduced import only_in_full
from tests.report.runs import report_run

FILES = ("coefficients.ecsv", "budget.ecsv", "margins.ecsv", "sip.hdr")


def angle(model, theta):
    """Angle of the image of the y axis against that of the x axis less 90 degrees, by steps."""
    x, y = CENTRE
    places = np.array([[x + 1, y], [x - 1, y], [x, y + 1], [x, y - 1]])
    p = model.predict(theta, *places.T)
    steps = (p[..., k, :] - p[..., k + 1, :] for k in (0, 2))
    of_x, of_y = (np.arctan2(step[..., 1], step[..., 0]) for step in steps)
    return of_y - of_x - np.pi / 2


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The same run without the skew and with it."""
    folder = tmp_path_factory.mktemp("skew")
    table = as_table(simulated(2000)[0])
    out = []
    for name, fit in (("without", {}), ("with", {"skew": True})):
        given = {"fit": fit, "products": {"sip": {}}}
        config = write_job(folder / name, table, stars="stars.parquet", **given)
        stages = ("fit", "sample", "assess", "export", *(("report",) if fit else ()))
        out.append(partly_run(folder / name / "run", config, *stages))
    return out


@pytest.mark.slow
@only_in_full("tests/infer/solution/test_skew has the angle")
def test_it_is_the_angle_between_the_axes(pair):
    """Finite differences of positions; the error from draws of the fit's covariance."""
    _, run = pair
    fit = load_fit(run / "fit.nc")
    found = summary_of(run)["fit"]["skew"]
    # steps of a pixel see terms of the third order, of which there are none
    assert found["value_rad"] == pytest.approx(angle(fit.model, fit.mean), abs=1e-10)
    draws = fit.draws(4000, np.random.default_rng(1))
    spread = np.std(angle(fit.model, draws))
    assert found["sigma_rad"] == pytest.approx(spread, rel=0.05)
    assert found["significance"] == pytest.approx(found["value_rad"] / found["sigma_rad"])
    truth = angle(model_of(), truth_of(model_of()))
    assert abs(found["value_rad"] - truth) < 4 * found["sigma_rad"]


def test_it_moves_nothing(pair):
    """Linear terms are free either way: fit, posterior and products are the same to the bit."""
    without, with_it = pair
    assert "skew" not in summary_of(without)["fit"]
    for load in (load_fit, load_posterior):
        name = "fit.nc" if load is load_fit else "posterior.nc"
        one, other = load(without / name), load(with_it / name)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.cov, other.cov)
    for name in FILES:
        assert (without / name).read_bytes() == (with_it / name).read_bytes(), name


def test_the_report_has_that_of_fit_and_posterior(pair, finished):
    without, with_it = (
        lxml_html.parse(run / "report.html").getroot() for run in (finished.path, pair[1])
    )
    assert "Skew of the axes" not in without.text_content()
    text = with_it.get_element_by_id("fit").text_content()
    assert "Skew of the axes at the reference pixel" in text
    assert "the weights of the fit are not the inverse variances" not in text
    (table,) = with_it.xpath("//table[caption[contains(., 'Skew of the axes')]]")
    rows = {r[0].text_content(): [c.text_content() for c in r[1:]] for r in table.xpath(".//tr")}
    posterior = load_posterior(pair[1] / "posterior.nc")
    draws = 1e6 * np.array([angle(posterior.model, one) for one in posterior.flat[::10]])
    value, sigma, _ = (float(c.replace("−", "-")) for c in rows["posterior"])
    assert value == pytest.approx(draws.mean(), abs=0.3 * draws.std())
    assert sigma == pytest.approx(draws.std(), rel=0.15)
    assert set(rows) >= {"least squares", "posterior"}


def test_extra_weight_in_the_corners_is_flagged():
    run = report_run()
    for weight in (1.0, 10.0):
        config = {**run.configuration, "fit": {"skew": True, "radial_weight": weight}}
        tables = fit_tables(run.having(configuration=config))
        [table] = [table for table in tables if "Skew of the axes" in table.caption]
        assert ("With 10 times the weight in the corners" in table.note) == (weight > 1)


@pytest.mark.parametrize("weight", [1.0, 10.0])
def test_the_error_is_that_of_repeated_experiments(weight, full):
    """Also where the weights are not the inverse variances: pulls are standard normal.

    With the truth without skew the significance is the pull.
    """
    model = model_of()
    theta = truth_of(model)
    pulls, n = [], 150 if full else 60
    for seed in range(n):
        matches, _ = simulated(200, seed=seed, fraction=0.0, jitter=0.0)
        fit = fit_linear(matches, model, rejection=Rejection(1e9, None, weight))
        skew = skew_of(fit)
        pulls.append((skew.value - angle(model, theta)) / skew.sigma)
    low, high = stats.chi2(n).ppf([5e-4, 1 - 5e-4])
    assert low < (np.array(pulls) ** 2).sum() < high
    assert abs(np.mean(pulls)) < 3.5 / np.sqrt(n)


def test_it_is_a_switch(tmp_path):
    config = write_job(tmp_path, fit={"skew": 0.1})
    refused(tmp_path, "check", config, words=("fit.skew", "true or false"))
