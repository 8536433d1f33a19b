"""The WISE solution against the numbers printed in the report that it comes from.

Source: WSDC D-T033, "WISE IOC Distortion Calibration", Appendix B (current SIP coefficients for
ops), band W2, and section 4 (vector-flow diagrams).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer import fit_linear
from bayesdist.simulate import simulate_wise, wise_solution

# fmt: off
# AP_p_q and BP_p_q of W2 as printed: (p, q): (AP, BP)
INVERSE = {
    (0, 0): (-7.601833e-01,  9.412452e-02),
    (0, 1): ( 1.214455e-04, -5.536797e-04),
    (1, 0): ( 5.022762e-04,  2.031710e-04),
    (0, 2): ( 8.060749e-06, -1.087708e-06),
    (0, 3): ( 4.733730e-10,  3.865684e-09),
    (0, 4): ( 1.892303e-13,  5.128681e-13),
    (1, 1): (-1.080554e-06,  3.953409e-06),
    (1, 2): (-2.655445e-10,  9.209293e-10),
    (1, 3): ( 6.091029e-13, -8.239603e-13),
    (2, 0): ( 1.357302e-06, -7.895137e-08),
    (2, 1): ( 1.285175e-09, -3.948197e-10),
    (2, 2): (-2.174012e-12,  5.843392e-13),
    (3, 0): (-2.964908e-09, -1.087914e-10),
    (3, 1): ( 6.893457e-13, -1.963102e-12),
    (4, 0): (-1.795530e-12,  1.753401e-13),
}
# fmt: on
A_DMAX, B_DMAX = 2.083, 1.089  # as printed
LONGEST = 3.048  # px, section 4: longest vector of W2 with the zeroth order suppressed


@pytest.fixture(scope="module")
def pixels():
    """Centres of all 1016 x 1016 pixels and the correction there, relative to pixel 508.5."""
    model, theta = wise_solution("W2")
    x, y = (g.ravel() for g in np.meshgrid(np.arange(1.0, 1017), np.arange(1.0, 1017)))
    corrected = model.predict(theta, x, y)
    return x - 508.5, y - 508.5, corrected - np.column_stack([x, y])


def test_the_detector_reaches_507_5_pixels_from_its_reference(pixels):
    dx, dy, _ = pixels
    assert dx.max() == dy.max() == 507.5 and dx.min() == dy.min() == -507.5


def test_largest_corrections_are_those_printed(pixels):
    *_, correction = pixels
    largest = np.abs(correction).max(axis=0)
    # three decimals are printed
    np.testing.assert_allclose(largest, [A_DMAX, B_DMAX], atol=0.0005)


def test_longest_vector_is_the_one_printed(pixels):
    """Vectors are longest in a corner, by 0.0115 px for each pixel further out.

    The report does not say whether its diagram ends at the centres of the outermost pixels or at
    their edges; the printed number lies between the two.
    """
    *_, correction = pixels
    model, theta = wise_solution("W2")
    constant = model.predict(theta, [508.5], [508.5])[0] - 508.5
    to_centres = np.hypot(*(correction - constant).T).max()
    x, y = (g.ravel() for g in np.meshgrid([0.5, 1016.5], [0.5, 1016.5]))
    corners = model.predict(theta, x, y) - np.column_stack([x, y]) - constant
    to_edges = np.hypot(*corners.T).max()
    assert to_centres < LONGEST < to_edges
    assert to_edges - to_centres < 0.006


def closure(inverse, dx, dy, correction):
    """Distance from a pixel to where forward and inverse polynomial bring it."""
    U, V = dx + correction[:, 0], dy + correction[:, 1]
    back = np.column_stack([U, V])
    for (p, q), pair in inverse.items():
        back += np.asarray(pair) * (U**p * V**q)[:, None]
    return np.hypot(back[:, 0] - dx, back[:, 1] - dy)


def test_the_printed_inverse_brings_pixels_back(pixels):
    """AP/BP were fitted for themselves and stand beside A/B: closure reads the digits of both.

    A fourth-order inverse of a fourth-order polynomial is not exact: the best one, fitted to all
    pixels, leaves 0.0021 px at worst and 0.0002 px rms.  The printed one leaves 0.0038 px and
    0.0007 px.
    """
    error = closure(INVERSE, *pixels)
    assert error.max() < 0.004
    assert np.sqrt((error**2).mean()) < 0.0008


def test_closure_would_show_a_wrong_sign(pixels):
    """Of every single coefficient."""
    dx, dy, correction = (values[::37] for values in pixels)
    for key, (ap, bp) in INVERSE.items():
        for wrong in ((-ap, bp), (ap, -bp)):
            assert closure(INVERSE | {key: wrong}, dx, dy, correction).max() > 0.01


def test_unknown_bands_are_refused():
    with pytest.raises(InputError, match=r"no band 'W9'.*W2"):
        wise_solution("W9")


@pytest.fixture(scope="module")
def pairs():
    return simulate_wise(40_000, rng=np.random.default_rng(1))


def test_counts_rise_as_in_the_galaxy(pairs):
    """N(< m) ~ 10^(0.3 m) between the bright and the faint limit."""
    matches, _ = pairs
    low, high = 10 ** (0.3 * 7.0), 10 ** (0.3 * 14.5)
    p = (10 ** (0.3 * matches.mag) - low) / (high - low)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_pairs_scatter_about_the_published_solution(pairs):
    matches, truth = pairs
    model, theta = wise_solution("W2")
    np.testing.assert_array_equal(truth.theta, theta)
    r = np.column_stack([matches.u, matches.v]) - model.predict(theta, matches.x, matches.y)
    wide = np.hypot(np.column_stack([matches.sigma_u, matches.sigma_v]), truth.jitter)
    good = ~truth.false
    assert stats.kstest((r / wide)[good].ravel(), "norm").pvalue > 1e-3
    assert stats.kstest((r[truth.false] / truth.outlier_scale).ravel(), "norm").pvalue > 1e-3
    assert stats.binomtest(int(truth.false.sum()), 40_000, 0.03).pvalue > 1e-3


def test_fainter_pairs_are_measured_worse(pairs):
    matches, _ = pairs
    order = np.argsort(matches.mag)
    assert (np.diff(matches.sigma_u[order]) >= 0).all()
    assert matches.sigma_u.min() >= 0.03 and matches.sigma_u.max() < 0.2


def test_the_fit_finds_the_published_coefficients(pairs):
    """Within its errors, jitter included: the quoted ones are too small by that."""
    matches, truth = pairs
    model, theta = wise_solution("W2")
    honest = matches.with_sigma(
        np.hypot(matches.sigma_u, truth.jitter), np.hypot(matches.sigma_v, truth.jitter)
    ).select(~truth.false)
    fit = fit_linear(honest, model, clip_chi2=np.inf, clip_abs=None)
    d = fit.mean - theta
    assert 1e-3 < stats.chi2(30).sf(d @ np.linalg.solve(fit.cov, d)) < 1 - 1e-3
