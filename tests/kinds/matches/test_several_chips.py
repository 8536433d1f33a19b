"""A run of two chips, three exposures with frames, and drift: every file, and what it says."""

from __future__ import annotations

import json
import logging
from itertools import product

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import area_map, uncertainty_map
from bayesdist.assess.terms.correlated import (
    DEVIATIONS,
    FIELDS_IN_FIT,
    STRUCTURE,
    STRUCTURE_IN_FIT,
)
from bayesdist.diagnose.residuals.binned import binned_residuals
from bayesdist.diagnose.residuals.misfit import misfit_of
from bayesdist.formats.idctab.table import read_idctab
from bayesdist.infer import load_fit, load_posterior, residuals
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches
from tests.app.support import (
    EXACT,
    as_table,
    cli,
    config_text,
    good,
    refused,
    snapshot,
    summary_of,
    write_config,
    write_job,
)

pytestmark = pytest.mark.usefixtures("figures_made")

SIZE = (4096, 2048)
MAS = 50.0
CHIPS = (
    Chip(2, "WFC2", (4096.0, 2048.0), (2048.0, 1024.0)),
    Chip(1, "WFC1", (4096.0, 2048.0), (2048.0, 1024.0)),
)
# as in a file: the reference chip need not stand first
BLOCKS = [
    {"number": 1, "name": "WFC1", "size": SIZE, "reference_pixel": (2048, 1024)},
    {"number": 2, "name": "WFC2", "size": SIZE, "reference_pixel": (2048, 1024), "reference": True},
]
TERMS = (("u", 1, 0), ("v", 1, 0), ("v", 0, 1))
TDD = {"epoch0": 2004.5, "terms": [list(t) for t in TERMS]}
EPOCHS = (2003.0, 2005.0, 2008.0)
GAP = 2079.58
GRID, DRAWS, WHEN = (9, 5), 400, 2006.0
OFFSET = (0.003, 0.004)
REQUIREMENTS = [
    {"name": "all", "statistic": "p95", "limit": 0.05},
    {"name": "v of all", "statistic": "v_max", "limit": 0.05},
    {"name": "lower", "statistic": "p95", "limit": 0.05, "chip": 2},
    {"name": "upper", "statistic": "p95", "limit": 0.05, "chip": 1},
]
SETTINGS = {
    "detector": {"name": "ACS", "scale_mas": MAS},
    "chip": BLOCKS,
    "model": {"order": 3, "frames": "shift", "tdd": TDD},
    "sampler": {"target_ess": 100, "target_rhat": 1.05},
    "assess": {"grid": GRID, "draws": DRAWS, "epoch": WHEN},
    "requirement": REQUIREMENTS,
    "budget": [
        {"name": "catalogue", "kind": "systematic", "sigma_u": OFFSET[0], "sigma_v": OFFSET[1]},
        EXACT | {"name": "proper motions"},
    ],
    "products": {"sip": {"inverse_order": 5}, "idctab": {"instrument": "ACS", "detector": "WFC"}},
}


def model_of(n_exposures: int) -> DistortionModel:
    time = TimeDependence(TERMS, (2004.5,))
    names = tuple(f"e{k}" for k in range(n_exposures))
    return DistortionModel(3, CHIPS, time=time, frames="shift", exposures=names)


