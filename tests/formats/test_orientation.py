"""Solutions laid on V2 and V3, and what of them a file can hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.orientation import oriented
from bayesdist.errors import InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.drift import storable
from bayesdist.formats.idctab.table import IdcTab, read_idctab
from bayesdist.infer.solution.transforms import lines, reference_gauge, segment
from bayesdist.missions.hst.simulate import acs_solution
from bayesdist.model import DistortionModel, TimeDependence

from .support import (
    F606W,
    StandIn,
    laid_on,
    random_pixels,
    some_covariance,
    turned_by,
    wfc_solution,
)

ACS = {"instrument": "ACS", "detector": "WFC"}
ROLL, SCALE, SHIFT, V2V3 = np.deg2rad(-2.2336), 0.05, np.array([0.3, -0.2]), (256.602, 302.252)


@pytest.fixture(scope="module")
def truth() -> StandIn:
    """The report's distortion, in its gauge, in pixels, with a full covariance."""
    model, theta = acs_solution()
    return StandIn(model, theta, some_covariance(theta.size, 1e-3, np.random.default_rng(3)))


def complex_coefficients(solution, chip: int) -> np.ndarray:
    u, v = (solution.mean[solution.model.coefficient_slice(chip, axis)] for axis in (0, 1))
    return u + 1j * v


def table_of(solution, turn: complex, shift: complex = 0.0, extra=None) -> IdcTab:
    """An IDCTAB of chip 2, turned by arithmetic of its own; `extra` is added to the terms."""
    model = DistortionModel(solution.model.order, (solution.model.chips[1],), "arcsec")
    w = turn * complex_coefficients(solution, 2)
    w[0] += shift
    if extra is not None:
        w = w + extra
    theta = np.concatenate([w.real, w.imag])
    made = StandIn(model, theta, 1e-12 * np.eye(theta.size))
    return idctab_from_solution(made, **ACS, v2ref=V2V3[0], v3ref=V2V3[1])


# -- the similarity -------------------------------------------------------------------------------


@pytest.mark.parametrize("fitted", [True, False])
def test_a_known_similarity_is_found(truth, fitted: bool) -> None:
    """A table that is the solution but for a similarity gives that similarity back."""
    reference = table_of(truth, SCALE * np.exp(1j * ROLL), complex(*SHIFT))
    names = {} if fitted else {"scale_arcsec": SCALE}
    found = laid_on(truth, reference, epoch=2004.5, reference_drift=False, **names)
    assert found.angle == pytest.approx(ROLL, abs=1e-12)
    assert found.scale == pytest.approx(SCALE, rel=1e-12)
    assert found.agreement is not None and found.agreement.rms < 1e-7
    # the table has its constant in V2REF and V3REF, and counts from there
    row = reference.rows[0]
    assert found.v2v3 == (float(row["V2REF"]), float(row["V3REF"]))
    assert_allclose(found.shift, 0.0, atol=1e-11)
    assert row["V2REF"] == pytest.approx(V2V3[0] + SHIFT[0], abs=1e-11)
    assert row["V3REF"] == pytest.approx(V2V3[1] - SHIFT[1], abs=1e-11)  # parity


def test_the_gauge_of_the_solution_does_not_matter(truth) -> None:
    """Turn and shift (u, v) at will: laid on the same table, every pixel lies at the same place."""
    rng = np.random.default_rng(4)
    rough = rng.normal(scale=1e-2, size=(21, 2)) @ [1, 1j]
    reference = table_of(truth, SCALE * np.exp(1j * ROLL), extra=rough)
    w = {c: 1.3 * np.exp(0.4j) * complex_coefficients(truth, c) for c in (1, 2)}
    theta = truth.mean.copy()
    for c in (1, 2):
        w[c][0] += 200 - 300j
        for axis, part in enumerate((w[c].real, w[c].imag)):
            theta[truth.model.coefficient_slice(c, axis)] = part
    model = replace(truth.model, time=None)
    n = model.n_params
    places = []
    for values in (truth.mean[:n], theta[:n]):
        solution = StandIn(model, values, 1e-6 * np.eye(n))
        turned = turned_by(solution, laid_on(solution, reference))
        x, y = random_pixels((4096, 2048), 50)
        places.append(turned.model.predict(turned.solution.mean, x, y, chip=1))
    assert_allclose(places[0], places[1], atol=1e-9, rtol=0)


