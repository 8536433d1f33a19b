"""A run in Python: the numbers of the command line, in memory and in a folder."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from astropy.time import Time

import bayesdist as bd
from tests.app.conftest import BUDGET, REQUIREMENTS
from tests.app.support import CENTRE, SIZE, as_table, good, simulated, summary_of, write_job
from tests.calibration.cameras import PIXEL, camera
from tests.reduced import only_in_full

SETTINGS = {
    "sampler": {"target_ess": 100, "target_rhat": 1.05},
    "assess": {"grid": (9, 7), "draws": 400},
}


def calibrated(stars, **options):
    """A small run in memory, of the settings of `config_text`."""
    settings = options.pop("settings", {})
    settings = SETTINGS | settings if isinstance(settings, dict) else settings
    given = {"order": 2, "size": SIZE, "reference_pixel": CENTRE, "name": "A"}
    return bd.calibrate(stars, settings=settings, **(given | options))


@pytest.fixture(scope="module")
def run(finished):
    return calibrated(
        bd.read_matches(finished.config.parent / "stars.ecsv"),
        scale_mas=50.0 * u.mas,
        requirements=[bd.Requirement(**one) for one in REQUIREMENTS],
        terms=[bd.UserTerm(**one) for one in BUDGET],
        settings={"products": {"sip": {"inverse_order": 4}}},
    )


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory):
    return run.save(tmp_path_factory.mktemp("python") / "run")


def assert_same(one: bd.Run, other: bd.Run):
    """Two runs are equal to the last bit, from the fit to the margins."""
    np.testing.assert_array_equal(one.fit.mean, other.fit.mean)
    np.testing.assert_array_equal(one.posterior.theta, other.posterior.theta)
    np.testing.assert_array_equal(one.solution.theta, other.solution.theta)
    assert one.budget().rows() == other.budget().rows()
    assert one.budget(at=(10, 10), to=(900, 700)).rows() == (
        other.budget(at=(10, 10), to=(900, 700)).rows()
    )
    assert one.evaluation.checks == other.evaluation.checks
    assert one.warnings == other.warnings
    np.testing.assert_array_equal(one.map().radius, other.map().radius)
    for margin, known in zip(one.margins, other.margins, strict=True):
        assert (margin.verdict, margin.reason) == (known.verdict, known.reason)
        np.testing.assert_array_equal(margin.draws, known.draws)
    assert one.diagnostics.score_tests == other.diagnostics.score_tests


def test_python_and_the_command_line_agree_to_the_bit(run, finished):
    with bd.open_run(finished.path) as other:
        assert len(other.margins) == 3
        assert_same(run, other)


def test_a_pickled_run_is_the_run(run, saved):
    """In memory with its stars; in a folder without, where they are read again."""
    assert_same(run, pickle.loads(pickle.dumps(run)))
    with bd.open_run(saved) as opened:
        assert_same(run, opened)
        stars = opened.stars
        with pickle.loads(pickle.dumps(opened)) as other:
            assert "stars" not in other.made and "posterior" in other.made
            assert_same(run, other)
            np.testing.assert_array_equal(other.stars.x, stars.x)


def test_a_saved_run_is_the_run(run, saved):
    with bd.open_run(saved) as other:
        assert_same(run, other)
        assert other.folder == saved and run.folder is None
        assert other.matches.n_rows == run.matches.n_rows


def test_commands_read_a_saved_run(saved, tmp_path):
    summary = summary_of(saved)
    assert [one["verdict"] for one in summary["margins"]]
    assert (saved / "sip.hdr").exists()
    assert "total" in good("budget", saved, "--at", 10, 10).out
    good("stage", "report", saved)
    assert (saved / "report.html").exists()
    # nothing has to be made again
    before = (saved / "posterior.nc").stat().st_mtime_ns
    good("run", saved / "config.toml", "-o", saved, "--resume")
    assert (saved / "posterior.nc").stat().st_mtime_ns == before


def test_a_saved_run_can_be_copied_and_moved(saved, run, tmp_path):
    with bd.open_run(saved) as other:
        copy = other.save(tmp_path / "copy")
    moved = copy.rename(tmp_path / "moved")
    with bd.open_run(moved) as other:
        np.testing.assert_array_equal(other.posterior.theta, run.posterior.theta)


def test_a_folder_in_use_is_refused_and_left(run, saved, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(bd.InputError, match="holds other files"):
        run.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    for folder in (saved, tmp_path):
        with bd.open_run(saved) as other, pytest.raises(bd.InputError, match="holds other files"):
            other.save(folder)
    with pytest.raises(bd.InputError, match="holds other files"):
        run.save(saved)
    with bd.open_run(saved) as other:
        np.testing.assert_array_equal(other.posterior.theta, run.posterior.theta)


def test_a_run_that_cannot_be_saved_leaves_nothing(run, tmp_path, monkeypatch):
    def full(*_):
        raise bd.InputError("cannot be written", do="make room")

    monkeypatch.setattr("bayesdist.app.stages.save_sampled", full)
    with pytest.raises(bd.InputError, match="make room"):
        run.save(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_files_that_changed_since_are_not_those_of_the_run(finished, tmp_path):
    text = (finished.config.parent / "stars.ecsv").read_text()
    (tmp_path / "stars.ecsv").write_text(text)
    run = calibrated(tmp_path / "stars.ecsv")
    (tmp_path / "stars.ecsv").write_text("\n".join(text.splitlines()[:-5]) + "\n")
    with pytest.raises(bd.InputError, match="changed"):
        run.save(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_earlier_calibration_may_be_named_relatively(finished, tmp_path, monkeypatch):
    """The earlier run halves the errors of the same stars, and is found when the run is opened."""
    monkeypatch.chdir(finished.path.parent)
    stars = simulated(seed=5)[0]
    run = calibrated(stars, settings={"prior_calibration": {"source": "run"}})
    assert run.map().radius_max < calibrated(stars).map().radius_max
    with bd.open_run(run.save(tmp_path / "run")) as other:
        np.testing.assert_array_equal(run.posterior.theta, other.posterior.theta)


@pytest.mark.slow
@only_in_full("tests/kinds/matches/test_kinds_of_data has errors by magnitude")
def test_stars_by_magnitude_are_found_without_being_asked():
    stars, _ = simulated(800, mag=np.linspace(12.0, 18.0, 800))
    bare = stars.with_columns(sigma_u=None, sigma_v=None)
    run = calibrated(bare)
    assert run.config.data.sigma == "by_magnitude"
    np.testing.assert_array_equal(
        calibrated(stars, sigma="by_magnitude").posterior.theta, run.posterior.theta
    )


def test_a_path_is_read_as_by_the_command_line(finished):
    run = calibrated(finished.config.parent / "stars.ecsv", scale_mas=50.0)
    with bd.open_run(finished.path) as other:
        np.testing.assert_array_equal(run.posterior.theta, other.posterior.theta)


def test_a_run_of_files_is_saved_with_their_names(finished, tmp_path):
    run = calibrated(finished.config.parent / "stars.ecsv")
    with bd.open_run(run.save(tmp_path / "run")) as other:
        np.testing.assert_array_equal(run.posterior.theta, other.posterior.theta)
        assert not (tmp_path / "run" / "matches.h5").exists()


def test_tables_of_others_are_taken(finished):
    table = QTable.read(finished.config.parent / "stars.ecsv")
    run = calibrated(table, scale_mas=50.0)
    with bd.open_run(finished.path) as other:
        np.testing.assert_array_equal(run.posterior.theta, other.posterior.theta)


def test_a_table_is_read_by_the_options_of_settings():
    """Motions of 1 arcsec in ten years move stars by as much."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1.0, 799.0, (2, 300))
    dx, dy = rng.normal(0, 0.02, (2, 300))
    table = QTable({"x": x + dx, "y": y + dy, "ra": 30.0 + x / 18000.0, "dec": y / 18000.0})
    table["pmra"], table["pmdec"] = np.full(300, 100.0) * u.mas / u.yr, np.zeros(300) * u.mas / u.yr
    table["ra_error"] = table["dec_error"] = np.full(300, 20.0) * u.mas
    table["ref_epoch"] = np.full(300, 2016.0)
    settings = {"data": {"epoch": 2026.0, "tangent_point": (30.0, 0.0)}}
    moved = calibrated(table, order=1, settings=settings)
    settings["data"]["epoch"] = 2016.0
    still = calibrated(table, order=1, settings=settings)
    shift = moved.matches.u - still.matches.u
    np.testing.assert_allclose(shift, 1.0, atol=1e-4)


