"""The WISE solutions against the numbers printed in the report that they come from.

Source: WSDC D-T033, "WISE IOC Distortion Calibration", Appendix B (current SIP coefficients for
ops) and section 4 (vector-flow diagrams); most closely of band W2.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer import Rejection, fit_linear
from bayesdist.missions.wise.published import WISE_COEFFICIENTS
from bayesdist.missions.wise.simulate import simulate_wise, wise_solution
from bayesdist.model import polynomial_terms

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


# band: where the outermost pixels that the printed DMAX belongs to lie, A_DMAX, B_DMAX, longest
PRINTED = {
    "W1": (507.5, 2.046, 1.066, 2.931),
    "W2": (507.5, 2.083, 1.089, 3.048),
    "W3": (507.5, 2.095, 1.300, 3.004),
    "W4": (254.0, 0.971, 0.582, 1.435),
}


def field(band, reach):
    """Correction over a grid within +-reach pixels of the centre, (N, 2)."""
    model, theta = wise_solution(band)
    centre = np.array(model.chips[0].reference_pixel)
    steps = np.linspace(-reach, reach, 201)
    offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return model.predict(theta, *(offset + centre).T) - offset - centre


@pytest.mark.parametrize("band", PRINTED)
def test_every_band_has_the_printed_extent(band):
    reach, a_dmax, b_dmax, longest = PRINTED[band]
    correction = field(band, reach)
    np.testing.assert_allclose(np.abs(correction).max(axis=0), [a_dmax, b_dmax], atol=0.0005)
    model, theta = wise_solution(band)
    assert model.chips[0].size == ((508.0, 508.0) if band == "W4" else (1016.0, 1016.0))
    centre = np.array(model.chips[0].reference_pixel)
    vectors = correction - (model.predict(theta, *centre[:, None])[0] - centre)
    assert np.hypot(*vectors.T).max() == pytest.approx(longest, rel=0.005)


def test_the_misprint_of_w1_would_show():
    """Printed as B_0_2 is B_1_1; with it the correction on y reaches 2 px, and 1.066 is printed."""
    reach, _, b_dmax, _ = PRINTED["W1"]
    (_, b) = WISE_COEFFICIENTS["W1"]
    terms = polynomial_terms(4)
    y = np.linspace(-reach, reach, 201)
    off = (b[terms.index((1, 1))] - b[terms.index((0, 2))]) * y**2
    # of the grid, x runs fastest
    printed = field("W1", reach)[:, 1] + np.repeat(off, 201)
    assert np.abs(printed).max() > 1.8 * b_dmax


# BP_p_q of W1 as printed, and AP_p_q, both in the order of polynomial_terms(4)
# fmt: off
W1_INVERSE = (
    (-7.233219e-01, 7.777227e-04, 1.261763e-04, 1.636841e-06, -1.342059e-06, 7.795772e-06,
     -2.759976e-09, 1.107923e-10, -1.159637e-09, 2.696271e-10,
     -1.804259e-12, 4.712913e-13, -1.580363e-12, 6.084245e-13, 6.665114e-13),
    (7.930997e-02, 2.484437e-04, -3.239962e-04, 6.524476e-08, 3.542573e-06, -1.163635e-06,
     6.293886e-11, 2.734704e-10, 4.895069e-10, 3.198763e-09,
     -8.708176e-13, -7.164364e-13, 2.664114e-13, -1.423222e-12, 8.509823e-13),
)
# fmt: on


def test_the_mended_value_of_w1_is_what_the_printed_inverse_implies():
    """B_0_2 of W1 by least squares from the closure of the fifteen printed BP alone."""
    reach = PRINTED["W1"][0]
    steps = np.linspace(-reach, reach, 41)
    dx, dy = (g.ravel() for g in np.meshgrid(steps, steps))
    U, V = np.column_stack([dx, dy]).T + field_at("W1", dx, dy).T

    def closure(change):
        moved = V + change * dy**2
        bp = sum(
            c * U**i * moved**j
            for (i, j), c in zip(polynomial_terms(4), W1_INVERSE[1], strict=True)
        )
        return moved + bp - dy

    slope = (closure(1e-9) - closure(-1e-9)) / 2e-9
    change = -(slope @ closure(0.0)) / (slope @ slope)
    assert abs(change) < 1e-9  # 0.1 % of the value: 0.0003 px in a corner


def field_at(band, dx, dy):
    """Correction at offsets from the centre."""
    model, theta = wise_solution(band)
    cx, cy = model.chips[0].reference_pixel
    return model.predict(theta, dx + cx, dy + cy) - np.column_stack([dx + cx, dy + cy])


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
    honest = matches.with_errors(truth.jitter, in_quadrature=True).select(~truth.false)
    fit = fit_linear(honest, model, rejection=Rejection(np.inf, None))
    d = fit.mean - theta
    assert 1e-3 < stats.chi2(30).sf(d @ np.linalg.solve(fit.cov, d)) < 1 - 1e-3
