"""Whatever is wrong with the input of a campaign: one sentence, or a run that says what it did."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.time import Time

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches
from bayesdist.errors import DegenerateError
from bayesdist.files.tables import read_table
from bayesdist.infer import fit_linear, load_fit
from bayesdist.kinds.campaign.inputs import (
    distance_of_pointings,
    frames_not_set,
    shear_warnings,
)
from bayesdist.model import Chip, DistortionModel
from tests.app.damaged import CONFIG, ONE, Campaign, masked, scattered, setting
from tests.app.support import cli, good, one_sentence, refused, summary_of
from tests.reduced import case_in_full, only_in_full


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign") / "acs"
    good("simulate", "acs", "-o", folder, "--exposures", 8, "--stars", 3000, "--seed", 3, "-q")
    for name in ("catalog_early.parquet", "catalog_late.parquet"):
        (folder / name).unlink()
    shutil.rmtree(folder / "truth")
    config = folder / CONFIG
    text = config.read_text(encoding="utf-8").replace('method = "field"', 'method = "none"')
    config.write_text(text + "\n[sampler]\ntarget_ess = 100\n", encoding="utf-8")
    return folder


@pytest.fixture
def campaign(folder, tmp_path) -> Campaign:
    shutil.copytree(folder, tmp_path / "input")
    return Campaign(tmp_path / "input")


@pytest.fixture(scope="module")
def undamaged(folder, tmp_path_factory) -> tuple[Campaign, Path]:
    """The campaign as it is, and its run after the first stage."""
    campaign = Campaign(shutil.copytree(folder, tmp_path_factory.mktemp("undamaged") / "input"))
    campaign.matched()
    return campaign, campaign.path.parent / "run"


@pytest.fixture
def resumable(undamaged, tmp_path) -> Iterator[tuple[Campaign, Path]]:
    """The same, to be damaged; afterwards it is as it was."""
    campaign, run = undamaged
    shutil.copytree(campaign.path, tmp_path / "undamaged")
    yield campaign, run
    shutil.rmtree(campaign.path)
    shutil.copytree(tmp_path / "undamaged", campaign.path)


# -- the log --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda t: t.remove_column("vafactor"),
            ["f606w-001", "vafactor", "campaign.vafactor_source"],
        ),
        (masked("vafactor", 3), ["f606w-003", "vafactor", "campaign.vafactor_source"]),
        (setting("vafactor", 3, 0.0), ["row 3", "f606w-003", "vafactor is 0.0"]),
        (setting("vafactor", 3, 2.0), ["row 3", "f606w-003", "vafactor is 2.0"]),
        (lambda t: t.remove_column("epoch"), ["'epoch'", "rename"]),
        (masked("epoch", 3), ["row 3", "'epoch'", "missing"]),
        (setting("filter", slice(None), "F999W"), ["F606W", "F999W"]),
        (lambda t: vstack([t, t[2:3]]), ["f606w-003", "twice"]),
    ],
    ids=["no VAFACTOR", "one VAFACTOR", "0", "2", "no epoch", "one epoch", "filter", "twice"],
)
def test_a_log_that_lacks_something(campaign, change, words):
    campaign.log(change).refused("exposures.ecsv", *words)


def test_aberration_of_the_earth_needs_no_factor_but_a_target(campaign):
    campaign.log(lambda t: t.remove_column("vafactor"))
    campaign.replaced("q_max = 0.1", 'q_max = 0.1\nvafactor_source = "earth"')
    assert "of the Earth alone" in campaign.check()
    assert any("aberration were computed" in text for text in campaign.matched()["warnings"])
    shutil.rmtree(campaign.path.parent / "run")
    campaign.log(lambda t: t.remove_columns(["ra", "dec"]))
    campaign.refused("f606w-001", "neither vafactor nor ra and dec")


def as_days(table: Table) -> None:
    table["epoch"] = (np.asarray(table["epoch"]) - 2000.0) * 365.25 + 51544.5


def test_epochs_in_days_are_told_from_years(campaign):
    campaign.log(as_days)
    campaign.refused("row 1", "'epoch'", "not a year", "'d'")


@pytest.mark.parametrize("kind", ["days", "dates", "texts"])
def test_epochs_that_are_no_years_are_read_as_what_they_are(campaign, kind):
    def change(table: Table) -> None:
        if kind == "days":
            as_days(table)
            table["epoch"].unit = "d"
        elif kind == "dates":
            times = Time(np.asarray(table["epoch"]), format="decimalyear")
            table["epoch"] = times.iso
        else:
            table["epoch"] = [str(t) for t in table["epoch"]]

    plain = campaign.check()
    assert campaign.log(change).check() == plain


def test_an_epoch_that_is_no_date(campaign):
    def change(table: Table) -> None:
        table["epoch"] = [*(str(t) for t in table["epoch"][:-1]), "spring 2014"]

    campaign.log(change).refused("row 8", "'spring 2014'")


def test_without_roll_angles_those_of_the_matches_do(campaign):
    text = campaign.log(masked("pa_v3", 3)).check()
    assert "WARNING      PA_V3 is missing of 1 of 8 exposures" in text
    text = campaign.log(lambda t: t.remove_column("pa_v3")).check()
    assert "not known; roll angles will be those of the matches" in text
    found = campaign.matched()
    rolls = np.asarray(Table.read(campaign.path.parent / "run" / "matching.ecsv")["rotation"])
    assert np.ptp(rolls) > 90 and not found["warnings"]


# -- chips ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        pytest.param("f606w-001", 2, id="first, reference"),
        case_in_full(ONE, 1, instead="that of the reference chip is run", id="later, other"),
    ],
)
def test_an_exposure_with_one_chip_serves_for_that_one(campaign, folder, name, missing):
    campaign.lists(lambda t: t[t["chip"] != missing], name)
    assert f"chip {missing} " in campaign.check() and name in campaign.check()
    found = campaign.matched()
    assert found["n_exposures"] == 8 and not found["left_out"]
    assert any(f"chip {missing}" in text and name in text for text in found["warnings"])
    run = campaign.path.parent / "run"
    rows = Table.read(run / "matching.ecsv")
    row = rows[rows["exposure"] == name][0]
    assert row[f"chip {missing}"] == 0 < row[f"chip {3 - missing}"]
    assert row["completeness"] > 0.9  # of the chip that is there
    good("stage", "fit", run, "-q")
    fit = load_fit(run / "fit.nc")
    assert set(fit.model.exposures) == set(rows["exposure"])
    assert np.isfinite(fit.mean).all() and np.isfinite(fit.cov).all()
    assert 0.8 < fit.chi2 / fit.dof < 1.3
    assert name in summary_of(run)["exposures_skipped"]  # of those that are fitted alone
    warnings = Run.of(RunDirectory.open(run)).match_facts["warnings"]
    assert any(f"chip {missing}" in text and name in text for text in warnings)


@pytest.mark.parametrize(("kept", "name"), [(2, "WFC1"), (1, "WFC2")])
def test_a_chip_that_no_exposure_has(campaign, kept, name):
    campaign.lists(lambda t: t[t["chip"] == kept]).refused(name, "[[chip]]", "column 'chip'")


def test_a_chip_that_the_configuration_does_not_name(campaign):
    campaign.lists(setting("chip", slice(1, None, 7), 3), ONE)
    campaign.refused(ONE, "chip 3", "[[chip]]", "known: 2, 1")


def test_chips_that_change_places(campaign):
    def change(rows: fits.FITS_rec) -> None:
        rows["DETCHIP"] = 3 - np.array(rows["DETCHIP"])

    campaign.start(change).unmatched("8 of 8 exposures", "chip", "known distortion")


# -- how many, and when ---------------------------------------------------------------------------


def test_one_exposure(campaign):
    campaign.keep(2).refused("one exposure", "at least 3")


@pytest.mark.parametrize("drift", [True, False])
def test_two_exposures(campaign, drift):
    campaign.keep(2, 6)
    if not drift:
        campaign.without_drift()
    campaign.refused("2 exposures", "at least 3", "[data]")


def test_no_more_exposures_than_the_lines_absorb(campaign):
    campaign.keep(2, 3, 6, 7).refused("model.tdd", "4 exposures", "2 lines", "drop a break")
    assert "4 in F606W" in campaign.without_drift().check()


@pytest.mark.parametrize(
    ("year", "words"),
    [
        (2019.4, ["segment 2 of the drift (from 2019.4)", "no exposure", "2002.43 to 2014.04"]),
        (1999.4, ["segment 1 of the drift (to 1999.4)", "no exposure", "2002.43 to 2014.04"]),
        (2013.5, ["segment 2 of the drift (from 2013.5)", "one exposure only, at 2014.04"]),
    ],
)
def test_a_segment_that_exposures_do_not_determine(campaign, year, words):
    campaign.replaced("breaks = [2009.4]", f"breaks = [{year}]")
    campaign.refused("model.tdd", *words, "breaks")


def test_a_segment_with_one_epoch(campaign):
    def change(table: Table) -> None:
        table["epoch"][4:] = 2012.0 + np.arange(4) / 1e5

    campaign.log(change).refused("segment 2", "one epoch only, at 2012.00", "rate")


def test_a_period_outside_its_segment(campaign):
    campaign.replaced("years = [2009.4, 2015.0]", "years = [2002.0, 2009.0]")
    campaign.refused("period[2]", "2002 to 2009", "segment 2 of the drift (from 2009.4)")
    campaign.replaced("segment = 1", "segment = 2")
    campaign.refused("period[2]", "segment 2", "0 to 1")


def test_an_epoch_far_outside_is_said(campaign):
    campaign.replaced("epoch = 2006.5", "epoch = 2106.5")
    assert "WARNING      Assess.epoch asks for 2106.5" in campaign.check()


# -- roll angles ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rolls", [[120.0], [20.0, 200.0], [300.0, 301.0]])
def test_one_roll_angle_is_said_to_be_degenerate(campaign, rolls):
    def change(table: Table) -> None:
        table["pa_v3"] = np.resize(rolls, len(table))

    text = campaign.log(change).check()
    assert "WARNING" in text and "degenerate with one of the detector" in text


@pytest.mark.parametrize("rolls", [[20.0, 110.0], [20.0, 40.0], [20.0, np.nan, 60.0], [np.nan]])
def test_several_roll_angles_are_not(rolls):
    assert shear_warnings(np.array(rolls), "PA_V3") == []


def test_one_roll_angle_shows_in_the_matches_whatever_the_log_says(campaign):
    """The same sky eight times: the log's angles are wrong."""
    lists = campaign.path / "lists"
    for k in range(2, 9):
        shutil.copy(lists / "f606w-001.parquet", lists / f"f606w-00{k}.parquet")

    def change(table: Table) -> None:
        table["epoch"] = table["epoch"][0] + np.arange(8) / 100
        table["vafactor"] = table["vafactor"][0]

    campaign.log(change).without_drift().replaced("epoch = 2006.5", "epoch = 2002.5")
    assert "WARNING" not in campaign.check()
    assert any("one roll angle" in text for text in campaign.matched()["warnings"])


