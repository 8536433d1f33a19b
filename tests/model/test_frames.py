"""Frames of exposures: matrices, derivatives, and the nearest frame of a linear map."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.model.frames import (
    FRAME_KINDS,
    frame_matrix,
    frame_names,
    frame_tangent,
    nearest_frame,
)

PARAMETERS = {
    "none": [],
    "shift": [3.0, -2.0],
    "shift_rotation": [3.0, -2.0, 0.7],
    "shift_rotation_scale": [3.0, -2.0, 0.01, 0.7],
    "affine": [3.0, -2.0, 0.01, 0.7, -0.2, 0.04],
}


def test_all_kinds_are_tested():
    assert set(PARAMETERS) == set(FRAME_KINDS)
    for kind, p in PARAMETERS.items():
        assert len(frame_names(kind)) == len(p)


def test_matrices():
    a = 0.7
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    expected = {
        "none": np.eye(2),
        "shift": np.eye(2),
        "shift_rotation": turn,
        "shift_rotation_scale": 1.01 * turn,
        "affine": turn @ [[0.81, 0.04], [0.04, 1.21]],
    }
    for kind, p in PARAMETERS.items():
        M, d = frame_matrix(kind, p)
        np.testing.assert_allclose(M, expected[kind], rtol=1e-15)
        np.testing.assert_array_equal(d, [0, 0] if kind == "none" else [3, -2])


@pytest.mark.parametrize("kind", FRAME_KINDS)
def test_each_kind_is_a_case_of_the_next(kind):
    """The same names mean the same: what a kind does not have is zero in 'affine'."""
    value = dict(zip(frame_names(kind), PARAMETERS[kind], strict=True))
    M, d = frame_matrix(kind, PARAMETERS[kind])
    general = frame_matrix("affine", [value.get(name, 0.0) for name in frame_names("affine")])
    np.testing.assert_allclose(M, general[0], rtol=1e-15)
    np.testing.assert_array_equal(d, general[1])


def test_deviations_are_those_of_the_detector_at_any_roll():
    """What an exposure at roll a sees of a sheared detector is the rotated sight at roll zero."""
    deviations = [0.0, 0.0, 1e-3, 0.0, 2e-3, -3e-3]
    straight, _ = frame_matrix("affine", deviations)
    for a in (0.5, 2.0, -3.0):
        rolled, _ = frame_matrix("affine", [*deviations[:3], a, *deviations[4:]])
        turn, _ = frame_matrix("shift_rotation", [0, 0, a])
        np.testing.assert_allclose(rolled, turn @ straight, rtol=1e-14, atol=1e-15)
        # singular values do not see the rotation, and a small scale is their mean
        size = np.linalg.svd(rolled, compute_uv=False)
        assert size.mean() - 1 == pytest.approx(1e-3)
        assert (size[0] - size[1]) / 2 == pytest.approx(np.hypot(2e-3, 3e-3))


def test_a_rotation_turns_u_towards_v():
    M, _ = frame_matrix("shift_rotation", [0, 0, np.pi / 2])
    np.testing.assert_allclose(M @ [1, 0], [0, 1], atol=1e-15)


@pytest.mark.parametrize("kind", FRAME_KINDS)
def test_many_at_once_are_each_by_itself(kind):
    rng = np.random.default_rng(1)
    p = rng.standard_normal((4, 3, len(PARAMETERS[kind])))
    M, d = frame_matrix(kind, p)
    assert M.shape == (4, 3, 2, 2) and d.shape == (4, 3, 2)
    for k in np.ndindex(4, 3):
        np.testing.assert_array_equal(M[k], frame_matrix(kind, p[k])[0])
        np.testing.assert_array_equal(d[k], frame_matrix(kind, p[k])[1])


@pytest.mark.parametrize("kind", FRAME_KINDS)
def test_tangent_is_the_derivative(kind):
    p, step = np.array(PARAMETERS[kind], float), 1e-6
    tangent = frame_tangent(kind, p)
    assert tangent.shape == (max(len(p) - 2, 0), 2, 2)
    for k, derivative in enumerate(tangent):
        e = step * np.eye(len(p))[k + 2]
        difference = (frame_matrix(kind, p + e)[0] - frame_matrix(kind, p - e)[0]) / (2 * step)
        np.testing.assert_allclose(derivative, difference, atol=1e-9)


@pytest.mark.parametrize("kind", FRAME_KINDS)
def test_nearest_frame_of_a_frame_is_itself(kind):
    p = PARAMETERS[kind]
    np.testing.assert_allclose(nearest_frame(kind, *frame_matrix(kind, p)), p, atol=1e-14)


def test_nearest_rotation_and_similarity_minimise_the_frobenius_norm():
    """Against a scan over all angles and scales."""
    M = np.array([[0.8, -0.9], [0.6, 1.1]])
    angles = np.linspace(-np.pi, np.pi, 20001)
    rotations = frame_matrix("shift_rotation", np.stack([0 * angles, 0 * angles, angles], 1))[0]
    best = angles[((rotations - M) ** 2).sum((1, 2)).argmin()]
    assert nearest_frame("shift_rotation", M, [0, 0])[2] == pytest.approx(best, abs=1e-3)

    s, r = np.meshgrid(np.linspace(-0.5, 0.5, 401), np.linspace(0, 1.5, 601))
    p = np.stack([0 * s, 0 * s, s, r], -1)
    distance = ((frame_matrix("shift_rotation_scale", p)[0] - M) ** 2).sum((-2, -1))
    k = np.unravel_index(distance.argmin(), distance.shape)
    np.testing.assert_allclose(
        nearest_frame("shift_rotation_scale", M, [0, 0])[2:], [s[k], r[k]], atol=3e-3
    )


@pytest.mark.parametrize("seed", range(5))
def test_every_linear_map_is_an_affine_frame(seed):
    M = np.random.default_rng(seed).standard_normal((2, 2))
    again, d = frame_matrix("affine", nearest_frame("affine", M, [1.0, 2.0]))
    np.testing.assert_allclose(again, M, atol=1e-14)
    np.testing.assert_array_equal(d, [1.0, 2.0])