def test_the_fit_is_least_squares_over_the_chip(truth) -> None:
    """No similarity near by leaves a smaller mean square; the rms is what the pixels say."""
    rng = np.random.default_rng(5)
    rough = rng.normal(scale=5e-3, size=(21, 2)) @ [1, 1j]
    reference = table_of(truth, SCALE * np.exp(1j * ROLL), extra=rough)
    found = laid_on(truth, reference, epoch=2004.5, reference_drift=False)
    x, y = (
        g.ravel() for g in np.meshgrid(np.arange(0.5, 4097, 16) + 8, np.arange(0.5, 2048, 16) + 8)
    )
    x, y = x[x < 4096.5], y[x < 4096.5]
    uv = truth.model.predict(truth.mean, x, y, epoch=2004.5, chip=2) @ [1, 1j]
    Xc, Yc = reference.evaluate(2, x, y)

    def rms(step) -> float:
        a = complex(*(found.shift + step[:2]))
        b = found.scale * np.exp(step[2] + 1j * (found.angle + step[3]))
        return float(np.sqrt(np.mean(np.abs(Xc + 1j * Yc - a - b * uv) ** 2)))

    best = rms(np.zeros(4))
    assert found.agreement.rms == pytest.approx(1e3 * best, rel=1e-3)
    assert found.agreement.worst >= found.agreement.rms
    for k, size in enumerate((1e-4, 1e-4, 1e-5, 1e-5)):
        for sign in (-1, 1):
            assert rms(sign * size * np.eye(4)[k]) > best * (1 + 1e-7)


def test_derivatives_are_those_of_the_fit(truth) -> None:
    """Against small steps of every parameter, with the scale fitted and held."""
    rough = np.random.default_rng(6).normal(scale=5e-3, size=(21, 2)) @ [1, 1j]
    reference = table_of(truth, SCALE * np.exp(1j * ROLL), extra=rough)
    ways = (
        lambda s: laid_on(s, reference, epoch=2006.0, reference_drift=False),
        lambda s: laid_on(s, reference, epoch=2006.0, reference_drift=False, scale_arcsec=SCALE),
    )

    def four(orientation) -> np.ndarray:
        return np.array([*orientation.shift, np.log(orientation.scale), orientation.angle])

    rng = np.random.default_rng(7)
    for way in ways:
        at = way(truth)
        for _ in range(5):
            step = rng.normal(size=truth.mean.size)
            up, down = (
                four(way(replace(truth, mean=truth.mean + sign * 1e-3 * step))) for sign in (1, -1)
            )
            expected = at.derivative @ step
            # rounding of a shift of 1e-8 arcsec out of 100
            assert_allclose((up - down) / 2e-3, expected, rtol=1e-5, atol=1e-9)


def test_error_of_the_reference_is_what_its_terms_scatter_by(truth) -> None:
    """Maps whose terms are all wrong by the same amount: the stated covariance covers."""
    n, sigma = 80, 4e-3
    rng = np.random.default_rng(8)
    i, j = np.array(truth.model.basis(2).terms).T
    norm = np.sqrt((2 * i + 1) * (2 * j + 1))  # to functions of mean square 1 over the chip
    reference = table_of(truth, SCALE * np.exp(1j * ROLL))
    pulls = []
    for _ in range(n):
        theta = truth.mean.copy()
        for axis in (0, 1):
            theta[truth.model.coefficient_slice(2, axis)] += sigma * norm * rng.normal(size=21)
        wrong = StandIn(truth.model, theta, 0 * truth.cov)
        found = laid_on(wrong, reference, epoch=2004.5, reference_drift=False)
        error = np.array([*found.shift, np.log(found.scale / SCALE), found.angle - ROLL])
        pulls.append(np.linalg.solve(np.linalg.cholesky(found.cov), error))
    squares = np.square(pulls)
    # each variance is estimated from the 38 components that are seen (mean of F: 38 / 36)
    assert squares.mean() == pytest.approx(38 / 36, abs=3.3 * np.sqrt(2 / squares.size))