# -- the field ------------------------------------------------------------------------------------


@only_in_full("tests/data names one, and test_campaign_on_sky refuses one in a run")
def test_a_catalogue_of_the_wrong_field(campaign):
    def change(table: Table) -> None:
        rng = np.random.default_rng(2)
        for name in ("u", "v"):
            table[name][:] = rng.permutation(np.asarray(table[name]))

    said = campaign.catalog(change).unmatched("f606w-001", "bring together", "1 more of 8")
    assert int(said.split("bring together ")[1].split()[0]) >= 6  # the best number by chance
    assert "while chance gives" in said


@pytest.mark.parametrize(("factor", "said"), [(0.05, "0.05 times"), (50.0, "50 times")])
def test_a_catalogue_in_another_unit(campaign, factor, said):
    def change(table: Table) -> None:
        for name in ("u", "v"):
            table[name] = factor * np.asarray(table[name])
            table[name].unit = "pix"

    text = campaign.catalog(change).unmatched("does match at", "unit")
    scale = float(text.split("does match at ")[1].split()[0])
    assert scale == pytest.approx(float(said.split()[0]), rel=0.01)


def test_a_catalogue_in_a_unit_that_it_says(campaign, undamaged):
    def change(table: Table) -> None:
        for name in table.colnames:
            unit = str(table[name].unit or "")
            if unit.startswith("pix"):
                table[name] = 0.05 * np.asarray(table[name])
                table[name].unit = unit.replace("pix", "arcsec")

    n_pairs = summary_of(undamaged[1])["matching"]["n_pairs"]
    assert campaign.catalog(change).matched()["n_pairs"] == n_pairs


