"""Linear transformations are a group; their fit is least squares; frames change their reference."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Column, Table
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesdist.data import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.missions.wise.rvb.linear import (
    FIVE,
    LinearMoments,
    fit_transform,
    linear_moments,
)
from bayesdist.missions.wise.rvb.solutions import read_solutions
from bayesdist.missions.wise.rvb.transform import PARAMETERS, RvbTransform, rereference, transformed

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


@settings(deadline=None)
@given(transforms, transforms, transforms)
def test_transformations_are_a_group(a, b, c):
    close(a.then(b)(POINTS), b(a(POINTS)))
    close(a.then(b).then(c)(POINTS), a.then(b.then(c))(POINTS))
    close(a.inverse()(a(POINTS)), POINTS)
    close(a.then(a.inverse())(POINTS), POINTS)
    close(a.then(RvbTransform())(POINTS), a(POINTS))


@settings(deadline=None)
@given(transforms, transforms)
def test_a_transformation_is_its_matrix_and_does_not_depend_on_its_centre(a, b):
    again = RvbTransform.of_matrix(a.matrix, a.shift, a.centre)
    close(again.values, a.values)
    close(a.about(b.centre)(POINTS), a(POINTS))
    assert a.about(b.centre).matrix.tolist() == a.matrix.tolist()


@settings(deadline=None)
@given(st.floats(-3, 3), st.floats(-0.5, 0.5), st.floats(-3, 3), st.floats(-0.5, 0.5))
def test_rotations_add_and_common_scales_multiply(p, s, q, t):
    both = RvbTransform(1.0, 2.0, p / 3, s, s).then(RvbTransform(3.0, -1.0, q / 3, t, t))
    close(both.values[2:], [(p + q) / 3, (1 + s) * (1 + t) - 1, (1 + s) * (1 + t) - 1, 0.0])


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
    both, once = transformed(transformed(matches, a), b), transformed(matches, a.then(b))
    for name in ("u", "v"):
        close(getattr(both, name), getattr(once, name))
    back = transformed(once, a.then(b).inverse())
    close(np.stack([back.u, back.v]), np.stack([matches.u, matches.v]))
    for name in ("x", "y", "epoch", "row"):
        assert getattr(once, name) is not None
        np.testing.assert_array_equal(getattr(once, name), getattr(matches, name))
    same = transformed(matches, RvbTransform())
    assert same.u.tobytes() == matches.u.tobytes() and same.v.tobytes() == matches.v.tobytes()


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
    with pytest.raises(
        InputError, match=r"row 1: the errors of u and v would be correlated by 0\.6"
    ):
        transformed(pairs(rng), RvbTransform(0, 0, np.pi / 4))
    # equal errors may be turned by any angle
    assert transformed(pairs(rng, sigma=(0.1, 0.1)), RvbTransform(0, 0, 1.0)).sigma_u[0] == (
        pytest.approx(0.1)
    )


def test_six_free_parameters_are_an_affine_fit(rng):
    truth = RvbTransform(0.7, -0.3, 0.02, 0.003, -0.002, 0.001)
    matches = pairs(rng, transform=truth)
    fit = fit_transform(linear_moments(matches, CENTRE), free=PARAMETERS)
    design = np.column_stack([np.ones(400), matches.u - 508.5, matches.v - 508.5])
    chi2 = 0.0
    for axis, (values, sigma) in enumerate(
        ((matches.x, matches.sigma_u), (matches.y, matches.sigma_v))
    ):
        weighted = (design.T / sigma).T
        solution, rest, *_ = np.linalg.lstsq(weighted, (values - 508.5) / sigma, rcond=None)
        np.testing.assert_allclose(fit.transform.matrix[axis], solution[1:], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(fit.transform.shift[axis], solution[0], atol=1e-9)
        chi2 += rest[0]
    assert fit.chi2 == pytest.approx(chi2, rel=1e-7) and fit.dof == 794


@pytest.mark.parametrize("free", [FIVE, ("shift_u", "shift_v"), ("rotation", "scale_v", "skew")])
def test_the_fit_recovers_what_it_frees_and_its_covariance_covers(rng, free):
    """Pulls of all free parameters together: chi-square, over 300 truths; held ones stay."""
    total = 0.0
    for _ in range(300):
        values = rng.normal(0, (1.0, 1.0, 0.01, 0.01, 0.01, 0.01))
        truth = RvbTransform(*values)
        start = RvbTransform(
            *[0.0 if p in free else v for p, v in zip(PARAMETERS, values, strict=True)]
        )
        moments = linear_moments(pairs(rng, n=60, transform=truth), CENTRE)
        fit = fit_transform(moments, free=free, start=start)
        which = [PARAMETERS.index(name) for name in free]
        held = [k for k in range(6) if k not in which]
        assert fit.transform.values[held].tolist() == values[held].tolist()
        assert not fit.cov[held].any()
        pull = fit.transform.values[which] - values[which]
        total += pull @ np.linalg.solve(fit.cov[np.ix_(which, which)], pull)
    dof = 300 * len(free)
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
    fit = fit_transform(linear_moments(bent, CENTRE), free=PARAMETERS)
    assert fit.chi2 / fit.dof > 2
    left = fit_transform(linear_moments(transformed(bent, fit.transform), CENTRE), free=PARAMETERS)
    assert np.abs(left.transform.values / left.sigma).max() < 0.05


def test_moments_add(rng):
    matches = pairs(rng)
    whole = linear_moments(matches, CENTRE)
    parts = [linear_moments(matches.select(np.arange(k, 400, 3)), CENTRE) for k in range(3)]
    total = parts[0] + parts[1] + parts[2]
    one, other = fit_transform(whole), fit_transform(total)
    np.testing.assert_allclose(other.transform.values, one.transform.values, atol=1e-12)
    assert total.n == 400 and other.chi2 == pytest.approx(one.chi2)
    with pytest.raises(ValueError, match="different centres"):
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
        free[name] = fixed[name].then(detector).then(wrong)
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
            if kind == "free" or name in FIVE[:3]:
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

    def read(**columns):
        table.write(tmp_path / "s.ecsv", format="ascii.ecsv", overwrite=True)
        return read_solutions(tmp_path / "s.ecsv", centre=CENTRE, columns=columns)

    with pytest.raises(InputError, match="row 3: frame 'a' stands twice"):
        read()
    table["frame"] = ["a", "b", "c"]
    assert read()["b"].values.tolist() == [2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(InputError, match="no column of parameters"):
        read(shift_u="")
    table["rotation"] = Column([0.0, 0.1, 0.2], unit="m")
    with pytest.raises(InputError, match="unit m is not one of angles"):
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
    fit_transform(linear_moments(line, CENTRE), free=("shift_u", "shift_v", "rotation", "scale_u"))
    spot = line.select(np.arange(1))
    with pytest.raises(DegenerateError, match="do not determine"):
        fit_transform(linear_moments(spot, CENTRE))
    with pytest.raises(InputError, match="'zoom' is no parameter"):
        fit_transform(linear_moments(line, CENTRE), free=("zoom",))
    with pytest.raises(InputError, match=r"no parameter .* is free"):
        fit_transform(linear_moments(line, CENTRE), free=())


def test_wrong_input_is_refused(rng):
    matches = pairs(rng, exposure_names=("f1",))
    with pytest.raises(InputError, match="frame 'f1' has no solution with fixed scales"):
        rereference(matches, {"f1": RvbTransform()}, {})
    with pytest.raises(InputError, match="carry no errors"):
        linear_moments(Matches(*[np.arange(3.0)] * 4), CENTRE)
    with pytest.raises(InputError, match=r"scale_u .* is -1"):
        RvbTransform(scale_u=-1.0)
    with pytest.raises(InputError, match="determinant -1"):
        RvbTransform.of_matrix([[1, 0], [0, -1]], (0, 0), CENTRE)
    one = linear_moments(matches, CENTRE)
    assert isinstance(one, LinearMoments) and one.n == 400