# -- the turned solution --------------------------------------------------------------------------


def test_positions_are_turned_at_every_epoch(truth) -> None:
    reference = table_of(truth, SCALE * np.exp(1j * ROLL))
    o = laid_on(truth, reference, epoch=2004.5, reference_drift=False)
    turned = turned_by(truth, o)
    assert turned.model.unit == "arcsec"
    x, y = random_pixels((4096, 2048), 50)
    for chip in (1, 2):
        for epoch in (2003.0, 2009.3, 2010.0, 2014.0):
            uv = truth.model.predict(truth.mean, x, y, epoch=epoch, chip=chip) @ [1, 1j]
            w = complex(*o.shift) + o.scale * np.exp(1j * o.angle) * uv
            got = turned.model.predict(turned.solution.mean, x, y, epoch=epoch, chip=chip)
            assert_allclose(got, np.stack([w.real, w.imag], axis=1), atol=1e-10, rtol=0)


def test_covariance_is_that_of_the_draws(truth) -> None:
    """Of a few directions: draws go through the exact map, the covariance through its Jacobian."""
    rough = np.random.default_rng(9).normal(scale=5e-3, size=(21, 2)) @ [1, 1j]
    reference = table_of(truth, SCALE * np.exp(1j * ROLL), extra=rough)
    o = laid_on(truth, reference, epoch=2004.5, reference_drift=False)
    other = replace(truth, cov=0.5 * truth.cov)
    rng = np.random.default_rng(10)
    n = 4000
    for solution in (truth, other):
        calibration = turned_by(solution, o)
        turned = calibration.solution
        draws = turned.draws(n, rng)
        weights = rng.normal(size=(draws.shape[1], 8)) / np.sqrt(np.diag(turned.cov))[:, None]
        stated = np.sqrt(np.diag(weights.T @ turned.cov @ weights))
        found = (draws - turned.mean) @ weights
        assert_allclose(found.std(axis=0) / stated, 1.0, atol=5 / np.sqrt(2 * n))
        assert np.abs(found.mean(axis=0) / stated).max() < 5 / np.sqrt(n)
        # with the orientation, by draws too
        assert calibration.with_plane.shape == (turned.mean.size, 4)


def test_total_derivative_by_steps(truth) -> None:
    """A step of the solution moves the orientation with it: laid on the table again, less moves."""
    reference = table_of(truth, SCALE * np.exp(1j * ROLL))
    names = {"epoch": 2004.5, "reference_drift": False}
    rng = np.random.default_rng(11)
    steps = rng.normal(size=(6, truth.mean.size)) * 1e-3
    moved = []
    for step in steps:
        solution = replace(truth, mean=truth.mean + step)
        moved.append(turned_by(solution, laid_on(solution, reference, **names)).solution.mean)
    base = turned_by(truth, laid_on(truth, reference, **names))
    few = replace(truth, cov=steps.T @ steps)
    stated = turned_by(few, laid_on(few, reference, **names)).solution.cov
    difference = np.array(moved) - base.solution.mean
    scale = np.sqrt(np.diag(stated))
    scale = np.maximum(scale, 1e-2 * scale.max())  # the mean of chip 2 cannot move at all
    norm = np.outer(scale, scale)
    assert_allclose(difference.T @ difference / norm, stated / norm, atol=1e-4)


