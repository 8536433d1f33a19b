"""Data that do not determine the model are refused, by the names of the parameters and the reason.

What is degenerate here is known by algebra, not by what the library says.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError
from bayesdist.infer import Rejection, fit_linear, load, residuals
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.equations.normal import check_coverage, null_space
from bayesdist.model import DistortionModel, TimeDependence

from ..support import CHIP, TWO_CHIPS, exposures, simulated, table


def refusal(model: DistortionModel, matches: Matches) -> str:
    with pytest.raises(DegenerateError) as caught:
        fit_linear(matches, model)
    return str(caught.value)


def named_in(message: str) -> set[str]:
    """Parameters that a message lists."""
    return set(re.findall(r"(?:\w+\.)*(?:[uv]_\d_\d)(?:\.\w+)?|\be\d+\.\w+", message))


def with_time(time: TimeDependence, epochs, frames="none", n=400, order=2):
    model, matches, _ = simulated(
        21, n, order=order, frames=frames, n_exposures=len(epochs), time=time, epochs=epochs
    )
    return model, matches


def test_null_space_of_a_known_matrix():
    """a + b is seen, a - b is not, c is never seen, d is fine."""
    rows = np.array([[1.0, 1, 0, 0], [2, 2, 0, 0], [0, 0, 0, 3], [1, 1, 0, 1]])
    H = rows.T @ rows
    arrow = Arrow(H, np.zeros((0, 4, 0)), np.zeros((0, 0, 0)))
    space = null_space(arrow, ("a", "b", "c", "d"))
    assert (space.rank, space.n_params) == (2, 4)
    assert sorted(sorted(d) for d in space.directions) == [["a", "b"], ["c"]]


def test_null_space_does_not_depend_on_units():
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((20, 4)) * [1e-8, 1e6, 1.0, 1e3]
    arrow = Arrow(rows.T @ rows, np.zeros((0, 4, 0)), np.zeros((0, 0, 0)))
    space = null_space(arrow, tuple("abcd"))
    assert space.rank == 4 and space.directions == ()
    unit = rows / np.sqrt((rows**2).sum(axis=0))
    assert space.condition == pytest.approx(np.linalg.cond(unit) ** 2, rel=1e-8)


def named_frames(message: str) -> str:
    """The value of model.frames that a refusal advises."""
    return re.search(r"or set model\.frames = '(\w+)'", message).group(1)


@pytest.mark.parametrize("epoch", [2005.0, 2004.5])
def test_one_epoch_does_not_tell_a_drift_from_a_constant(epoch):
    """At the reference date itself the rate has no effect at all."""
    time = TimeDependence((("v", 1, 0),), (2004.5,))
    message = refusal(*with_time(time, [epoch] * 3))
    assert "all exposures share one epoch" in message
    # the drifting monomial is x - xref, which is v_1_0 and, off the centre, a little of v_0_0
    expected = {"tdd.v_1_0.rate"}
    assert expected <= named_in(message) <= expected | {"v_1_0", "v_0_0"}
    if epoch != 2004.5:
        assert "v_1_0" in named_in(message)


def test_one_epoch_in_a_segment_does_not_tell_its_step_from_its_rate():
    time = TimeDependence((("u", 1, 0),), (2004.5, 2012.5), (2009.4,))
    message = refusal(*with_time(time, [2003.0, 2005.0, 2010.0]))
    assert named_in(message) == {"tdd.u_1_0.step_2", "tdd.u_1_0.rate_2"}
    assert "epochs of a segment" in message
    assert "share one epoch" not in message


def test_a_segment_without_data():
    time = TimeDependence((("u", 1, 0),), (2004.5, 2012.5), (2009.4,))
    message = refusal(*with_time(time, [2003.0, 2005.0, 2006.0]))
    assert named_in(message) <= {"tdd.u_1_0.step_2", "tdd.u_1_0.rate_2"} != set()
    assert "epochs of a segment" in message


ABSORBED = {
    # equal relative rates of u_1_0 and v_0_1 are a change of scale
    "shift_rotation_scale": (("u", 1, 0), ("v", 0, 1)),
    "affine": (("u", 1, 0),),
    "shift": (("u", 0, 0),),
}
EPOCHS = [2003.0, 2005.0, 2008.0, 2011.0]


def drifting(frames: str, *, order: int, bend: float, seed: int):
    """A detector that is linear but for `bend` pixels, with nothing that drifts."""
    time = TimeDependence(ABSORBED[frames], (2004.5,))
    model = DistortionModel(
        order, (CHIP,), frames=frames, exposures=exposures(4), time=time, origin=(500.0, 400.0)
    )
    theta = np.zeros(model.n_params)
    u, v = (theta[model.coefficient_slice(1, a)] for a in (0, 1))
    u[:2] = v[[0, 2]] = 500.0
    v[[0, 2]] = 400.0
    rng = np.random.default_rng(seed)
    for part in (u, v):
        part[3:] = bend * rng.standard_normal(len(part) - 3)
    _, matches, _ = simulated(
        seed,
        800,
        order=order,
        frames=frames,
        n_exposures=4,
        time=time,
        epochs=EPOCHS,
        theta=theta,
    )
    return model, matches, theta


@pytest.mark.parametrize("frames", ABSORBED)
@pytest.mark.parametrize("order", [1, 3])
def test_frames_that_absorb_the_drift(frames, order):
    """Exactly degenerate: the detector is linear and the positions are free of noise."""
    model, noisy, theta = drifting(frames, order=order, bend=0.0, seed=1)
    u, v = model.predict(theta, noisy.x, noisy.y, epoch=noisy.epoch, exposure=noisy.exposure).T
    exact = table(
        noisy.x,
        noisy.y,
        u,
        v,
        epoch=noisy.epoch,
        exposure=noisy.exposure,
        exposure_names=noisy.exposure_names,
    )
    message = refusal(model, exact)
    assert f"the frame '{frames}' of each exposure absorbs the drift" in message
    parts = named_in(message)
    assert {f"tdd.{a}_{i}_{j}.rate" for a, i, j in ABSORBED[frames]} <= parts
    assert any(re.match(r"e[234]\.", p) for p in parts)
    # with the frames that are named there is no such degeneracy
    simpler = named_frames(message)
    assert simpler == {"shift_rotation_scale": "shift_rotation", "affine": "shift_rotation_scale",
                       "shift": "none"}[frames]  # fmt: skip
    fit_linear(exact, replace(model, frames=simpler), rejection=Rejection(clip_abs=None))


@pytest.mark.parametrize("frames", ABSORBED)
@pytest.mark.parametrize(("order", "bend"), [(1, 0.0), (2, 0.0), (2, 1.0), (4, 0.0), (4, 30.0)])
def test_frames_that_all_but_absorb_the_drift(frames, order, bend):
    """With noise the degeneracy is no longer exact.

    Then the fit is refused, by the drift and with its reason, or it holds the truth within its
    covariance; it never returns numbers that are wrong by more than they say.
    """
    for seed in (1, 2, 3):
        model, matches, theta = drifting(frames, order=order, bend=bend, seed=seed)
        try:
            fit = fit_linear(matches, model)
        except DegenerateError as error:
            assert "absorbs the drift" in str(error)
            assert any(p.startswith("tdd.") for p in named_in(str(error)))
        else:
            d = fit.mean - theta
            p_value = stats.chi2(len(d)).sf(d @ np.linalg.solve(fit.cov, d))
            assert p_value > 1e-6, f"seed {seed}: condition {fit.condition:.1e}"


def test_a_skew_is_not_absorbed_by_a_similarity():
    """u_1_0 alone drifts: a similarity cannot follow, and the fit goes through."""
    time = TimeDependence((("u", 1, 0),), (2004.5,))
    model, matches = with_time(time, EPOCHS, frames="shift_rotation_scale")
    fit = fit_linear(matches, model)
    assert fit.condition < 1e6


def test_stars_on_a_line():
    rng = np.random.default_rng(2)
    x = rng.uniform(1, 1000, 100)
    message = refusal(DistortionModel(1, (CHIP,)), table(x, 0.5 * x + 20, x, 0.5 * x))
    assert "all stars lie on a line" in message


def test_stars_in_one_corner():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(1, 300, 100), rng.uniform(1, 200, 100)
    message = refusal(DistortionModel(1, (CHIP,)), table(x, y, x, y))
    # 299 x 199 of 1000 x 800 is 7.4 %; the hull of 100 points covers most of that
    assert re.search(r"span [67] % of the detector", message)
    assert "extrapolated" in message


def test_stars_on_two_lines_cannot_carry_a_parabola():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(1, 1000, 100), np.repeat([10.0, 790.0], 50)
    message = refusal(DistortionModel(2, (CHIP,)), table(x, y, x, y))
    # on two values of y, y^2 is a linear function of y
    assert "u_0_2" in message or "v_0_2" in message
    assert "do not fill the detector well enough for order 2" in message


def test_too_few_stars():
    rng = np.random.default_rng(5)
    x, y = rng.uniform(1, 800, (2, 20))
    message = refusal(DistortionModel(5, (CHIP,)), table(x, y, x, y))
    assert "20 stars give 40 numbers, fewer than the 42 parameters" in message


def test_as_many_numbers_as_parameters_is_enough():
    rng = np.random.default_rng(5)
    x, y = rng.uniform(1, 800, (2, 6))
    model = DistortionModel(2, (CHIP,))
    matches = table(x, y, x, y)
    fit = fit_linear(matches, model)
    assert fit.dof == 0
    np.testing.assert_allclose(residuals(fit, matches), 0, atol=1e-6)


def test_an_exposure_with_too_few_stars():
    model, matches, _ = simulated(6, 300, frames="affine", n_exposures=3)
    few = matches.select(np.r_[0:200, 200:202])
    message = refusal(model, few)
    assert "exposure 'e3' has 2 stars, too few for frame 'affine'" in message
    assert named_frames(message) == "shift_rotation_scale"  # four numbers
    fit_linear(few, replace(model, frames="shift_rotation_scale"))
    assert named_frames(refusal(model, matches.select(np.r_[0:200, 200:201]))) == "shift"
    none = matches.select(np.arange(100, 300))
    assert "exposure 'e1' has 0 stars" in refusal(model, none)


def test_an_exposure_whose_stars_lie_on_a_line_has_no_affine_frame():
    model, matches, _ = simulated(7, 300, frames="affine", n_exposures=3)
    x, y = matches.x.copy(), matches.y.copy()
    y[200:] = 0.5 * x[200:] + 10
    u, v = x.copy(), y.copy()
    message = refusal(
        model, table(x, y, u, v, exposure=matches.exposure, exposure_names=exposures(3))
    )
    assert {p.split(".")[0] for p in named_in(message)} == {"e3"}
    assert "too little joins the exposures" in message
    assert named_frames(message) == "shift_rotation_scale"


def test_a_star_outside_the_detector():
    model, matches, _ = simulated(8, 100)
    for column, value in (("x", 1000.6), ("x", 0.4), ("y", 800.51), ("y", -3.0)):
        x, y = matches.x.copy(), matches.y.copy()
        {"x": x, "y": y}[column][41] = value
        message = refusal(model, table(x, y, matches.u, matches.v))
        assert "row 42 lies at pixel" in message
        assert "outside the 1000 x 800 detector" in message
    x = matches.x.copy()
    x[41] = 1000.5  # the edge of the last pixel
    fit_linear(table(x, matches.y, matches.u, matches.v), model, rejection=Rejection(clip_abs=None))


def test_a_chip_without_stars_is_named():
    model, matches, _ = simulated(9, 300, chips=TWO_CHIPS)
    message = refusal(model, matches.select(matches.chip == 0))
    assert message.startswith("chip B: no star lies on this chip")


def test_coverage_is_judged_chip_by_chip():
    model, matches, _ = simulated(10, 400, chips=TWO_CHIPS)
    keep = (matches.chip == 0) | ((matches.x < 200) & (matches.y < 200))
    message = refusal(model, matches.select(keep))
    assert message.startswith("chip B: the stars lie within")
    check_coverage(model, load(model, matches).survey)
