"""The gap between chips: known differences of tables and solutions, and what chance makes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from scipy.stats import chi2, kstest

from bayesdist.assess.comparison.compare import gap_lines, gap_verdict
from bayesdist.assess.comparison.frame import gap_difference, pair_of_chips
from bayesdist.calibration.calibration import calibration_of
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import write_idctab
from bayesdist.infer import Rejection, fit_linear, save_fit
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches
from tests.app.support import good
from tests.reduced import only_in_full

pytestmark = pytest.mark.plugins

CHIPS = tuple(Chip(k, f"WFC{k}", (512.0, 256.0), (256.0, 128.0)) for k in (2, 1))
NAMES = ("shift_x", "shift_y", "scale", "rotation")


def truth(model: DistortionModel) -> np.ndarray:
    """A detector in pixels of 0.05 arcsec, chip 1 above chip 2."""
    rng = np.random.default_rng(3)
    theta = np.zeros(model.n_params)
    for chip in model.chips:
        basis = model.basis(chip.number)
        for axis, first in enumerate(((1, 0), (0, 1))):
            c = np.zeros(model.n_terms)
            c[basis.terms.index(first)] = 0.05
            legendre = basis.from_monomials(c)
            legendre[3:] += 0.02 * rng.standard_normal(model.n_terms - 3)
            legendre[0] += 13.0 * (chip.number == 1) * axis
            theta[model.coefficient_slice(chip.number, axis)] = legendre
    return theta


def moved(model, theta, chip, *, shift=0j, turn=1.0, mirror=False):
    """Parameters with one chip (None: all) shifted, turned about u = v = 0, mirrored."""
    out = theta.copy()
    for one in model.chips:
        if chip is not None and one.number != chip:
            continue
        at = [model.coefficient_slice(one.number, axis) for axis in (0, 1)]
        z = turn * (theta[at[0]] + 1j * theta[at[1]])
        z[0] += shift
        out[at[0]], out[at[1]] = z.real, -z.imag if mirror else z.imag
    return out


def drawn(model, theta, seed, n=600, sigma=2e-3):
    matches, _ = simulate_matches(
        model, theta, n, rng=np.random.default_rng(seed), sigma=sigma, fraction=0.0
    )
    return fit_linear(matches, model, rejection=Rejection(np.inf, np.inf))


def pair(fit, name="fit"):
    return pair_of_chips(calibration_of(fit, name), 2, 1)


@pytest.mark.slow
@only_in_full("test_comparison has differences of errors alone")
def test_errors_alone_make_a_chi_square_of_four():
    """Frames turned, shifted and mirrored as wholes, of other orders: they are no gap."""
    a, b = DistortionModel(3, CHIPS, "arcsec"), DistortionModel(4, CHIPS, "arcsec")
    true = truth(a)
    same = np.zeros(b.n_params)
    for chip in b.chips:
        for axis in (0, 1):
            part = true[a.coefficient_slice(chip.number, axis)]
            same[b.coefficient_slice(chip.number, axis)][: len(part)] = part
    same = moved(b, same, None, shift=40 - 3j, turn=1.001 * np.exp(0.7j), mirror=True)
    values, pulls = [], []
    for seed in range(150):
        found = gap_difference(
            pair(drawn(a, true, [1, seed])), pair(drawn(b, same, [2, seed], n=900))
        )
        assert found.errors_of == "both" and found.test.dof == 4
        values.append(found.test.chi2)
        pulls.append(found.values / found.sigma)
    assert kstest(values, chi2(4).cdf).pvalue > 1e-3
    squares = (np.array(pulls) ** 2).sum(axis=0)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], len(values))
    assert ((squares > low) & (squares < high)).all()


def test_a_moved_chip_is_found_as_it_was_moved():
    """By a least-squares similarity of positions on both chips, which numpy fits."""
    model = DistortionModel(3, CHIPS, "arcsec")
    true = truth(model)
    shift, turn = 0.004 + 0.002j, 1.0003 * np.exp(2e-4j)
    one = drawn(model, true, 5)
    a = replace(one, mean=moved(model, true, 1, shift=shift, turn=turn))
    b = replace(one, mean=true)
    found = gap_difference(pair(a), pair(b))
    side = (np.arange(200) + 0.5) / 200
    x, y = (g.ravel() + 0.5 for g in np.meshgrid(512 * side, 256 * side))

    def positions(theta, chip):
        u, v = model.predict(theta, x, y, chip=chip).T
        return u + 1j * v

    w = positions(true, 1)
    left = positions(a.mean, 1) - w  # the reference chip is the same in both
    offset = w - w.mean()
    design = np.stack([np.ones_like(w), offset], axis=1)
    mean, relative = np.linalg.lstsq(design, left)[0]
    linear = model.basis(1).to_monomials(a.mean[: 4 * model.n_terms].reshape(4, -1)[2:])[:, 1:3]
    pixels = np.linalg.solve(linear, [mean.real, mean.imag])
    np.testing.assert_allclose(found.values[:2], pixels, rtol=1e-3)
    assert found.values[2] == pytest.approx(relative.real, rel=1e-3)
    assert found.values[3] == pytest.approx(relative.imag, rel=1e-3)
    assert found.test.p_value < 1e-6
    assert "lies elsewhere against chip 2, significantly" in gap_verdict(found)
    assert all("sigma" in line for line in gap_lines(found))
    back = gap_difference(pair(b), pair(a))
    np.testing.assert_allclose(back.values, -found.values, atol=2e-3 * np.abs(found.values).max())


def test_errors_of_a_gap_hold_what_chips_share():
    """An error common to both chips is none of the gap."""
    model = DistortionModel(2, CHIPS, "arcsec")
    fit = drawn(model, truth(model), 6)
    constants = [model.coefficient_slice(c.number, 0).start for c in model.chips]
    common = np.zeros(model.n_params)
    common[constants] = 1.0
    loose = replace(fit, cov=fit.cov + np.outer(common, common))
    tight, free = (gap_difference(pair(f), pair(fit)) for f in (fit, loose))
    np.testing.assert_allclose(free.sigma, tight.sigma, rtol=1e-6)
    lonely = np.zeros(model.n_params)
    lonely[constants[1]] = 0.05  # a pixel
    apart = replace(fit, cov=fit.cov + np.outer(lonely, lonely))
    assert gap_difference(pair(apart), pair(fit)).sigma[0] == pytest.approx(1.0, rel=0.02)


# -- files ----------------------------------------------------------------------------------------


@pytest.mark.slow
@only_in_full("gaps of two runs are compared")
def test_two_tables_with_another_gap(data_dir, tmp_path):
    """V2REF and V3REF of chip 1, which stwcs places it by: 0.02 and -0.01 arcsec more."""
    old = data_dir / "hst_reference" / "0461802ej_idc.fits"
    new = tmp_path / "new_idc.fits"
    shutil.copy(old, new)
    with fits.open(new, mode="update") as hdus:
        rows = hdus[1].data
        of_one = rows["DETCHIP"] == 1
        rows["V2REF"][of_one] += 0.02
        rows["V3REF"][of_one] -= 0.01
        row = next(r for r in rows if r["DETCHIP"] == 1 and r["DIRECTION"].strip() == "FORWARD")
        linear = np.array([[row["CX11"], row["CX10"]], [row["CY11"], row["CY10"]]], float)
    out = good("compare", new, old, "--filter", "F606W", "-o", tmp_path / "out").out
    # V2 = V2REF + Xc and V3 = V3REF - Yc (stwcs, wcsutil/instruments.py)
    expected = np.linalg.solve(linear, [0.02, 0.01])
    table = Table.read(tmp_path / "out" / "gap.ecsv")
    assert list(table["quantity"]) == list(NAMES) and set(table["chip"]) == {1}
    # the distortion differs over the chip by some per cent from the linear part at its middle
    np.testing.assert_allclose(table["difference"][:2], expected, rtol=1e-3)
    np.testing.assert_allclose(table["difference"][2:], 0, atol=1e-8)
    assert np.isnan(table["sigma"]).all()
    assert "neither gives errors of the gap" in out and out.count("agree to rounding") == 2
    [gap] = json.loads((tmp_path / "out" / "comparison.json").read_text())["gaps"]
    assert gap["p_value"] is None and gap["reference"] == 2
    np.testing.assert_allclose(gap["shift"], expected, rtol=1e-3)
    assert (
        "Chip 1 lies alike against chip 2, to rounding"
        in good("compare", old, old, "--filter", "F606W").out
    )


def test_a_table_has_the_gap_and_its_errors_of_what_it_was_made_from(tmp_path):
    model = DistortionModel(3, CHIPS, "arcsec")
    one, other = (drawn(model, truth(model), seed) for seed in (8, 9))
    save_fit(one, tmp_path / "fit.nc")
    tab = idctab_from_solution(other, instrument="ACS", detector="WFC", scale_arcsec=0.05)
    write_idctab(tab, tmp_path / "x_idc.fits")
    direct = gap_difference(pair(one), pair(other))
    good("compare", tmp_path / "fit.nc", tmp_path / "x_idc.fits", "-o", tmp_path / "out")
    [gap] = json.loads((tmp_path / "out" / "comparison.json").read_text())["gaps"]
    np.testing.assert_allclose(gap["shift"], direct.values[:2], rtol=1e-5)
    np.testing.assert_allclose(gap["sigma_shift"], direct.sigma[:2], rtol=1e-5)
    assert gap["p_value"] == pytest.approx(direct.test.p_value, rel=1e-4)
    assert gap["significance_of"] == "both"
