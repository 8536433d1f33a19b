"""Two filters of a simulated campaign: one detector, one drift, one release."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table

import bayesdist.kinds.campaign.release
import bayesdist.missions.hst.release
from bayesdist.app.parts import StoredLookupTables, read_tables, write_tables
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import LocalErrors
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.data import read_exposures
from bayesdist.errors import InputError
from bayesdist.formats.idctab.table import read_idctab
from bayesdist.formats.lookup.file import read_lookup_file
from bayesdist.formats.lookup.tables import read_d2im
from bayesdist.infer import load_fit, load_posterior
from bayesdist.infer.nodes.fit import held_sigma
from bayesdist.infer.solution.transforms import linear_terms, lines, reference_gauge, without_frames
from bayesdist.kinds.campaign.reference import drift_priors, held_tables, with_drift_of
from bayesdist.kinds.campaign.release import _require_alike, compare_filters
from bayesdist.kinds.campaign.series import Series, fit_series
from bayesdist.missions.hst.simulate import acs_solution, making, read_acs, simulate_acs
from bayesdist.model import LookupTable, TimeDependence, corrected
from tests.app.support import carried_out, cli, good, one_sentence, replaced, snapshot
from tests.formats.acs_offline import Pointing, to_sky
from tests.formats.acs_offline import corrected as corrected_by_stwcs
from tests.formats.stwcs_offline import separation_mas
from tests.formats.support import laid_on, turned_by
from tests.infer.small_campaign import Truth
from tests.reduced import only_in_full

FILTERS = {"F606W": ("F606W", "CLEAR2L"), "F814W": ("CLEAR1L", "F814W")}
INPUTS = ("catalog.parquet", "exposures.ecsv", "start_idc.fits", "lists", "run_f606w")


def config_of(folder, filter: str, **changes: str) -> str:
    """The configuration of a filter as text, with files named in full."""
    text = (folder / f"campaign_{filter.lower()}.toml").read_text(encoding="utf-8")
    for name in INPUTS:
        text = text.replace(f'"{name}"', f'"{folder / name}"')
    return replaced(text, changes)


def calibrated(run, text: str, *stages: str):
    """Stages of a run; no report, so it is quick."""
    run.mkdir()
    (run / "config.toml").write_text(text, encoding="utf-8")
    return carried_out(run, *stages)


@pytest.fixture(scope="module")
def runs(folder, run):
    other = calibrated(folder / "run_f814w", config_of(folder, "F814W"), "match", "fit", "sample")
    return {"F606W": run, "F814W": other}


@pytest.fixture(scope="module")
def by_filter(runs):
    return {name: Run.of(RunDirectory.open(run)) for name, run in runs.items()}


@pytest.fixture(scope="module")
def release(runs, folder, full):
    """The files of both filters, and what was said.

    Reduced, trends with time have few sweeps; tests/kinds/campaign/series looks at them.
    """
    out = folder.parent / "release"
    with pytest.MonkeyPatch.context() as patch:
        if not full:
            comparing = import_module("bayesdist.kinds.campaign.series.compare")
            patch.setattr(comparing, "fit_series", partial(fit_series, max_sweeps=200))
        text = good("release", *runs.values(), "-o", out, "-q").out
    return SimpleNamespace(path=out, text=text)


# -- what one run takes from the other ------------------------------------------------------------


def local_errors(run):
    return [term for term in run.error_model.terms if isinstance(term, LocalErrors)]


def test_the_detectors_tables_are_held_and_the_filters_are_fitted(by_filter):
    reference, other = (by_filter[name] for name in FILTERS)
    assert [(t.chip, t.filter) for t in reference.tables.tables] == [(1, ""), (2, "")]
    assert [(t.chip, t.filter) for t in other.tables.tables] == [
        *((1, ""), (2, "")),
        *((1, "F814W"), (2, "F814W")),
    ]
    for a, b in zip(reference.tables.tables, other.tables.tables, strict=False):
        np.testing.assert_array_equal(a.values, b.values)
    # pixels are those that both tables have corrected
    raw, x = other.stars, other.placed.x
    numbers = raw.chip_number
    both, _ = corrected(other.tables.tables, raw.x, raw.y, chip=numbers, filter="F814W")
    assert len(x) == len(both) and np.array_equal(x, both)


def test_the_error_of_the_held_tables_stays_in_the_budget(by_filter):
    other = by_filter["F814W"]
    [term] = [one for one in local_errors(other) if one.name == "look-up tables"]
    grid = other.config.assess.grid  # between its positions errors are interpolated
    for chip in other.fit.model.chips:
        x, y = np.meshgrid(*(np.linspace(1, n, m) for n, m in zip(chip.size, grid, strict=True)))
        held = held_sigma(other.tables.tables, x.ravel(), y.ravel(), chip=chip.number)
        domain = EvaluationDomain.of_chips(
            other.posterior.model, grid, chips=(chip.number,), epoch=other.epoch
        )
        sigma = term.sigma(domain)
        # a pixel is 1 px of (u, v) but for some per cent of scale
        assert (sigma > 0.9 * held).all() and (held > 0).all()


@pytest.mark.slow
@only_in_full("tables of a run are held")
def test_a_d2imfile_serves_as_well(by_filter, release, runs):
    block = by_filter["F814W"].config.tables
    chips = by_filter["F814W"].config.chips()
    of_run = held_tables(block, chips, runs["F814W"])
    file = block.model_copy(update={"detector": str(release.path / "acs_wfc_d2i.fits")})
    for a, b in zip(of_run, held_tables(file, chips, runs["F814W"]), strict=True):
        np.testing.assert_array_equal(a.values.astype(np.float32), b.values.astype(np.float32))


def test_drift_of_few_exposures_is_that_of_the_reference(by_filter):
    """Eight exposures know the drift as well as 28 do, and it is the true one."""
    model, theta = acs_solution("F814W")
    true = [lines(Truth(model, theta), s) for s in (0, 1)]
    pulls = []
    for s in (0, 1):
        found = lines(reference_gauge(by_filter["F814W"].posterior, 2), s)
        first = lines(reference_gauge(by_filter["F606W"].posterior, 2), s)
        for chip in ("WFC1", "WFC2"):
            for term in ("A_2", "B_2", "B_3"):
                label = f"{chip}.{term}.beta"
                k, m = found.labels.index(label), true[s].labels.index(label)
                pulls.append((found.values[k] - true[s].values[m]) / found.sigma[k])
                # independent priors are wider than the reference's posterior, data make up for it
                assert found.sigma[k] < 2 * first.sigma[k]
    assert np.abs(pulls).max() < 3.5


@pytest.mark.slow
@only_in_full("few exposures take the drift of others")
def test_a_filter_without_exposures_before_a_break(folder, runs, tmp_path):
    """All of them after SM4: before it the drift is the reference's, with its error."""
    log = Table.read(folder / "exposures.ecsv")
    log = log[(log["filter"] == "F606W") | (log["epoch"] > 2009.4)]
    log.write(tmp_path / "late.ecsv")
    text = config_of(
        folder, "F814W", **{str(folder / "exposures.ecsv"): str(tmp_path / "late.ecsv")}
    )
    fit = load_fit(calibrated(tmp_path / "late", text, "match", "fit") / "fit.nc")
    known = drift_priors(load_posterior(runs["F606W"]), fit.model)
    names = [name for name in known if name.endswith(("_1_0.rate", "_0_1.rate"))]
    assert len(names) == 6
    for name in names:
        k = fit.model.names.index(name)
        assert fit.mean[k] == pytest.approx(known[name][0], abs=0.1 * known[name][1])
        assert np.sqrt(fit.cov[k, k]) == pytest.approx(known[name][1], rel=0.05)