def test_a_rotation_of_the_solution_is_no_error_of_the_table(truth) -> None:
    """What the fit does not know of its roll and scale, the reference supplies."""
    rotation = np.zeros(truth.mean.size)
    for chip in (1, 2):
        w = 1j * complex_coefficients(truth, chip)
        for axis, part in enumerate((w.real, w.imag)):
            rotation[truth.model.coefficient_slice(chip, axis)] = part
    loose = replace(truth, cov=1e-8 * np.outer(rotation, rotation))  # 1e-4 rad
    reference = table_of(truth, SCALE * np.exp(1j * ROLL))
    o = laid_on(loose, reference, epoch=2004.5, reference_drift=False)
    assert o.sigma["angle"] == pytest.approx(1e-4, rel=1e-3)
    turned = turned_by(loose, o)
    jac = turned.model.jacobian(turned.solution.mean, 4000.0, 2000.0, epoch=2004.5, chip=1)[0]
    variance = np.diag(jac @ turned.solution.cov @ jac.T)
    assert np.abs(variance).max() < 1e-6**2  # and 1e-4 rad over 150 arcsec were 0.015


# -- real tables and published numbers ------------------------------------------------------------


def test_the_delivered_table_is_the_reports_solution_turned(real) -> None:
    """ACS ISR 2015-06, Tables 1-3 and section 4.4.1, from its successor, turned back to the gauge.

    The coefficients agree to some 1e-5, as two reductions do; the rates within their sigmas.  The
    rotation is the 2.2345 deg that stwcs has for Anderson's frame, to 1e-3 deg.
    """
    view = reference_gauge(wfc_solution(real), 2)
    assert view.gauge is not None
    assert np.rad2deg(view.gauge.rotation) == pytest.approx(2.234529, abs=2e-3)
    found = lines(view)
    got = dict(zip(found.labels, (found.values / 0.05).tolist(), strict=True))
    published = {
        "WFC1": {"A_2": (0.98205648, -9.22e-6), "B_2": (0.080947069, 3.617e-5)},
        "WFC2": {"A_2": (0.99468101, -9.16e-6), "B_2": (0.068598586, 3.532e-5)},
    }
    for chip, terms in published.items():
        for name, (alpha, beta) in terms.items():
            assert got[f"{chip}.{name}.alpha"] == pytest.approx(alpha, abs=1.5e-5)
            assert got[f"{chip}.{name}.beta"] == pytest.approx(beta, abs=6.9e-7)
    assert got["WFC1.B_3.alpha"] == pytest.approx(0.97263238, abs=1.5e-5)
    assert got["WFC2.B_3.alpha"] == pytest.approx(1.00622300, abs=1.5e-5)
    assert got["WFC1.B_1.alpha"] == pytest.approx(2079.58, abs=0.02)


def test_the_report_laid_on_the_delivered_table(real, truth) -> None:
    """Its linear terms and the simulation's higher ones: roll, drift and chip offset are real."""
    o = laid_on(truth, real, filter=F606W, epoch=2004.5, scale_arcsec=SCALE)
    assert np.rad2deg(o.angle) == pytest.approx(-2.2337, abs=1e-3)
    free = laid_on(truth, real, filter=F606W, epoch=2004.5)
    assert free.scale == pytest.approx(0.05, rel=1e-5)
    turned = segment(turned_by(truth, o).solution, 0)
    terms = lines(turned)
    got = dict(zip(terms.labels, terms.values.tolist(), strict=True))
    for chip in (1, 2):
        # CXB and CTB of the real file, in arcsec/pix/yr; 0.05 times the sigma of Tables 1 and 3
        assert got[f"WFC{chip}.A_2.beta"] == pytest.approx(real.tdd[f"TDD_CXB{chip}"], abs=3.4e-8)
        assert got[f"WFC{chip}.B_2.beta"] == pytest.approx(real.tdd[f"TDD_CTB{chip}"], abs=3.4e-8)
    offset = [float(real.rows[name][real.row(1, F606W)]) for name in ("V2REF", "V3REF")]
    assert o.v2v3[0] + got["WFC1.A_1.alpha"] == pytest.approx(offset[0], abs=0.02)
    assert o.v2v3[1] - got["WFC1.B_1.alpha"] == pytest.approx(offset[1], abs=0.02)


