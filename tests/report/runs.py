"""A WISE-like run whose fit and assessment are real and whose sampler is a Gaussian.

Draws come from a normal distribution near the fit, so that a report takes a second to prepare and
any state of convergence can be shown.

Coefficients: band W2 of Appendix B of the WISE distortion report (u, v in pixels about the centre).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from bayesdist.app.kind import RunKind
from bayesdist.app.parts import NO_TABLES, StoredLookupTables
from bayesdist.app.stars import QUOTED, ErrorLaw
from bayesdist.assess import (
    Requirement,
    UserTerm,
    area_map,
    uncertainty_map,
)
from bayesdist.assess.comparison.compare import Comparison
from bayesdist.assess.evaluation import Evaluation, EvaluationSettings
from bayesdist.data.magnitude_errors import estimate
from bayesdist.data.matches import Matches
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.residuals.misfit import SHOWN
from bayesdist.diagnose.residuals.stars import flagged_by_exposure, star_sample, star_sums
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.convergence import Convergence, Limits
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.posterior.checks import ChiSquare, fit_checks, sampling_checks
from bayesdist.infer.solution.linear import LinearFit, fit_linear, residuals
from bayesdist.infer.stars.likelihood import OutlierMixture
from bayesdist.infer.stars.loading import load
from bayesdist.kinds.matches.kind import MATCHES
from bayesdist.model import Chip, DistortionModel, TimeDependence
from tests.assess.by_draws import margins_by_draws
from tests.budgets import detector_budget

SIZE = (1016.0, 1016.0)
CENTRE = (508.5, 508.5)
W2_A = {
    (0, 0): 7.597772e-01, (0, 1): -1.192789e-04, (1, 0): 1 - 5.040463e-04, (0, 2): -8.064834e-06,
    (0, 3): -4.935791e-10, (0, 4): -1.303108e-13, (1, 1): 1.082862e-06, (1, 2): 3.389170e-10,
    (1, 3): -5.769507e-13, (2, 0): -1.349460e-06, (2, 1): -1.297961e-09, (2, 2): 2.075723e-12,
    (3, 0): 2.959435e-09, (3, 1): -6.743610e-13, (4, 0): 1.787756e-12,
}  # fmt: skip
W2_B = {
    (0, 0): -9.433609e-02, (0, 1): 1 + 5.505028e-04, (1, 0): -2.026974e-04, (0, 2): 1.091415e-06,
    (0, 3): -3.840921e-09, (0, 4): -5.181754e-13, (1, 1): -3.953933e-06, (1, 2): -9.316313e-10,
    (1, 3): 8.534495e-13, (2, 0): 8.038015e-08, (2, 1): 4.101600e-10, (2, 2): -5.705721e-13,
    (3, 0): 1.067827e-10, (3, 1): 1.952342e-12, (4, 0): -1.788157e-13,
}  # fmt: skip
CELLS = (16, 16)  # of the map of mean residuals
F, JITTER, S_OUT = 0.03, 0.02, 0.6


def wise_model(unit: str = "pix", size=SIZE, names=("W2",)) -> DistortionModel:
    centre = ((size[0] + 1) / 2, (size[1] + 1) / 2)
    return DistortionModel(
        order=4,
        chips=tuple(Chip(k, name, size, centre) for k, name in zip((1, 2), names, strict=False)),
        unit=unit,
        time=TimeDependence((("u", 1, 0),), (2010.0,)),
        frames="shift",
        exposures=tuple(f"frame{k}" for k in range(4)),
    )


def sigma_of(mag):
    return 0.05 + 0.12 * 10 ** (0.4 * (mag - 15.0))


def simulated(
    n: int = 6000,
    *,
    unit: str = "pix",
    size=SIZE,
    scale: float = 1.0,
    seed: int = 3,
    names=("W2",),
):
    """Stars of the W2 distortion with 3 % false matches; u, v are `scale` units to the pixel.

    A second chip lies above the first one, with a gap of 30 pixels.
    """
    rng = np.random.default_rng(seed)
    model = wise_model(unit, size, names)
    basis = model.basis(1)
    truth = np.zeros(model.n_params)
    for k, chip in enumerate(model.chips):
        above = {(0, 0): W2_B[0, 0] + k * (size[1] + 30.0)}
        for axis, c in enumerate((W2_A, W2_B | above)):
            place = model.coefficient_slice(chip.number, axis)
            truth[place] = basis.from_monomials([c[t] for t in basis.terms])
    x, y = (rng.uniform(0.5, s + 0.5, n) for s in size)
    mag = 15.5 - rng.exponential(1.0, n)
    sigma = sigma_of(mag)
    exposure = rng.integers(0, 4, n)
    epoch = 2010.0 + 0.1 * exposure
    # no random numbers are drawn for it: those of one chip stay what they are
    chip = np.arange(n) % len(model.chips)
    uv = model.predict(truth, x, y, exposure=exposure, epoch=epoch, chip=chip + 1)
    false = rng.random(n) < F
    spread = np.where(false, S_OUT, np.hypot(sigma, JITTER))
    uv = scale * (uv + rng.normal(size=(n, 2)) * spread[:, None])
    return Matches(
        x, y, uv[:, 0], uv[:, 1], sigma_u=scale * sigma, sigma_v=scale * sigma, unit=unit, mag=mag,
        exposure=exposure, exposure_names=model.exposures, epoch=epoch,
        chip=chip, chip_numbers=tuple(c.number for c in model.chips),
        sources=("wise-w2.ecsv",), n_rows=n + 23,
        rejected={"quality flag": 20, "no magnitude": 3},
    )  # fmt: skip


def sampled(
    fit: LinearFit,
    table: Matches,
    *,
    converged: bool = True,
    outliers: str = "gaussian",
    scale=1.0,
) -> Posterior:
    rng = np.random.default_rng(8)
    shape = (4, 3000)
    root = np.linalg.cholesky(fit.cov)
    mean = fit.mean + 0.3 * root @ rng.standard_normal(len(fit.mean))
    theta = mean + 1.06 * rng.standard_normal((*shape, len(mean))) @ root.T
    if not converged:
        theta[0] += 1.3 * fit.sigma  # one ensemble sits elsewhere
    hyper = {"j": np.abs(rng.normal(JITTER, 0.002, shape)) * scale}
    if outliers != "none":
        hyper["f"] = rng.beta(F * 6000, (1 - F) * 6000, shape)
    if outliers == "gaussian":
        hyper["s_out"] = rng.lognormal(np.log(S_OUT), 0.04, shape) * scale
    r2 = (residuals(fit, table) ** 2).sum(axis=1)
    s2, o2 = table.sigma_u**2 + (scale * JITTER) ** 2, (scale * S_OUT) ** 2
    odds = F / (1 - F) * s2 / o2 * np.exp(np.minimum(0.5 * r2 * (1 / s2 - 1 / o2), 700.0))
    sampled_as = {"j": "log j", "f": "logit f", "s_out": "log s_out"}
    n = len(mean) + len(hyper)
    ess = rng.uniform(3200, 9000, n) if converged else rng.uniform(35, 300, n)
    sd = np.concatenate([theta.std(axis=(0, 1)), [v.std() for v in hyper.values()]])
    convergence = Convergence(
        names=(*fit.model.names, *(sampled_as[k] for k in hyper)),
        rhat=1 + rng.uniform(0, 0.004 if converged else 0.2, n),
        ess_bulk=ess,
        ess_tail=0.8 * ess,
        mcse_mean=sd / np.sqrt(ess),
        mcse_sd=sd / np.sqrt(2 * ess),
        pareto_k=0.21 if converged else 0.83,
        importance_efficiency=0.93 if converged else 0.04,
        converged=converged,
        reasons=() if converged else ("R-hat of u_3_1 is 1.19 and must be at most 1.01",),
        limits=Limits(),
    )
    sampler = SamplerInfo("independence", 4, 2, 1600, 100, 12_800, 0.91, 21.4, 1)
    radius = 3 * scale if outliers == "uniform" else None
    mixture = OutlierMixture(outliers, match_radius=radius)
    return Posterior(
        model=fit.model,
        mixture=mixture,
        theta=theta,
        hyper=hyper,
        log_prob=np.zeros(shape),
        n_stars=len(table),
        n_flagged=int((odds > 1).sum()),
        n_false=float((odds / (1 + odds)).sum()),
        reference_sigma=float(np.median(table.sigma_u)),
        convergence=convergence,
        sampler=sampler,
    )


REQUIREMENTS = (
    Requirement("field-wide", "p95", 0.1, "pix", 0.95),
    Requirement("worst corner", "max", 0.02, "pix"),
    Requirement("along scan", "u_rms", 0.017, "pix"),
)
TERMS = (
    UserTerm("reference catalogue", "systematic", 0.008, 0.007, "pix"),
    UserTerm("centroid of a bright star", "random", 0.004, 0.004, "pix"),
)


@dataclass(frozen=True, eq=False)
class SketchedRun:
    """A `ReportedRun` whose members are given."""

    title: str
    configuration: Mapping[str, Any]
    fit: LinearFit
    posterior: Posterior
    diagnostics: Diagnostics
    evaluation: Evaluation
    errors: ErrorLaw = QUOTED
    added_errors: GroupedErrors | None = None
    held_parameters: frozenset[str] = frozenset()
    tables: StoredLookupTables = NO_TABLES
    kind: RunKind = MATCHES
    previous: tuple[Comparison, ...] = ()
    report_data: Any = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> DistortionModel:
        return self.fit.model

    @property
    def solution(self) -> Posterior:
        return self.posterior

    def having(self, **changes: Any) -> SketchedRun:
        """The run with other members, or other members of its diagnostics and evaluation."""
        own = {field.name for field in dataclasses.fields(self)}
        for name in ("diagnostics", "evaluation"):
            part = getattr(self, name)
            of_part = {field.name for field in dataclasses.fields(part)} & changes.keys() - own
            new = {key: changes.pop(key) for key in of_part}
            changes[name] = replace(changes.get(name, part), **new)
        return replace(self, **changes)


@lru_cache
def report_run(
    *,
    converged: bool = True,
    outliers: str = "gaussian",
    unit: str = "pix",
    size: tuple[float, float] = SIZE,
    scale: float = 1.0,
    shown: int = 1_000_000,
    names: tuple[str, ...] = ("W2",),
) -> SketchedRun:
    """A run as the report takes it; at most `shown` stars are drawn."""
    rng = np.random.default_rng(11)
    table = simulated(unit=unit, size=size, scale=scale, names=names)
    fit = fit_linear(table, wise_model(unit, size, names))
    posterior = sampled(fit, table, converged=converged, outliers=outliers, scale=scale)
    shards = load(fit.model, table)
    numbers = [chip.number for chip in fit.model.chips]
    bins = dict.fromkeys(numbers, (CELLS,))
    sums = shards.sum(star_sums, fit.likelihood, posterior.likelihood, bins)
    stars = star_sample(table.sample(shown), len(table), fit, posterior)
    mag, residual = (a[stars.used] for a in (stars.table.mag, stars.fit_residual))
    place = {"epoch": 2010.3}
    chi_square = ChiSquare(fit.chi2, fit.dof)
    diagnostics = Diagnostics(
        sums=sums,
        partitions={number: {SHOWN: CELLS} for number in numbers},
        misfits=(),
        coverage=(),
        sample=stars,
        chi_square=chi_square,
        input_checks=(),
        dates=np.unique(table.epoch),
        flagged=flagged_by_exposure(shards, posterior),
    )
    assessed = {"terms": TERMS, "n_draws": 500, "rng": rng, "pixel_scale": 2757.0} | place
    evaluation = Evaluation(
        settings=EvaluationSettings(scale_mas=2757.0, **place),
        formal=tuple(uncertainty_map(fit, chip=n, **place) for n in numbers),
        maps=tuple(uncertainty_map(posterior, chip=n, **place) for n in numbers),
        relative=(),
        areas=tuple(area_map(posterior, chip=n, **place) for n in numbers),
        budget=detector_budget(posterior, **assessed),
        surface=None,
        margins=margins_by_draws(posterior, REQUIREMENTS, **assessed),
        validity=(),
        checks=(*sampling_checks(posterior), chi_square.check(), *fit_checks(fit)),
    )
    return SketchedRun(
        title="wise-w2",
        configuration={
            "data": {"matches": "wise-w2.ecsv", "unit": unit, "sigma": "by_magnitude"},
            "detector": {"name": "W2", "size": list(size), "scale_mas": 2757.0},
            "model": {"order": 4, "frames": "shift"},
            "fit": {"clip_chi2": 25.0, "clip_abs": 2.0},
        },
        fit=fit,
        posterior=posterior,
        diagnostics=diagnostics,
        evaluation=evaluation,
        errors=ErrorLaw(by_magnitude=estimate(mag, *residual.T)),
        summary={
            "products": [
                written("sip.hdr", "SIP header", closure_pix=3.1e-6, a_dmax=2.21),
                written("maps.fits", "uncertainty maps"),
            ]
        },
        provenance={
            "command": "bayesdist run wise.toml -o run",
            "seed": 1,
            "versions": {"bayesdist": "0.1.0", "numpy": np.__version__},
            "inputs": {"wise-w2.ecsv": "9f86d081884c7d659a2feaa0c55ad015" * 2},
            "timings": {"fit": 0.4, "sample": 21.4, "assess": 3.2},
        },
    )


def written(path: str, kind: str, *findings: str, **numbers: Any) -> dict[str, Any]:
    """A product as in summary.json."""
    return {"path": path, "kind": kind, "findings": list(findings), **numbers}