@only_in_full("test_campaign_on_sky has a mirrored catalogue")
def test_a_mirrored_catalogue(campaign):
    def change(table: Table) -> None:
        for name in ("u", "pm_u"):
            table[name] = -table[name]

    campaign.catalog(change).unmatched("mirror image does match", "axes")


def test_a_known_distortion_of_another_scale(campaign):
    def change(rows: fits.FITS_rec) -> None:
        for name in rows.names:
            if name[:2] in ("CX", "CY"):
                rows[name] = 1.05 * rows[name]

    campaign.start(change).unmatched("does match at 0.952", "known distortion")


def test_a_known_distortion_without_distortion(campaign):
    """Linear terms alone: 60 pixels off in the corners, and still enough."""

    def change(rows: fits.FITS_rec) -> None:
        for name in rows.names:
            if name[:2] in ("CX", "CY") and name[2:4] > "19":
                rows[name] = 0.0

    found = campaign.start(change).matched()
    assert found["completeness"]["median"] > 0.9 and found["n_exposures"] == 8


@pytest.mark.slow
@only_in_full("tests/data/test_columns moves the origin")
def test_pixels_that_count_from_elsewhere_give_the_same_positions(campaign, undamaged, tmp_path):
    """Half a pixel is a shift of the polynomials, and of nothing else."""

    def change(table: Table) -> None:
        table["x"], table["y"] = table["x"] - 0.5, table["y"] - 0.5

    campaign.lists(change).matched()
    fits_ = []
    for run in (shutil.copytree(undamaged[1], tmp_path / "plain"), tmp_path / "run"):
        good("stage", "fit", run, "-q")
        fits_.append(load_fit(run / "fit.nc"))
    x, y = np.random.default_rng(1).uniform((1, 1), (4096, 2048), (300, 2)).T
    where = {"chip": 1, "epoch": np.full(300, 2011.0), "exposure": np.full(300, 5)}
    here = fits_[0].model.predict(fits_[0].mean, x, y, **where)
    there = fits_[1].model.predict(fits_[1].mean, x - 0.5, y - 0.5, **where)
    # cuts at the same stars; rejected ones may differ by one or two
    assert np.abs(here - there).max() < 0.2 * fits_[0].rms_u


