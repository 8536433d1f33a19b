"""Small campaigns in which stars and whole exposures are held out, solved without sampling.

Stars lie on a fixed field, exposures point and roll over it as they like, and a star has one error
of the catalogue in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.data.preparing import HoldoutSpec, HoldoutSplit, split_matches
from bayesdist.diagnose.holdout.predictive import ExposureDeviations, Predictive
from bayesdist.diagnose.holdout.validation import HoldoutValidation, holdout_validation
from bayesdist.infer import OutlierMixture, Rejection, load
from bayesdist.infer.catalogue.star_covariance import star_covariance, star_influence
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.target import Target
from bayesdist.infer.exposures.hierarchy import HierarchicalFit, fit_hierarchical
from bayesdist.model import DistortionModel
from tests.infer.small_campaign import campaign_model, campaign_truth

CENTROID, POSITION, MOTION = 0.02, 0.008, 0.002  # pixels, and pixels per year
TAU, OWN = (7e-6, 5e-6, 3e-6), (8e-3, 8e-3, 2e-6, 2e-6, 1.5e-6, 1e-6)
DATE = 2004.5  # of the catalogue


@dataclass(frozen=True, eq=False)
class Field:
    """A campaign of known truth.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
    matches : Matches
    errors : StarErrors
        Of the catalogue.
    """

    model: DistortionModel
    theta: np.ndarray
    matches: Matches
    errors: StarErrors


def field(
    seed: int,
    *,
    n_exposures: int = 10,
    n_stars: int = 700,
    order: int = 2,
    one_pointing: bool = False,
    fraction: float = 0.0,
    far: float = 0.5,
    centroid: float = CENTROID,
    wrong: dict[str, float] | None = None,
    bent=None,
) -> Field:
    """Stars of a catalogue on two chips; `bent` adds (N, 2) pixels to the detector's positions.

    With `one_pointing` all exposures see the same stars within 100 pixels of the same places.
    """
    rng = np.random.default_rng(seed)
    rolls = np.full(n_exposures, 0.3) if one_pointing else rng.uniform(-3, 3, n_exposures)
    model = campaign_model(n_exposures, order=order, rolls=rolls, apart=True)
    theta = campaign_truth(model, rng, tau=TAU, rolls=rolls, own=OWN)
    for name, value in (wrong or {}).items():
        theta[model.names.index(name)] += value
    epochs = np.sort(rng.uniform(2002.3, 2007.1, n_exposures))
    star, exposure = (a.ravel() for a in np.meshgrid(np.arange(n_stars), np.arange(n_exposures)))
    chip = rng.integers(1, 3, n_stars)[star]
    home = rng.uniform(150, 1900, (n_stars, 2))[star] * [2, 1]
    x, y = (home + rng.uniform(-100, 100, home.shape) * [2, 1]).T
    if not one_pointing:
        x, y = rng.uniform(1, 4096, star.size), rng.uniform(1, 2048, star.size)
        chip = rng.integers(1, 3, star.size)
    seen = rng.uniform(size=star.size) < 0.6
    star, exposure, chip, x, y = (a[seen] for a in (star, exposure, chip, x, y))
    epoch = epochs[exposure]
    mag = rng.uniform(14, 20, n_stars)[star]
    sigma = centroid * 10 ** (0.1 * (mag - 17))
    shift = np.zeros((len(x), 2)) if bent is None else bent(x, y, exposure, chip)
    place = {"epoch": epoch, "exposure": exposure, "chip": chip}
    true = model.predict(theta, x + shift[:, 0], y + shift[:, 1], **place)
    errors = StarErrors(
        np.full((n_stars, 2), POSITION), np.full((n_stars, 2), MOTION), np.full(n_stars, DATE)
    )
    moved = np.einsum(
        "lan,lna->na",
        errors.levers(star, epoch),
        (np.array([POSITION, MOTION])[:, None, None] * rng.standard_normal((2, n_stars, 2)))[
            :, star
        ],
    )
    data = true + moved + sigma[:, None] * rng.standard_normal(true.shape)
    false = rng.uniform(size=len(x)) < fraction
    data[false] = (true + far * rng.standard_normal(true.shape))[false]
    quoted = np.sqrt(sigma**2 + errors.at(star, epoch)[:, 0])
    matches = Matches(
        x=x,
        y=y,
        u=data[:, 0],
        v=data[:, 1],
        sigma_u=quoted,
        sigma_v=quoted,
        epoch=epoch,
        mag=mag,
        exposure=exposure,
        exposure_names=model.exposures,
        chip=chip - 1,
        chip_numbers=(1, 2),
        star=star,
    )
    return Field(model, theta, matches, errors)


def solved(
    one: Field, split: HoldoutSplit, whole: tuple[str, ...], *, mixture: bool = False
) -> tuple[HierarchicalFit, Predictive]:
    """The joint fit of what is kept, and what it predicts."""
    kept, held = split.kept, split.held
    assert held is not None
    model = replace(one.model, exposures=kept.exposure_names)
    joint = fit_hierarchical(
        kept, model, rejection=Rejection(25.0 if mixture else np.inf, None), n_tau=64
    )
    mean, cov, extra = joint.mean, joint.cov, {}
    if mixture:
        shards = load(model, kept)
        target = Target(shards, OutlierMixture(jitter=0.0), joint.priors)
        proposal = build_proposal(target, joint.fit)
        best, n = proposal.best, model.n_params
        psi = proposal.split.to_psi(best.mode, best.at)
        hyper = target.hyper.values(psi[n:])
        mean = joint.settling.mean(psi[:n])
        tau = np.sqrt((joint.tau_draws**2).mean(axis=0))
        cov = joint.settling.covariance(best.factor.covariance()[:n, :n], tau)
        f, scale = float(hyper["f"]), float(hyper["s_out"])
        known = [f * (1 - f) / len(kept), 1 / max(4 * f * len(kept), 1)]
        extra = {
            "outliers": "gaussian",
            "fraction": f,
            "scale": scale,
            "free": ("f", "s_out"),
            "free_cov": np.diag(known),
        }
        shards.close()
    errors = one.errors
    shared = star_covariance(joint.fit, kept, errors)
    codes = np.unique(held.star[np.isin(np.array(held.exposure_names)[held.exposure], whole)])
    return joint, Predictive(
        model,
        mean,
        cov + shared.extra,
        deviations=ExposureDeviations(joint.scatter.kinds, joint.tau_draws),
        stars=star_influence(joint.fit, kept, errors, codes),
        **extra,
    )


def judged(one: Field, aside: HoldoutSpec, *, mixture: bool = False) -> HoldoutValidation:
    """Hold out, solve, predict, judge."""
    split = split_matches(one.matches, aside)
    _, predictive = solved(one, split, aside.exposures, mixture=mixture)
    return holdout_validation(predictive, split.held, whole=aside.exposures)
