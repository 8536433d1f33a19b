from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data.magnitude_errors import estimate
from bayesdist.errors import InputError
from tests.reduced import only_in_full

FAINT = np.linspace(-10.5, -6.2, 30)


def truth(mag):
    """Like hst1pass: a floor of 0.01 px and photon noise."""
    return np.hypot(0.01, 0.06 * 10 ** (0.3 * (np.asarray(mag) + 6)))


def simulated(rng, n=6800, outliers=0.0):
    mag = -6.0 - rng.exponential(2.0, n)
    r = rng.normal(size=(2, n)) * np.array([[1.0], [1.3]]) * truth(mag)
    bad = rng.random(n) < outliers
    r[:, bad] = rng.normal(0, 0.5, (2, bad.sum()))
    return mag, r


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_the_truth_comes_back_with_and_without_outliers(rng, outliers):
    ratio = []
    for _ in range(25):
        mag, r = simulated(rng, outliers=outliers)
        u, v = estimate(mag, *r).at(FAINT)
        ratio.append([u / truth(FAINT), v / (1.3 * truth(FAINT))])
    bias = np.mean(ratio, axis=(0, 1)) - 1
    assert np.abs(bias).max() < 0.03  # at any magnitude
    assert np.abs(bias.mean()) < 0.01
    # the plain standard deviation, for comparison, is far off: 5 % at 0.5 px add 0.11 px
    if outliers:
        assert np.std(r[0][mag < -9]) > 3 * truth(-9)


@pytest.mark.slow
@only_in_full("large samples are run")
def test_small_samples_are_unbiased(rng):
    scatter = [estimate(np.zeros(40), *rng.normal(size=(2, 40))).sigma_u[0] for _ in range(4000)]
    # the clipping at 4 sigma and the median leave less than 1 %
    assert np.median(scatter) == pytest.approx(1.0, abs=0.012)


@pytest.mark.slow
@only_in_full("the truth comes back from large samples")
def test_what_a_weighted_fit_takes_up_is_given_back(rng):
    # order 5 in x and y by itself, weights 1 / sigma^2: 42 parameters from 400 stars of two kinds
    n, p = 400, 21
    mag = np.where(np.arange(n) < 200, -12.0, -8.0)
    sigma = np.where(mag < -10, 0.01, 0.1)
    corrected, plain = [], []
    for _ in range(300):
        x, y = rng.uniform(-1, 1, (2, n))
        A = np.column_stack([x**i * y**j for i in range(6) for j in range(6 - i)]) / sigma[:, None]
        z = rng.normal(size=(n, 2))
        r = (z - A @ np.linalg.lstsq(A, z, rcond=None)[0]) * sigma[:, None]
        corrected.append(estimate(mag, *r.T, n_params=2 * p).scatter_u)
        plain.append(estimate(mag, *r.T).scatter_u)
    bright = slice(0, -1) if len(corrected[0]) > 2 else slice(0, 1)
    assert np.mean(np.array(corrected)[:, bright]) == pytest.approx(0.01, rel=0.015)
    assert np.mean(np.array(plain)[:, bright]) < 0.01 * 0.965  # sqrt(1 - 21 / 202) = 0.946


def test_bins_hold_about_equal_numbers(rng):
    mag, r = simulated(rng)
    e = estimate(mag, *r)
    assert e.n.sum() == len(mag) and 20 <= len(e.n) <= 25
    assert e.n.min() >= 40 and np.ptp(e.n) <= 2
    assert (np.diff(e.mag) > 0).all()
    assert len(estimate(mag[:100], *r[:, :100]).n) == 2
    assert len(estimate(mag[:20], *r[:, :20]).n) == 1


def test_the_curve_rises_and_is_flat_beyond_the_ends(rng):
    mag, r = simulated(rng)
    e = estimate(mag, *r)
    curve = e.at(np.linspace(e.mag[0], e.mag[-1], 500))[0]
    assert (np.diff(curve) >= -1e-12).all()
    assert e.at([-100.0])[0][0] == pytest.approx(e.sigma_u[0])
    assert e.at([100.0])[0][0] == pytest.approx(e.sigma_u[-1])


def test_saturated_stars_keep_their_large_errors(rng):
    mag = rng.uniform(-16, -8, 6000)
    sigma = np.where(mag < -14, 0.05, 0.01)
    e = estimate(mag, *(rng.normal(size=(2, 6000)) * sigma))
    assert e.at([-15.5])[0][0] == pytest.approx(0.05, rel=0.15)
    assert e.at([-12.0, -9.0])[0] == pytest.approx(0.01, rel=0.1)


def test_equal_magnitudes_stay_in_one_bin(rng):
    mag = np.repeat([10.0, 11.0, 12.0], 300)
    e = estimate(mag, *rng.normal(size=(2, 900)))
    assert set(e.mag) <= {10.0, 11.0, 12.0} and e.n.sum() == 900


def test_what_cannot_be_estimated_is_refused(rng):
    mag, r = simulated(rng, 100)
    with pytest.raises(InputError, match="5 stars are too few"):
        estimate(mag[:5], *r[:, :5])
    with pytest.raises(InputError, match="no scatter"):
        estimate(mag, np.zeros(100), r[1])
    with pytest.raises(InputError, match="after fitting 200 parameters"):
        estimate(mag, *r, n_params=200)
    with pytest.raises(InputError, match="not finite"):
        estimate(np.where(mag < -9, np.nan, mag), *r)


def test_real_errors_grow_as_published(data_dir):
    # residuals of raw WFC3/UVIS positions after a polynomial of order 4; the data's README gives
    # 0.011 to 0.077 px from bright to faint
    path = data_dir / "hst1pass_uvis" / "hst1pass_uvis_matched.csv"
    d = np.genfromtxt(path, delimiter=",", names=True)
    residuals, mags = [], []
    for frame in (1, 2, 3, 4):
        s = d[d["frame"] == frame]
        X, Y = (s["x_raw"] - 512) / 512, (s["y_raw"] - 512) / 512
        A = np.column_stack([X**i * Y**j for i in range(5) for j in range(5 - i)])
        target = np.column_stack([s["U_master"], s["V_master"]])
        weight = np.ones(len(s))
        for _ in range(10):  # robust: far stars lose their weight
            r = (
                target
                - A @ np.linalg.lstsq(A * weight[:, None], target * weight[:, None], rcond=None)[0]
            )
            weight = 1 / (1 + (np.hypot(*r.T) / 0.1) ** 2)
        residuals.append(r)
        mags.append(s["mag"])
    e = estimate(np.concatenate(mags), *np.concatenate(residuals).T, n_params=120)
    assert e.at([-12.0])[0][0] == pytest.approx(0.011, rel=0.4)
    assert e.at([-6.2])[0][0] == pytest.approx(0.077, rel=0.4)
