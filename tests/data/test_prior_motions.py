"""Stars without a proper motion get one from the others, with its error."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import MaskedColumn

import bayesdist as bd
from bayesdist.errors import InputError
from tests.data.test_sky import POINT, catalogue, read
from tests.reduced import FULL

YEARS = 12.0
EPOCH = 2016.0 + YEARS


def field(n=600, seed=2, **changes):
    """Bright stars move fast and faint ones slowly, about a common motion."""
    rng = np.random.default_rng(seed)
    t = catalogue(n, seed)
    t["x"], t["y"] = rng.uniform(1, 1000, (2, n))
    faint = np.asarray(t["phot_g_mean_mag"]) > 17.5
    sigma = np.where(faint, 2.0, 8.0)
    t["pmra"], t["pmdec"] = 3.0 + sigma * rng.normal(size=n), -5.0 + sigma * rng.normal(size=n)
    t["parallax"] = 0.5 + 0.1 * rng.normal(size=n)
    t["parallax_error"] = 0.02
    for name in ("ra_error", "dec_error", "pmra_error", "pmdec_error"):
        t[name] = 0.05
    for name, value in changes.items():
        t[name] = value
    return t, faint


def masked(
    t, gone, names=("pmra", "pmdec", "pmra_error", "pmdec_error", "parallax", "parallax_error")
):
    t = t.copy()
    for name in names:
        t[name] = MaskedColumn(t[name], mask=gone)
    return t


def third(n):
    return np.arange(n) % 3 == 0


def test_their_errors_grow_by_the_scatter_of_stars_of_their_magnitude():
    t, faint = field(3000)
    gone = third(len(t))
    m = read(masked(t, gone), epoch=EPOCH)
    assert len(m) == len(t) and not m.rejected
    for sigma, group in ((2.0, faint & gone), (8.0, ~faint & gone)):
        for axis in (m.sigma_u, m.sigma_v):
            assert np.median(axis[group]) == pytest.approx(YEARS * sigma / 1e3, rel=0.15)
    with_motion = read(t, epoch=EPOCH)
    for name in ("u", "v", "sigma_u", "sigma_v"):
        np.testing.assert_allclose(getattr(m, name)[~gone], getattr(with_motion, name)[~gone])
    # they are moved by the mean motion of the field
    offset = np.mean([m.u - with_motion.u, m.v - with_motion.v], axis=1, where=gone)
    assert np.abs(offset).max() < 5 * YEARS * 6e-3 / np.sqrt(gone.sum())
    assert any("1000 of 3000 rows have no motion" in note for note in m.notes)


@pytest.mark.parametrize("how", ["zeros", "nan", "two parameters"])
def test_every_form_of_a_missing_motion_is_one(how, caplog):
    t, _ = field()
    gone = third(len(t))
    expected = read(masked(t, gone), epoch=EPOCH)
    t = t.copy()
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error", "parallax", "parallax_error"):
        if how == "two parameters":  # numbers that are none
            t[name][gone] = 1e3 if name.startswith("pm") else 0.0
        else:
            t[name][gone] = 0.0 if how == "zeros" and name.startswith("pm") else np.nan
    if how == "two parameters":
        t["astrometric_params_solved"] = np.where(gone, 3, 31)
    m = read(t, epoch=EPOCH)
    for name in ("u", "v", "sigma_u", "sigma_v", "rho_uv"):
        np.testing.assert_allclose(getattr(m, name), getattr(expected, name), rtol=1e-9, atol=1e-12)
    assert ("exactly 0" in caplog.text) == (how == "zeros")


def test_the_prior_may_be_given():
    t, _ = field(60)
    gone = third(60)
    wide = read(masked(t, gone), epoch=EPOCH, motion_prior=40.0)
    assert wide.sigma_u[gone] == pytest.approx(YEARS * 0.040, rel=0.01)
    few = masked(t, np.arange(60) >= 10)
    assert read(few, epoch=EPOCH).rejected == {"no proper motion": 50}
    assert len(read(few, epoch=EPOCH, motion_prior=5.0)) == 60
    with pytest.raises(InputError, match="motion_prior is -1"):
        read(t, epoch=EPOCH, motion_prior=-1.0)


@pytest.mark.parametrize("name", ["pmra_error", "pmdec_error", "parallax_error"])
def test_errors_below_zero_are_refused_by_row(name):
    t, _ = field()
    t[name][17] = -0.1
    with pytest.raises(InputError, match=f"row 18, column '{name}': an error is -0.0001"):
        read(t, epoch=EPOCH)


def test_a_measured_motion_without_an_error_is_refused_by_row():
    t, _ = field()
    t["pmdec_error"][4] = np.nan
    with pytest.raises(InputError, match="row 5, column 'pmdec_error': a measured proper motion"):
        read(t, epoch=EPOCH)
    assert read(t, epoch=EPOCH, not_finite="reject").rejected == {"no proper motion": 1}


def test_doubtful_solutions_are_counted():
    t, _ = field(ruwe=1.0)
    t["ruwe"][:7] = 2.0
    assert "7 of 600 rows have a ruwe above 1.4" in " ".join(read(t, epoch=EPOCH).notes)


# -- coverage -------------------------------------------------------------------------------------

TRUTHS = 600 if FULL else 60
PROBES = np.array([[200.0, 300.0], [850.0, 700.0]])


def fitted(t, **options):
    """Fit to the stars of a table with their own errors, as positions (2, 2) and errors of u."""
    stars = read(t, epoch=EPOCH, **options)
    model = bd.build_model(stars, order=1, size=(1000, 1000))
    fit = bd.fit_linear(stars, model)
    phi = fit.model.basis().evaluate(*PROBES.T)
    variance = np.einsum("nk,kl,nl->n", phi, fit.cov[:3, :3], phi)
    return phi @ np.reshape(fit.mean, (2, -1)).T, np.sqrt(variance)


@pytest.mark.slow
def test_a_third_of_the_stars_without_motions_is_covered():
    """Least squares, 12 years from the catalogue: neither left out nor believed to stand still."""
    z = {"prior": [], "standing still": []}
    for seed in range(TRUTHS):
        rng = np.random.default_rng([7, seed])
        t, _ = field(150, seed)
        gone = third(len(t))
        seen = read(t, epoch=EPOCH)  # true positions at the date
        model = bd.build_model(seen, order=1, size=(1000, 1000))
        truth = np.array([0.0, 50.0, 0.0, 0.0, 0.0, 50.0])
        phi = model.basis().evaluate(t["x"], t["y"])
        place = phi @ truth.reshape(2, -1).T
        # the detector sees true stars; the catalogue has errors of its positions and motions
        shift = place - np.column_stack([seen.u, seen.v])
        t["ra"] += shift[:, 0] / 3600 / np.cos(np.radians(POINT[1]))
        t["dec"] += shift[:, 1] / 3600
        again = read(t, epoch=EPOCH)  # the plane bends by less than the errors
        rest = place - np.column_stack([again.u, again.v])
        t["ra"] += rest[:, 0] / 3600 / np.cos(np.radians(POINT[1]))
        t["dec"] += rest[:, 1] / 3600
        for name, error in (("pmra", 0.05), ("pmdec", 0.05)):
            t[name] += error * rng.normal(size=len(t))
        t["ra"] += 0.05e-3 / 3600 / np.cos(np.radians(POINT[1])) * rng.normal(size=len(t))
        t["dec"] += 0.05e-3 / 3600 * rng.normal(size=len(t))
        t["parallax"] += 0.02 * rng.normal(size=len(t))
        still = t.copy()
        for name in ("pmra", "pmdec"):
            still[name][gone] = 1e-9
        expected = model.basis().evaluate(*PROBES.T) @ truth.reshape(2, -1).T
        for kind, table in (("prior", masked(t, gone)), ("standing still", still)):
            found, sigma = fitted(table)
            z[kind] += list((found - expected)[:, 0] / sigma)
    within = {kind: [np.mean(np.abs(v) < k) for k in (1.0, 1.96)] for kind, v in z.items()}
    spread = 4 * np.sqrt(0.25 / (2 * TRUTHS))
    assert within["prior"] == pytest.approx([0.683, 0.95], abs=spread)
    assert within["standing still"][1] < 0.3
