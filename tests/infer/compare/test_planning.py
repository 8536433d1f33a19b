"""What more data would do, against fits of data that were then simulated."""

import numpy as np
import pytest

from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.infer import build_model, fit_linear
from bayesdist.infer.compare.planning import (
    exposure_content,
    exposure_information,
    with_information,
)
from bayesdist.infer.equations.scaled import recolouring
from bayesdist.model import TimeDependence

SIZE = (512.0, 256.0)
SIGMA = 0.02


def stars(epochs, n, rng, *, frames=False, sigma=SIGMA):
    """Exposures of n stars each, without distortion: errors alone matter here."""
    N = n * len(epochs)
    x, y = rng.uniform(1, SIZE[0], N), rng.uniform(1, SIZE[1], N)
    code = np.repeat(np.arange(len(epochs)), n)
    errors = sigma * rng.standard_normal((2, N))
    names = tuple(f"e{k}" for k in range(len(epochs)))
    return Matches(
        x=x, y=y, u=x - 256 + errors[0], v=y - 128 + errors[1],
        sigma_u=np.full(N, sigma), sigma_v=np.full(N, sigma),
        epoch=np.repeat(epochs, n), exposure=code, exposure_names=names,
        unit="pix",
    )  # fmt: skip


def model_of(matches, frames="none", time=None):
    return build_model(
        matches, order=2, size=SIZE, reference_pixel=(256.0, 128.0), frames=frames, time=time
    )


def content_of(fit, matches, **options):
    weight = np.stack([matches.sigma_u, matches.sigma_v], axis=1) ** -2.0
    return exposure_content(fit.model, matches, weight, **options)


# a scale of each exposure leaves of this drift of the linear terms only what is no scale
DRIFT = TimeDependence((("u", 1, 0), ("v", 1, 0), ("u", 1, 1)), (2010.0,))


@pytest.mark.parametrize("frames", ["none", "shift", "shift_rotation_scale"])
def test_exposures_that_are_taken_later_do_what_was_planned(frames):
    rng = np.random.default_rng(3)
    before, later = list(np.linspace(2005.0, 2012.0, 8)), [2018.0, 2019.0, 2019.5]
    first = stars(before, 400, rng)
    whole = stars([*before, *later], 400, rng)
    fit = fit_linear(first, model_of(first, frames, DRIFT))
    after = fit_linear(whole, model_of(whole, frames, DRIFT))
    content = content_of(fit, first, n_exposures=len(before))
    planned = with_information(
        fit, sum(exposure_information(fit, content, epoch) for epoch in later)
    )
    n = fit.model.n_distortion
    # 400 stars at random places: sums over them scatter by some 1 / sqrt(400)
    assert planned.sigma[:n] == pytest.approx(after.sigma[:n], rel=0.05)
    assert (planned.sigma[:n] < 0.995 * fit.sigma[:n]).any()


def test_the_same_stars_again_halve_the_covariance():
    rng = np.random.default_rng(4)
    first = stars([2010.0], 300, rng)
    fit = fit_linear(first, model_of(first))
    used = fit.uses(first)
    weight = used[:, None] * np.stack([first.sigma_u, first.sigma_v], axis=1) ** -2.0
    content = exposure_content(fit.model, first, weight)
    planned = with_information(fit, exposure_information(fit, content, None))
    assert planned.cov == pytest.approx(fit.cov / 2, rel=1e-9, abs=1e-15)


def test_a_sample_stands_for_all_stars():
    rng = np.random.default_rng(5)
    first = stars([2010.0], 20_000, rng)
    fit = fit_linear(first, model_of(first))
    whole = content_of(fit, first)
    part = content_of(fit, first.select(np.arange(0, 20_000, 4)), n_total=20_000)
    assert part.n_stars == whole.n_stars
    diagonal = [np.einsum("akk->ak", c.moments[1]) for c in (part, whole)]
    assert diagonal[0] == pytest.approx(diagonal[1], rel=0.05)


def test_draws_of_the_planned_solution_have_its_covariance():
    rng = np.random.default_rng(7)
    first = stars([2010.0], 300, rng)
    fit = fit_linear(first, model_of(first))
    content = content_of(fit, first)
    planned = with_information(fit, 3 * exposure_information(fit, content, None))
    drawn = planned.draws(40_000, rng)
    assert drawn.std(axis=0) == pytest.approx(planned.sigma, rel=5 / np.sqrt(2 * 40_000))
    assert planned.mean is fit.mean


def test_recolouring_gives_the_covariance_that_is_asked_for():
    rng = np.random.default_rng(8)
    scales = 10.0 ** np.array([-9, -3, 0, 4])
    before, after = (np.outer(scales, scales) * (a @ a.T) for a in rng.standard_normal((2, 4, 9)))
    A = recolouring(before, after)
    unit = np.outer(scales, scales)
    assert (A @ before @ A.T) / unit == pytest.approx(after / unit, rel=1e-9, abs=1e-9)
    assert recolouring(before, before) == pytest.approx(np.eye(4), abs=1e-9)


def test_information_of_another_model_is_refused():
    rng = np.random.default_rng(9)
    first = stars([2010.0], 300, rng)
    fit = fit_linear(first, model_of(first))
    with pytest.raises(InputError, match="information has shape"):
        with_information(fit, np.eye(3))
