"""Wide fields: exposures see the sky on their own tangent planes, here as astropy.wcs has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

from bayesdist.infer.solution.transforms import gauge_free_matrix
from bayesdist.kinds.selfcal.diagnose.tests import selfcal_score_tests
from bayesdist.kinds.selfcal.infer import self_calibrate
from bayesdist.kinds.selfcal.infer.problem import TangentPlane
from bayesdist.model import Chip, DistortionModel
from tests.kinds.selfcal.infer.wide import (
    ARCSEC,
    DEC,
    MIDDLE,
    RA,
    SIGMA,
    N,
    camera,
    observed,
    on,
    tangent_plane,
)
from tests.reduced import only_in_full

WIDE_ARCSEC = 68 * 60 / N


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.1, 0.0), (-0.5, 0.8)])
def test_planes_are_taken_to_one_as_by_astropy(offset):
    """Of a field of a degree or two, to some millionths of a second of arc."""
    rng, zero = np.random.default_rng(1), np.array([300.0, -200.0])
    ra, dec = RA + offset[0], DEC + offset[1]
    sky = np.column_stack([ra + rng.uniform(-1, 1, 200), dec + rng.uniform(-1, 1, 200)])
    common = tangent_plane(RA, DEC)
    [touches], truth = (on(common, at) + zero for at in ([[ra, dec]], sky))
    plane, seen = TangentPlane(1.0), on(tangent_plane(ra, dec), sky)

    def off(angle):
        """With the axes of the exposure's plane turned by this."""
        c, s = np.cos(angle), np.sin(angle)
        flat = touches + seen @ np.array([[c, s], [-s, c]])
        return flat + plane.displacements(flat, touches, zero) - truth

    best = minimize_scalar(lambda angle: (off(angle) ** 2).sum(), (-0.02, 0.02), tol=1e-14)
    assert np.abs(off(best.x)).max() < 5e-6


def _start(detections, pointings, rolls, arcsec=ARCSEC):
    """Model, and parameters without distortion: exposures lie as they were pointed."""
    model = DistortionModel(
        3, (Chip(1, "C", (N, N), (MIDDLE, MIDDLE)),), unit="pix", frames="shift_rotation",
        exposures=detections.exposure_names,
    )  # fmt: skip
    theta, basis = np.zeros(model.n_params), model.basis(1)
    nodes = np.linspace(1, N, 6)
    x, y = (z.ravel() for z in np.meshgrid(nodes, nodes))
    for axis, values in enumerate((x - MIDDLE, y - MIDDLE)):
        fitted = np.linalg.lstsq(basis.evaluate(x, y), values, rcond=None)[0]
        theta[model.coefficient_slice(1, axis)] = fitted
    at = on(tangent_plane(*pointings[0], rolls[0], arcsec), pointings)
    for e in range(1, len(pointings)):
        theta[model.frame_slice(e)] = [*at[e], rolls[e] - rolls[0]]
    return model, theta


def _grid(model, theta):
    """Pixels x, y (400,) of the first exposure, and derivatives (800, D) of their positions."""
    at = (np.arange(20) + 0.5) * N / 20 + 0.5
    x, y = (z.ravel() for z in np.meshgrid(at, at))
    J = model.jacobian(theta, x, y, exposure=np.zeros(len(x), np.int64))
    return x, y, J.reshape(-1, model.n_params)


def _without(moves, values):
    """Values (M,) without their part in the span of moves (M, d)."""
    return values - moves @ np.linalg.lstsq(moves, values, rcond=None)[0]


def _chi2(found, bends):
    """Chi-square of relative positions against the true camera, and its degrees of freedom."""
    theta, model = found.mode.theta, found.mode.problem.model
    null = found.gauge.null
    x, y, J = _grid(model, theta)
    predicted = model.predict(theta, x, y, exposure=np.zeros(len(x), np.int64))
    off = _without(J @ null, np.ravel(camera(bends, x, y) - predicted))
    S = gauge_free_matrix(model, theta, null)
    values, vectors = np.linalg.eigh(J @ S @ found.mode.cov @ S.T @ J.T)
    n = model.n_polynomial - null.shape[1]
    return ((vectors[:, -n:].T @ off) ** 2 / values[-n:]).sum(), n


def _pointing_test(found):
    return next(t for t in selfcal_score_tests(found.mode) if t.name == "pointing")


def _degree_wide(seed):
    """A field of 68 minutes of arc with steps of 27."""
    given = {"step_deg": 27 / 60, "n_stars": 300, "n_exposures": 6}
    return observed(seed, arcsec=WIDE_ARCSEC, **given)


def _solved(detections, pointings, rolls):
    model, theta = _start(detections, pointings, rolls, WIDE_ARCSEC)
    plane = TangentPlane(WIDE_ARCSEC)
    given = {"match_radius": 1.0, "start_radius": 50.0}
    return self_calibrate(model, detections, theta, plane=plane, **given)


def test_positions_in_a_field_of_a_degree_are_covered_and_the_first_exposure_is_any():
    """The camera that astropy.wcs projects, and the same numbers with the exposures reversed."""
    detections, pointings, rolls, bends = _degree_wide(1)
    found = _solved(detections, pointings, rolls)
    chi2, dof = _chi2(found, bends)
    low, high = stats.chi2.ppf([0.001, 0.999], dof)
    assert low < chi2 < high
    last = len(pointings) - 1
    other = replace(detections, exposure=last - detections.exposure)
    turned = _solved(other, pointings[::-1], rolls[::-1])
    model = found.mode.problem.model
    held = [model.names[k] for k in found.gauge.held]
    assert held == [model.names[k] for k in turned.gauge.held]
    x, y, J = _grid(model, found.mode.theta)
    first = np.zeros(len(x), np.int64)
    a, b = (
        one.mode.problem.model.predict(one.mode.theta, x, y, exposure=first)
        for one in (found, turned)
    )
    assert np.abs(_without(J @ found.gauge.null, np.ravel(b - a))).max() < 1e-4 * SIGMA


@pytest.mark.slow
@only_in_full("tests/kinds/selfcal/runs/test_wide_field has one")
def test_a_wide_field():
    """A field of 19 minutes of arc, steps of 8: half a hundredth of a pixel if it were flat."""
    total, dof, p_values = 0.0, 0, []
    n_fields = 4
    for seed in range(n_fields):
        detections, pointings, rolls, bends = observed(seed)
        model, theta = _start(detections, pointings, rolls)
        given = {"match_radius": 1.0, "start_radius": 20.0}
        found = self_calibrate(model, detections, theta, plane=TangentPlane(ARCSEC), **given)
        chi2, n = _chi2(found, bends)
        total, dof = total + chi2, dof + n
        p_values.append(_pointing_test(found).p_value)
        if seed == 0:  # of a sky that is taken as flat the residuals say so
            flat = self_calibrate(model, detections, theta, **given)
            wrong, _ = _chi2(flat, bends)
            assert wrong > stats.chi2.isf(1e-9, n)
            told = _pointing_test(flat)
            assert told.significant and told.p_value < 1e-6
            assert "scale_mas" in told.remedy
    assert dof == n_fields * 16
    low, high = stats.chi2.ppf([0.001, 0.999], dof)
    assert low < total < high
    assert min(p_values) > 0.001 / n_fields
