"""Expected covariances: what is free by symmetry, and what is known beforehand by closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.data.detections import Detections
from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer.mode import expected_solution
from bayesdist.kinds.selfcal.infer.prior import frame_prior
from bayesdist.kinds.selfcal.patterns.exposures import (
    dithered_model,
    flat_coefficients,
    sky_seen,
    stars_on_detector,
)
from tests.kinds.selfcal.infer.fields import SIZE, chips

RNG = np.random.default_rng(8)
SPREAD = np.concatenate([np.zeros((1, 2)), RNG.uniform(-500, 500, (8, 2))])
NOWHERE = np.zeros((9, 2))
ROLLS = np.radians(np.tile([0.0, 60.0, 130.0], 3))
NO_ROLLS = np.zeros(9)


def _expected(offsets, rolls, frames="shift_rotation", order=3, information=None, seed=1):
    flat = flat_coefficients(order, chips())
    model, truth = dithered_model(chips(), flat, offsets, rolls, frames=frames)
    low, high = sky_seen(model, truth)
    rng = np.random.default_rng(seed)
    n = int(300 * np.prod(high - low) / np.prod(SIZE))
    sky = low + rng.uniform(size=(n, 2)) * (high - low)
    x, y, exposure, chip, star = stars_on_detector(model, truth, sky)
    detections = Detections(
        x, y, exposure, model.exposures, chip, sigma=np.full(len(x), 0.02), star=star
    )
    known = information(model, truth) if information else Prior.none(truth)
    return expected_solution(model, truth, detections, known)


def _polynomial(model, z_to_w):
    """Coefficients (2 K,) of a map of the complex plane about the detector's middle."""
    basis, middle = model.basis(), (np.array(SIZE) + 1) / 2
    x, y = (a.ravel() for a in np.meshgrid(*(np.linspace(1, s, 9) for s in SIZE)))
    w = z_to_w(((x - middle[0]) + 1j * (y - middle[1])) / SIZE[0])
    fit = np.linalg.lstsq(basis.evaluate(x, y), np.stack([w.real, w.imag], axis=1), rcond=None)[0]
    return fit.T.ravel()


# What a detector cannot know without a catalogue, from symmetry.  Rolls about the middle alone
# leave f free where f(r z) = r f(z): z, i z, z |z|^2 and i z |z|^2 up to the third degree.  Dithers
# without rolls leave all linear maps free; where each exposure has a scale of its own also z^2 and
# i z^2, which a dither by d changes by 2 d z, a rotation and a scale.
LINEAR = (lambda z: z, lambda z: 1j * z)
SKEWS = (lambda z: z.conj(), lambda z: 1j * z.conj())
RADIAL = (lambda z: z * abs(z) ** 2, lambda z: 1j * z * abs(z) ** 2)
CONFORMAL = (lambda z: z**2, lambda z: 1j * z**2)
CONSTANT = (lambda z: z**0, lambda z: 1j * z**0)


@pytest.mark.parametrize(
    ("offsets", "rolls", "frames", "free"),
    [
        (NOWHERE, ROLLS, "shift_rotation", LINEAR + RADIAL),
        (SPREAD, NO_ROLLS, "shift_rotation", LINEAR + SKEWS),
        (SPREAD, NO_ROLLS, "shift_rotation_scale", LINEAR + SKEWS + CONFORMAL),
        (SPREAD, ROLLS, "shift_rotation", LINEAR),
        (SPREAD, ROLLS, "shift_rotation_scale", LINEAR),
    ],
    ids=["rolls alone", "no rolls", "no rolls, scales free", "both", "both, scales free"],
)
def test_free_directions_are_those_of_symmetry(offsets, rolls, frames, free):
    found = _expected(offsets, rolls, frames)
    n = found.model.n_polynomial
    wanted = np.stack([_polynomial(found.model, f) for f in CONSTANT + free], axis=1)
    null = found.gauge.null[:n]
    assert found.gauge.null.shape[1] == wanted.shape[1]
    # one space: each holds the other
    for a, b in ((null, wanted), (wanted, null)):
        Q, _ = np.linalg.qr(b)
        left = a - Q @ (Q.T @ a)
        assert np.abs(left).max() < 1e-5 * np.abs(a).max()
    # z |z|^2 has a skew about a reference pixel off its middle, but the sky has none
    said = any("skew of the distortion" in text for text in found.gauge.sentences)
    assert said == set(SKEWS).issubset(free)


def test_commanded_rolls_add_as_independent_measurements():
    sigma, E = 1e-5, 9
    known = _expected(
        SPREAD,
        ROLLS,
        information=lambda m, t: frame_prior(m, t, "rotation", ROLLS, sigma),
    )
    free = _expected(SPREAD, ROLLS)
    # the zero point of the commands is unknown: of rotation on the sky they say nothing
    assert known.gauge.free_names == free.gauge.free_names
    assert known.gauge.open.shape == free.gauge.open.shape
    at = [known.model.frame_slice(e).start + 2 for e in range(1, E)]
    alone = np.linalg.inv(free.cov[np.ix_(at, at)])
    # of differences from the first one, E commands of one error have the covariance 1 + delta_ef
    commands = np.linalg.inv(np.eye(E - 1) + np.ones((E - 1, E - 1))) / sigma**2
    both = np.linalg.inv(alone + commands)
    assert known.cov[np.ix_(at, at)] == pytest.approx(both, rel=1e-6, abs=1e-9 * both.max())


def test_the_same_errors_up_to_free_directions_in_every_gauge():
    """A solution moved along free directions has the same gauge-free covariance."""
    found = _expected(SPREAD, NO_ROLLS)
    null = found.gauge.null
    mix = RNG.normal(size=(found.model.n_params, null.shape[1]))
    mix /= np.linalg.norm(mix, axis=0)
    other = np.eye(len(found.mean)) - null @ np.linalg.solve(mix.T @ null, mix.T)
    moved = replace(found, cov=other @ found.cov @ other.T)
    a, b = found.up_to(null), moved.up_to(null)
    n = found.model.n_polynomial
    assert b[:n, :n] == pytest.approx(a[:n, :n], rel=1e-4, abs=1e-6 * np.abs(a[:n, :n]).max())
    # the skews are open: nothing bounds the shape
    assert found.bounded_by(null) and not found.bounded_by(null[:, :0])
