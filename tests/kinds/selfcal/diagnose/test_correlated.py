"""Sums with the stars eliminated, against dense algebra with all stars explicit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.diagnose.correlated.deviations import deviation_columns
from bayesdist.diagnose.correlated.priors import StructureFunctions
from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.diagnose.eliminated import (
    AddedColumns,
    SelfcalScores,
    eliminated,
    scores_of_detections,
    squared_scores,
    without_parameters,
)
from bayesdist.kinds.selfcal.infer.elimination import Mixture
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode, gauge_of, mode_at, solve
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.model import TimeDependence
from tests.kinds.selfcal.infer.fields import field, problem_of
from tests.reduced import case_in_full

NO_FALSE = Mixture(0.0, 1e-300)


def solution_of(simulated, *, motion="none", mixture=NO_FALSE) -> SelfCalibrationMode:
    """The truth as a solution in the gauge of convention, its stars at their modes."""
    theta, n_exposures = simulated.theta, len(simulated.model.exposures)
    factors = np.random.default_rng(0).normal(size=(n_exposures, 2))
    least = 5 if motion != "none" else 2
    problem, stars = problem_of(
        simulated, motion=motion, parallax_factors=factors, min_detections=least
    )
    information = Prior.none(theta)
    held = gauge_of(problem, theta, information).held
    free = np.setdiff1d(np.arange(problem.model.n_params), held)
    return mode_at(problem, theta, stars, mixture, free, information)


def star_design(p: Problem) -> np.ndarray:
    """Places by the parameters of their stars, (N, 2, q)."""
    S = np.zeros((len(p), 2, p.n_star))
    S[:, 0, 0] = S[:, 1, 1] = 1.0
    if p.n_star >= 4:
        S[:, 0, 2] = S[:, 1, 3] = p.time
    if p.n_star == 5:
        S[:, :, 4] = p.factor
    return S


def displacement(columns: AddedColumns, theta: np.ndarray) -> np.ndarray:
    """Derivatives (N, 2, n) of places by all columns, detection by detection."""
    p, model = columns.problem, columns.problem.model
    found = p.effective_jacobian(theta)
    of_axis = [functions.n_known for functions in columns.functions.values()]
    n_deviations = 0 if columns.deviations is None else len(columns.deviations)
    out = np.zeros((len(p), 2, model.n_params + 2 * sum(of_axis) + n_deviations))
    for i, g in enumerate(p.groups.index):
        which, derivative = found[g]
        chip, epoch = int(p.groups.chip[g]), float(p.groups.epoch[g])
        basis = model.basis(model.chips[chip].number)
        phi = basis.evaluate_scaled(p.X[i : i + 1], p.Y[i : i + 1])
        out[i][:, which] = np.einsum("akm,k->am", derivative, phi[0])
        frame = derivative[:, 0, [0, model.n_terms]]
        if chip in columns.functions:
            first = model.n_params + 2 * sum(of_axis[:chip])
            values = columns.functions[chip].evaluate(p.X[i : i + 1], p.Y[i : i + 1])
            out[i][:, first : first + 2 * of_axis[chip]] = np.kron(frame, values)
        if columns.deviations is not None:
            at, moved = columns.deviations.at(int(g), chip, epoch, phi, columns.centre)
            first = model.n_params + 2 * sum(of_axis)
            out[i][:, first + at] = frame @ moved[0]
    return out


def with_drift(simulated):
    """The same field for a model whose linear terms drift."""
    model, theta = simulated.model, simulated.theta
    time = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2004.0,), ())
    at = model.n_polynomial
    theta = np.concatenate([theta[:at], [0.0, 0.0], theta[at:]])
    return replace(simulated, model=replace(model, time=time), theta=theta)


@pytest.mark.parametrize(
    ("kind", "motion"),
    [
        *((kind, "none") for kind in ("one chip", "two chips", "scale", "drift")),
        *[("one chip", "proper_motion"), ("two chips", "parallax")],
        *(
            case_in_full(kind, motion, instead="each motion is run, and each kind without any")
            for kind, motion in (
                *[("two chips", "proper_motion"), ("one chip", "parallax")],
                *((kind, m) for kind in ("scale", "drift") for m in ("proper_motion", "parallax")),
            )
        ),
    ],
)
def test_sums_are_those_with_all_stars_explicit(kind, motion, rng):
    simulated = field(
        1,
        9,
        120,
        n_chips=2 if kind == "two chips" else 1,
        frames="shift_rotation_scale" if kind == "scale" else "shift_rotation",
        epochs=np.linspace(2002.0, 2006.0, 9),
        disturbed=0.03,
    )
    if kind == "drift":
        simulated = with_drift(simulated)
    solution = solution_of(simulated, motion=motion, mixture=Mixture(0.002, 0.03))
    p, theta, model = solution.problem, solution.theta, solution.problem.model
    functions = {
        c: StructureFunctions(model.order, chip.size, 6) for c, chip in enumerate(model.chips)
    }
    counts = np.bincount(p.groups.index, minlength=len(p.groups)).astype(float)
    columns = AddedColumns(p, theta, functions, deviation_columns(model, theta, p.groups, counts))
    working = scores_of_detections(solution)
    scores = working.flattened(rng.uniform(0.7, 2.0, len(p)))
    N, score, taken = eliminated(columns, scores, solution.stars, working=working)

    Z, S = displacement(columns, theta), star_design(p)
    n, q = Z.shape[2], p.n_star
    whole = np.zeros((len(p), 2, n + q * p.n_stars))
    whole[:, :, :n] = Z
    for i, s in enumerate(p.star):
        whole[i, :, n + q * s : n + q * (s + 1)] = -S[i]

    def sums(one: SelfcalScores) -> tuple[np.ndarray, np.ndarray]:
        matrix = np.einsum("nai,nab,nbj->ij", whole, one.curvature, whole, optimize=True)
        pull = np.einsum("nai,na->i", whole, one.gradient)
        for s in range(p.n_stars):
            at = slice(n + q * s, n + q * (s + 1))
            matrix[at, at] += p.priors.precision[s]
            pull[at] += p.priors.precision[s] @ (p.priors.centre[s] - solution.stars[s])
        inner = matrix[n:, n:]
        scale = 1 / np.sqrt(np.diag(inner))
        inverse = np.linalg.pinv(inner * np.outer(scale, scale), rcond=1e-10, hermitian=True)
        through = matrix[:n, n:] @ (inverse * np.outer(scale, scale))
        return matrix[:n, :n] - through @ matrix[n:, :n], pull[:n] - through @ pull[n:]

    dense, right = sums(scores)
    unit = np.sqrt(np.diag(dense))
    np.testing.assert_allclose(N / unit / unit[:, None], dense / unit / unit[:, None], atol=1e-8)
    np.testing.assert_allclose(score / unit, right / unit, atol=1e-8 * np.abs(right / unit).max())
    D = model.n_params
    other = sums(working)[0]
    np.testing.assert_allclose(
        taken / unit / unit[:D, None], other[:D] / unit / unit[:D, None], atol=1e-8
    )
    # parameters eliminated, as held by the gauge
    found = without_parameters(solution, N, score)
    S_left, score_left = found.information, found.score
    free, rest = solution.free, np.arange(D, n)
    through = dense[np.ix_(rest, free)] @ np.linalg.inv(dense[np.ix_(free, free)])
    left = dense[np.ix_(rest, rest)] - through @ dense[np.ix_(free, rest)]
    unit = np.sqrt(np.diag(dense)[rest])
    np.testing.assert_allclose(
        S_left / unit / unit[:, None], left / unit / unit[:, None], atol=1e-8
    )
    np.testing.assert_allclose(
        score_left / unit,
        (right[rest] - through @ right[free]) / unit,
        atol=1e-8 * np.abs(right[rest] / unit).max(),
    )


def test_information_of_the_parameters_is_that_of_the_expansion():
    solution = solution_of(field(2, 8, 150))
    columns = AddedColumns(solution.problem, solution.theta)
    N, score, _ = eliminated(columns, scores_of_detections(solution), solution.stars)
    known = solution.expansion
    assert np.abs(N - known.curvature).max() < 1e-9 * np.abs(known.curvature).max()
    scale = np.sqrt(np.diag(known.curvature))
    assert np.abs((score - known.gradient) / scale).max() < 1e-6


def test_sandwich_is_a_jackknife_over_stars():
    """Left-out stars one by one, each with the normal equations of the others."""
    start = solution_of(field(5, 6, 60, sigma=0.02))
    solution = solve(
        start.problem, start.theta, start.free, start.prior, mixture=NO_FALSE, jitter=0.0
    )
    p, free = solution.problem, solution.free
    scores = scores_of_detections(solution)
    found = squared_scores(solution, scores).sandwich()
    columns = AddedColumns(p, solution.theta)
    A = eliminated(columns, scores, solution.stars)[0][np.ix_(free, free)]
    moved = np.zeros((p.n_stars, len(free)))
    for s in range(p.n_stars):
        others = np.setdiff1d(np.arange(p.n_stars), [s])
        rest = np.isin(p.star, others)
        N, score, _ = eliminated(
            AddedColumns(p.of_stars(others), solution.theta),
            scores.at(rest),
            solution.stars[others],
        )
        moved[s] = np.linalg.solve(N[np.ix_(free, free)], score[free])
    jackknife = moved.T @ moved
    assert np.linalg.eigvalsh(A)[0] > 0
    sigma = np.sqrt(np.diag(jackknife))
    ratio = np.sqrt(np.diag(found))[free] / sigma
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    assert np.abs(ratio - 1).max() < 0.35
    held = np.setdiff1d(np.arange(len(found)), free)
    assert not found[held].any()