# -- the release ----------------------------------------------------------------------------------


def test_one_set_of_files(release):
    assert sorted(p.name for p in release.path.iterdir()) == [
        *("acs_wfc_d2i.fits", "acs_wfc_f814w_npl.fits", "acs_wfc_post_idc.fits"),
        *("acs_wfc_pre_idc.fits", "filters.ecsv"),
        *("filters_A_2.png", "filters_B_2.png", "filters_B_3.png", "release.json"),
    ]
    for period in ("pre", "post"):
        tab = read_idctab(release.path / f"acs_wfc_{period}_idc.fits")
        rows = {(int(r["DETCHIP"]), r["FILTER1"], r["FILTER2"]) for r in tab.rows}
        assert rows == {(chip, *names) for chip in (1, 2) for names in FILTERS.values()}
        assert "the drift is that of F606W" in " ".join(map(str, tab.header["HISTORY"]))
    assert {t.chip for t in read_d2im(release.path / "acs_wfc_d2i.fits")} == {1, 2}
    assert read_lookup_file(release.path / "acs_wfc_f814w_npl.fits").filters == ("CLEAR1L", "F814W")


def test_offsets_between_filters_are_the_true_ones(release):
    """Figures 25 and 26: what F814W adds to A_2 and B_2, the drift taken out."""
    table = Table.read(release.path / "filters.ecsv")
    true = {}
    for name in FILTERS:
        model, theta = acs_solution(name)
        found = linear_terms(Truth(model, theta), epoch=2004.5)
        true[name] = dict(zip(found.labels, found.values, strict=True))
    rows = [row for row in table if row["filter"] == "F814W"]
    assert len(rows) == 7  # A_3 of the reference chip is fixed by the gauge
    for row in rows:
        label = f"WFC{row['chip']}.{row['term']}"
        offset = true["F814W"][label] - true["F606W"][label]
        assert abs(row["offset"] - offset) < 3 * row["sigma_offset"]
        assert row["at_edge"] == pytest.approx(
            row["offset"] * (2048 if "2" in row["term"] else 1024)
        )
    scale = next(r for r in rows if (r["chip"], r["term"]) == (2, "A_2"))
    assert scale["offset"] < -4 * scale["sigma_offset"]  # 0.1 px: it is seen
    assert "one drift serves all filters" in table.meta["drift"]["verdict"]
    assert "one drift serves all filters" in release.text


