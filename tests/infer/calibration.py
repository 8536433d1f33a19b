"""One simulated truth and what is said of it: the unit of the coverage and rank suites."""

from __future__ import annotations

import numpy as np

from bayesdist.infer import OutlierMixture, Rejection, fit_linear, sample
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches
from tests.seeds import over

from .support import draw_prior

LEVELS = (0.683, 0.954)
SIZE = (1016.0, 1016.0)
PLACES = np.array(
    [
        *[(508, 508), (100, 100), (900, 120), (110, 905), (1000, 1000)],
        *[(300, 700), (650, 250), (508, 1010), (5, 508), (800, 600)],
    ],
    float,
)


def _truth(order: int, rng: np.random.Generator) -> tuple[DistortionModel, np.ndarray]:
    model = DistortionModel(order, (Chip(1, "chip", SIZE, (508.5, 508.5)),))
    theta = rng.normal(size=model.n_params)
    for axis, term in ((0, (1, 0)), (1, (0, 1))):
        theta[model.coefficient_slice(1, axis)][model.basis().terms.index(term)] += 508.0
    return model, theta


def _errors(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    sigma = 0.05 * np.exp(0.3 * rng.normal(size=(n, 2)))
    return sigma[:, 0], sigma[:, 1]


def _inside(draws: np.ndarray, truth: np.ndarray, level: float) -> np.ndarray:
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return (low <= truth) & (truth <= high)


def coverage_of(seed: int) -> dict[str, np.ndarray]:
    """Which intervals cover, for the posterior and for clipped least squares."""
    rng = np.random.default_rng([20, seed])
    model, theta = _truth(3, rng)
    n = 500
    matches, _ = simulate_matches(
        model, theta, n, rng=rng, sigma=_errors(n, rng), fraction=0.03, jitter=0.02
    )
    fit = fit_linear(matches, model)
    posterior = sample(fit, matches, seed=seed)
    x, y = PLACES.T
    truth_uv = model.predict(theta, x, y)
    out = {"converged": np.array(posterior.convergence.converged)}
    for name, draws in (
        ("posterior", posterior.flat),
        ("clipped", fit.draws(4000, np.random.default_rng(seed))),
    ):
        uv = model.predict(draws, x, y)
        for level in LEVELS:
            out[f"{name} coefficients {level}"] = _inside(draws, theta, level)
            out[f"{name} positions {level}"] = _inside(uv, truth_uv, level)
    return out


def ranks_of(seed: int) -> dict[str, float]:
    """Rank of f, j, s_out, drawn from their priors, among thinned posterior draws."""
    rng = np.random.default_rng([21, seed])
    model, theta = _truth(2, rng)
    n = 300
    sigma = _errors(n, rng)
    hyper = OutlierMixture().bind(float(np.median(np.concatenate(sigma))))
    true = {k: float(v) for k, v in hyper.values(draw_prior(hyper, 1, rng)[0]).items()}
    matches, _ = simulate_matches(
        model,
        theta,
        n,
        rng=rng,
        sigma=sigma,
        fraction=true["f"],
        jitter=true["j"],
        outlier_scale=true["s_out"],
    )
    # no rejection by absolute size: s_out from its prior may be hundreds of pixels
    fit = fit_linear(matches, model, rejection=Rejection(clip_abs=None))
    posterior = sample(fit, matches, seed=seed, target_ess=800)
    out = {"converged": float(posterior.convergence.converged)}
    for key, values in posterior.hyper.items():
        thinned = rng.choice(values.ravel(), 199, replace=False)
        out[key] = float((thinned < true[key]).sum())
    return out


def over_seeds(function, n: int) -> list:
    """A function of the seed over n seeds, on all cores."""
    return over(function, ((seed,) for seed in range(n)), lot=4)
