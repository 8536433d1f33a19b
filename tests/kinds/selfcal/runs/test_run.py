"""A self-calibration from star lists to the report: the truth is covered, the gauge is told."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pyarrow.parquet as parquet
import pytest
from astropy.io import fits
from astropy.table import Table
from lxml import html
from scipy import stats

from bayesdist.app.pipeline import fit, match
from bayesdist.app.run import Run
from bayesdist.app.store import as_json
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.infer import load_fit, load_posterior
from bayesdist.infer.compare.planning import with_information
from bayesdist.infer.solution.transforms import gauge_free
from bayesdist.infer.stars.stars import in_table_order, prepare
from tests.app.support import (
    cli,
    good,
    in_memory,
    one_sentence,
    snapshot,
    summary_of,
    write_config,
)
from tests.kinds.selfcal.runs.support import affine_left
from tests.reduced import only_in_full


def _grid(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    at = (np.arange(n) + 0.5) * 1024 / n + 0.5
    x, y = np.meshgrid(at, at)
    return x.ravel(), y.ravel()


@pytest.mark.parametrize(
    ("name", "kind", "n_free"), [("three_rolls", "similarity", 4), ("one_roll", "linear", 6)]
)
def test_the_distortion_is_within_its_errors(name, kind, n_free, request):
    """Chi-square of the coefficients, but for the sky's free maps, which theta's null space has."""
    finished = request.getfixturevalue(name)
    run = Run.of(RunDirectory.open(finished.path))
    posterior, gauge = run.posterior, run.parts["solved"].gauge
    assert gauge.null.shape[1] == gauge.open.shape[1] == n_free
    relative = gauge_free(run.solution, gauge.null)
    model, truth = posterior.model, finished.truth
    x, y = _grid()
    first = np.zeros(len(x), np.int64)
    ours = model.predict(posterior.mean, x, y, exposure=first)
    true = truth.model.predict(truth.theta, x, y, exposure=first)
    off = true - ours - affine_left(ours, true, ours, kind)
    K = model.n_polynomial
    J = model.jacobian(posterior.mean, x, y, exposure=first)[..., :K].reshape(-1, K)
    cov = J @ np.asarray(relative.cov)[:K, :K] @ J.T
    values, vectors = np.linalg.eigh(cov)
    known = values > 1e-8 * values[-1]
    assert known.sum() == K - n_free
    # both projections are over the detector's area: of a fine grid here, exact there
    chi2 = (((vectors[:, known].T @ off.ravel()) ** 2) / values[known]).sum()
    low, high = stats.chi2.ppf([0.001, 0.999], K - n_free)
    assert low < chi2 < high


@pytest.mark.parametrize("name", ["three_rolls", "one_roll"])
def test_false_detections_are_told_as_in_the_posterior(name, request):
    """Places of stars go with the solution: beside other draws all detections would look false."""
    path = request.getfixturevalue(name).path
    posterior = load_posterior(path)
    assert posterior.own_places
    said = np.concatenate(
        [
            parquet.read_table(part, columns=["outlier_probability"]).column(0).to_numpy()
            for part in path.glob("stars/*")
        ]
    )
    assert len(said) == posterior.n_stars
    # expected numbers of the mode, and at the mean of the draws
    assert said.sum() == pytest.approx(posterior.n_false, rel=0.15, abs=2)
    assert abs(int((said > 0.5).sum()) - posterior.n_flagged) <= 2 + 0.1 * posterior.n_flagged


def test_functions_find_what_the_run_has_found(one_roll):
    """Lists become stars and a solution without a run's folder, the very ones that a run reads."""
    fitted = fit(match(in_memory(one_roll.config)))
    known = load_fit(one_roll.path / "fit.nc")
    np.testing.assert_array_equal(fitted.fit.mean, known.mean)
    np.testing.assert_array_equal(fitted.fit.cov, known.cov)
    run = Run.of(RunDirectory.open(one_roll.path))
    np.testing.assert_array_equal(fitted.parts["solved"].mode.stars, run.parts["solved"].mode.stars)
    np.testing.assert_array_equal(fitted.parts["solved"].gauge.held, run.parts["solved"].gauge.held)
    assert fitted.parts["solved"].fixed == run.parts["solved"].fixed
    made, read = fitted.matches, run.matches
    for name in ("x", "u", "sigma_u", "exposure", "row"):
        np.testing.assert_array_equal(getattr(made, name), getattr(read, name))
    facts, summary = as_json(fitted.fit_facts["selfcal"]), summary_of(one_roll.path)["selfcal"]
    assert {name: summary[name] for name in facts} == facts