@pytest.fixture(scope="module")
def plane(by_filter, folder):
    """Both solutions as they are released, turned into the plane of the IDCTAB."""
    first, other = (by_filter[name].solution for name in FILTERS)
    formal = by_filter["F814W"].fit
    released = {"F606W": first, "F814W": with_drift_of(other, first, formal=formal)}
    views = {name: reference_gauge(without_frames(one), 2) for name, one in released.items()}
    orientation = laid_on(
        views["F606W"],
        read_idctab(folder / "start_idc.fits"),
        epoch=2004.5,
        scale_arcsec=0.05,
    )
    return {
        name: turned_by(view, orientation).solution for name, view in views.items()
    }, orientation


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize(("period", "date"), [("pre", "2005-03-01"), ("post", "2013-01-01")])
def test_stwcs_sees_our_model_and_the_true_sky(
    filter, period, date, release, by_filter, folder, plane, tmp_path
):
    """All files together: 0.1 mas from the model, and as far from the truth as is stated."""
    pytest.importorskip("stwcs")
    pointing = Pointing(date, (5.66, -72.07), 57.3, 1.00002, FILTERS[filter])
    npol = release.path / f"acs_wfc_{filter.lower()}_npl.fits"
    wcs = corrected_by_stwcs(
        *(tmp_path, "one", pointing),
        idctab=release.path / f"acs_wfc_{period}_idc.fits",
        d2im=release.path / "acs_wfc_d2i.fits",
        npol=npol if npol.exists() else None,
    )
    turned, orientation = plane[0][filter], plane[1]
    model, epoch = turned.model, pointing.epoch
    middle = {"epoch": epoch, "chip": 2}
    [centre] = model.predict(turned.mean, 2048.0, 1024.0, **middle)
    v2v3 = orientation.v2v3[0] + centre[0], orientation.v2v3[1] - centre[1]
    truth = read_acs(folder).truth
    [true_centre] = truth.model.predict(truth.theta[filter], 2048.0, 1024.0, **middle)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 4096, 600), rng.uniform(1, 2048, 600)
    [term] = [one for one in local_errors(by_filter[filter]) if one.name == "look-up tables"]
    for chip in (1, 2):
        theirs = wcs[chip].all_pix2world(np.stack([x, y], axis=1), 1)
        px, py = corrected(by_filter[filter].tables.tables, x, y, chip=chip, filter=filter)
        ours = model.predict(turned.mean, px, py, epoch=epoch, chip=chip)
        assert separation_mas(to_sky(ours - centre, pointing, v2v3), theirs).max() < 0.1

        # tables have no shift of their own at the zero point: the truth hangs on its polynomial
        tx, ty = corrected(truth.tables, x, y, chip=chip, filter=filter)
        real = truth.model.predict(truth.theta[filter], tx, ty, epoch=epoch, chip=chip)
        away = separation_mas(to_sky(0.05 * (real - true_centre), pointing, v2v3), theirs)
        D = model.jacobian(turned.mean, x, y, epoch=epoch, chip=chip)
        D = D - model.jacobian(turned.mean, 2048.0, 1024.0, **middle)
        variance = 1e6 * np.einsum("nap,pq,naq->n", D, turned.cov, D, optimize=True)
        tables = 50.0**2 * (term.tables[chip].values ** 2).sum(axis=0).mean()
        unresolved = 50.0**2 * (beyond_nodes(truth.tables, chip, filter) ** 2).sum(axis=1).mean()
        stated = np.sqrt(variance.mean() + tables + unresolved)
        assert 0.4 * stated < np.sqrt((away**2).mean()) < 1.4 * stated


