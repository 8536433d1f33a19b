"""Held-out stars: right models pass as often as they should, wrong ones are named.

The posterior is the Laplace approximation of the mixture, which for thousands of stars is as good
as draws and takes a tenth of a second.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest, norm

from bayesdist.data.preparing import HoldoutSpec, split_matches
from bayesdist.diagnose.holdout.predictive import (
    SCALES,
    Predictive,
    marginals_of,
    scores_of,
    uniforms_of,
)
from bayesdist.diagnose.holdout.sums import SpreadMoments, _beyond, sum_tails
from bayesdist.diagnose.holdout.validation import holdout_validation
from bayesdist.diagnose.statistics import holm
from bayesdist.infer import GaussianPriors, OutlierMixture, fit_linear, load
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.target import Target
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches
from bayesdist.utils.checks import HELD_OUT_DOUBTFUL
from tests.reduced import case_in_full, only_in_full

SIZE = (1000.0, 800.0)
RUNS = 200 if os.environ.get("BAYESDIST_FULL") else 12
F, SIGMA, FAR = 0.05, 0.02, 0.4


def model_of(order: int = 2, **options) -> DistortionModel:
    return DistortionModel(order, (Chip(1, "A", SIZE, (500.5, 400.5)),), **options)


def truth_of(model: DistortionModel, rng: np.random.Generator) -> np.ndarray:
    theta = rng.normal(0, 0.5, model.n_params)
    for axis, place in enumerate(((1, 0), (0, 1))):
        k = model.basis().terms.index(place)
        theta[model.coefficient_slice(None, axis)][k] += SIZE[axis] / 2
    for block in model.local_blocks:
        theta[block] = rng.normal(0, 1, model.n_frame) * ([3, 3, 1e-3, 1e-2][: model.n_frame])
    return theta


def stars(seed: int, n: int, model: DistortionModel | None = None, change=None, **options):
    """Matches of a known truth; `change` is applied to offsets from it (N, 2)."""
    rng = np.random.default_rng(seed)
    model = model or model_of()
    theta = truth_of(model, rng)
    options = {"sigma": SIGMA, "fraction": F, "outlier_scale": FAR} | options
    mag = rng.uniform(12, 18, n)
    matches, _ = simulate_matches(model, theta, n, rng=rng, mag=mag, **options)
    if change is not None:
        exposure = matches.exposure if model.n_frame else None
        true = model.predict(theta, matches.x, matches.y, exposure=exposure)
        offset = change(matches, np.stack([matches.u, matches.v], axis=1) - true)
        matches = matches.with_columns(u=true[:, 0] + offset[:, 0], v=true[:, 1] + offset[:, 1])
    return model, matches


def posterior_of(model: DistortionModel, kept, mixture: OutlierMixture) -> Predictive:
    """Laplace approximation of the posterior of these stars."""
    model = replace(model, exposures=kept.exposure_names)
    priors = GaussianPriors.none(model)
    shards = load(model, kept)
    target = Target(shards, mixture, priors)
    proposal = build_proposal(target, fit_linear(shards, model, priors=priors))
    best, n = proposal.best, model.n_params
    psi = proposal.split.to_psi(best.mode, best.at)
    hyper = {k: float(v) for k, v in target.hyper.values(psi[n:]).items()}
    f, scale = hyper.get("f", 0.0), hyper.get("s_out", mixture.match_radius or 1.0)
    free = tuple(k for k in ("f", "s_out") if k in hyper)
    # counting false matches, and the width of their distribution
    known = {"f": f * (1 - f) / len(kept), "s_out": 1 / max(4 * f * len(kept), 1)}
    return Predictive(
        model,
        psi[:n],
        best.factor.covariance()[:n, :n],
        outliers=mixture.model,
        fraction=f,
        scale=scale,
        free=free,
        free_cov=np.diag([known[k] for k in free]),
    )


def judged(seed, n, model=None, *, fitted=None, aside=None, mixture=None, **options):
    model, matches = stars(seed, n, model, **options)
    split = split_matches(matches, aside or HoldoutSpec(0.3, (), seed))
    solution = posterior_of(fitted or model, split.kept, mixture or OutlierMixture(jitter=0.0))
    return holdout_validation(solution, split.held, whole=aside.exposures if aside else ())


def collected(results) -> dict[tuple[str, str], np.ndarray]:
    """All p-values by kind of test and part; those of one kind are nearly independent."""
    out: dict = {}
    for one in results:
        for t in one.tests:
            key = (t.name, t.part if t.index >= 0 else f"{t.part} together")
            key = (*key, t.index) if t.name in ("tails", "distribution") else key
            out.setdefault(key, []).append(t.p_value)
    return {key: np.array(values) for key, values in out.items()}


def assert_calibrated(results):
    found = collected(results)
    for key, p in found.items():
        if key[0] == "tails":  # counts: probabilities are larger than uniform ones, never smaller
            assert (p < 0.05).sum() <= binom.ppf(0.9999, p.size, 0.05), key
        else:  # about a dozen kinds
            assert kstest(p, "uniform").pvalue > 1e-4, (key, np.mean(p), np.mean(p < 0.05))
    alarms = sum(one.p_value < 0.05 for one in results)
    assert alarms <= binom.ppf(0.999, len(results), 0.05)


def test_right_models_have_uniform_probabilities():
    """5 % of the stars are false matches, and raise no alarm."""
    assert_calibrated([judged(seed, 3000) for seed in range(RUNS)])


@pytest.mark.slow
@only_in_full("Gaussian ones are judged")
def test_uniform_false_matches_have_uniform_probabilities():
    mixture = OutlierMixture("uniform", match_radius=FAR, jitter=0.0)
    some = [judged(1000 + seed, 3000, mixture=mixture, outliers="uniform") for seed in range(RUNS)]
    assert_calibrated(some)


@pytest.mark.slow
@only_in_full("stars that are held out are run")
@pytest.mark.parametrize(
    "frames", [case_in_full("shift", instead="frames of all kinds are run"), "shift_rotation_scale"]
)
def test_whole_exposures_have_uniform_probabilities(frames):
    """Frames of whole exposures are fitted to the very stars that are judged: that is allowed for.

    80 stars of four parameters: without it residuals would be 2.5 % too small.
    """
    names = tuple("abcdefgh")
    model = model_of(frames=frames, exposures=names, origin=(500.0, 400.0))
    aside = HoldoutSpec(0.1, ("c", "f"), 5)
    assert_calibrated([judged(2000 + seed, 1600, model, aside=aside) for seed in range(RUNS)])


@pytest.mark.slow
@only_in_full("whole exposures are judged")
def test_an_exposure_is_found_whatever_its_roll():
    """A frame of a hundred pixels and nearly half a turn is no misfit."""
    model = model_of(frames="shift_rotation_scale", exposures=("a", "b", "c"), origin=(10.0, -5.0))

    def one(seed):
        rng = np.random.default_rng(seed)
        theta = truth_of(model, rng)
        theta[model.frame_slice(2)] = (120.0, -60.0, 0.01, 2.8)
        options = {"sigma": SIGMA, "fraction": F, "outlier_scale": FAR}
        matches, _ = simulate_matches(model, theta, 2400, rng=rng, **options)
        split = split_matches(matches, HoldoutSpec(0.0, ("c",)))
        solution = posterior_of(model, split.kept, OutlierMixture(jitter=0.0))
        found = holdout_validation(solution, split.held, whole=("c",))
        assert found.n == len(split.held) == 800
        return found

    assert_calibrated([one(3000 + seed) for seed in range(RUNS)])


def test_too_low_an_order_is_seen_where_it_is_worst():
    """A cubic term that the fit lacks."""
    wave = lambda m, r: r + 0.04 * np.stack([((m.x - 500) / 500) ** 5, 0 * m.x], axis=1)  # noqa: E731
    found = judged(1, 6000, change=wave)
    assert found.level == "fail"
    assert "from where they are predicted" in found.verdict


def test_errors_that_are_too_small_are_measured():
    found = judged(2, 6000, change=lambda m, r: 1.3 * r, outlier_scale=FAR / 1.3)
    assert found.level == "fail"
    assert "over the whole detector" in found.verdict
    (whole,) = [t for t in found.tests if (t.name, t.part) == ("spread", "all")]
    # the scale of a normal variable is known to 1 / sqrt(4 n) for two axes
    assert abs(whole.value / 1.3 - 1) < 4 / np.sqrt(4 * found.n)


def test_errors_that_are_too_small_along_one_axis_are_named():
    """As large as predicted for both axes together: 1.22 and 0.71 times."""
    sizes = np.array([np.sqrt(1.5), np.sqrt(0.5)])
    found = judged(8, 6000, change=lambda m, r: r * sizes)
    assert found.level == "fail"
    assert found.verdict.startswith("along u the residuals of held-out stars are 1.")
    along = {t.where: t.value for t in found.tests if t.part == "axis"}
    for axis, size in zip("uv", sizes, strict=True):
        assert abs(along[f"along {axis}"] / size - 1) < 4 / np.sqrt(2 * found.n)
    first = {c.axis: c for c in found.coverage if c.level == 1.0}
    for axis, size in zip("uv", sizes, strict=True):
        true = norm.cdf(1 / size) - norm.cdf(-1 / size)
        # 5 % are false matches, a few of which are within
        assert first[axis].value == pytest.approx(0.97 * true, abs=0.03 * true + 0.04)
        assert not first[axis].interval[0] < first[axis].expected < first[axis].interval[1]


def test_the_corner_where_errors_are_too_small_is_named():
    def worse(m, r):
        return r * np.where((m.x > 750) & (m.y < 200), 1.8, 1.0)[:, None]

    found = judged(3, 8000, change=worse)
    assert found.level == "fail"
    assert found.verdict.startswith("in the corner x > ")
    cell = found.regions[found.tests[0].index]
    assert cell.limits[1] == 1000.5 and cell.limits[2] == 0.5
    assert "times as large as predicted" in found.verdict


def test_a_pattern_that_was_left_out_is_named_by_its_place():
    """A bump of 0.05 px, 2.5 sigma of a star, 80 px wide, at (310, 650)."""

    def bump(m, r):
        size = 0.05 * np.exp(-0.5 * ((m.x - 310) ** 2 + (m.y - 650) ** 2) / 80**2)
        return r + np.stack([size, size], axis=1)

    found = judged(4, 12_000, change=bump)
    assert found.level == "fail"
    worst = next(t for t in found.tests if t.name == "offset" and t.index >= 0)
    x0, x1, y0, y1 = found.regions[worst.index].limits
    assert x0 < 310 < x1 and y0 < 650 < y1
    assert worst.where in found.verdict


def test_faint_stars_whose_errors_are_too_small_are_named():
    found = judged(5, 6000, change=lambda m, r: r * np.where(m.mag > 17, 1.5, 1.0)[:, None])
    assert found.level == "fail" and "at magnitudes 17" in found.verdict


def test_errors_that_are_too_large_are_unusual_but_no_doubt():
    found = judged(6, 6000, change=lambda m, r: 0.8 * r)
    assert found.level == "warn" and not found.doubtful


def test_an_exposure_that_went_wrong_is_named():
    model = model_of(exposures=tuple("abcd"))
    found = judged(7, 6000, model, change=lambda m, r: r + 0.02 * (m.exposure == 2)[:, None])
    assert found.level == "fail" and "in exposure c" in found.verdict


# -- pieces against what is known in closed form or by numbers ------------------------------------

MIXTURES = {
    "none": Predictive(model_of(), np.zeros(12), np.zeros((12, 12))),
    "gaussian": Predictive(model_of(), np.zeros(12), np.zeros((12, 12)), "gaussian", 0.2, 0.0, 2.5),
    "uniform": Predictive(model_of(), np.zeros(12), np.zeros((12, 12)), "uniform", 0.2, 0.0, 3.0),
}
COV = np.array([[1.0, 0.5, 0.3]])


def drawn(one: Predictive, n: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    a, b, c = COV[0]
    core = rng.multivariate_normal([0, 0], [[a, c], [c, b]], n)
    far = rng.normal(0, one.scale, (n, 2))
    if one.outliers == "uniform":
        r, phi = one.scale * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
        far = np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)
    return np.where((rng.uniform(size=n) < one.fraction)[:, None], far, core)


@pytest.mark.parametrize("kind", MIXTURES)
def test_predictive_probabilities_are_uniform_and_independent(kind):
    r = drawn(MIXTURES[kind], 20_000)
    p = uniforms_of(MIXTURES[kind], r, np.repeat(COV, len(r), axis=0))
    for values in (*p, *marginals_of(MIXTURES[kind], r, np.repeat(COV, len(r), axis=0))):
        assert kstest(values, "uniform").pvalue > 1e-3
    counts = np.histogram2d(p[0], p[1], bins=8, range=[[0, 1], [0, 1]])[0]
    assert chi2.sf(((counts - 312.5) ** 2 / 312.5).sum(), 63) > 1e-3


@pytest.mark.parametrize("kind", MIXTURES)
def test_expected_tails_are_those_of_draws(kind):
    one, n = MIXTURES[kind], 40_000
    half = 2.0 * np.sqrt(COV[:, :2])
    # of independent axes: the correlation of the prediction is left out, so it is here
    rng, free = np.random.default_rng(3), COV * [1, 1, 0]
    core = rng.normal(size=(n, 2)) * np.sqrt(free[0, :2])
    r = np.where(
        (rng.uniform(size=n) < one.fraction)[:, None], drawn(replace(one, fraction=1.0), n, 4), core
    )
    seen = int((np.abs(r) > half).any(axis=1).sum())
    share = _beyond(one, half, 0.0, free)
    assert binom.ppf(1e-4, n, share) <= seen <= binom.ppf(1 - 1e-4, n, share)


@pytest.mark.parametrize("kind", MIXTURES)
def test_scores_are_derivatives_of_the_log_density(kind):
    one, h = MIXTURES[kind], 1e-5
    r = drawn(one, 50)
    cov = np.repeat(COV, len(r), axis=0)

    def log_p(r, one=one, cov=cov, factor=1.0):
        a, b, c = (cov * factor**2).T
        det = a * b - c * c
        q = (b * r[:, 0] ** 2 - 2 * c * r[:, 0] * r[:, 1] + a * r[:, 1] ** 2) / det
        core = (1 - one.fraction) * np.exp(-q / 2) / (2 * np.pi * np.sqrt(det))
        return np.log(core + one.fraction * one.outlier_density((r**2).sum(axis=1), one.scale))

    one = replace(one, free=("j", "f", "s_out")[: {"none": 1, "gaussian": 3, "uniform": 2}[kind]])
    found = scores_of(one, r, cov)
    for axis in (0, 1):
        step = h * np.eye(2)[axis]
        # by the prediction, from which the data are taken off
        slope = (log_p(r - step) - log_p(r + step)) / (2 * h)
        np.testing.assert_allclose(found.place[:, axis], slope, atol=1e-6)
    slope = (log_p(r, factor=1 + h) - log_p(r, factor=1 - h)) / (2 * h)
    np.testing.assert_allclose(found.one, slope, atol=1e-6)
    free = cov * [1, 1, 0]  # of independent axes a factor on one of them is no correlation's
    found_free = scores_of(one, r, free)
    for axis in (0, 1):
        step = np.eye(3)[axis] * free
        slope = (log_p(r, cov=free + 2 * h * step) - log_p(r, cov=free - 2 * h * step)) / (2 * h)
        np.testing.assert_allclose(found_free.axes[:, axis], slope, atol=1e-6)
        for k in (0, 6, 12):
            wider = free + (SCALES[k] ** 2 - 1) * step
            np.testing.assert_allclose(
                found_free.axes_spread[:, axis, k],
                scores_of(one, r, wider).axes[:, axis],
                atol=1e-9,
            )
    extra = np.array([h, h, 0])
    slope = (log_p(r, cov=cov + extra) - log_p(r, cov=cov - extra)) / (2 * h)
    np.testing.assert_allclose(found.free[:, 0], slope, atol=1e-6)
    if kind != "none":
        low, high = (replace(one, fraction=one.fraction + s) for s in (-h, h))
        slope = (log_p(r, one=high) - log_p(r, one=low)) / (2 * h)
        np.testing.assert_allclose(found.free[:, 1], slope, atol=1e-5)
    if kind == "gaussian":
        low, high = (replace(one, scale=one.scale * np.exp(s)) for s in (-h, h))
        slope = (log_p(r, one=high) - log_p(r, one=low)) / (2 * h)
        np.testing.assert_allclose(found.free[:, 2], slope, atol=1e-6)


@pytest.mark.slow
@only_in_full("stars that are held out are run")
def test_scores_of_the_spread_scatter_as_expected():
    """Without false matches w (q - 2) is 2 (t - 1), t exponential: moments 4 and 16."""
    (second, third), of_axis = SpreadMoments(MIXTURES["none"]).of(COV)
    assert second[0] == pytest.approx(4.0, rel=1e-3)
    assert third[0] == pytest.approx(16.0, rel=1e-3)
    # of one axis they are those of chi-square with one degree of freedom
    second, third = of_axis
    assert second[0] == pytest.approx(2.0, rel=1e-3)
    assert third[0] == pytest.approx(8.0, rel=1e-3)
    one = MIXTURES["gaussian"]
    n = 400_000
    cov = COV * [1, 1, 0]
    r = np.where(
        (np.random.default_rng(1).uniform(size=n) < one.fraction)[:, None],
        np.random.default_rng(2).normal(0, one.scale, (n, 2)),
        np.random.default_rng(3).normal(size=(n, 2)) * np.sqrt(cov[0, 0]),
    )
    same = np.repeat(cov[:, [0, 0, 2]], n, axis=0)
    scores, (of_both, of_axis) = scores_of(one, r, same), SpreadMoments(one).of(same[:1])
    for score, (second, third) in (
        (scores.one, of_both),
        (scores.axes[:, 0], of_axis),
        (scores.axes[:, 1], of_axis),
    ):
        for power, value in ((1, 0.0), (2, second[0]), (3, third[0])):
            error = np.std(score**power) / np.sqrt(n)
            assert abs(np.mean(score**power) - value) < 4.5 * error


def test_sums_of_squares_have_their_exact_probability():
    for n, total in ((5, 14.0), (60, 90.0), (60, 150.0)):
        p = sum_tails(total - 2 * n, 4.0 * n, 16.0 * n)
        tails = chi2.cdf(total, 2 * n), chi2.sf(total, 2 * n)
        assert p == pytest.approx(2 * min(tails), rel=1e-6)
    assert sum_tails(3.0, 4.0, 0.0) == pytest.approx(2 * norm.sf(1.5))


def test_correction_for_the_number_of_tests():
    """The example of Holm's procedure worked by hand."""
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    assert HELD_OUT_DOUBTFUL.value < 0.01
