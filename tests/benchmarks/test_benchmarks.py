"""The benchmark program works, and what it compares is one posterior.  No figure is judged here."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from tests.benchmarks import __main__ as program
from tests.benchmarks import scamp
from tests.benchmarks.agreement import compare
from tests.benchmarks.dithered import POINTING, dithered_sky, relative
from tests.benchmarks.effective import autocorrelation, smallest_ess
from tests.benchmarks.ldac import write_catalogues, write_references
from tests.benchmarks.markdown import to_markdown
from tests.benchmarks.plain import PlainDensity
from tests.benchmarks.problem import simulated
from tests.benchmarks.roofline import MIXTURE_OPS, Roofline
from tests.benchmarks.scaling import exponent
from tests.reduced import only_in_full

AGREE = 5.0  # Monte-Carlo errors, the largest of nine parameters


def _points(problem, n: int = 6) -> np.ndarray:
    """Parameter vectors around the truth, some far out."""
    rng = np.random.default_rng(2)
    width = np.concatenate([problem.fit.sigma, [0.2, 0.2, 0.2]])
    reach = np.geomspace(0.3, 30, n)[:, None] * np.r_[np.ones(problem.dim - 3), 0.2, 0.2, 0.2]
    return problem.truth + reach * width * rng.standard_normal((n, problem.dim))


@pytest.mark.parametrize("order", [1, 5])
def test_numpy_density_is_the_library_s_but_for_a_constant(order):
    problem = simulated(700, order)
    points = _points(problem)
    density = problem.log_density(points)
    apart = np.array([PlainDensity(problem)(p) for p in points]) - density
    # thousands below the mode the kernel rounds in the tenth digit (in long doubles the plain form
    # is right to 1e-10 there)
    room = np.maximum(1e-7, 1e-10 * (density.max() - density))
    assert (np.abs(apart - apart[0]) < room).all(), apart


@pytest.mark.slow
@only_in_full("tests/infer/test_nuts has this density")
def test_jax_density_is_the_library_s_but_for_a_constant():
    pytest.importorskip("numpyro", reason="NumPyro (extra 'test') is not installed")
    import jax

    from tests.benchmarks.nuts import log_density

    problem = simulated(700, 3)
    points = _points(problem)
    function, data = log_density(problem)
    fast = jax.jit(function)
    theirs = np.array([float(fast(p, *data)) for p in points])
    apart = theirs - problem.log_density(points)
    np.testing.assert_allclose(apart, apart[0], rtol=0, atol=1e-7)


def _autoregressive(coefficient: float, rows: int, walkers: int) -> np.ndarray:
    """Chains (rows, walkers, 2) whose autocorrelation time is (1 + c) / (1 - c)."""
    rng = np.random.default_rng(4)
    out = np.empty((rows, walkers, 2))
    out[0] = rng.standard_normal((walkers, 2))
    for k in range(1, rows):
        noise = np.sqrt(1 - coefficient**2) * rng.standard_normal((walkers, 2))
        out[k] = coefficient * out[k - 1] + noise
    return out


def test_autocorrelation_time_of_a_known_process():
    chain = _autoregressive(0.8, 4000, 20)
    tau = autocorrelation(chain, 1, 1)
    assert tau.bulk == pytest.approx(9.0, rel=0.1)
    assert tau.tail < tau.bulk  # an indicator forgets sooner
    assert tau.long_enough
    # every fifth row of it: a row stands for five steps
    assert autocorrelation(chain[::5], 5, 1).bulk == pytest.approx(9.0, rel=0.2)
    bulk, _ = smallest_ess(np.swapaxes(chain, 0, 1))
    assert bulk == pytest.approx(4000 * 20 / 9, rel=0.15)


def test_agreement_is_in_monte_carlo_errors():
    rng = np.random.default_rng(6)
    a, b = rng.standard_normal((2, 10_000, 3))
    same = compare(a, 1e4, b, 1e4)
    assert same["shift_errors"] < 4 and same["sd_errors"] < 4
    other = compare(a + 0.1, 1e4, 1.1 * b, 1e4)
    assert other["shift"] == pytest.approx(0.1 / 1.1, abs=0.03)
    assert other["shift_errors"] > 5 and other["sd_errors"] > 5
    assert other["sd_ratio"][1] == pytest.approx(1 / 1.1, rel=0.03)


def test_exponent_of_a_power_law():
    rows = [{"n_stars": n, "seconds": 3e-6 * n**1.03} for n in (1e5, 1e6, 1e7)]
    found = exponent(rows)
    assert found["value"] == pytest.approx(1.03) and found["error"] < 1e-9
    assert exponent(rows[:2]) is None


def test_roofline_counts_the_terms_of_two_polynomials():
    roof = Roofline(fma_per_ns=10.0, bytes_per_ns=20.0)
    floor = roof.floor_ns(order=5, batch=1, threads=1)
    assert floor["polynomials"] == pytest.approx(42 / 10)
    assert floor["memory"] == pytest.approx(48 / 20)
    arithmetic = roof.floor_ns(5, 16, 2)["arithmetic"]
    assert arithmetic == pytest.approx((42 + MIXTURE_OPS) / 10 / 2)


@pytest.fixture(scope="module")
def undistorted():
    return dithered_sky(replace(scamp.QUICK, distortion=0.0, stars=60), 3, 0.0)


def test_catalogues_hold_the_commanded_pointings(undistorted, tmp_path):
    """Without distortion the headers alone bring detections to their stars, but for pointing."""
    sky = undistorted
    d = sky.field.detections
    for e, name in enumerate(write_catalogues(sky, tmp_path)):
        with fits.open(tmp_path / name) as hdus:
            (text,) = hdus["LDAC_IMHEAD"].data.field(0)
            objects = hdus["LDAC_OBJECTS"].data
            x, y, error = (np.array(objects[k]) for k in ("X_IMAGE", "Y_IMAGE", "ERRA_IMAGE"))
            assert (objects["FLUX_AUTO"] / objects["FLUXERR_AUTO"] > 10).all()
        raw = (tmp_path / name).read_bytes()
        assert raw.count(b"END" + 77 * b" ") == 4  # of three headers and the text: blanks
        np.testing.assert_array_equal(error, d.sigma[d.exposure == e])
        solution = WCS(fits.Header.fromstring("".join(card.ljust(80) for card in text)))
        found = sky.plane.wcs_world2pix(solution.all_pix2world(np.stack([x, y], axis=1), 1), 1)
        off = found - sky.field.sky[d.star[d.exposure == e]]
        assert np.abs(off.mean(axis=0)).max() < 4 * POINTING
        turned = 3 * np.radians(scamp.QUICK.roll_error) * 1500 + 0.1  # corners, errors of centroids
        assert np.abs(off - off.mean(axis=0)).max() < turned
    write_references(sky, tmp_path / "references.cat")
    with fits.open(tmp_path / "references.cat") as hdus:
        stars = hdus["LDAC_OBJECTS"].data
        world = np.stack([stars["X_WORLD"], stars["Y_WORLD"]], axis=1)
    found = sky.plane.all_world2pix(world, 1)
    nearest = np.linalg.norm(found[:, None] - sky.field.sky, axis=2).min(axis=1)
    assert nearest.max() < 0.06


def test_linear_maps_of_the_sky_are_no_relative_errors(undistorted):
    rng = np.random.default_rng(5)
    places = undistorted.truth[2]
    moved = places @ (np.eye(2) + 0.01 * rng.standard_normal((2, 2))) + rng.standard_normal(2)
    assert np.abs(relative(moved - places, places)).max() < 1e-9
    bent = (places - places.mean(axis=0)) ** 2 / 1e5
    assert np.abs(relative(bent, places)).max() > 0.1


def test_goes_on_where_scamp_is_missing(monkeypatch):
    monkeypatch.setattr(scamp, "available", lambda: False)
    monkeypatch.setattr(scamp, "own_solution", lambda *_: None)
    monkeypatch.setattr(scamp, "SOLUTIONS", {"SCAMP": scamp.SOLUTIONS["SCAMP, one instrument"]})
    part = scamp.run(scamp.QUICK)
    assert part["rows"] == [] and "scamp" in part["absent"]


@pytest.mark.parametrize("part", [["--quick"], ["--only", "kernel"]])
def test_a_part_of_the_benchmark_is_no_page(part, tmp_path):
    with pytest.raises(SystemExit):
        program.main([*part, "--output", str(tmp_path), "--docs", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def quick(tmp_path_factory, full):
    if not full:
        pytest.skip("all parts take a minute of processor time: set BAYESDIST_FULL=1")
    pytest.importorskip("numpyro", reason="NumPyro (extra 'test') is not installed")
    folder = tmp_path_factory.mktemp("bench")
    assert program.main(["--quick", "--output", str(folder)]) == 0
    return folder


@pytest.mark.slow
def test_json_and_markdown_are_complete(quick):
    bench = json.loads((quick / "bench.json").read_text(encoding="utf-8"))
    assert set(bench["parts"]) == set(program.PARTS)
    machine = bench["machine"]
    assert machine["cpu"] and machine["cores"] >= 1 and machine["libraries"]["numba"]
    text = (quick / "bench.md").read_text(encoding="utf-8")
    assert text == to_markdown(bench)
    for name in (
        "stock emcee",
        "DEMove",
        "NUTS, whitened",
        "bayesdist",
        "lstsq",
        "GB/s",
        "p95 of every draw",
    ):
        assert name in text
    samplers = bench["parts"]["samplers"]["rows"]
    assert len(samplers) == 5
    for row in samplers:
        for key in ("rate", "per_pass", "ratio", "ratio_total"):
            assert row[key] > 0 and math.isfinite(row[key]), (row["sampler"], key)
    kernel = bench["parts"]["kernel"]["rows"]
    assert {row["order"] for row in kernel} == {1, 3} and all(row["ns_numpy"] > 0 for row in kernel)
    (linear,) = bench["parts"]["linear"]["rows"]
    assert linear["coefficients_differ"] < 1e-6 and linear["astropy_s"] > 0
    assert linear["astropy_close"]  # the same pairs on the sky: a matched degree finds the fit
    scaling = bench["parts"]["scaling"]
    assert [row["n_stars"] for row in scaling["rows"]] == [400, 1200]
    assert all(
        row["converged"] and row["peak_mb"] > row["peak_before_mb"] - 1 for row in scaling["rows"]
    )
    selfcal = bench["parts"]["scamp"]
    for row in selfcal["rows"]:
        assert 0 < row["rms"] < row["largest"] < 1 and row["seconds"] > 0
    assert len(selfcal["rows"]) == (2 if selfcal["absent"] else 5)
    (dithers,) = bench["parts"]["dithers"]["rows"]
    assert dithers["converged"] and dithers["n_stars"] > dithers["stars"] > 0
    here, there = bench["parts"]["processes"]["rows"]
    assert (here["workers"], there["workers"]) == (0, 2) and here["passes"] == there["passes"]
    for stage in ("group", "solve", "sample"):
        assert here[stage]["workers_s"] == 0 < there[stage]["workers_s"]
    commands = {row["what"]: row["cpu_s"] for row in bench["parts"]["commands"]["rows"]}
    assert commands["run, first of all"] > commands["run, warm"] > commands["--help"] > 0
    budget = bench["parts"]["budget"]["rows"]
    assert len(budget) == 4 and all(row["seconds"] > 0 for row in budget)
    assert (quick / "figures" / "scaling.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_all_samplers_sample_one_posterior(quick):
    bench = json.loads((quick / "bench.json").read_text(encoding="utf-8"))
    others = [r for r in bench["parts"]["samplers"]["rows"] if r["sampler"] != "bayesdist"]
    for row in others:
        assert row["agreement"]["shift_errors"] < AGREE, row["sampler"]
        assert row["agreement"]["sd_errors"] < AGREE, row["sampler"]
    stock = next(r for r in others if r["sampler"] == "stock emcee")
    assert stock["density_difference"] < 1e-6


@pytest.mark.slow
@only_in_full("the table of benchmarks is tested")
def test_only_the_parts_that_are_asked_for(tmp_path):
    program.main(["--quick", "--only", "linear", "--output", str(tmp_path)])
    bench = json.loads((tmp_path / "bench.json").read_text(encoding="utf-8"))
    assert list(bench["parts"]) == ["linear"]
    (linear,) = bench["parts"]["linear"]["rows"]
    assert linear["coefficients_differ"] < 1e-6
    assert (tmp_path / "bench.md").read_text(encoding="utf-8") == to_markdown(bench)
    with pytest.raises(SystemExit):
        program.main(["--only", "nothing"])
    with pytest.raises(SystemExit):  # fields are those of SCAMP's part alone
        program.main(["--only", "linear", "--fields", "10", "--output", str(tmp_path)])