def test_dates_are_times_or_years():
    stars = simulated(600)[0].with_columns(epoch=np.linspace(2010.0, 2014.0, 600))
    time = bd.TimeDependence((("u", 1, 0),), (2012.0,))
    run = calibrated(stars, time=time, epoch=Time(2013.0, format="decimalyear"))
    assert run.map().epoch == pytest.approx(2013.0)
    late, early = run.map(epoch=2019.0), run.map(epoch=2012.0)
    assert late.radius_max > early.radius_max
    assert run.budget(epoch=2019.0).rows()[-1]["radial"] > run.budget().rows()[-1]["radial"]


WRONG = {
    "order": ({"order": 13}, "calibrate: order"),
    "size": ({"size": None}, "size"),
    "frames": ({"frames": "rotation"}, "calibrate: frames"),
    "unknown key": ({"settings": {"sampler": {"max_step": 5}}}, "max_steps"),
    "given twice": ({"settings": {"model": {"order": 3}}}, "give it once"),
    "unit": ({"scale_mas": 50 * u.s}, "scale_mas"),
    "requirement": ({"requirements": ["p95"]}, "bayesdist.Requirement"),
    "term": ({"terms": [0.1]}, "bayesdist.UserTerm"),
    "seed": ({"seed": -1}, "calibrate: seed"),
    "catalogue": ({"catalogue": "Gaia DR3"}, "bd.Catalogue"),
    "outliers": ({"outliers": None}, "bayesdist.OutlierMixture"),
    "chips": ({"chips": 5}, "bayesdist.Chip"),
    "no settings": ({"settings": "x"}, "sections"),
    "no TOML": ({"settings": {"sampler": {"max_steps": object()}}}, "TOML"),
    "not finite": ({"size": (np.nan, 800)}, "calibrate: size"),
    "options of reading": ({"settings": {"data": {"epoch": 2020.0}}}, "have already been read"),
    "another kind": ({"settings": {"campaign": {"catalogue": "x"}}}, "give one"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_settings_are_named(name):
    options, words = WRONG[name]
    with pytest.raises(bd.InputError, match=words) as caught:
        calibrated(simulated()[0], **options)
    assert caught.value.do and "\n" not in str(caught.value)


def test_pixels_of_a_budget_may_have_their_unit(run):
    plain = run.budget(at=[(10, 20), (30, 40)], to=None).rows()
    assert run.budget(at=[(10 * u.pix, 20 * u.pix), (30, 40)]).rows() == plain
    assert run.budget(at=[(10, 20), (30, 40)] * u.pix).rows() == plain
    one = run.budget(at=(10, 20)).rows()
    assert run.budget(at=(10 * u.pix, 20 * u.pix)).rows() == one


def test_draws_of_positions_have_the_errors_of_the_centroids(run):
    """Errors of 20 pixels, far above those of the calibration; the columns are photutils's."""
    on_sky = replace(run)
    vars(on_sky)["calibration"] = camera()  # a cached property; that of `run` is in pixels
    stars = {"xcentroid": [100.0, 700.0], "ycentroid": [100.0, 500.0], "sx": [20.0, 20.0]}
    drawn = on_sky.to_sky(stars, centroids=("sx", "sx"), draws=2000)
    table = on_sky.to_sky(stars, centroids=("sx", "sx"))
    expected = np.full(2, 20 * PIXEL * 1000)
    np.testing.assert_allclose(table["sigma_dec"].to_value("mas"), expected, rtol=0.05)
    np.testing.assert_allclose(
        drawn.dec.pdf_std().to_value("mas"), table["sigma_dec"].value, rtol=0.08
    )
    wcs = camera().wcs().pixel_to_world(stars["xcentroid"], stars["ycentroid"])
    np.testing.assert_allclose(table["dec"].value, wcs.dec.deg, rtol=1e-13)


def test_wrong_questions_are_named(run):
    with pytest.raises(bd.InputError, match="chip"):
        run.map(chip=7)
    with pytest.raises(bd.InputError, match="one position"):
        run.budget(to=(1, 2))
    with pytest.raises(bd.InputError, match="give \\(x, y\\)"):
        run.budget(at="corner")
    with pytest.raises(bd.InputError, match="at is given in deg"):
        run.budget(at=(1 * u.deg, 2 * u.deg))
    with pytest.raises(bd.InputError, match="not on chip"):
        run.budget(at=(2000, 1))
    with pytest.raises(bd.InputError, match="draws is 'many'"):
        run.to_sky({"x": [1.0], "y": [1.0]}, draws="many")
    with pytest.raises(bd.InputError, match="epoch is 'never'"):  # the model depends on no date
        run.wcs(point=(1.0, 2.0), pixel_scale=0.05, epoch="never")
    with pytest.raises(bd.InputError, match="epoch"):
        run.map(epoch=16.5)
    with pytest.raises(bd.InputError, match="is not a run"):
        bd.open_run(Path(__file__).parent)


def test_a_run_that_is_not_sampled_is_refused(tmp_path):
    config = write_job(tmp_path / "input", as_table(simulated()[0]))
    good("stage", "fit", _begun(tmp_path / "run", config))
    with pytest.raises(bd.InputError, match="sample"):
        bd.open_run(tmp_path / "run")


def _begun(folder: Path, config: Path) -> Path:
    folder.mkdir()
    text = config.read_text().replace("stars.ecsv", str(config.parent / "stars.ecsv"))
    (folder / "config.toml").write_text(text)
    return folder


def test_published_errors_of_gaia_decide_a_requirement():
    """By [catalogue], without a [[budget]] row, and the same in Python; dates are needed."""
    stars, _ = simulated(400)
    gaia, need = bd.Catalogue("Gaia DR3"), bd.Requirement("field", "p95", 0.1)
    options = {"order": 2, "size": SIZE, "reference_pixel": CENTRE, "scale_mas": 100.0}
    with pytest.raises(bd.InputError, match="date of the exposures is not known"):
        bd.calibrate(stars, **options, catalogue=gaia)
    dated = replace(stars, epoch=np.full(len(stars), 2026.0))
    run = bd.calibrate(dated, **options, catalogue=gaia, requirements=need)
    assert run.margins[0].verdict == "met"
    assert "errors given by the user: Gaia DR3, Gaia DR3 proper motions" in run.margins[0].rests_on
    rows = {row["name"]: row for row in run.budget().rows()}
    motions = np.hypot(
        *(rows[f"Gaia DR3 proper motions{part}"]["u"] for part in ("", " (over the field)"))
    )
    spin = 0.08**2 / 3  # the stars have no magnitudes
    assert motions == pytest.approx(10.0 * np.sqrt(625e-6 + spin) / 100.0, rel=1e-6)
    alone = bd.calibrate(dated, **options, requirements=need)
    assert alone.margins[0].verdict == "undecided"