def test_an_old_table_can_serve_too(real, data_dir) -> None:
    """Order 4 of 2006: the same roll to 0.01 deg, some mas apart; its drift is not to be had."""
    old = read_idctab(data_dir / "hst_reference" / "qbu1641sj_idc.fits")
    solution = wfc_solution(real)
    names = {"filter": F606W, "epoch": 2004.5}
    o = laid_on(solution, old, **names, reference_drift=False)
    assert abs(np.rad2deg(o.angle)) < 0.01 and o.scale == 1.0
    assert 1 < o.agreement.rms < o.agreement.worst < 20
    assert o.reference_cov[3, 3] > 0
    with pytest.raises(InputError, match="of the scheme 'default'"):
        laid_on(solution, old, **names)


def test_wrong_references_are_refused(truth) -> None:
    reference = table_of(truth, SCALE)
    mirrored = truth.mean.copy()
    for chip in (1, 2):
        mirrored[truth.model.coefficient_slice(chip, 0)] *= -1
    flipped = replace(truth, mean=mirrored)
    chip = replace(truth.model.chips[1], size=(1024.0, 1024.0), reference_pixel=(512.0, 512.0))
    other = StandIn(replace(truth.model, chips=(truth.model.chips[0], chip)), truth.mean, truth.cov)
    names = {"epoch": 2004.5, "reference_drift": False}
    for message, call in (
        ("no epoch", lambda: laid_on(truth, reference)),
        ("mirrored", lambda: laid_on(flipped, reference, **names)),
        ("pixels, but in the solution", lambda: laid_on(other, reference, **names)),
        (
            "scale is -1",
            lambda: laid_on(truth, reference, scale_arcsec=-1, **names),
        ),
    ):
        with pytest.raises(InputError, match=message):
            call()
    o = laid_on(truth, reference, **names)
    turned = turned_by(truth, o)
    with pytest.raises(InputError, match="orientation is for pix"):
        oriented(turned, o)


# -- what a file can hold -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turned(truth):
    reference = table_of(truth, SCALE * np.exp(1j * ROLL))
    o = laid_on(truth, reference, epoch=2004.5, reference_drift=False)
    return turned_by(truth, o)


@pytest.mark.parametrize(("part", "years"), [(0, (2002.2, 2009.39)), (1, (2009.41, 2015.0))])
def test_what_is_left_out_is_what_is_stated(turned, part: int, years) -> None:
    """Over corners and dates, the stored model differs from the whole by at most the bound."""
    stored, lost = storable(turned, segment=part, years=years)
    assert {e.term for e in lost} == {("u", 0, 1)}
    x, y = (g.ravel() for g in np.meshgrid([0.5, 2048.0, 4096.5], [0.5, 1024.0, 2048.5]))
    for chip in (1, 2):
        worst = 0.0
        for epoch in (*years, np.mean(years)):
            whole = turned.model.predict(turned.solution.mean, x, y, epoch=epoch, chip=chip)
            held = stored.model.predict(stored.solution.mean, x, y, epoch=epoch, chip=chip)
            worst = max(worst, 1e3 * np.hypot(*(whole - held).T).max())
        [stated] = [e for e in lost if e.chip == f"WFC{chip}"]
        assert worst == pytest.approx(stated.mas, rel=1e-6)
        assert 0.001 < stated.mas < 0.05 and "at most" in str(stated)


def test_the_bound_of_the_report_by_hand(turned) -> None:
    """Table 2: 3.30e-6 per year, times sin 2.2336 deg, 5 years and 1024.5 pixels of 50 mas."""
    _, lost = storable(turned, years=(2002.2, 2009.4))
    [stated] = [e for e in lost if e.chip == "WFC2"]
    expected = 3.30e-6 * np.sin(-ROLL) * 4.9 * 1024.5 * 50
    assert stated.mas == pytest.approx(expected, rel=1e-6)