def test_stars_are_where_they_were(three_rolls):
    """But for a similarity of the sky, and by the errors of their own detections."""
    stars, truth = Table.read(three_rolls.path / "stars.ecsv"), three_rolls.truth
    found = np.column_stack([stars["u"], stars["v"]])
    problem = Run.of(RunDirectory.open(three_rolls.path)).parts["solved"].mode.problem
    every = np.split(truth.detections.star[problem.rows], problem.starts[1:-1])
    whose = np.array([np.median(one) for one in every]).astype(int)
    assert len(np.unique(whose)) == len(whose) == len(stars)
    sky = truth.sky[whose]
    off = found + affine_left(found, sky, found, "similarity") - sky
    sigma = np.column_stack([stars["sigma_own_u"], stars["sigma_own_v"]])
    inside = np.mean(np.abs(off) < 2 * sigma)
    n = off.size
    # the errors of the distortion come on top of the stars' own: 12 % at the median
    assert inside > 0.93 - 3 * np.sqrt(0.95 * 0.05 / n)
    counts = summary_of(three_rolls.path)["selfcal"]
    assert len(stars) == counts["n_stars"] == counts["stars"]["n"]
    assert stars["n"].sum() == counts["detections"]["used"]
    assert (counts["stars"]["n_two_detections"]) == (stars["n"] == 2).sum()
    for row in stars[:5]:
        cov = row["cov_u_v"]
        assert abs(cov) < row["sigma_u"] * row["sigma_v"]


def test_every_detection_is_accounted_for(three_rolls):
    counts = summary_of(three_rolls.path)["selfcal"]["detections"]
    lost = sum(counts["unused"].values()) + sum(counts["cut"].values())
    assert counts["read"] == len(three_rolls.truth.detections) == counts["used"] + lost
    matching = Table.read(three_rolls.path / "matching.ecsv")
    assert matching["detections"].sum() == counts["read"]


def test_one_roll_is_told_by_name(one_roll):
    summary = summary_of(one_roll.path)
    gauge = summary["selfcal"]["gauge"]
    free = {d["name"] for d in gauge["directions"] if d["state"] == "free"}
    assert free == {
        *("zero_point_u", "zero_point_v", "scale", "rotation"),
        *("skew_plus", "skew_cross"),
    }
    assert all(d["fixed_by"] == "convention" for d in gauge["directions"] if d["name"] in free)
    assert len(gauge["held"]) == gauge["n_free"] == 6
    assert any("one roll angle" in text.lower() for text in summary["warnings"])
    table = Table.read(one_roll.path / "gauge.ecsv")
    assert set(table["name"][table["state"] == "free"]) == free


def test_check_names_the_free_directions_and_writes_nothing(one_roll):
    before = snapshot(one_roll.config.parent)
    out = good("check", one_roll.config).out
    assert "skew_plus: held by convention" in out
    assert "6 directions are free, 6 of them held by convention" in out
    assert "One roll angle" in out
    [row] = summary_of(one_roll.path)["fit"]["geometry"]
    assert f"geometry     chip 1: {row['sentence']}" in out.splitlines()
    assert snapshot(one_roll.config.parent) == before


def largest_deviation(plane, x, y):
    """Largest deviation of positions from their best linear map of x, y, in pixels."""
    design = np.column_stack([np.ones_like(x), x, y])
    best = np.linalg.lstsq(design, plane, rcond=None)[0]
    pixel = np.sqrt(abs(np.linalg.det(best[1:])))
    return np.hypot(*(plane - design @ best).T).max() / pixel


@pytest.mark.parametrize("name", ["three_rolls", "one_roll"])
def test_the_geometry_is_that_of_the_truth(name, request):
    finished = request.getfixturevalue(name)
    truth = finished.truth
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0.5, 1024.5, 21)] * 2))
    plane = truth.model.predict(truth.theta, x, y, exposure=np.zeros(len(x), np.int64))
    [row] = summary_of(finished.path)["fit"]["geometry"]
    assert row["distortion"] == pytest.approx(largest_deviation(plane, x, y), rel=0.02)
    # scale and rotation are free, and held as those of the pixels
    assert (row["scale_x"], row["scale_y"]) == pytest.approx((1.0, 1.0), abs=0.01)
    assert row["parity"] == 1 and row["position_angle"] == pytest.approx(0.0, abs=0.5)
    said = f"chip 1: {row['sentence']}"
    assert said in finished.result.out.splitlines()
    assert said in (finished.path / "bayesdist.log").read_text(encoding="utf-8")


