"""Wide fields: exposures see the sky on their own tangent planes, here as astropy.wcs has them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

from bayesdist.diagnose.selfcal.score import selfcal_score_tests
from bayesdist.infer.selfcal import self_calibrate
from bayesdist.infer.selfcal.sky_moves import gauge_free_matrix
from bayesdist.infer.selfcal.tangent import TangentPlane
from bayesdist.model import Chip, DistortionModel
from tests.infer.selfcal.wide import (
    ARCSEC,
    DEC,
    MIDDLE,
    RA,
    E,
    N,
    camera,
    observed,
    on,
    tangent_plane,
)
from tests.reduced import only_in_full


@pytest.mark.parametrize("point", [None, (300.0, -200.0)])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.1, 0.0), (-0.5, 0.8)])
def test_planes_are_taken_to_one_as_by_astropy(offset, point):
    """Of a field of a degree or two, to some millionths of a second of arc."""
    rng, origin = np.random.default_rng(1), (5.0, 7.0)
    ra, dec = RA + offset[0], DEC + offset[1]
    sky = np.column_stack([ra + rng.uniform(-1, 1, 200), dec + rng.uniform(-1, 1, 200)])
    common, zero = tangent_plane(RA, DEC), np.array(origin if point is None else point)
    [touches], truth = (on(common, at) + zero for at in ([[ra, dec]], sky))
    model = DistortionModel(
        1, (Chip(1, "C", (N, N), (MIDDLE, MIDDLE)),), unit="arcsec", frames="shift_rotation",
        exposures=("a", "b"), origin=origin,
    )  # fmt: skip
    theta, first = np.zeros(model.n_params), model.frame_slice(1).start
    theta[first : first + 2] = touches - origin
    plane, seen = TangentPlane(1.0, point), on(tangent_plane(ra, dec), sky)

    def off(angle):
        """With the axes of the exposure's plane turned by this."""
        c, s = np.cos(angle), np.sin(angle)
        flat = touches + seen @ np.array([[c, s], [-s, c]])
        return flat + plane.displacements(model, theta, flat, 1) - truth

    best = minimize_scalar(lambda angle: (off(angle) ** 2).sum(), (-0.02, 0.02), tol=1e-14)
    assert np.abs(off(best.x)).max() < 5e-6


def _start(detections, pointings, rolls):
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
    at = on(tangent_plane(*pointings[0], rolls[0], ARCSEC), pointings)
    for e in range(1, E):
        theta[model.frame_slice(e)] = [*at[e], rolls[e] - rolls[0]]
    return model, theta


def _chi2(found, bends):
    """Chi-square of relative positions against the true camera, and its degrees of freedom."""
    theta, model = found.mode.theta, found.mode.problem.model
    null, at = found.gauge.null, (np.arange(20) + 0.5) * N / 20 + 0.5
    x, y = (z.ravel() for z in np.meshgrid(at, at))
    first = np.zeros(len(x), np.int64)
    off = np.ravel(camera(bends, x, y) - model.predict(theta, x, y, exposure=first))
    J = model.jacobian(theta, x, y, exposure=first).reshape(-1, model.n_params)
    off = off - J @ null @ np.linalg.lstsq(J @ null, off, rcond=None)[0]
    S = gauge_free_matrix(model, theta, null)
    values, vectors = np.linalg.eigh(J @ S @ found.mode.cov @ S.T @ J.T)
    n = model.n_polynomial - null.shape[1]
    return ((vectors[:, -n:].T @ off) ** 2 / values[-n:]).sum(), n


def _pointing_test(found):
    return next(t for t in selfcal_score_tests(found.mode) if t.name == "pointing")


@pytest.mark.slow
@only_in_full("tests/app/selfcal/test_wide_field has one")
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