def test_more_than_the_limit_is_refused(truth, turned) -> None:
    with pytest.raises(InputError, match=r"cannot store drifts of WFC2.*\(u, 0, 1\) with 0.032"):
        storable(turned, years=(2002.2, 2009.4), limit_mas=0.03)
    with pytest.raises(InputError, match=r"years 2009\.0 to 2002.0 are not ascending"):
        storable(turned, years=(2009.0, 2002.0))
    with pytest.raises(InputError, match="orient the solution first"):
        storable(calibration_of(truth), years=(2002.0, 2009.0))
    with pytest.raises(InputError, match="no segment 2"):
        storable(turned, years=(2002.0, 2009.0), segment=2)


def test_a_drift_of_the_chip_offset_is_bounded_too(truth) -> None:
    """B_1 of WFC1 that moves by 0.05 px in ten years cannot be stored; 2.5 mas are not dropped."""
    time = TimeDependence((("v", 0, 0),), (2004.5,))
    model = replace(truth.model, time=time)
    theta = np.concatenate([truth.mean[: model.n_polynomial], [0.005, 0.0]])
    solution = StandIn(model, theta, 1e-8 * np.eye(theta.size))
    reference = table_of(truth, SCALE * np.exp(1j * ROLL))
    o = laid_on(solution, reference, epoch=2004.5, reference_drift=False)
    with pytest.raises(InputError, match=r"drifts of WFC1 that reach 1.*mas"):
        storable(turned_by(solution, o), years=(2002.5, 2009.4))
    _, lost = storable(turned_by(solution, o), years=(2002.5, 2009.4), limit_mas=2)
    both = {e.term: e.mas for e in lost if e.chip == "WFC1"}
    assert np.hypot(both["u", 0, 0], both["v", 0, 0]) == pytest.approx(0.005 * 4.9 * 50, rel=1e-6)


def test_another_filters_drift_counts_against_the_stored_one(truth, turned) -> None:
    base, _ = storable(turned, years=(2002.2, 2009.39))
    same, lost = storable(turned, years=(2002.2, 2009.39), like=base)
    assert same.model.time is None
    assert [e.term for e in lost] == [("u", 0, 1)] * 2
    faster = truth.mean.copy()
    start = truth.model.tdd_slice(2).start
    faster[start] *= 1.5  # the rate of A_2 before SM4: 4.6e-6 per year more
    other = turned_by(replace(truth, mean=faster), turned.plane.orientation)
    with pytest.raises(InputError, match=r"cannot store drifts of WFC2.*\(u, 1, 0\)"):
        storable(other, years=(2002.2, 2009.39), like=base)
    loose, lost = storable(other, years=(2002.2, 2009.39), like=base, limit_mas=5.0)
    x, y = np.array([0.5, 4096.5]), np.array([1024.0, 1024.0])
    whole = other.model.predict(other.solution.mean, x, y, epoch=2009.39, chip=2)
    held = loose.model.predict(loose.solution.mean, x, y, chip=2)
    drift = base.model.predict(base.solution.mean, x, y, epoch=2009.39, chip=2)
    drift = drift - base.model.predict(base.solution.mean, x, y, epoch=2004.5, chip=2)
    got = 1e3 * np.hypot(*(whole - held - drift).T).max()
    parts = [e.mas for e in lost if e.chip == "WFC2" and e.term[1:] == (1, 0)]
    assert got == pytest.approx(np.hypot(*parts), rel=1e-3)
    still = StandIn(replace(truth.model, time=None), truth.mean[: truth.model.n_polynomial],
                    truth.cov[: truth.model.n_polynomial, : truth.model.n_polynomial])  # fmt: skip
    with pytest.raises(InputError, match="does not depend on time"):
        storable(turned_by(still, turned.plane.orientation), years=(2002.2, 2009.39), like=base)
