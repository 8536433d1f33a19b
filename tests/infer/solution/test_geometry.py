"""Geometry of a fitted chip against numbers from which the test builds its map."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.infer.solution.geometry import geometry_of, refuse_geometry
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.model import Chip, DistortionModel

SIZE = (1000, 800)
REFERENCE = (500.5, 400.5)


def solution(linear, cubic=0.0, unit="arcsec"):
    """Map with a linear part, and a radial term of some pixels per pixel^3."""
    model = DistortionModel(3, (Chip(1, "chip", SIZE, REFERENCE),), unit)
    basis = model.basis(1)
    x, y = (z.ravel() for z in np.meshgrid(np.linspace(1, 1000, 12), np.linspace(1, 800, 12)))
    d = np.array([x - REFERENCE[0], y - REFERENCE[1]])
    plane = np.asarray(linear) @ (d * (1 + cubic * (d**2).sum(axis=0)))
    theta = np.zeros(model.n_params)
    coefficients = np.linalg.lstsq(basis.evaluate(x, y), plane.T, rcond=None)[0]
    for axis in (0, 1):
        theta[model.coefficient_slice(1, axis)] = coefficients[:, axis]
    return GaussianSolution(model, theta, np.zeros((theta.size, theta.size)))


def turned(angle, scale_x=0.15, scale_y=0.15, parity=1):
    """North through east; u grows to the east, so that a direct image has parity -1."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, s], [-s, c]]) @ np.diag([parity * scale_x, scale_y])


@pytest.mark.parametrize("parity", [1, -1])
@pytest.mark.parametrize("angle", [0.0, 30.0, -100.0])
def test_scales_angle_and_parity_are_those_of_the_map(angle, parity):
    g = geometry_of(solution(turned(angle, 0.15, 0.16, parity)))
    assert (g.scale_x, g.scale_y) == pytest.approx((0.15, 0.16), rel=1e-9)
    assert g.position_angle == pytest.approx(angle, abs=1e-8) and g.parity == parity
    assert g.skew == pytest.approx(0, abs=1e-9) and g.distortion == pytest.approx(0, abs=1e-6)
    assert g.mean_scale == pytest.approx(np.sqrt(0.15 * 0.16), rel=1e-9)
    assert g.sentence.startswith("scale 150.000 x 160.000 mas/px")
    assert len(g.warnings) == 1 and "the pixel is 150.000 x 160.000" in g.warnings[0]
    assert geometry_of(solution(turned(angle, 0.15, 0.157, parity))).warnings == []


def test_skewed_axes_are_a_warning():
    g = geometry_of(solution(0.15 * np.array([[1.0, np.sin(0.2)], [0.0, np.cos(0.2)]])))
    assert abs(g.skew) == pytest.approx(0.2, rel=1e-6)
    assert any("degrees apart" in text for text in g.warnings)


def test_the_largest_distortion_is_in_pixels():
    """Of a cubic lens, against a linear fit over pixels of a finer grid."""
    cubic = 4e-7
    g = geometry_of(solution(turned(20.0), cubic))
    x, y = (
        z.ravel() for z in np.meshgrid(np.linspace(0.5, 1000.5, 41), np.linspace(0.5, 800.5, 41))
    )
    d = np.array([x - REFERENCE[0], y - REFERENCE[1]])
    moved = (d * (1 + cubic * (d**2).sum(axis=0))).T
    design = np.column_stack([np.ones_like(x), *d])
    rest = moved - design @ np.linalg.lstsq(design, moved, rcond=None)[0]
    scale = g.mean_scale / 0.15
    assert g.distortion == pytest.approx(np.hypot(*rest.T).max() / scale, rel=0.05)
    assert any("half its diagonal" in text for text in g.warnings)


@pytest.mark.parametrize("angle", [0.0, 45.0, 77.0])
def test_right_ascensions_in_hours_are_refused_at_any_roll(angle):
    hours = np.diag([1 / 15, 1.0]) @ turned(angle, 0.43, 0.43)
    with pytest.raises(InputError, match=r"are read as degrees.*multiply ra by 15"):
        refuse_geometry(
            [geometry_of(solution(hours))], scale_mas=None, tangent_point=(202.5, 47.2), where="t"
        )


def test_a_stated_scale_is_that_of_the_fit():
    chips = [geometry_of(solution(turned(30.0)))]
    with pytest.raises(InputError, match=r"scale_mas: .*given as 400 mas.*fit is 150\.00 mas"):
        refuse_geometry(chips, scale_mas=400.0, tangent_point=(202.5, 47.2), where="t")
    refuse_geometry(chips, scale_mas=151.0, tangent_point=(202.5, 47.2), where="t")
    pixels = [geometry_of(solution(turned(30.0, 1.0, 1.0), unit="pix"))]
    refuse_geometry(pixels, scale_mas=400.0, tangent_point=None, where="t")
