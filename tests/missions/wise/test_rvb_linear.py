"""The fit of linear transformations is least squares; frames change their reference."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Column, Table
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from bayesdist.data import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.missions.wise.rvb import (
    PARAMETERS,
    LinearMoments,
    RvbTransform,
    fit_transform,
    linear_moments,
    read_solutions,
    rereference,
    transformed,
)

CENTRE = (508.5, 508.5)
POINTS = np.random.default_rng(1).uniform(0.5, 1016.5, (40, 2))

numbers = st.floats(-1.0, 1.0)
transforms = st.builds(
    lambda a, b, c, d, e, f, x, y: RvbTransform(
        5 * a, 5 * b, 3 * c, 0.5 * d, 0.5 * e, f, (508.5 + 300 * x, 508.5 + 300 * y)
    ),
    *[numbers] * 8,
)


def close(found, expected) -> None:
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-8)


def product(*several: RvbTransform) -> RvbTransform:
    """One transformation about the common centre that does what several do one after another."""
    origin, *axes = np.add(CENTRE, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    for one in several:
        origin, *axes = (one(p) for p in (origin, *axes))
    a, b = (axis - origin for axis in axes)
    along = np.hypot(*a)
    across = np.linalg.det([a, b]) / along
    skew, turn = a @ b / along / across, np.arctan2(a[1], a[0])
    return RvbTransform(*(origin - CENTRE), turn, along - 1, across - 1, skew)


@settings(deadline=None)
@given(transforms)
def test_derivatives(a):
    def flat(values):
        one = RvbTransform(*values, centre=a.centre)
        return np.concatenate([one.shift, one.matrix.ravel()])

    step = 1e-6
    for k, column in enumerate(a.jacobian().T):
        e = step * np.eye(6)[k]
        numerical = (flat(a.values + e) - flat(a.values - e)) / (2 * step)
        np.testing.assert_allclose(column, numerical, atol=1e-8)


def pairs(rng, n=400, transform=None, sigma=(0.05, 0.1), extent=(0.5, 1016.5), **columns):
    """Detections are the transformed reference stars, with noise of the quoted size."""
    uv = rng.uniform(*extent, (n, 2))
    xy = (transform or RvbTransform())(uv) + rng.standard_normal((n, 2)) * sigma
    sigmas = np.broadcast_to(sigma, (n, 2)).T
    return Matches(*xy.T, *uv.T, sigma_u=sigmas[0], sigma_v=sigmas[1], **columns)


def test_pairs_transformed_twice_are_transformed_by_the_product(rng):
    matches = pairs(rng, epoch=rng.uniform(2010, 2011, 400))
    a, b = RvbTransform(1, 2, 0.01, 0.002, -0.001), RvbTransform(0, -3, -0.02, 0.001, 0.004)
    both, once = transformed(transformed(matches, a), b), transformed(matches, product(a, b))
    for name in ("u", "v"):
        close(getattr(both, name), getattr(once, name))
    for name in ("x", "y", "epoch", "row"):
        assert getattr(once, name) is not None
        np.testing.assert_array_equal(getattr(once, name), getattr(matches, name))
    same = transformed(matches, RvbTransform())
    assert same.u.tobytes() == matches.u.tobytes() and same.v.tobytes() == matches.v.tobytes()


@settings(deadline=None)
@given(transforms, transforms)
def test_rereferenced_pairs_are_where_the_other_solution_puts_their_stars(free, fixed):
    """Whatever the centres of both."""
    u, v = free(POINTS).T
    matches = Matches(*POINTS.T, u, v)
    moved = rereference(matches, {"1": free}, {"1": fixed})
    close(np.column_stack([moved.u, moved.v]), fixed(POINTS))


def test_errors_go_through_the_transformation(rng):
    turned = RvbTransform(0, 0, np.pi / 2, 0.5, 0.0)
    matches = transformed(pairs(rng), turned)
    np.testing.assert_allclose(matches.sigma_u, 0.1)
    np.testing.assert_allclose(matches.sigma_v, 0.05 * 1.5)
    # against the scatter of the points themselves
    small = RvbTransform(0, 0, 0.05, 0.2, 0.1)
    cloud = small(np.array(CENTRE) + rng.standard_normal((200_000, 2)) * (0.05, 0.1))
    after = transformed(pairs(rng), small)
    np.testing.assert_allclose(cloud.std(axis=0), [after.sigma_u[0], after.sigma_v[0]], rtol=0.01)
    # errors that are unequal become correlated: (0.01 - 0.0025) / (0.01 + 0.0025)
    half = transformed(pairs(rng), RvbTransform(0, 0, np.pi / 4))
    np.testing.assert_allclose(np.abs(half.rho_uv), 0.6)
    cloud = RvbTransform(0, 0, np.pi / 4)(rng.standard_normal((200_000, 2)) * (0.05, 0.1))
    assert np.corrcoef(cloud.T)[0, 1] == pytest.approx(half.rho_uv[0], abs=0.01)
    # equal errors may be turned by any angle
    assert transformed(pairs(rng, sigma=(0.1, 0.1)), RvbTransform(0, 0, 1.0)).sigma_u[0] == (
        pytest.approx(0.1)
    )


def test_the_fit_is_least_squares(rng):
    """Against a minimiser that is given nothing but the residuals."""
    matches = pairs(rng, transform=RvbTransform(0.7, -0.3, 0.02, 0.003, -0.002, 0.001))
    uv, xy = (np.column_stack(c) for c in ((matches.u, matches.v), (matches.x, matches.y)))
    sigma = np.column_stack([matches.sigma_u, matches.sigma_v])

    def residuals(values):
        return ((xy - RvbTransform(*values)(uv)) / sigma).ravel()

    scale = [1.0, 1.0, 1e-3, 1e-3, 1e-3]
    best = least_squares(residuals, np.zeros(5), x_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fit = fit_transform(linear_moments(matches, CENTRE))
    np.testing.assert_allclose((fit.transform.values[:5] - best.x) / fit.sigma[:5], 0, atol=1e-5)
    assert fit.transform.skew == 0 and not fit.cov[5].any()
    assert fit.chi2 == pytest.approx(2 * best.cost, rel=1e-7) and fit.dof == 795


def test_the_covariance_of_the_fit_covers(rng):
    """Pulls of all parameters together: chi-square, over 300 truths."""
    total = 0.0
    for _ in range(300):
        values = rng.normal(0, (1.0, 1.0, 0.01, 0.01, 0.01))
        moments = linear_moments(pairs(rng, n=60, transform=RvbTransform(*values)), CENTRE)
        fit = fit_transform(moments)
        pull = fit.transform.values[:5] - values
        total += pull @ np.linalg.solve(fit.cov[:5, :5], pull)
    dof = 300 * 5
    assert abs(total - dof) < 4 * np.sqrt(2 * dof)


def test_exact_pairs_are_recovered_exactly_and_linearised_away(rng):
    truth = RvbTransform(30.0, -20.0, 0.4, 0.2, -0.1)
    matches = pairs(rng, transform=truth, sigma=(1e-6, 1e-6))
    fit = fit_transform(linear_moments(matches, CENTRE))
    np.testing.assert_allclose(fit.transform.values, truth.values, atol=1e-8)
    bare = Matches(matches.x, matches.y, matches.u, matches.v)
    straight = transformed(bare, fit.transform)
    np.testing.assert_allclose(straight.u, straight.x, atol=1e-5)
    np.testing.assert_allclose(straight.v, straight.y, atol=1e-5)


def test_nothing_linear_is_left_in_linearised_pairs(rng):
    """Of distorted pairs too, whose residuals are far above the errors."""
    matches = pairs(rng, transform=RvbTransform(0.5, 0.2, 0.001, 0.002, -0.001))
    bent = transformed(matches, RvbTransform())
    bent = Matches(bent.x + 5e-6 * (bent.x - 300) ** 2, bent.y, bent.u, bent.v,
                      sigma_u=bent.sigma_u, sigma_v=bent.sigma_v)  # fmt: skip
    fit = fit_transform(linear_moments(bent, CENTRE))
    assert fit.chi2 / fit.dof > 2
    left = fit_transform(linear_moments(transformed(bent, fit.transform), CENTRE))
    assert np.abs(left.transform.values[:5] / left.sigma[:5]).max() < 0.05


def test_moments_add(rng):
    matches = pairs(rng)
    whole = linear_moments(matches, CENTRE)
    parts = [linear_moments(matches.select(np.arange(k, 400, 3)), CENTRE) for k in range(3)]
    total = parts[0] + parts[1] + parts[2]
    one, other = fit_transform(whole), fit_transform(total)
    np.testing.assert_allclose(other.transform.values, one.transform.values, atol=1e-12)
    assert total.n == 400 and other.chi2 == pytest.approx(one.chi2)
    with pytest.raises(ValueError, match="different centre"):
        whole + linear_moments(matches, (1.0, 1.0))


def frames_of(rng, n_frames, n, detector):
    """Stars on nominal pixels, and what the detector does to each frame's true pointing.

    The free solution of a frame takes up the detector's linear terms, as no one knows them.
    """
    names = tuple(f"f{k}" for k in range(n_frames))
    fixed, free = {}, {}
    for name in names:
        fixed[name] = RvbTransform(*rng.normal(0, (3.0, 3.0, 0.01)))
        wrong = RvbTransform(0, 0, 0, *rng.normal(0, 1e-4, 2))
        free[name] = product(fixed[name], detector, wrong)
    frame = rng.integers(n_frames, size=n)
    nominal = rng.uniform(0.5, 1016.5, (n, 2))
    xy, uv = np.empty((n, 2)), np.empty((n, 2))
    for k, name in enumerate(names):
        own = frame == k
        uv[own] = free[name](nominal[own])
        xy[own] = detector(fixed[name](nominal[own]))
    xy += rng.normal(0, 0.05, (n, 2))
    sigma = np.full(n, 0.05)
    matches = Matches(*xy.T, *uv.T, sigma_u=sigma, sigma_v=sigma, exposure=frame,
                         exposure_names=names)  # fmt: skip
    return matches, free, fixed


@pytest.mark.parametrize("suffix", [".tbl", ".ecsv"])
def test_solutions_of_frames_from_a_table(rng, tmp_path, suffix):
    """Degrees where the column says so; what has no column is zero; then pairs move as by hand."""
    matches, free, fixed = frames_of(rng, 7, 500, RvbTransform(0.4, -0.7, 0.002, 0.003, -0.001))
    paths = []
    for kind, solutions in (("free", free), ("fixed", fixed)):
        table = Table({"frame": list(solutions)})
        for k, name in enumerate(PARAMETERS):
            if kind == "free" or name in PARAMETERS[:3]:
                table[name] = [one.values[k] for one in solutions.values()]
        if kind == "free":
            table["rotation"] = Column(np.degrees(table["rotation"]), unit="deg")
        paths.append(tmp_path / f"{kind}{suffix}")
        table.write(paths[-1], format="ascii.ipac" if suffix == ".tbl" else "ascii.ecsv")
    found = [read_solutions(path, centre=CENTRE) for path in paths]
    moved, expected = rereference(matches, *found), rereference(matches, free, fixed)
    np.testing.assert_allclose(moved.u, expected.u, rtol=0, atol=1e-9)
    np.testing.assert_allclose(moved.v, expected.v, rtol=0, atol=1e-9)


def test_solutions_that_say_too_little_or_too_much(tmp_path):
    table = Table({"frame": ["a", "b", "a"], "shift_u": [1.0, 2.0, 3.0]})

    def read():
        table.write(tmp_path / "s.ecsv", format="ascii.ecsv", overwrite=True)
        return read_solutions(tmp_path / "s.ecsv", centre=CENTRE)

    with pytest.raises(InputError, match="row 3: frame 'a' occurs twice"):
        read()
    table["frame"] = ["a", "b", "c"]
    assert read()["b"].values.tolist() == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    table.rename_column("shift_u", "du")
    with pytest.raises(InputError, match="no column of parameters"):
        read()
    table["rotation"] = Column([0.0, 0.1, 0.2], unit="m")
    with pytest.raises(InputError, match="unit m is not an angle"):
        read()


def test_linear_terms_are_lost_with_free_scales_and_found_with_fixed_ones(rng):
    detector = RvbTransform(0.4, -0.7, 0.002, 0.003, -0.001)
    matches, free, fixed = frames_of(rng, 30, 6000, detector)
    lost = fit_transform(linear_moments(matches, CENTRE))
    assert np.abs(lost.transform.values[3:5]).max() < 2e-4  # what the frames took up is gone
    moved = rereference(matches, free, fixed)
    found = fit_transform(linear_moments(moved, CENTRE))
    pull = (found.transform.values - detector.values)[:5] / found.sigma[:5]
    assert (pull**2).sum() < 20.5  # chi-square of five, p = 0.001
    # there and back again
    back = rereference(moved, fixed, free)
    np.testing.assert_allclose(back.u, matches.u, atol=1e-9)
    np.testing.assert_allclose(back.v, matches.v, atol=1e-9)


def test_what_the_pairs_do_not_determine_is_named(rng):
    x = np.linspace(1, 1000, 50)
    line = Matches(x, np.full(50, 508.5), x, np.full(50, 508.5),
                      sigma_u=np.ones(50), sigma_v=np.ones(50))  # fmt: skip
    with pytest.raises(DegenerateError, match="do not determine scale_v"):
        fit_transform(linear_moments(line, CENTRE))
    spot = line.select(np.arange(1))
    with pytest.raises(DegenerateError, match="do not determine"):
        fit_transform(linear_moments(spot, CENTRE))


def test_wrong_input_is_refused(rng):
    matches = pairs(rng, exposure_names=("f1",))
    with pytest.raises(InputError, match="frame 'f1' has no solution with fixed scales"):
        rereference(matches, {"f1": RvbTransform()}, {})
    with pytest.raises(InputError, match="have no errors"):
        linear_moments(Matches(*[np.arange(3.0)] * 4), CENTRE)
    with pytest.raises(InputError, match=r"scale_u .* is -1"):
        RvbTransform(scale_u=-1.0)
    one = linear_moments(matches, CENTRE)
    assert isinstance(one, LinearMoments) and one.n == 400