def beyond_nodes(tables, chip: int, filter: str, step: float = 256.0) -> np.ndarray:
    """Shifts (N, 2) of the true tables that nodes 256 pixels apart cannot describe."""
    x, y = (g.ravel() for g in np.meshgrid(np.arange(16.5, 4096, 32), np.arange(16.5, 2048, 32)))
    shift = sum(t.evaluate(x, y) for t in tables if t.chip == chip and t.filter in ("", filter))
    size = (int(2048 / step), int(4096 / step))
    first = (step + 1) / 2
    blank = LookupTable(chip, np.zeros((2, *size)), "", (first, first), (step, step))
    index, weight = blank.weights(x, y)
    W = np.zeros((len(x), size[0] * size[1]))
    np.add.at(W, (np.arange(len(x))[:, None], index), weight)
    return shift - W @ np.linalg.lstsq(W, shift, rcond=None)[0]


# -- whether one drift serves all filters ---------------------------------------------------------


def exposures_of(campaign, filter: str, sigma: float = 2e-6) -> Series:
    """True linear terms of WFC2 in each exposure, measured with a small error."""
    truth = campaign.truth
    names = [one.name for one in campaign.log if one.filter == filter]
    terms = np.array([truth.linear_terms(name, 2)[[1, 4, 5]] for name in names])
    rng = np.random.default_rng(len(names))
    return Series.of(
        [campaign.log[name].epoch for name in names],
        terms + sigma * rng.standard_normal(terms.shape),
        sigma,
        coefficients=("WFC2.A_2", "WFC2.B_2", "WFC2.B_3"),
        names=names,
    )


@pytest.mark.slow
@only_in_full("tests/kinds/campaign/series/test_filters finds it")
@pytest.mark.parametrize("own", [0.0, 6e-6])
def test_a_drift_of_one_filter_only_is_found(own, monkeypatch):
    """B_2 of F814W drifts by a fifth more than the report's 3.5e-5 a year, or does not."""

    def altered(filter: str = "F606W"):
        model, theta = acs_solution(filter)
        if filter == "F814W":
            # one line through both segments: their reference dates are eight years apart
            for name, years in (("rate", 1.0), ("step_2", 8.0), ("rate_2", 1.0)):
                theta[model.names.index(f"WFC2.tdd.v_1_0.{name}")] += own * years * 2048
        return model, theta

    monkeypatch.setattr(making, "acs_solution", altered)
    campaign = simulate_acs(
        seed=4, n_exposures=30, n_other=20, n_stars=100, filters=("F606W", "F814W")
    )
    series = {name: exposures_of(campaign, name) for name in FILTERS}
    found = compare_filters(series, campaign.truth.model.time)
    value, sigma = found.rates["F814W", "WFC2.B_2"]
    assert abs(value - own) < 3 * sigma
    if own:
        assert not found.alike and found.p_value < 1e-4
        assert "WFC2.B_2 in F814W" in found.sentence
    else:
        assert found.alike and "one drift serves all filters" in found.sentence


# -- wrong input ----------------------------------------------------------------------------------


def refused(tmp_path, *arguments, words=()):
    """A release that is refused in one sentence, and of which nothing is left."""
    before = snapshot(tmp_path)
    result = cli("release", *arguments, "-o", tmp_path / "out", "-q")
    assert result.code == 1, result.err
    one_sentence(result.err, *words)
    assert snapshot(tmp_path) == before


def test_one_filter_twice(runs, tmp_path):
    refused(tmp_path, runs["F606W"], runs["F606W"], words=["F606W", "one run for each filter"])


def test_the_first_run_must_say_what_is_released(runs, tmp_path):
    refused(tmp_path, runs["F814W"], runs["F606W"], words=["[products.release]", "first"])


def test_a_run_that_is_not_finished(runs, folder, tmp_path):
    calibrated(tmp_path / "half", config_of(folder, "F814W"), "match")
    refused(tmp_path, runs["F606W"], tmp_path / "half", words=["fit", "half"])


