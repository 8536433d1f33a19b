"""A campaign from star lists to a release: simulated, with the published linear terms."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import bayesdist as bd
from bayesdist.app.parts import read_tables
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import read_exposures, read_matches
from bayesdist.formats.idctab.table import read_idctab
from bayesdist.formats.lookup.tables import read_d2im
from bayesdist.infer import load_posterior
from bayesdist.infer.nodes import NodeGrid
from bayesdist.infer.solution.transforms import reference_gauge, segment, without_frames
from bayesdist.missions.hst.simulate import read_acs
from bayesdist.model import corrected
from bayesdist.report.drawing import MIN_FIGURES_SHARED
from bayesdist.report.run import to_be_drawn
from bayesdist.report.sections import REPORT
from tests.app.support import cli, good, one_sentence, snapshot, summary_of

# ACS ISR 2015-06, Tables 1 to 3: chip, segment (RDATE 2004.5, 2012.5), alpha, beta
PUBLISHED = {
    ("A_2", 1, 0): (0.98205648, -9.22e-6),
    ("A_2", 2, 0): (0.99468101, -9.16e-6),
    ("A_2", 1, 1): (0.98196909, -2.18e-5),
    ("A_2", 2, 1): (0.99459657, -2.26e-5),
    ("B_3", 1, 0): (0.97263238, 2.42e-6),
    ("B_3", 2, 0): (1.00622300, 3.30e-6),
    ("B_3", 1, 1): (0.97263233, -1.12e-6),
    ("B_3", 2, 1): (1.00621870, -8.04e-7),
    ("B_2", 1, 0): (0.080947069, 3.617e-5),
    ("B_2", 2, 0): (0.068598586, 3.532e-5),
    ("B_2", 1, 1): (0.081139194, 3.235e-5),
    ("B_2", 2, 1): (0.068779336, 3.070e-5),
}
GAP = 2079.58  # B_1 of WFC1, Section 4.4.1


def test_nearly_all_stars_are_matched_and_hardly_any_wrongly(run, folder):
    found = summary_of(run)["matching"]
    assert found["n_exposures"] == 16
    assert found["completeness"]["median"] > 0.95
    assert found["false_fraction"] < 0.01
    truth = read_acs(folder).truth
    pairs = read_matches(run / "pairs", unit="pix")
    assert len(pairs) == found["n_pairs"]
    for code, name in enumerate(pairs.exposure_names[:4]):
        some = pairs.select(pairs.exposure == code)
        chip = some.chip_number
        u, v = truth.to_catalog(name, some.x, some.y, chip).T
        vafactor = truth.log[name].vafactor
        apart = np.hypot(some.u * vafactor - u, some.v * vafactor - v)
        assert np.median(apart) < 0.05  # pixels: centroid and catalogue, not another star
        assert np.mean(apart > 1.0) < 0.01


def test_published_drifts_are_found(run):
    rows = {(r["term"], r["chip"], r["segment"]): r for r in summary_of(run)["lines"]}
    pulls = []
    for key, (alpha, beta) in PUBLISHED.items():
        row = rows[key]
        pulls.append((row["alpha"] - alpha) / row["sigma_alpha"])
        pulls.append((row["beta"] - beta) / row["sigma_beta"])
        assert row["sigma_alpha"] < 2e-5  # it says something: the drift of B_2 is 2e-4 in 5 years
    assert np.abs(pulls).max() < 5  # the catalogue's errors, common to all exposures, are not in
    assert np.median(np.abs(pulls)) < 1.5


def test_exposures_by_themselves_show_the_published_drifts(run):
    time = summary_of(run)["time_dependence"]
    rows = {(r["term"], r["segment"]): r for r in time["lines"]}
    pulls = []
    for (term, chip, part), (alpha, beta) in PUBLISHED.items():
        row = rows[f"WFC{chip}.{term}", part]
        pulls.append((row["alpha"] - alpha) / row["sigma_alpha"])
        pulls.append((row["beta"] - beta) / row["sigma_beta"])
    assert np.abs(pulls).max() < 5
    assert np.median(np.abs(pulls)) < 1.5
    assert {r["term"] for r in time["breaks"]} == set(time["scatter"])
    exposures, drift = (Table.read(run / name) for name in ("series.ecsv", "drift.ecsv"))
    assert len(exposures) == 16 and not time["outlying_exposures"]
    assert np.all(exposures["outlier_probability"] < 0.5)
    for term in time["scatter"]:
        first = rows[term, 0]
        before = drift[drift["epoch"] < time["breaks"][0]["break"]]
        line = first["alpha"] + first["beta"] * (before["epoch"] - first["epoch0"])
        assert np.all(np.abs(before[term] - line) < 0.2 * before[f"sigma_{term}"])
        assert np.all(before[f"sigma_new_{term}"] > before[f"sigma_{term}"])


def test_the_gauge_is_that_of_the_reference_chip(run):
    view = reference_gauge(without_frames(load_posterior(run)), 2)
    monomials = {
        (c, a): view.model.basis(c).to_monomials(view.mean[view.model.coefficient_slice(c, a)])
        for c in (1, 2)
        for a in (0, 1)
    }
    assert abs(monomials[2, 0][0]) < 1e-9 and abs(monomials[2, 1][0]) < 1e-9
    assert abs(monomials[2, 0][2]) < 1e-12
    assert monomials[1, 1][0] == pytest.approx(GAP, abs=0.05)


def test_monte_carlo_errors_are_those_of_the_parameters_that_are_kept(run):
    """Chips stand where the exposures have them on average, which scatters less than one of them.

    The error of a mean is the standard deviation of as many draws as count, by definition.
    """
    posterior = load_posterior(run)
    c, n = posterior.convergence, len(posterior.mean)
    moves = np.isfinite(c.ess_bulk[:n])
    expected = posterior.flat.std(axis=0) / np.sqrt(c.ess_bulk[:n])
    assert c.mcse_mean[:n][moves] == pytest.approx(expected[moves], rel=1e-6)
    assert sum(name.endswith("WFC1.shift_v") for name in c.names) == 16


def test_each_period_has_its_table_and_both_are_the_model(run):
    """Forward maps of the files against the posterior mean, along V2 and V3, at several dates."""
    products = {p["path"]: p for p in summary_of(run)["products"]}
    assert set(products) == {"acs_wfc_pre_idc.fits", "acs_wfc_post_idc.fits", "acs_wfc_d2i.fits"}
    view = reference_gauge(without_frames(load_posterior(run)), 2)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 4096, 200), rng.uniform(1, 2048, 200)
    for number, name, dates in (
        (0, "pre", (2003.0, 2005.0, 2007.0)),
        (1, "post", (2010.0, 2014.0)),
    ):
        tab = read_idctab(run / f"acs_wfc_{name}_idc.fits")
        one = segment(view, number)
        for chip in (1, 2):
            for date in dates:
                ours = one.model.predict(one.mean, x, y, chip=chip, epoch=np.full(200, date))
                theirs = np.column_stack(tab.evaluate(chip, x, y, filter="F606W", epoch=date))
                # one turn, one scale for both files, all dates and chips; zero points are in V2REF
                a, b = (
                    np.array(p) @ [1, 1j] for p in (ours - ours.mean(0), theirs - theirs.mean(0))
                )
                factor = np.vdot(a, b) / np.vdot(a, a)
                assert abs(factor) == pytest.approx(0.05, rel=1e-3)
                assert 1000 * np.abs(b - factor * a).max() < 0.1  # mas
    assert {t.chip for t in read_d2im(run / "acs_wfc_d2i.fits")} == {1, 2}


def test_the_error_of_the_tables_is_in_the_budget(run):
    rows = {row["name"]: row for row in summary_of(run)["budget"]}
    tables, total = rows["look-up tables"], rows["total"]
    assert tables["kind"] == "local" and 0 < tables["u"] < total["u"]
    others = [r for n, r in rows.items() if n != "total" and r["kind"] != "product"]
    assert total["u"] ** 2 < sum(r["u"] ** 2 for r in others) * 1.001


def test_every_cause_has_its_row_and_its_source(run):
    """Parts of another row are no larger than that, and a released set is the solution."""
    rows = {row["name"]: row for row in summary_of(run)["budget"]}
    kinds = ("measured in this run", "given by the user", "published")
    assert all(row["source"].startswith(kinds) for n, row in rows.items() if n != "total")
    # the error of the nodes has none of its own, nor then has the total
    known = {n for n, row in rows.items() if row["radial_error"] is not None}
    assert set(rows) - known == {"look-up tables", "total"}
    for name in (
        "coefficients",
        "time dependence",
        "reference catalogue (shared stars)",
        "proper motions (shared stars)",
        "look-up tables, between nodes",
    ):
        assert 0 < rows[name]["radial"] < rows["total"]["radial"], name
    assert rows["velocity aberration"]["radial"] < rows["exposure-to-exposure variation"]["radial"]
    assert rows["acs_wfc, forward"]["kind"] == "product"
    assert rows["acs_wfc, forward"]["radial"] < 1e-5  # tables in single precision
    text = good("budget", run, "--at", 100, 100, "--chip", 1, "--epoch", 2011.0).out
    assert all(name in text for name in rows)


def test_what_lies_between_nodes_is_what_the_truth_has_there(run, folder):
    """The published pattern at cells four times as wide, less the best table with a polynomial."""
    truth, found = read_acs(folder).truth, summary_of(run)["tables"]["between_nodes"]
    for one in found:
        chip = next(c for c in truth.model.chips if c.number == one["chip"])
        grid = NodeGrid(chip, 5, (256.0, 256.0))
        x, y = (a.ravel() for a in np.meshgrid(*(np.arange(4.5, n, 16.0) for n in chip.size)))
        px, py = corrected(truth.tables, x, y, chip=chip.number, filter="F606W")
        shift = np.column_stack([px - x, py - y])
        W = grid.without_polynomials(grid.interpolation(x, y).toarray().T).T
        A = np.hstack([W, grid.basis.evaluate(x, y)])
        left = shift - A @ np.linalg.lstsq(A, shift, rcond=1e-10)[0]
        true = (left**2).mean(axis=0)
        off = (np.array(one["square"]) - true) / one["square_error"]
        assert np.abs(off).max() < 4
        assert np.array(one["square_error"]).max() < 0.2 * true.max()  # it tells something


def test_published_errors_of_tables_hold_what_lies_between_nodes(run):
    own = {table.chip: table for table in read_tables(run / "tables.h5", do="").tables}
    rows = {row["chip"]: row for row in summary_of(run)["tables"]["between_nodes"]}
    for table in read_d2im(run / "acs_wfc_d2i.fits"):
        between = np.array([rows[table.chip][f"rms_{axis}"] for axis in "xy"])
        whole = np.hypot(own[table.chip].sigma, between[:, None, None])
        np.testing.assert_allclose(table.sigma, whole, rtol=1e-6)


def test_check_says_what_there_is(folder):
    text = good("check", folder / "campaign_f606w.toml").out
    assert "16 in F606W" in text and "aberration" in text and "WARNING" not in text


# -- wrong input ----------------------------------------------------------------------------------


def refused(folder, tmp_path, words, **changes):
    """A run with another configuration must end in one sentence and leave nothing."""
    text = (folder / "campaign_f606w.toml").read_text(encoding="utf-8")
    for name in ("catalog.parquet", "exposures.ecsv", "start_idc.fits", '"lists"'):
        plain = name.strip('"')
        text = text.replace(f'"{plain}"', f'"{folder / plain}"')
    for old, new in changes.items():
        key = old.replace("_", " ") if old not in text else old
        assert key in text
        text = text.replace(key, new)
    config = tmp_path / "config.toml"
    config.write_text(text, encoding="utf-8")
    result = cli("run", config, "-o", tmp_path / "run", "-q")
    assert result.code == 1, result.err
    one_sentence(result.err, *words)
    return result.err


def test_exposures_without_vafactor(folder, tmp_path):
    log = Table.read(folder / "exposures.ecsv")
    log.remove_column("vafactor")
    log.write(tmp_path / "log.ecsv")
    changes = {str(folder / "exposures.ecsv"): str(tmp_path / "log.ecsv")}
    refused(folder, tmp_path, ["vafactor"], **changes)
    assert not (tmp_path / "run").exists()


def test_a_filter_that_no_exposure_has(folder, tmp_path):
    refused(folder, tmp_path, ["F775W"], **{'filter = "F606W"': 'filter = "F775W"'})


def test_an_exposure_without_list(folder, tmp_path):
    log = read_exposures(folder / "exposures.ecsv")
    first = next(one for one in log if one.filter == "F606W")
    lists = tmp_path / "lists"
    lists.mkdir()
    for path in sorted((folder / "lists").iterdir()):
        if path.stem != first.name:
            (lists / path.name).symlink_to(path)
    refused(folder, tmp_path, [first.name], **{str(folder / "lists"): str(lists)})


def test_data_and_campaign_together_are_refused(folder, tmp_path):
    config = tmp_path / "config.toml"
    text = (folder / "campaign_f606w.toml").read_text(encoding="utf-8")
    config.write_text('[data]\nmatches = "stars.ecsv"\n' + text, encoding="utf-8")
    result = cli("run", config, "-o", tmp_path / "run")
    assert result.code == 1
    one_sentence(result.err, "campaign", "data")
    assert snapshot(tmp_path).keys() == {"config.toml"}


def test_the_calibration_of_a_run_has_its_tables(run, tmp_path):
    """Written as look-up tables, or into a polynomial on request, and never left out silently."""
    own = read_tables(run / "tables.h5", do="").tables
    found = bd.read_calibration(run)
    assert len(found.before) == len(own)
    x, y = np.random.default_rng(3).uniform(1, 2000, (2, 200))
    for chip in found.numbers:
        px, py = corrected(own, x, y, chip=chip, filter="F606W")
        epoch = None if found.model.time is None else 2004.0
        bare = replace(found, before=())
        np.testing.assert_allclose(
            found.forward(x, y, chip=chip, epoch=epoch),
            bare.forward(px, py, chip=chip, epoch=epoch), rtol=1e-12,
        )  # fmt: skip
    with pytest.raises(bd.InputError, match="has look-up tables, and TPV headers cannot hold them"):
        found.write("tpv", tmp_path, epoch=2004.0)
    [path] = found.write("cpdis", tmp_path / "acs.fits", epoch=2004.0)
    again = bd.read_calibration(path)
    for chip in found.numbers:
        far = found.forward(x, y, chip=chip, epoch=2004.0) - again.forward(x, y, chip=chip)
        pixel = np.sqrt(abs(np.linalg.det(found.chip(chip, 2004.0).linear)))
        # nodes of tables lie between those of the file, which states what that leaves
        with fits.open(path) as file:
            limit = max(float(hdu.header.get("BDWORST", 0.0)) for hdu in file)
        assert np.hypot(*far.T).max() < 1.01 * limit * pixel + 1e-9


def test_processes_that_draw_import_nothing_that_runs_are_made_with(run, tmp_path):
    """What they receive, and the figures' functions, are of the report and the rooms below it."""
    with Run.of(RunDirectory.open(run)) as opened:
        drawn = to_be_drawn(opened)
        sent = pickle.dumps((drawn, REPORT.items(drawn, "figure")))
    path = tmp_path / "sent.pickle"
    path.write_bytes(sent)
    code = "import pickle, sys; _, items = pickle.load(open(sys.argv[1], 'rb')); print(len(items))"
    code += "; print(*(name for name in sys.modules if name.startswith('bayesdist.app')))"
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, check=True
    )
    count, imported = done.stdout.split("\n")[:2]
    assert int(count) > MIN_FIGURES_SHARED and not imported