def test_swapped_columns(campaign):
    def change(table: Table) -> None:
        table["x"], table["y"] = table["y"].copy(), table["x"].copy()

    campaign.lists(change).refused("f606w-001", "outside", "swapped")


def test_pixels_of_a_mosaic(campaign):
    def change(table: Table) -> None:
        table["y"] = table["y"] + 2048.0 * (table["chip"] == 1)

    campaign.lists(change).refused("f606w-001", "WFC1", "outside", "mosaic")


# -- files ----------------------------------------------------------------------------------------


def test_a_missing_list(campaign):
    (campaign.path / "lists" / f"{ONE}.parquet").unlink()
    campaign.refused("exposures.ecsv", ONE, "no star list")


def test_an_empty_file_and_an_empty_list(campaign):
    campaign.lists(lambda t: t[:0], ONE).refused(f"{ONE}.parquet", "no detections")
    (campaign.path / "lists" / f"{ONE}.parquet").write_bytes(b"")
    campaign.refused(f"{ONE}.parquet", "is empty")


@pytest.mark.parametrize("column", ["x", "mag", "q"])
def test_a_list_with_nan(campaign, column):
    campaign.lists(setting(column, 5, np.nan), ONE)
    campaign.refused(f"{ONE}.parquet", "row 5", f"'{column}'")