def test_every_product_names_the_gauge(three_rolls):
    run = three_rolls.path
    held = summary_of(run)["selfcal"]["gauge"]["held"]
    for name in ("coefficients", "budget", "margins", "stars"):
        words = Table.read(run / f"{name}.ecsv").meta["gauge"]
        assert all(one in words for one in held), name
    with fits.open(run / "maps.fits") as file:
        words = " ".join(file[0].header["COMMENT"])
        assert "scale, rotation by convention" in words
        assert {"MIX_SIGMA_U", "REL_SIGMA_U", "REL_SIGMA_V", "REL_CORR"} <= {h.name for h in file}
    assert "Gauge of a self-calibration" in (run / "sip.hdr").read_text(encoding="ascii")
    with fits.open(run / "acs_sbc_idc.fits") as file:
        assert "Gauge of a self-calibration" in " ".join(file[0].header["HISTORY"])


def test_parameters_that_are_held_are_not_judged(three_rolls):
    posterior = load_posterior(three_rolls.path)
    held = summary_of(three_rolls.path)["selfcal"]["gauge"]["held"]
    c = posterior.convergence
    assert c.converged and np.isfinite(c.rhat_max) and np.isfinite(c.ess_bulk_min)
    unjudged = {name for name, rhat in zip(c.names, c.rhat, strict=True) if not np.isfinite(rhat)}
    assert unjudged == set(held)
    still = np.ptp(posterior.flat, axis=0) == 0
    assert {posterior.model.names[k] for k in np.flatnonzero(still)} == set(held)


def test_the_report_shows_gauge_and_stars(three_rolls):
    page = html.fromstring((three_rolls.path / "report.html").read_bytes())
    assert "Gauge and stars" in [title.text_content() for title in page.xpath("//h2")]
    rows = [[cell.text_content().strip() for cell in row] for row in page.xpath("//tr")]
    assert ["outliers.model", "uniform"] in [row[:2] for row in rows]
    text = "".join(page.xpath("//body//text()[not(ancestor::script or ancestor::style)]"))
    assert "Degeneracies of the detections, and the constraints that remove them" in text
    assert "relative positions" in text
    assert not re.search(r" --(?!-)", text)  # units that are missing
    assert (three_rolls.path / "figures" / "selfcal.svg").is_file()
    # what is fitted are detections; the test for structure allows for their stars
    said = ("Detections of stars", "false detections", "Structure in the residuals")
    for words in said:
        assert words in text
    for words in ("Matched stars", "false matches", "least-squares fit"):
        assert words not in text
    assert not summary_of(three_rolls.path)["misfit"]["significant"]


class Killed(BaseException):
    """What no stage catches."""


@pytest.mark.slow
@only_in_full("tests/kills kills one")
def test_a_run_that_was_killed_goes_on(three_rolls, tmp_path, monkeypatch, no_report):
    """Killed before each of its stages in turn, it ends bit for bit as if nothing had happened."""
    shutil.copytree(three_rolls.config.parent, tmp_path / "input")
    config, run = tmp_path / "input" / "config.toml", tmp_path / "run"

    def killed(*_, **options):
        raise Killed

    for stage, flag in (("fit", ()), ("sample", ("--resume",)), ("diagnose", ("--resume",))):
        with monkeypatch.context() as patch:
            patch.setattr(f"bayesdist.app.stages.{stage}", killed)
            with pytest.raises(Killed):
                cli("run", config, "-o", run, *flag)
    good("run", config, "-o", run, "--resume")
    one, other = load_posterior(run), load_posterior(three_rolls.path)
    assert np.array_equal(one.theta, other.theta)
    assert np.array_equal(one.hyper["j"], other.hyper["j"])
    a, b = (Table.read(p / "stars.ecsv") for p in (run, three_rolls.path))
    assert np.array_equal(a["u"], b["u"]) and np.array_equal(a["sigma_u"], b["sigma_u"])


def test_other_commands(three_rolls, tmp_path):
    """What needs matched stars says so; budget and requirements are there."""
    run = three_rolls.path
    assert "total" in good("budget", run, "--at", 512, 512).out
    for arguments, word in (
        (("select-order", three_rolls.config), "is a self-calibration"),
        (("monitor", run, run), "is the released run itself"),
        (("monitor", run, run / "stars.ecsv"), "has no section [data]"),
        (("wise", "bands", run, "-o", tmp_path / "bands"), "self-calibration"),
        (("plan", run), "has no requirements"),
        (("plan", run, "--epochs", "2020"), "self-calibration"),
        (("release", run, "-o", tmp_path / "release"), "campaign"),
    ):
        result = cli(*arguments)
        assert result.code == 1, arguments
        one_sentence(result.err, word)
    assert "posterior of a distortion" in good("inspect", run).out


