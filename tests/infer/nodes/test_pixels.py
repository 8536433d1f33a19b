"""Residuals brought to the detector."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.nodes import pixel_shifts
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.model import TimeDependence
from bayesdist.model.frames import nearest_frame
from tests.infer.support import TWO_CHIPS, columns_of, numerical_gradient, simulated, table


class Solution:
    def __init__(self, model, mean):
        self.model, self.mean = model, np.asarray(mean)


def turned_by(angle: float, shift) -> np.ndarray:
    """Parameters of a frame 'shift_rotation_scale' with a roll."""
    M = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return nearest_frame("shift_rotation_scale", M, shift)


@pytest.fixture
def turned():
    """Two chips, three exposures at different roll, a drift: no noise."""
    model, matches, truth = simulated(
        3,
        600,
        order=4,
        chips=TWO_CHIPS,
        frames="shift_rotation_scale",
        n_exposures=3,
        time=TimeDependence((("u", 1, 0), ("v", 1, 0)), (2005.0,)),
        epochs=[2003.0, 2006.0, 2010.0],
        sigma=0.05,
    )
    theta = truth.theta.copy()
    for e, angle in ((1, 0.7), (2, 2.9)):
        theta[model.frame_slice(e)] = turned_by(angle, [3.0, -2.0])
    uv = model.predict(theta, matches.x, matches.y, **columns_of(matches))
    same = table(
        matches.x,
        matches.y,
        *uv.T,
        epoch=matches.epoch,
        exposure=matches.exposure,
        exposure_names=matches.exposure_names,
        chip=matches.chip,
        chip_numbers=matches.chip_numbers,
    )
    return model, theta, same


def test_jacobian_is_the_slope_of_predict(turned):
    model, theta, matches = turned
    of = columns_of(matches)
    got = model.slopes(theta, matches.x, matches.y, **of)
    for k in range(0, 600, 60):
        one = {name: None if v is None else v[k] for name, v in of.items()}

        def position(p, one=one):
            return model.predict(theta, p[:1], p[1:], **one)[0]

        want = numerical_gradient(position, np.array([matches.x[k], matches.y[k]]), 0.5)
        np.testing.assert_allclose(got[k], want, rtol=1e-7, atol=1e-9)


def test_variances_of_turned_ellipses_are_those_of_the_pixels(turned, rng):
    """Errors along x and y, which are correlated between u and v where exposures are turned."""
    model, theta, matches = turned
    sigma = rng.uniform(0.01, 0.1, (len(matches), 2))
    J = model.slopes(theta, matches.x, matches.y, **columns_of(matches))
    matches = matches.with_covariances(J * sigma[:, None] ** 2 @ np.swapaxes(J, 1, 2))
    assert np.abs(matches.rho_uv).max() > 0.9
    found = pixel_shifts(Solution(model, theta), matches)
    np.testing.assert_allclose(found.variance, sigma**2, rtol=1e-9)


def test_adding_the_shift_meets_the_position(turned, rng):
    """A star whose pixel is off by 0.1 px: the shift leads back, whatever chip, roll and epoch."""
    model, theta, matches = turned
    off = 0.1 * rng.standard_normal((len(matches), 2))
    moved = table(
        matches.x + off[:, 0],
        matches.y + off[:, 1],
        matches.u,
        matches.v,
        **{
            name: getattr(matches, name)
            for name in ("epoch", "exposure", "exposure_names", "chip", "chip_numbers")
        },
    )
    shift = pixel_shifts(Solution(model, theta), moved).shift
    np.testing.assert_allclose(shift, -off, atol=1e-3 * np.abs(off).max())


def test_variances_turn_with_the_roll(turned, rng):
    """Against the scatter of noise that is carried through; u ten times worse than v."""
    model, theta, matches = turned
    sigma = np.array([0.1, 0.01])
    quoted = matches.with_errors(tuple(sigma))
    variance = pixel_shifts(Solution(model, theta), quoted).variance
    J = model.slopes(theta, matches.x, matches.y, **columns_of(matches))
    noise = sigma * rng.standard_normal((4000, 2))
    for k in (0, 250, 599):
        scatter = np.linalg.solve(J[k], noise.T).var(axis=1)
        np.testing.assert_allclose(variance[k], scatter, rtol=0.1)


def test_residuals_are_those_of_the_fit(rng):
    from bayesdist.infer import fit_linear, residuals

    model, matches, _ = simulated(5, 2000, order=2)
    fit = fit_linear(matches, model)
    assert isinstance(fit, LinearFit)
    shifts = pixel_shifts(fit, matches)
    J = model.slopes(fit.mean, matches.x, matches.y)
    np.testing.assert_allclose(
        np.einsum("nab,nb->na", J, shifts.shift), residuals(fit, matches), atol=1e-9
    )


def test_wrong_input_is_named(turned):
    model, theta, matches = turned
    flat = np.zeros_like(theta)
    with pytest.raises(DegenerateError, match="neighbouring pixels to one position"):
        pixel_shifts(Solution(model, flat), matches)
    bare = table(matches.x, matches.y, matches.u, matches.v, unit="arcsec")
    with pytest.raises(InputError, match="in arcsec, but the model is in pix"):
        pixel_shifts(Solution(model, theta), bare)