def test_other_tables_of_the_detector(runs, tmp_path, monkeypatch):
    # as if the run had been made with them
    monkeypatch.setattr(RunDirectory, "require", lambda run, what, needs: None)
    monkeypatch.setattr(RunDirectory, "refuse_damaged", lambda run, stage: None)
    other = shutil.copytree(runs["F814W"], tmp_path / "other")
    stored = read_tables(other / "tables.h5", do="")
    moved = [replace(t, values=t.values + 1e-4 * (not t.filter)) for t in stored.tables]
    write_tables(other / "tables.h5", replace(stored, tables=tuple(moved)))
    refused(tmp_path, runs["F606W"], other, words=["detector's tables", str(runs["F606W"])])


@pytest.mark.slow
@only_in_full("tests/app/test_run has one of matched stars")
def test_a_run_that_has_not_converged(runs, tmp_path, monkeypatch):
    def doubtful(path):
        posterior = load_posterior(path)
        poor = replace(posterior.convergence, converged=False, reasons=("R-hat 1.3",))
        return replace(posterior, convergence=poor)

    monkeypatch.setattr("bayesdist.app.run.load_posterior", doubtful)
    refused(tmp_path, runs["F606W"], words=["R-hat 1.3", "--allow-unconverged"])
    good("release", runs["F606W"], "-o", tmp_path / "out", "--allow-unconverged", "-q")
    for path in sorted((tmp_path / "out").glob("*.fits")):
        header = read_lookup_file(path).header if "d2i" in path.name else read_idctab(path).header
        assert "NOT CONVERGED" in " ".join(map(str, header["HISTORY"]))


def test_a_folder_in_use_is_left_alone(runs, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine", encoding="utf-8")
    refused(tmp_path, runs["F606W"], words=["holds other files", "never overwritten"])


def test_nothing_is_left_of_a_release_that_fails_late(runs, tmp_path, monkeypatch):
    def fails(*args, **options):
        raise InputError("the disk is full", where="NPOLFILE", do="make room")

    def has_none(*args, **options):
        raise InputError("not of interest here")

    # it takes a while
    monkeypatch.setattr(bayesdist.kinds.campaign.release, "compare_filters", has_none)
    monkeypatch.setattr(bayesdist.missions.hst.release, "write_npol", fails)
    refused(tmp_path, *runs.values(), words=["the disk is full"])


CHIPS = acs_solution()[0].chips
TIME = TimeDependence((("u", 1, 0),), (2004.5, 2012.5), (2009.4,))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time": replace(TIME, epoch0=(2004.5, 2012.0))}, "RDATE"),
        ({"order": 4}, "orders"),
        ({"chips": CHIPS[::-1]}, "chips"),
        ({"scale": 49.7}, "pixel scales"),
    ],
)
def test_runs_of_another_structure(change, words):
    def run_of(name, order=5, time=TIME, chips=CHIPS, scale=50.0):
        model = SimpleNamespace(order=order, time=time, chips=chips, unit="pix")
        return SimpleNamespace(
            posterior=SimpleNamespace(model=model),
            config=SimpleNamespace(
                detector=SimpleNamespace(scale_mas=scale), products=SimpleNamespace(release=1)
            ),
            tables=StoredLookupTables(),
            directory=SimpleNamespace(path=name),
        )

    _require_alike({"F606W": run_of("a"), "F814W": run_of("b")})
    with pytest.raises(InputError, match=words):
        _require_alike({"F606W": run_of("a"), "F814W": run_of("b", **change)})


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("detector = ", 'detector = "nowhere" # ', ["nowhere", "tables.detector"]),
        ("rates = ", 'rates = "nowhere" # ', ["nowhere", "model.tdd.rates"]),
        ("2012.5", "2012.0", ["reference dates", "run_f606w"]),
        ('method = "field"', 'method = "feild"', ["method"]),
    ],
)
def test_a_reference_that_cannot_be_used(old, new, words, folder, runs, tmp_path):
    text = config_of(folder, "F814W")
    (tmp_path / "config.toml").write_text(text.replace(old, new), encoding="utf-8")
    result = cli("run", tmp_path / "config.toml", "-o", tmp_path / "run", "-q")
    assert result.code == 1
    one_sentence(result.err, *words)
    assert not (tmp_path / "run").exists()


def test_every_filter_has_a_configuration_that_can_be_checked(folder, runs):
    assert len(read_exposures(folder / "exposures.ecsv").filters) == 2
    for name in FILTERS:
        assert name in good("check", folder / f"campaign_{name.lower()}.toml").out