@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_new_matches_on_another_sky_test_the_release(bend, three_rolls, tmp_path):
    """Exposures of a catalogue in any linear frame: a bend is found, and a frame is none."""
    rng, n = np.random.default_rng(5), 900
    x, y = rng.uniform(1, 1024, (2, n))
    exposure = np.repeat([0, 1, 2], n // 3)
    u, v = three_rolls.truth.model.predict(three_rolls.truth.theta, x, y, exposure=exposure).T
    u = u + bend * ((x - 512) / 512) ** 2
    frames = np.array([[[1.02, 0.3], [-0.25, 0.97]], [[-0.9, 0.1], [0.2, -1.0]], np.eye(2)])
    u, v = np.einsum("nab,bn->an", frames[exposure], [u, v]) + 0.02 * rng.standard_normal((2, n))
    names = np.array(["p", "q", "r"])[exposure]
    sigma = np.full(n, 0.02)
    columns = {"x": x, "y": y, "u": u, "v": v, "sigma_u": sigma, "sigma_v": sigma}
    table = Table(columns | {"exposure": names})
    for name in ("u", "v", "sigma_u", "sigma_v"):
        table[name].unit = "pix"
    table.write(tmp_path / "new.ecsv")
    config = write_config(
        tmp_path / "new.toml",
        data={"matches": "new.ecsv"},
        detector={"size": (1024, 1024)},
        model={"order": 3, "reference_pixel": (512.0, 512.0)},
    )
    result = good("monitor", three_rolls.path, config)
    assert ("no longer describes" in result.out) == (bend > 0)
    assert "in 3 exposure(s); fitted to each and taken out: affine" in result.out


def test_more_exposures_are_planned_as_these_are_dithered(three_rolls):
    """Once more as many exposures halve the variance: as a limit by the root of 2 nearer asks."""
    run = Run.of(RunDirectory.open(three_rolls.path))
    mode = run.parts["solved"].mode
    n = mode.problem.model.n_distortion
    more = with_information(mode.solution, mode.distortion_information)
    before, after = (np.diag(one.cov)[:n] for one in (mode.solution, more))
    free = before > 0
    assert free.sum() > n / 2
    np.testing.assert_allclose(after[free], before[free] / 2, rtol=1e-6)
    # the draws of a parameter that the gauge fixes are equal: no rounding is taken for a variance
    drawn = run.posterior
    fixed = np.setdiff1d(np.arange(len(mode.theta)), mode.free)
    assert len(fixed) and not drawn.cov[fixed].any()
    planned = with_information(drawn, mode.distortion_information)
    assert (planned.sigma[:n][free] < drawn.sigma[:n][free]).all()


def test_requirements_are_judged(three_rolls, tmp_path):
    shutil.copytree(three_rolls.path, tmp_path / "run")
    text = '[[requirement]]\nname = "a"\nstatistic = "p95"\nlimit = 0.05\nprobability = 0.9\n'
    (tmp_path / "req.toml").write_text(text)
    good("requirements", tmp_path / "run", "--requirements", tmp_path / "req.toml")
    [margin] = summary_of(tmp_path / "run")["margins"]
    assert margin["verdict"] == "met"
    planned = good("plan", tmp_path / "run").out
    assert "dithered as these 8 are" in planned and "dithered like these: met as it is" in planned


def test_residuals_are_about_the_stars_that_were_fitted(three_rolls):
    """The residuals of a star have no mean: about the mean of the draws they would have one."""
    run = Run.of(RunDirectory.open(three_rolls.path))
    sample = run.diagnostics.sample
    problem = run.parts["solved"].mode.problem
    n, star = len(problem.starts) - 1, np.empty(problem.rows.max() + 1, int)
    star[problem.rows] = np.repeat(np.arange(n), np.diff(problem.starts))
    assert set(sample.table.row) == set(problem.rows)
    star = star[sample.table.row]
    # of these the mixture counts nearly all
    true = sample.outlier_probability < 0.05
    counted = np.where(true, 1.0 - sample.outlier_probability, 0.0)
    weight = counted[:, None] / sample.variance
    doubted = np.bincount(star[~true], minlength=n) > 0

    def of_stars(values):
        return np.array([np.bincount(star, one, minlength=n)[~doubted] for one in values.T])

    def pull(residual):
        return np.abs(of_stars(weight * residual) / np.sqrt(of_stars(weight)))

    assert (~doubted).sum() > 50
    stars, order = prepare(run.fit.model, run.matches)
    of_mean = in_table_order(stars.residuals(run.posterior.mean), order)
    assert np.median(pull(sample.residual)) < 0.5 * np.median(pull(of_mean))
