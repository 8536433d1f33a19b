"""Structure finer than the functions: what neighbouring stars say once the rest is taken out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from bayesdist.calibration.chip_map import FurtherError
from bayesdist.diagnose.correlated import Discrepancy, estimate_discrepancy
from bayesdist.diagnose.correlated.neighbours import _below
from bayesdist.diagnose.correlated.priors import StructureFunctions, legendre_products
from bayesdist.utils.random import correlation_at, drawn_fields, matern

from .skies import SIGMA, SIZE, Map, matched, scaled


def field(rng: np.random.Generator, length: float, rms: float) -> Map:
    """A Matern field on both axes, by the waves of its spectral density."""

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        phases = np.stack([x, y], axis=1) @ k
        return rms * np.sqrt(2 / 500) * np.stack([np.cos(phases + p).sum(1) for p in phase], 1)

    k = (rng.normal(size=(500, 2)) / length * np.sqrt(3 / rng.chisquare(3, 500))[:, None]).T
    phase = rng.uniform(0, 2 * np.pi, (2, 500))
    return at


def higher_orders(rng: np.random.Generator, rms: float) -> Map:
    """Legendre products of the two orders above a cubic."""
    terms = tuple((i, d - i) for d in (4, 5) for i in range(d + 1))
    c = rms / np.sqrt(len(terms)) * rng.normal(size=(2, len(terms)))
    return lambda x, y: legendre_products(scaled(x), scaled(y), terms) @ c.T


def separations(fit, true: Map, found: Discrepancy, rng: np.random.Generator):
    """Errors of the separations of stars 20 to 60 pixels apart, and those that are stated."""
    x, y = rng.uniform(80, SIZE - 80, (2, 150))
    away, angle = rng.uniform(20, 60, 150), rng.uniform(0, 2 * np.pi, 150)
    x, y = (np.concatenate([z, z + away * f(angle)]) for z, f in ((x, np.cos), (y, np.sin)))
    phi = fit.model.basis().evaluate(x, y)
    structure = found.structure[1].evaluate(*fit.model.basis().scaled(x, y))
    noise = np.linalg.cholesky(found.noise + 1e-30 * np.eye(len(found.noise)))
    theta = found.structure_theta + rng.standard_normal(found.structure_theta.shape) @ noise.T
    err, stated = np.empty((2, 150)), np.empty((2, 150))
    for a in (0, 1):
        block = fit.model.coefficient_slice(1, a)
        miss = phi @ fit.mean[block] - true(x, y)[:, a]
        drawn = theta[:, block] @ phi.T + found.structure[1].coefficients[:, a] @ structure.T
        err[a] = miss[150:] - miss[:150]
        stated[a] = np.sqrt(np.mean((drawn[:, 150:] - drawn[:, :150]) ** 2, axis=0))
    return err, stated


@pytest.mark.parametrize("kind", ["fine", "smooth"])
def test_separations_of_neighbours(kind, full):
    """A pattern of 30 pixels is not lost, and orders beyond the model's are no pattern."""
    errors, inside = [], []
    for seed in range(6 if full else 1):
        rng = np.random.default_rng([5, seed])
        truth = field(rng, 30.0, 0.015) if kind == "fine" else higher_orders(rng, 0.01)
        fit, table, true = matched(3000 if kind == "fine" else 15000, rng, truth)
        if kind == "fine":  # as a jitter would have it
            table = table.with_errors((float(np.hypot(SIGMA, 0.015)),) * 2)
        found = estimate_discrepancy(table, fit, rng=rng, sample=table, stars=table, n_draws=500)
        err, stated = separations(fit, true, found, rng)
        errors.append((np.mean(err**2), np.mean(stated**2)))
        inside.append(np.mean(np.abs(err) < 2 * stated))
    truth_square, stated_square = np.mean(errors, axis=0)
    # one truth: its own slopes scatter by a tenth or two
    most = 1.25 if full else 1.5
    assert 1 / most < np.sqrt(stated_square / truth_square) < most
    assert np.mean(inside) > (0.88 if full else 0.75)


def test_the_part_below_a_frequency_is_an_integral():
    """The spectral density of the field, by adaptive quadrature; all of it is the correlation."""
    length, cut, d = 0.1, 20.0, np.array([0.0, 0.03, 0.1])
    k2 = 3 / length**2
    for separation, got in zip(d, _below(cut, length, d), strict=True):

        def density(k, s=separation):
            return 3 * k * k2**1.5 * (k2 + k**2) ** -2.5 * j0(k * s)

        assert got == pytest.approx(quad(density, 0, cut)[0], abs=1e-9)
        assert quad(density, 0, 4000, limit=2000)[0] == pytest.approx(
            matern(np.array(separation / length)), abs=2e-6
        )
    functions = StructureFunctions(3, (2048.0, 2048.0), 20)
    whole = 1 - _below(functions.cut, length, np.zeros(1))[0]
    assert functions.finer(length) == pytest.approx(whole, rel=1e-9)


@pytest.mark.parametrize("length", [0.02, 0.1, 0.6])
def test_waves_have_the_spectrum_of_the_field(length):
    """Their covariance by separation, averaged over directions and choices of the waves."""
    functions = StructureFunctions(3, (2048.0, 2048.0), 20)
    separation = np.array([0.0, 0.3, 0.6]) / functions.cut
    got = np.zeros(3)
    for seed in range(200):
        waves = functions.finer_waves(np.random.default_rng(seed))
        variance = functions.finer_spectrum(length, waves)
        phase = np.hypot(*waves.T)[:, None] * separation
        got += (variance[:, None] * j0(phase)).mean(axis=0) / 200
    expected = matern(separation / length) - _below(functions.cut, length, separation)
    np.testing.assert_allclose(got, expected, rtol=0.03, atol=0.01 * expected[0])


def test_drawn_fields_have_their_correlation():
    rng, n = np.random.default_rng(1), 4000
    at = np.column_stack([np.linspace(0, 300, 7), np.zeros(7)])
    correlation = [(0.3, 20.0), (0.5, 150.0)]
    drawn = drawn_fields(at, correlation, n, rng)
    expected = correlation_at(np.abs(at[:, 0, None] - at[:, 0]), correlation)
    assert np.abs(drawn @ drawn.T / n - expected).max() < 4.5 * np.sqrt(2 / n)


def test_a_row_knows_its_correlation():
    row = FurtherError("unmodelled structure", "local", 1.0, 2.0, correlation=((0.5, 10.0),))
    assert not row.shared and correlation_at(np.zeros(1), row.correlation)[0] == 0.5