def test_a_list_that_was_appended_to_itself(campaign):
    campaign.lists(lambda t: vstack([t, t]), "f606w-003").refused("f606w-003", "repeats row 1")


@pytest.mark.parametrize(
    ("name", "value"),
    [("exptime", 1e300), ("exptime", -1.0), ("pa_v3", 1e30), ("ra", 1e300), ("dec", 91.0)],
)
def test_numbers_of_a_log_that_no_exposure_has(campaign, name, value):
    campaign.log(setting(name, 2, value)).refused("exposures.ecsv, row 2", name)


@pytest.mark.parametrize("name", ["exptime", "ra", "dec", "pa_v3"])
def test_numbers_that_a_log_lacks_in_some_rows_are_said(campaign, name):
    text = campaign.log(setting(name, 2, np.nan)).check()
    assert f"{name} is missing of 1 of 8 exposures" in text.lower()


def test_one_exposure_in_two_lists(campaign):
    (campaign.path / "more").mkdir()
    shutil.copy(campaign.path / "lists" / f"{ONE}.parquet", campaign.path / "more")
    campaign.replaced('lists = "lists"', 'lists = ["lists", "more"]')
    campaign.refused("more", ONE, "one list for each exposure")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["sigma_u", "sigma_v"], ["no errors of the positions", "sigma_u"]),
        (["epoch"], ["proper motions but no epoch"]),
        (["mag"], ["no magnitudes", "campaign.pm_selection = 'all'"]),
    ],
    ids=["errors", "epoch", "magnitudes"],
)
def test_a_catalogue_that_lacks_something(campaign, names, words):
    campaign.catalog(lambda t: t.remove_columns(names)).refused("catalog.ecsv", *words)


def test_a_catalogue_with_errors_of_0(campaign):
    """Named by the star's code: stars with poor motions are left out before."""
    star = read_table(campaign.path / "catalog.parquet")["star"][6]
    campaign.catalog(setting("sigma_v", 7, 0.0)).refused(f"star {star},", "'sigma_v'", "error of 0")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"], "has no proper motions"),
        (["sigma_pm_u", "sigma_pm_v"], "no errors of the proper motions"),
    ],
    ids=["motions", "their errors"],
)
def test_a_catalogue_without_motions_is_said(campaign, names, words):
    campaign.catalog(lambda t: t.remove_columns(names))
    assert words in campaign.check()
    assert any(words in text for text in campaign.matched()["warnings"])


@pytest.mark.slow
@only_in_full("tests/data/test_campaign has stars that move")
def test_a_catalogue_without_motions_that_stars_outrun(campaign):
    """Over twelve years 0.01 px/yr are far more than centroids."""
    names = ["pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"]
    campaign.catalog(lambda t: t.remove_columns(names)).matched()
    result = cli("stage", "fit", campaign.path.parent / "run", "-q")
    assert result.code == 1
    words = ["catalog.ecsv: has no proper motions", "11.6 years", "scatter by", "pm_u and pm_v"]
    one_sentence(result.err, *words)


def test_refusals_of_a_campaign_do_not_advise_frames_that_it_cannot_set():
    """What the fit says to others is left out, and the rest stays."""
    x = np.linspace(1, 4000, 60)
    table = Matches(
        x=x,
        y=x[::-1] / 2,
        u=x,
        v=x,
        sigma_u=np.full(60, 0.1),
        sigma_v=np.full(60, 0.1),
        unit="pix",
        exposure=np.repeat([0, 1], [58, 2]),
        exposure_names=("a", "b"),
    )
    chip = Chip(1, "WFC2", (4096.0, 2048.0), (2048.0, 1024.0))
    model = DistortionModel(2, (chip,), unit="pix", frames="affine", exposures=("a", "b"))
    with pytest.raises(DegenerateError, match=r"exposure out, or set model\.frames") as before:
        fit_linear(table, model)
    with pytest.raises(DegenerateError) as after, frames_not_set():
        fit_linear(table, model)
    assert after.value.cause == before.value.cause
    assert after.value.do == "leave the exposure out"


