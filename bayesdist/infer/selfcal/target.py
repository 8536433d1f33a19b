"""Posterior density of a self-calibration, the stars integrated out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.selfcal.information import Information
from bayesdist.infer.selfcal.normal import Anchor, log_marginal
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.infer.selfcal.solve import Solution
from bayesdist.infer.stars.mixture import Hyper, OutlierMixture

__all__ = ["SelfTarget"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SelfTarget:
    """Density of psi = (free parameters, log j, logit f); j in pixels."""

    solution: Solution  # the mode; parameters that it fixes stay there
    jitter: float | None = None  # fixed value; sampled by default
    # (a, b) of the Beta prior of the fraction of false detections
    fraction_prior: tuple[float, float] = (1.0, 9.0)
    # of the prior of the jitter, in pixels; by default the typical error of a detection
    jitter_scale: float | None = None

    @property
    def problem(self) -> Problem:
        """Detections, linearised about the mode."""
        return self.solution.problem

    @property
    def information(self) -> Information:
        """Information from other sources than the detections."""
        return self.solution.information

    @cached_property
    def mixture(self) -> OutlierMixture:
        """Mixture with uniform false detections, in pixels."""
        radius = self.problem.match_radius
        return OutlierMixture(
            "uniform", radius, self.jitter, self.fraction_prior, self.jitter_scale
        )

    @cached_property
    def hyper(self) -> Hyper:
        """Priors of jitter and fraction of false detections."""
        return self.mixture.bind(self.problem.sigma)

    @property
    def n_theta(self) -> int:
        """Number of free parameters."""
        return len(self.solution.free)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        all_names = self.problem.model.names
        return (*(all_names[k] for k in self.solution.free), *self.hyper.names)

    @cached_property
    def _anchor(self) -> Anchor:
        s = self.solution
        return Anchor.at(s.problem, s.theta, s.mixture, s.stars)

    def theta(self, free: Float) -> Float:
        """Parameters (..., D) from free ones (..., F)."""
        out = np.tile(self.solution.theta, (*free.shape[:-1], 1))
        out[..., self.solution.free] = free
        return out

    def mixtures(self, hyper: Float) -> Float:
        """Jitter and fraction of false detections (n, 2) of sampled coordinates."""
        values = self.hyper.values(hyper)
        j = values.get("j", np.full(len(hyper), self.jitter or 0.0))
        return np.stack([j, values["f"]], axis=1)

    def log_density(self, psi: Float) -> Float:
        """Log posterior (n,) of points (n, F + h); minus infinity outside the support."""
        ok = np.isfinite(psi).all(axis=1)
        out = np.full(len(psi), -np.inf)
        if not ok.any():
            return out
        theta, h = self.theta(psi[ok, : self.n_theta]), psi[ok, self.n_theta :]
        value = self.information.log_density(theta) + self.hyper.log_prior(h)
        value += log_marginal(self.problem, theta, self.mixtures(h), self._anchor)
        out[ok] = np.where(np.isnan(value), -np.inf, value)
        return out
