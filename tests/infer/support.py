"""Small data sets with known truth, and design matrices that owe nothing to the library."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.polynomial import legendre
from scipy.special import logit

from bayesdist.data.matches import Matches
from bayesdist.infer import (
    Convergence,
    GaussianPriors,
    Limits,
    LinearFit,
    OutlierMixture,
    Posterior,
    Rejection,
    SamplerInfo,
    fit_linear,
    load,
)
from bayesdist.infer.density.target import Target
from bayesdist.infer.stars.likelihood import OUTLIER_SHAPE, T_DOF, Hyper
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches

SIZE = (1000.0, 800.0)
CHIP = Chip(1, "A", SIZE, (500.0, 400.0))
TWO_CHIPS = (CHIP, Chip(2, "B", (900.0, 850.0), (450.0, 425.0)))
# outlier models with all that they sample: log(jitter), logit(f), log(s_out)
MIXTURES = {
    "gaussian": (OutlierMixture(), [np.log(0.02), -3.0, np.log(0.8)]),
    "uniform": (OutlierMixture("uniform", match_radius=2.0), [np.log(0.02), -3.0]),
    "none": (OutlierMixture("none"), [np.log(0.02)]),
}
UNCLIPPED = {"rejection": Rejection(np.inf, None)}


def legendre_design(order: int, x, y, size=SIZE) -> np.ndarray:
    """Rows of P_i(X) P_j(Y), i + j <= order, by total order, then falling power of x."""
    X, Y = ((2 * np.asarray(p) - n - 1) / n for p, n in zip((x, y), size, strict=True))
    full = legendre.legvander2d(X, Y, [order, order]).reshape(len(X), order + 1, order + 1)
    return np.stack([full[:, t - j, j] for t in range(order + 1) for j in range(t + 1)], axis=1)


def exposures(n: int) -> tuple[str, ...]:
    return tuple(f"e{k + 1}" for k in range(n))


def truth_of(model: DistortionModel, rng: np.random.Generator) -> np.ndarray:
    """A plausible distortion: pixels, a linear part of about one, a few pixels of higher order."""
    theta = np.zeros(model.n_params)
    for chip in model.chips:
        half = (chip.size[0] / 2, chip.size[1] / 2)
        for axis in (0, 1):
            c = rng.standard_normal(model.n_terms) * 3.0 / (1 + np.arange(model.n_terms))
            c[0] += chip.size[axis] / 2 + 50 * chip.number
            c[1 + axis] += half[axis]
            theta[model.coefficient_slice(chip.number, axis)] = c
        theta[model.tdd_slice(chip.number)] = 0.2 * rng.standard_normal(model.n_tdd)
    for block in model.local_blocks:
        theta[block] = 0.01 * rng.standard_normal(model.n_frame)
        theta[block][:2] = 5.0 * rng.standard_normal(2)
    return theta


def simulated(
    seed: int,
    n: int,
    *,
    order: int = 2,
    frames: str = "none",
    n_exposures: int = 1,
    chips: tuple[Chip, ...] = (CHIP,),
    time: TimeDependence | None = None,
    epochs=None,
    theta=None,
    **options,
):
    """Model, matches and truth; no false matches and exact errors unless asked for."""
    rng = np.random.default_rng(seed)
    model = DistortionModel(
        order,
        chips,
        frames=frames,
        exposures=exposures(n_exposures),
        time=time,
        origin=(500.0, 400.0),
    )
    theta = truth_of(model, rng) if theta is None else theta
    options = {"fraction": 0.0} | options
    matches, truth = simulate_matches(model, theta, n, rng=rng, epochs=epochs, **options)
    return model, matches, truth


def table(x, y, u, v, sigma=0.05, **columns) -> Matches:
    n = len(x)
    sigma_u, sigma_v = (np.broadcast_to(s, n) for s in np.broadcast_arrays(sigma, sigma))
    return Matches(x, y, u, v, sigma_u=sigma_u, sigma_v=sigma_v, **columns)


def target_of(
    model: DistortionModel,
    matches: Matches,
    mixture: OutlierMixture,
    priors: GaussianPriors | None = None,
    **fit_options,
) -> tuple[Target, LinearFit]:
    shards = load(model, matches)
    fit = fit_linear(shards, model, priors=priors, **fit_options)
    return Target(shards, mixture, priors or GaussianPriors.none(model)), fit


def stars_of(model: DistortionModel, matches: Matches) -> Stars:
    return prepare(model, matches)[0]


def columns_of(matches: Matches) -> dict[str, np.ndarray]:
    """What `DistortionModel.predict` and `jacobian` want beside the pixels."""
    return {
        "epoch": matches.epoch,
        "exposure": matches.exposure,
        "chip": matches.chip_number,
    }


def residual_of(model: DistortionModel, theta, matches: Matches) -> np.ndarray:
    """Data minus `DistortionModel.predict`, star by star: no groups, no powers, no kernel."""
    uv = model.predict(theta, matches.x, matches.y, **columns_of(matches))
    return np.column_stack([matches.u, matches.v]) - uv


def posterior_at(target: Target, psi: np.ndarray) -> Posterior:
    """A posterior whose draws are the points psi (n, D): one chain, nothing said of convergence."""
    n, nothing = target.n_theta, np.zeros(psi.shape[1])
    return Posterior(
        model=target.model,
        mixture=target.mixture,
        theta=psi[None, :, :n],
        hyper={k: v[None] for k, v in target.hyper.values(psi[:, n:]).items()},
        log_prob=target.log_density(psi)[None],
        n_stars=len(target.shards),
        n_flagged=0,
        n_false=0.0,
        reference_sigma=target.hyper.scale,
        convergence=Convergence(
            target.names, *[nothing] * 5, 0.0, 1.0, False, ("made by hand",), Limits()
        ),
        sampler=SamplerInfo("by hand", 1, 1, len(psi), 0, 0, 1.0, 0.0, 0),
    )


def numerical_gradient(function, point: np.ndarray, step) -> np.ndarray:
    """Central differences of fourth order."""
    out = []
    steps = np.broadcast_to(step, point.shape)
    for k in range(len(point)):
        e = np.zeros(len(point))
        e[k] = steps[k]
        outer = np.asarray(function(point + 2 * e)) - np.asarray(function(point - 2 * e))
        inner = np.asarray(function(point + e)) - np.asarray(function(point - e))
        out.append((8 * inner - outer) / (12 * steps[k]))
    return np.stack(out, axis=-1)


def pieces(n: int, cuts: list[int]) -> list[np.ndarray]:
    return [np.arange(a, b) for a, b in pairwise([0, *cuts, n])]


def draw_prior(hyper: Hyper, n: int, rng: np.random.Generator) -> np.ndarray:
    """Points (n, n_hyper) from the prior of a mixture, for simulation-based calibration."""
    columns: list[np.ndarray] = []
    for name in hyper.mixture.hyper:
        if name == "f":
            f = rng.beta(*hyper.mixture.fraction_prior, size=n)
            columns.append(logit(np.clip(f, 1e-300, 1 - 1e-16)))
        elif name == "j":
            columns.append(np.log(hyper._jitter_scale * np.abs(rng.standard_t(T_DOF, size=n))))
        else:
            unit = rng.gamma(OUTLIER_SHAPE, size=n)  # w^2 is the rate over this
            rate = hyper._outlier_rate(np.column_stack(columns))
            columns.append(0.5 * np.log(rate / unit))
    return np.column_stack(columns) if columns else np.zeros((n, 0))