def test_lists_that_the_log_does_not_have_are_named(campaign):
    """Seen by `check` and kept by the run; other filters of the log are no strangers."""
    campaign.log(setting("filter", 8, "F814W"))
    assert "WARNING" not in campaign.check()
    campaign.log(lambda t: t[[0, 1, 2, 4, 6, 7]])
    words = "2 star lists are of exposures that", "f606w-004, f606w-006", "not used"
    assert all(text in campaign.check() for text in words)
    found = campaign.matched()
    assert found["n_exposures"] == 5
    assert any(all(text in said for text in words) for said in found["warnings"])


# -- cuts -----------------------------------------------------------------------------------------


def brighter(table: Table) -> None:
    table["mag"] = table["mag"] - 20.0


def test_saturated_stars_only(campaign):
    campaign.lists(brighter)
    n = sum(len(read_table(p)) for p in (campaign.path / "lists").iterdir())
    campaign.refused(f"none of {n} detections", f"{n} too bright", "mag")


def test_a_quality_that_no_star_has(campaign):
    campaign.replaced("q_max = 0.1", "q_max = 1e-9").refused("poor fit", "too faint", "q_max")


@pytest.mark.parametrize("change", [brighter, lambda t: t[::40], scattered])
def test_an_exposure_that_does_not_match_is_left_out_by_name(campaign, change):
    n = len(read_table(campaign.path / "lists" / f"{ONE}.parquet"))
    found = campaign.lists(change, ONE).matched()
    assert list(found["left_out"]) == [ONE]
    assert found["n_exposures"] == 7
    if change is brighter:
        assert f"none of {n} detections ({n} too bright)" in found["left_out"][ONE]
    assert any("1 of 8 exposures was left out" in w and ONE in w for w in found["warnings"])
    rows = Table.read(campaign.path.parent / "run" / "matching.ecsv")
    assert ONE not in rows["exposure"]


@pytest.mark.slow
@only_in_full("tests/data/test_campaign has too many")
def test_more_than_a_fifth_of_the_exposures_is_too_many(campaign):
    campaign.lists(scattered, "f606w-002", "f606w-006")
    campaign.unmatched("f606w-002", "bring together", "1 more of 8")


def test_what_is_left_must_still_carry_the_drift(campaign):
    campaign.keep(1, 2, 3, 5, 6).lists(scattered, "f606w-006")
    campaign.unmatched("segment 2", "one exposure only", "2010.82")


# -- suspicious exposures -------------------------------------------------------------------------


def thinned(table: Table) -> Table:
    return table[np.random.default_rng(5).random(len(table)) < 0.4]


def test_nothing_is_suspicious_where_nothing_is_wrong(undamaged):
    campaign, run = undamaged
    assert "WARNING" not in campaign.check()
    found = summary_of(run)["matching"]
    assert found["warnings"] == [] and found["left_out"] == {}


def test_an_incomplete_exposure_is_named(campaign):
    (said,) = campaign.lists(thinned, ONE).matched()["warnings"]
    assert "completeness" in said and ONE in said


def test_an_exposure_of_another_scale_is_named(campaign):
    """VAFACTOR of another exposure, or a breath that no telescope takes."""
    (said,) = campaign.log(setting("vafactor", 4, 1.00019)).matched()["warnings"]
    assert "scale" in said
    # 0.999998 was true; the others scatter by 3e-5
    assert float(said.split(f"{ONE} (")[1].strip(")")) == pytest.approx(-1.9e-4, abs=3e-5)


def test_a_chip_that_lies_elsewhere_in_one_exposure_is_named(campaign):
    def change(table: Table) -> None:
        there = table["chip"] == 1
        table["x"][there] = 4097.0 - table["x"][there]

    warnings = campaign.lists(change, ONE).matched()["warnings"]
    assert any("chip 1 hardly match" in text and ONE in text for text in warnings)