def truth_of(model: DistortionModel) -> np.ndarray:
    """An ACS-like distortion in pixels; WFC1 lies above WFC2, a little turned."""
    theta = np.zeros(model.n_params)
    for chip in model.chips:
        basis, above = model.basis(chip.number), GAP if chip.number == 1 else 0.0
        turned = 0.01 if chip.number == 1 else 0.0
        u = {(1, 0): 0.99, (0, 1): -turned, (2, 0): 2e-6, (1, 1): 3e-6, (0, 3): 1e-10}
        v = {(0, 0): above, (1, 0): 0.03, (0, 1): 0.97, (2, 0): -3e-6, (0, 2): 1e-6, (3, 0): 2e-10}
        for axis, terms in enumerate((u, v)):
            monomial = [terms.get(t, 0.0) for t in basis.terms]
            theta[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(monomial)
        theta[model.tdd_slice(chip.number)] = 0.02, -0.03, 0.01 * chip.number
    for code in range(1, len(model.exposures)):
        theta[model.frame_slice(code)] = 40.0 * code, -25.0
    return theta


def stars(n: int = 3000, epochs=EPOCHS) -> Table:
    model = model_of(len(epochs))
    matches, _ = simulate_matches(
        model,
        truth_of(model),
        n,
        rng=np.random.default_rng(5),
        sigma=0.03,
        fraction=0.03,
        epochs=epochs,
    )
    table = as_table(matches)
    table["chip"] = matches.chip_number
    return table


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chips")
    config = write_job(folder / "input", stars(), stars="stars.parquet", **SETTINGS)
    good("run", config, "-o", folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def posterior(run):
    return load_posterior(run)


@pytest.fixture(scope="module")
def errors(posterior) -> dict[int, np.ndarray]:
    """Error (draws, points, 2) on each chip, from `predict`: no polynomials of errors, no blocks.

    The random numbers are those of the stage: draws, an exposure for each, one offset of the whole
    field for each.  Frames are shifts, so that all exposures have the same axes.
    """
    rng = np.random.default_rng([1, 2])  # seed, number of the stage
    theta = posterior.draws(DRAWS, rng)
    exposures = rng.integers(1, len(EPOCHS), size=DRAWS)
    offsets = rng.normal(size=(DRAWS, 2)) * OFFSET
    out = {}
    for chip in CHIPS:
        X, Y = np.meshgrid(np.linspace(1, SIZE[0], GRID[0]), np.linspace(1, SIZE[1], GRID[1]))
        x, y = X.ravel(), Y.ravel()
        error = np.empty((DRAWS, x.size, 2))
        for e in (1, 2):
            place = {"epoch": WHEN, "exposure": e, "chip": chip.number}
            here = exposures == e
            error[here] = posterior.model.predict(theta[here], x, y, **place)
            error[here] -= posterior.model.predict(posterior.mean, x, y, **place)
        out[chip.number] = error
    return out | {0: offsets}


def test_the_reference_chip_defines_the_frame(run, posterior):
    assert [c.name for c in posterior.model.chips] == ["WFC2", "WFC1"]
    k = posterior.model.names.index("WFC1.v_0_0")
    at = posterior.model.predict(posterior.mean, [2048.0], [1024.0], epoch=2004.5, chip=1)
    below = posterior.model.predict(posterior.mean, [2048.0], [1024.0], epoch=2004.5, chip=2)
    assert at[0, 1] - below[0, 1] == pytest.approx(GAP, abs=8 * posterior.sigma[k])
    assert summary_of(run)["sampler"]["converged"]


# -- maps -----------------------------------------------------------------------------------------


def test_the_maps_of_each_chip(run, posterior):
    with fits.open(run / "maps.fits", checksum=True) as hdus:
        names = [h.name for h in hdus[1:]]
        assert len(names) == len(set(names)) == 2 * 8
        for number in (1, 2):
            place = {"grid": GRID, "epoch": WHEN, "chip": number}
            for prefix, solution in (("LSQ", load_fit(run / "fit.nc")), ("MIX", posterior)):
                found = uncertainty_map(solution, **place)
                for name in ("SIGMA_U", "SIGMA_V"):
                    hdu = hdus[f"{prefix}_{name}_{number}"]
                    ratio = hdu.data / getattr(found, name.lower())
                    # what the model may leave out is in the posterior's
                    low, high = (1.0, 1.0) if prefix == "LSQ" else (0.85, 1.8)
                    assert low <= np.median(ratio) <= high
                    assert hdu.header["DETCHIP"] == number
                    assert WCS(hdu.header).all_pix2world(9, 5, 1) == pytest.approx(list(SIZE))
            area = hdus[f"AREA_{number}"]
            np.testing.assert_allclose(area.data, area_map(posterior, **place).area, rtol=1e-12)
            assert area.header["DETCHIP"] == number


def test_the_summary_names_the_worst_chip(run, posterior):
    found = summary_of(run)["map"]
    maps = {n: uncertainty_map(posterior, grid=GRID, epoch=WHEN, chip=n) for n in (2, 1)}
    assert [c["chip"] for c in found["chips"]] == [2, 1]
    for c in found["chips"]:
        with fits.open(run / "maps.fits") as hdus:
            u, v = (hdus[f"MIX_SIGMA_{a}_{c['chip']}"].data for a in "UV")
        radius = np.hypot(u, v)
        assert c["radius_max"] == radius.max()
        iy, ix = np.unravel_index(np.argmax(radius), radius.shape)
        x, y = maps[c["chip"]].x, maps[c["chip"]].y
        assert c["position_of_max"] == [x[ix], y[iy]]
    worst = max(found["chips"], key=lambda c: c["radius_max"])
    for key in ("chip", "radius_max", "position_of_max"):
        assert found[key] == worst[key]
    for key in ("sigma_u_max", "sigma_v_max"):
        assert found[key] == max(c[key] for c in found["chips"])


# -- budget and requirements ----------------------------------------------------------------------


def test_the_budget_is_that_of_the_draws(run, errors):
    """Sigma of the model at each point by hand; one set of draws for both chips."""
    table = Table.read(run / "budget.ecsv")
    terms = ["coefficients", "time dependence", "exposure frame", STRUCTURE_IN_FIT]
    terms += [n for n in (DEVIATIONS, FIELDS_IN_FIT) if n in table["name"]] + [
        STRUCTURE,
        "catalogue",
        "proper motions",
    ]
    names = [*terms, "sip_2.hdr, sip_1.hdr, forward", "sip_2.hdr, sip_1.hdr, inverse"]
    names += [n for n in table["name"][: len(table) // 3] if n.startswith("acs_")]
    names.append("total")
    assert list(table["name"]) == 3 * names
    chips = ["all", "2", "1"]
    assert list(table["chip"]) == sorted(chips * len(names), key=chips.index)
    square = {n: (errors[n] ** 2).mean(axis=(0, 1)) + np.square(OFFSET) for n in (1, 2)}
    square["all"] = (square[1] + square[2]) / 2  # as many points on each
    for row in table[table["name"] == "total"]:
        expected = square[row["chip"] if row["chip"] == "all" else int(row["chip"])]
        # the posterior's draws and the catalogue by hand; what may be left out comes on top
        ratio = np.array([row["u"], row["v"]]) / np.sqrt(expected)
        assert (ratio > 0.85).all() and (ratio < 1.8).all()
        assert row["radial"] == pytest.approx(np.hypot(row["u"], row["v"]), rel=1e-7)
    whole = summary_of(run)["budget"]
    assert [r["name"] for r in whole] == names and "chip" not in whole[0]
    assert whole[-1]["radial"] == table["radial"][len(names) - 1]


def test_requirements_are_judged_on_all_chips_by_the_same_draws(run, errors):
    offsets = errors[0][:, None, :]
    fields = {n: errors[n] + offsets for n in (1, 2)}
    fields[None] = np.concatenate([fields[1], fields[2]], axis=1)
    for m, r in zip(summary_of(run)["margins"], REQUIREMENTS, strict=True):
        assert m["chip"] == r.get("chip")
        error = fields[m["chip"]]
        values = (
            np.abs(error[..., 1]).max(axis=1)
            if r["statistic"] == "v_max"
            else np.percentile(np.hypot(error[..., 0], error[..., 1]), 95, axis=1)
        )
        # without what may be left out, which makes errors larger
        assert 0.9 < m["value"] / np.median(values) < 1.8
        assert m["probability_met"] <= np.mean(values <= r["limit"]) + 0.1
    table = Table.read(run / "margins.ecsv")
    assert list(table["chip"]) == ["all", "all", "2", "1"]


def test_validate_keeps_the_chip_and_the_report_takes_it_up(run, tmp_path):
    before = (run / "summary.json").read_bytes(), (run / "margins.ecsv").read_bytes()
    path = tmp_path / "req.toml"
    none = dict.fromkeys(("data", "detector", "model", "sampler", "assess"))
    write_config(path, **none, requirement=[REQUIREMENTS[3] | {"limit": 5.0}])
    try:
        good("requirements", run, "--requirements", path)
        (margin,) = summary_of(run)["margins"]
        assert (margin["chip"], margin["verdict"]) == (1, "met")
        assert list(Table.read(run / "margins.ecsv")["chip"]) == ["1"]
        write_config(path, **none, requirement=[REQUIREMENTS[3] | {"chip": 3}])
        refused(
            tmp_path, "requirements", run, "--requirements", path, words=["chip 3", "upper", "2, 1"]
        )
    finally:
        (run / "summary.json").write_bytes(before[0])
        (run / "margins.ecsv").write_bytes(before[1])


# -- residuals ------------------------------------------------------------------------------------


def test_structure_is_looked_for_on_each_chip(run):
    """By arrays of the true stars, chip by chip; the smaller probability counts twice."""
    results = Run.of(RunDirectory.open(run))
    fit, table, found = results.fit, results.matches, results.diagnostics
    residual, used = residuals(results.posterior, table), found.sample.probably_true
    p = {}
    for chip in CHIPS:
        here = used & (table.chip_number == chip.number)
        bins = found.partitions[chip.number]
        arrays = (table.x[here], table.y[here], *residual[here].T)
        sums = {n: found.sums.binned[chip.number, bins[n]] for n in bins if n != "shown"}
        for name, one in sums.items():
            expected = binned_residuals(*arrays, bins=bins[name], size=chip.size)
            np.testing.assert_array_equal(one.residuals().count, expected.count)
            np.testing.assert_allclose(one.residuals().mean_u, expected.mean_u, atol=1e-9)
        p[chip.number] = misfit_of(sums, order=fit.model.order, unit="pix").p_value
    found = summary_of(run)["misfit"]
    assert {c["chip"]: c["p_value"] for c in found["chips"]} == p
    worst = min(p, key=p.get)
    assert found["chip"] == worst and found["p_value"] == min(1.0, 2 * p[worst])
    assert not found["significant"]  # the model is right


def test_structure_on_the_second_chip_is_named(tmp_path):
    table = stars()
    high = (table["chip"] == 1) & (np.abs(table["x"] - 3000) < 300)
    table["u"][high] += 0.06
    config = write_job(tmp_path, table, **SETTINGS)
    out = good("check", config).out
    n = int((table["chip"] == 2).sum())
    assert f"chips        WFC2 {n} stars, WFC1 {3000 - n} stars" in out
    assert "WARNING" in out and "of chip WFC1" in out


# -- products -------------------------------------------------------------------------------------


def test_each_chip_has_a_sip_header(run, posterior):
    for chip in CHIPS:
        header = fits.Header.fromtextfile(run / f"sip_{chip.number}.hdr")
        wcs = WCS(header)
        x, y = (np.linspace(1, s, 7) for s in chip.size)
        place = {"epoch": WHEN, "chip": chip.number}
        uv = posterior.model.predict(posterior.mean, x, y, **place)
        at = posterior.model.predict(posterior.mean, *np.array([chip.reference_pixel]).T, **place)
        focal = np.column_stack(wcs.sip_pix2foc(x, y, 1))
        offset = 3600e3 * focal @ wcs.wcs.cd.T / MAS  # pixels
        np.testing.assert_allclose(offset, uv - at, atol=1e-6)


def test_the_idctab_holds_both_chips_and_their_drift(run, posterior):
    tab = read_idctab(run / "acs_wfc_idc.fits")
    assert set(tab.rows["DETCHIP"]) == {1, 2}
    assert tab.header["TDD_DATE"] == 2004.5
    names = {"TDD_CXB": ("u_1_0", 2048), "TDD_CTB": ("v_1_0", 2048), "TDD_CYB": ("v_0_1", 1024)}
    for (keyword, (term, half)), chip in product(names.items(), CHIPS):
        rate = posterior.mean[posterior.model.names.index(f"{chip.name}.tdd.{term}.rate")]
        found = tab.header[f"{keyword}{chip.number}"]
        assert abs(found) == pytest.approx(abs(rate) * MAS / 1000 / half, rel=1e-9)
    listed = [p["path"] for p in summary_of(run)["products"]]
    assert listed == [
        *("sip_2_parameters.fits", "sip_2.hdr", "sip_1_parameters.fits", "sip_1.hdr"),
        "acs_wfc_idc.fits",
    ]


def test_an_idctab_of_two_segments_is_refused_before_sampling(tmp_path):
    model = SETTINGS["model"] | {"tdd": TDD | {"breaks": [2006.5]}}
    table = stars(900, (2003.0, 2005.0, 2008.0, 2009.0))
    config = write_job(tmp_path, table, **(SETTINGS | {"model": model}))
    words = ["one reference date", "2 segments", "a file for each"]
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)


# -- the report -----------------------------------------------------------------------------------


def test_the_report_shows_both_chips(run):
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "WFC2 and WFC1, 4096 × 2048 pixels" in page
    for words in ("WFC1, posterior", "WFC2, least squares", "p95 on WFC1", "gap and rotation"):
        assert words in page, words
    assert json.loads((run / "run.json").read_text())["config"]["chip"][1]["reference"] is True
    figures = {p.name for p in (run / "figures").iterdir()}
    assert figures == set(summary_of(run)["figures"]) and len(figures) >= 20


# -- chips that only one side knows ---------------------------------------------------------------


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("a third chip in the data", ["chip 3", "no [[chip]] block"]),
        ("a third chip in the file", ["no star lies on chip 3 (WFC3)", "drop the block"]),
        ("no chip column", ["no star lies on chip 2 (WFC2)", "map column 'chip'"]),
        ("one block, another chip", ["chip 5", "no [[chip]] block"]),
        ("no blocks", ["chips 1, 2", "[[chip]]"]),
    ],
)
def test_chips_that_do_not_agree(tmp_path, command, change, words):
    table, settings = stars(600), dict(SETTINGS)
    if change == "a third chip in the data":
        table["chip"][:50] = 3
    elif change == "a third chip in the file":
        settings["chip"] = [*BLOCKS, BLOCKS[0] | {"number": 3, "name": "WFC3"}]
    elif change == "no chip column":
        table.remove_column("chip")
    elif change == "one block, another chip":
        table["chip"] = 5
        settings["chip"] = BLOCKS[:1]
    else:
        settings |= {"chip": None, "detector": {"name": "ACS", "size": SIZE}}
    config = write_job(tmp_path / "in", table, **settings)
    target = ("-o", tmp_path / "run") if command == "run" else ()
    refused(tmp_path, command, config, *target, words=words)


def test_a_requirement_for_a_chip_that_is_not_there(tmp_path):
    requirement = [REQUIREMENTS[2] | {"chip": 7}]
    config = write_job(tmp_path, stars(600), **(SETTINGS | {"requirement": requirement}))
    before = snapshot(tmp_path)
    result = cli("run", config, "-o", tmp_path / "run")
    assert result.code == 1 and "'lower': there is no chip 7; name one of 2, 1" in result.err
    assert snapshot(tmp_path) == before
    assert "Traceback" not in result.err and logging.getLogger("bayesdist").propagate is False


@pytest.mark.parametrize(
    ("change", "word"),
    [({"number": 2}, "number 2"), ({"name": "WFC2"}, "name 'WFC2'"), ({"reference": True}, "one")],
)
def test_blocks_must_differ(tmp_path, change, word):
    blocks = [BLOCKS[0] | change, BLOCKS[1]]
    path = tmp_path / "c.toml"
    path.write_text(config_text(**(SETTINGS | {"chip": blocks})), encoding="utf-8")
    refused(tmp_path, "check", path, words=["[[chip]] blocks", word])


def test_a_table_of_positions_on_several_chips_keeps_its_order(run, tmp_path):
    places = [(2, 10.0, 20.0), (1, 4000.0, 2000.0), (2, 3000.0, 5.0), (1, 1.0, 1.0)]
    table = tmp_path / "places.csv"
    table.write_text("chip,x,y\n" + "".join(f"{c},{x},{y}\n" for c, x, y in places))
    said = json.loads(good("budget", run, "--at-table", table, "--json").out)["positions"]
    assert [(row["chip"], row["x"], row["y"]) for row in said] == places
    for row, (chip, x, y) in zip(said, places, strict=True):
        [alone] = json.loads(good("budget", run, "--at", x, y, "--chip", chip, "--json").out)[
            "positions"
        ]
        assert [t["u"] for t in row["terms"]] == pytest.approx([t["u"] for t in alone["terms"]])
