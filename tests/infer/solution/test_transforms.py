"""Views of solutions: the same positions, other parameters, and an honest covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import (
    linear_terms,
    lines,
    reference_gauge,
    segment,
    without_frames,
)
from bayesdist.model import Chip, DistortionModel, TimeDependence

from ..small_campaign import seen_by

CHIPS = (
    Chip(1, "WFC1", (4096.0, 2048.0), (2048.0, 1024.0)),
    Chip(2, "WFC2", (4096.0, 2048.0), (2048.0, 1024.0)),
)
TIME = TimeDependence((("u", 1, 0), ("v", 1, 0), ("v", 0, 1)), (2004.5, 2012.5), (2009.4,))
EPOCHS = (2003.0, 2008.5, 2010.0, 2014.0)

# Tables 1-3 of ACS ISR 2015-06: alpha and beta of A_2, B_3, B_2 before and after SM4
TABLES = {
    1: (
        [(0.98205648, -9.22e-6), (0.97263238, 2.42e-6), (0.080947069, 3.617e-5)],
        [(0.98196909, -2.18e-5), (0.97263233, -1.12e-6), (0.081139194, 3.235e-5)],
    ),
    2: (
        [(0.99468101, -9.16e-6), (1.00622300, 3.30e-6), (0.068598586, 3.532e-5)],
        [(0.99459657, -2.26e-5), (1.00621870, -8.04e-7), (0.068779336, 3.070e-5)],
    ),
}
TERMS = (("u", 1, 0, "A_2"), ("v", 0, 1, "B_3"), ("v", 1, 0, "B_2"))


@dataclass(frozen=True, eq=False)
class Gaussian(Solution):
    """A solution of given mean and covariance."""

    model: DistortionModel
    mean: np.ndarray
    cov: np.ndarray

    def draws(self, n, rng):
        return rng.multivariate_normal(self.mean, self.cov, size=n, method="cholesky")


class Judged(Gaussian):
    convergence = "judged"


def acs(seed=1, *, angle=0.0, shift=(0.0, 0.0), kind=Gaussian, frames="affine"):
    """Two chips with the published linear terms; the whole turned by an angle and shifted."""
    rng = np.random.default_rng(seed)
    model = DistortionModel(
        4, CHIPS, time=TIME, frames=frames, exposures=("a", "b", "c"), origin=(100.0, 50.0)
    )
    mean = np.zeros(model.n_params)
    for chip in CHIPS:
        basis = model.basis(chip.number)
        both = np.zeros((2, model.n_terms))
        high = rng.standard_normal((2, model.n_terms))
        for k, (i, j) in enumerate(basis.terms):
            if i + j > 1:
                both[:, k] = 30 * high[:, k] / 2048.0 ** (i + j)
        both[1, 0] = 2079.58 if chip.number == 1 else 0.0
        both[0, 2] = 1.2e-3 if chip.number == 1 else 0.0  # A_3
        before, after = TABLES[chip.number]
        drift = []
        for k, (axis, i, j, _) in enumerate(TERMS):
            both["uv".index(axis), basis.terms.index((i, j))] = before[k][0]
            half = 2048.0 if i else 1024.0
            drift.append(np.array([before[k][1], after[k][0] - before[k][0], after[k][1]]) * half)
        order = [TERMS.index(next(t for t in TERMS if t[:3] == term)) for term in TIME.terms]
        mean[model.tdd_slice(chip.number)] = np.concatenate([drift[k] for k in order])
        for axis in (0, 1):
            mean[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(both[axis])
    for e in (1, 2):
        mean[model.frame_slice(e)] = [3.0, -2.0, 1e-3, 0.4 * e, 2e-3, -1e-3]
    if angle or any(shift):
        assert frames == "affine"
    size = np.where([p.kind == "frame" for p in model.parameters], 1e-6, 1e-3)
    a = rng.standard_normal((model.n_params, model.n_params)) / np.sqrt(model.n_params)
    return kind(model, mean, size[:, None] * (a @ a.T + 0.1 * np.eye(len(a))) * size)


def turned(solution, angle, shift):
    """A solution without time dependence whose (u, v) are rotated and shifted."""
    model = solution.model
    assert model.time is None and model.frames == "none"
    n, K = model.n_params, model.n_terms
    T = np.zeros((n, n))
    c, s = np.cos(angle), np.sin(angle)
    for chip in model.chips:
        u, v = (model.coefficient_slice(chip.number, axis) for axis in (0, 1))
        T[u, u] = T[v, v] = c * np.eye(K)
        T[u, v], T[v, u] = -s * np.eye(K), s * np.eye(K)
    mean = T @ solution.mean
    for chip in model.chips:
        for axis in (0, 1):
            mean[model.coefficient_slice(chip.number, axis)][0] += shift[axis]
    return Gaussian(model, mean, T @ solution.cov @ T.T)


def pixels(n=40, seed=3):
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 4096, n), rng.uniform(1, 2048, n)


def jacobian_by_differences(transform, theta, size):
    out = []
    for k in range(len(theta)):
        e = np.zeros(len(theta))
        e[k] = size[k]
        out.append((transform(theta + e) - transform(theta - e)) / (2 * size[k]))
    return np.stack(out, axis=-1)


# -- the reference gauge --------------------------------------------------------------------------


def a_static(seed=2):
    """Polynomials alone, with any orientation."""
    source = acs(seed)
    seen = seen_by("b", 2005.0, source.model, source.mean)
    n = seen.model.n_params
    return Gaussian(seen.model, seen.mean, source.cov[:n, :n])


@pytest.mark.parametrize("chip", [1, 2])
@pytest.mark.parametrize("epoch", [None, 2013.0])
def test_in_the_reference_gauge_the_chip_has_no_offset_and_no_rotation(chip, epoch):
    view = reference_gauge(acs(), chip, epoch=epoch)
    terms = linear_terms(view, chip, epoch=epoch or 2004.5)
    value = dict(zip(terms.labels, terms.values, strict=True))
    assert abs(value["A_1"]) < 1e-10 and abs(value["B_1"]) < 1e-10 and abs(value["A_3"]) < 1e-14
    assert value["B_3"] > 0
    # what is zero by definition has no error
    fixed = terms.select("A_1", "B_1", "A_3").sigma
    # but for rounding, of which a square root makes much
    assert (fixed < 1e-6 * terms.select("A_2").sigma * np.array([2048.0, 2048.0, 1.0])).all()
    assert view.gauge.epoch == (epoch or 2004.5) and view.gauge.chip == chip


def test_the_gauge_is_a_rigid_motion_of_all_chips_at_all_epochs():
    source = acs()
    view = reference_gauge(source, 1)
    g = view.gauge
    turn = np.array(
        [
            [np.cos(g.rotation), -np.sin(g.rotation)],
            [np.sin(g.rotation), np.cos(g.rotation)],
        ]
    )
    x, y = pixels()
    for chip in (1, 2):
        for epoch in EPOCHS:
            before = source.model.predict(source.mean, x, y, epoch=epoch, chip=chip)
            after = view.model.predict(view.mean, x, y, epoch=epoch, chip=chip)
            np.testing.assert_allclose(after, (before - g.shift) @ turn.T, atol=1e-9)
    # WFC1 as the reference really turns: its A_3 is no zero
    assert g.rotation == pytest.approx(np.arctan2(1.2e-3, 0.97263238)) and g.sigma_rotation > 0


def test_covariance_is_that_of_the_exact_jacobian():
    source = acs()
    for view in (reference_gauge(source, 1), reference_gauge(source, 2, epoch=2012.0)):
        J = jacobian_by_differences(
            view.transform, source.mean, 1e-2 * np.sqrt(np.diag(source.cov))
        )
        expected = J @ source.cov @ J.T
        # A_1, B_1 and A_3 are fixed: single coefficients have errors all the same
        unit = np.sqrt(np.diag(expected))
        assert (unit > 0).all()
        np.testing.assert_allclose(
            view.cov / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-6
        )


def test_the_result_does_not_depend_on_the_orientation_before():
    """A solution turned by any angle and shifted is the same solution."""
    source = a_static()
    expected = reference_gauge(source)
    for angle, shift in ((0.3, (0.0, 0.0)), (-2.5, (400.0, -70.0)), (np.pi, (5000.0, 5000.0))):
        found = reference_gauge(turned(source, angle, shift))
        np.testing.assert_allclose(found.mean, expected.mean, atol=1e-9)
        unit = np.outer(expected.sigma, expected.sigma)
        np.testing.assert_allclose(found.cov / unit, expected.cov / unit, atol=1e-7)
        difference = expected.gauge.rotation - angle - found.gauge.rotation
        assert np.cos(difference) == pytest.approx(1, abs=1e-12)
    again = reference_gauge(expected)
    np.testing.assert_allclose(again.mean, expected.mean, atol=1e-10)
    assert abs(again.gauge.rotation) < 1e-13 and again.gauge.sigma_rotation < 1e-12


def test_draws_are_turned_one_by_one_and_have_the_covariance():
    source = acs()
    view = reference_gauge(source)
    draws = view.draws(3000, np.random.default_rng(5))
    first = source.draws(3000, np.random.default_rng(5))[:4]
    x, y = pixels(5)
    for theta, before in zip(draws[:4], first, strict=True):
        alone = reference_gauge(Gaussian(source.model, before, source.cov))
        np.testing.assert_allclose(theta, alone.mean, atol=1e-10)
        np.testing.assert_allclose(
            linear_terms(alone, 2, epoch=2004.5).values[[0, 2, 3]], 0, atol=1e-9
        )
        assert view.model.predict(theta, x, y, epoch=2005.0, chip=1).shape == (5, 2)
    # positions, since single parameters are tied by the gauge
    J = view.model.jacobian(view.mean, x, y, epoch=2013.0, chip=1).reshape(10, -1)
    S = J @ view.cov @ J.T
    error = (draws - view.mean) @ J.T
    p = stats.kstest((error @ np.linalg.inv(S) * error).sum(axis=1), stats.chi2(10).cdf).pvalue
    assert p > 1e-3


def test_errors_of_the_gauge_are_those_of_the_draws():
    source = acs()
    gauge = reference_gauge(source, 1).gauge
    theta = source.draws(300, np.random.default_rng(6))
    poses = [reference_gauge(Gaussian(source.model, t, source.cov), 1).gauge for t in theta]
    for found, sigma in (
        (np.std([p.rotation for p in poses]), gauge.sigma_rotation),
        (np.std([p.shift[0] for p in poses]), gauge.sigma_shift[0]),
        (np.std([p.shift[1] for p in poses]), gauge.sigma_shift[1]),
    ):
        assert found == pytest.approx(sigma, rel=4 / np.sqrt(2 * 300))


def test_a_rotation_makes_both_axes_drift():
    view = reference_gauge(acs(), 1)
    assert view.model.time.terms == (*TIME.terms, ("u", 0, 1))
    assert view.model.time.breaks == TIME.breaks and view.model.frames == "none"


# -- one segment ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("s", "epochs"), [(0, (2003.0, 2009.0)), (1, (2009.4, 2014.0))])
def test_a_segment_gives_the_positions_of_its_epochs(s, epochs):
    source = acs()
    view = segment(source, s)
    assert view.model.time.breaks == () and view.model.time.epoch0 == (TIME.epoch0[s],)
    x, y = pixels()
    for chip in (1, 2):
        for epoch in epochs:
            where = {"epoch": epoch, "chip": chip}
            np.testing.assert_allclose(
                view.model.predict(view.mean, x, y, **where),
                source.model.predict(source.mean, x, y, **where),
                atol=1e-9,
            )
            J = source.model.jacobian(source.mean, x, y, **where)
            V = view.model.jacobian(view.mean, x, y, **where)
            np.testing.assert_allclose(
                np.einsum("nap,pq,nbq->nab", V, view.cov, V),
                np.einsum("nap,pq,nbq->nab", J, source.cov, J),
                rtol=1e-9,
            )


def test_one_date_may_serve_all_segments():
    """The reference date of the second segment then lies before it begins."""
    model = DistortionModel(2, CHIPS[1:], time=TimeDependence((("u", 1, 0),), (2004.5,), (2009.4,)))
    theta = np.random.default_rng(8).standard_normal(model.n_params)
    view = segment(Gaussian(model, theta, np.eye(len(theta))), 1)
    x, y = pixels()
    np.testing.assert_allclose(
        view.model.predict(view.mean, x, y, epoch=2013.0),
        model.predict(theta, x, y, epoch=2013.0),
        atol=1e-12,
    )


def test_segments_that_are_not_there():
    with pytest.raises(InputError, match="no segment 2; choose one of 0 to 1"):
        segment(acs(), 2)
    with pytest.raises(InputError, match="no segment 0; the model has none"):
        segment(a_static(), 0)


# -- linear terms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("epoch", EPOCHS)
def test_linear_terms_are_the_derivatives_at_the_reference_pixel(epoch):
    source = acs()
    terms = linear_terms(source, epoch=epoch)
    assert terms.labels[:3] == ("WFC1.A_1", "WFC1.A_2", "WFC1.A_3")
    h = 0.5
    found = []
    for chip in (1, 2):
        x = 2048.0 + h * np.array([0, 1, -1, 0, 0])
        y = 1024.0 + h * np.array([0, 0, 0, 1, -1])
        p = source.model.predict(source.mean, x, y, epoch=epoch, chip=chip)
        found.append(np.stack([p[0], (p[1] - p[2]) / (2 * h), (p[3] - p[4]) / (2 * h)]).T.ravel())
    np.testing.assert_allclose(terms.values, np.concatenate(found), atol=1e-7)
    assert linear_terms(source, 2, epoch=epoch).labels[0] == "A_1"
    alone = linear_terms(source, 2, epoch=epoch).cov
    np.testing.assert_allclose(alone, terms.cov[6:, 6:], rtol=1e-12)


def test_covariance_of_linear_terms_is_that_of_the_parameters():
    source = acs()
    terms = linear_terms(source, epoch=2010.0)

    def values(theta):
        return linear_terms(Gaussian(source.model, theta, source.cov), epoch=2010.0).values

    J = jacobian_by_differences(values, source.mean, np.ones(len(source.mean)))
    expected = J @ source.cov @ J.T
    unit = np.outer(terms.sigma, terms.sigma)
    np.testing.assert_allclose(terms.cov / unit, expected / unit, atol=1e-8)


@pytest.mark.parametrize("s", [0, 1])
def test_lines_are_the_published_tables(s):
    source = acs()
    found = lines(source, s)
    for chip in CHIPS:
        for k, (_, _, _, term) in enumerate(TERMS):
            alpha, beta = TABLES[chip.number][s][k]
            pair = found.select(f"{chip.name}.{term}.alpha", f"{chip.name}.{term}.beta")
            np.testing.assert_allclose(pair.values, [alpha, beta], rtol=1e-9)
    # and a line is what it says at every date
    for epoch in (EPOCHS[:2], EPOCHS[2:])[s]:
        at = linear_terms(source, epoch=epoch)
        dt = epoch - TIME.epoch0[s]
        T = np.hstack([np.eye(12), dt * np.eye(12)])
        np.testing.assert_allclose(T @ found.values, at.values, atol=1e-11)
        np.testing.assert_allclose(T @ found.cov @ T.T, at.cov, rtol=1e-6, atol=1e-16)


def test_terms_that_do_not_drift_have_no_rate():
    found = lines(acs(), 1, chip=2).select("A_3.beta", "A_1.beta")
    assert found.labels == ("A_3.beta", "A_1.beta")
    np.testing.assert_allclose(found.values, 0, atol=1e-15)
    np.testing.assert_allclose(found.cov, 0, atol=1e-20)
    with pytest.raises(InputError, match=r"no term 'C_2'.*A_2\.alpha"):
        lines(acs()).select("C_2")


def test_without_frames_is_the_head_of_theta():
    source = acs()
    view = without_frames(source)
    n = source.model.n_distortion
    assert view.model.names == source.model.names[:n]
    np.testing.assert_array_equal(view.mean, source.mean[:n])
    np.testing.assert_allclose(view.cov, source.cov[:n, :n], rtol=1e-12)


def test_a_view_of_a_posterior_says_so():
    """A transformed posterior has its convergence, a transformed fit has none."""
    assert reference_gauge(acs(kind=Judged)).convergence == "judged"
    assert segment(reference_gauge(acs(kind=Judged)), 1).convergence == "judged"
    assert reference_gauge(acs()).convergence is None


def test_wrong_places():
    with pytest.raises(InputError, match="no chip 7"):
        reference_gauge(acs(), 7)
    with pytest.raises(InputError, match="no chip 7"):
        linear_terms(acs(), 7, epoch=2005.0)
    with pytest.raises(InputError, match="no epoch is given"):
        linear_terms(acs())