# -- again ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["list", "log", "catalogue", "start", "another list"])
def test_resuming_after_the_input_changed(resumable, what):
    campaign, run = resumable
    path = campaign.path
    if what == "list":
        campaign.lists(lambda t: t[::2], ONE)
    elif what == "log":
        campaign.log(setting("epoch", 4, 2006.6))
    elif what == "catalogue":
        (path / "catalog.parquet").write_bytes((path / "catalog.parquet").read_bytes() + b"x")
    elif what == "start":
        (path / "start_idc.fits").write_bytes((path / "start_idc.fits").read_bytes()[:-1])
    else:
        shutil.copy(path / "lists" / f"{ONE}.parquet", path / "lists" / "f606w-009.parquet")
    words = ["changed since the run began", "--force"]
    config = run / "config.toml"
    refused(path.parent, "run", config, "-o", run, "--resume", words=words)
    refused(path.parent, "stage", "fit", run, words=words)


def test_resuming_after_a_list_was_removed(resumable):
    campaign, run = resumable
    (campaign.path / "lists" / f"{ONE}.parquet").unlink()
    words = [f"{ONE}.parquet", "changed since the run began"]
    refused(campaign.path.parent, "stage", "fit", run, words=words)


# -- to the end -----------------------------------------------------------------------------------


@pytest.mark.slow
@only_in_full("each damage is matched alone, and tests/app/campaign runs to its end")
def test_a_damaged_campaign_is_calibrated_and_says_so(campaign, monkeypatch):
    monkeypatch.setattr("bayesdist.app.stages.report", lambda run, pdf: [])
    # how linear terms went with time takes longer than all the rest, and is not asked here
    monkeypatch.setattr("bayesdist.kinds.campaign.kind.write_series_tables", lambda *_: None)
    campaign.lists(scattered, ONE).lists(lambda t: t[t["chip"] == 1], "f606w-006")
    # a few steps: what is said does not rest on the draws
    campaign.replaced("target_ess = 100", "max_steps = 20")
    campaign.replaced("grid = [33, 17]", "grid = [9, 5]\ndraws = 200")
    run = campaign.path.parent / "run"
    good("run", campaign.path / CONFIG, "-o", run, "-q")
    warnings = " ".join(summary_of(run)["warnings"])
    assert "1 of 8 exposures was left out" in warnings and ONE in warnings
    assert "No detection on chip 2" in warnings and "f606w-006" in warnings
    assert summary_of(run)["data"]["n_exposures"] == 7
    assert len(summary_of(run)["products"]) >= 2


# -- files that could not be written ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "acs_wfc"', f'name = "{"a" * 240}"', ["cannot be the name of a file", "release"]),
        ('name = "acs_wfc"', 'name = "acs"\ninstrument = "WFC3"', ["WFC3/WFC", "ACS/WFC"]),
        ("[products.release]", "[products.stdgdc]\n[products.release]", ["STDGDC", "chips 2, 1"]),
        ('name = "WFC2"', 'name = "W\\u0000"', ["chip[1].name", "U+0000"]),
    ],
)
def test_files_are_made_on_trial_before_stars_are_matched(campaign, old, new, words):
    campaign.replaced(old, new).refused(*words)


def test_names_in_other_scripts_are_no_fault(campaign):
    campaign.replaced('name = "WFC2"', 'name = "Détecteur 检测器"')
    campaign.replaced("[products.release]", "[products.tpv]\n[products.cpdis]\n[products.release]")
    good("check", campaign.path / CONFIG)


def test_the_distance_of_pointings_is_an_angle_on_the_sky():
    """Two pointings at a declination of 60 degrees, one of them across the zero of RA."""
    ra, dec = np.array([359.0, 1.0, np.nan]), np.array([60.0, 60.0, 60.0])
    assert distance_of_pointings(ra, dec) == pytest.approx(0.5, rel=1e-3)
    assert distance_of_pointings(ra[2:], dec[2:]) == 0.0
