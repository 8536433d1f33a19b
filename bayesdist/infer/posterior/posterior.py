"""The posterior as a result: draws, their moments, convergence, and how they were made."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.infer.convergence import DIAGNOSTICS, Convergence
from bayesdist.infer.posterior.groups import Group, datatree_of
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.likelihood import MixtureAt
from bayesdist.infer.stars.mixture import Hyper, OutlierMixture
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Random, generator_of

if TYPE_CHECKING:
    import xarray

SCHEMA = 2  # of posterior.nc
POSTERIOR_NUMBERS = ("n_stars", "n_flagged", "n_false", "reference_sigma")


@dataclass(frozen=True)
class SamplerInfo:
    """Record of how the draws were made.

    Parameters
    ----------
    method : str
        Moves that were used.
    ensembles, walkers, steps : int
        Steps of each ensemble, warm-up included.
    warmup : int
        Steps dropped from each ensemble.
    passes : int
        Evaluations of the likelihood of all stars.
    acceptance : float
        Fraction of accepted proposals.
    wall_s : float
        Seconds of this session.
    seed : int
    exact : bool
        False where draws are those of a surrogate.
    """

    method: str
    ensembles: int
    walkers: int
    steps: int
    warmup: int
    passes: int
    acceptance: float
    wall_s: float
    seed: int
    exact: bool = True


@dataclass(frozen=True)
class Certificate:
    """Distance of a surrogate s from the posterior p, by pilots that were not used to make it.

    Each pilot is one pass over the data.
    """

    n_train: int
    n_held_out: int
    n_outside: int  # pilots where the posterior density is zero
    raw_sd: float  # standard deviation of log p - log q: without a surrogate
    remainder_sd: float  # standard deviation of log p - log s, over the pilots held out
    remainder_max: float  # the largest of these, with p and s normalised
    raw_efficiency: float  # effective fraction of draws of q, weighted by p / q; over all pilots
    # effective fraction of draws of s, weighted by p / s; over the pilots held out: 1 / (1 + chi2)
    efficiency: float
    pareto_k: float  # tail of p / q: where it is heavy, q misses a part of p that no pilot shows
    chi2: float  # estimate of chi2(p || s) (module docstring)
    chi2_upper: float  # upper limit of it
    # no posterior mean is off by more than this many standard deviations; from `chi2_upper`
    mean_shift_bound: float
    # bound of the total variation: no probability is off by more; from `chi2_upper`
    tv_bound: float
    unseen: float  # largest probability under q of a region that all held-out pilots missed (95 %)
    reasons: tuple[str, ...]  # of a refusal; empty when it is granted

    @property
    def granted(self) -> bool:
        """True if draws of the surrogate may represent the posterior."""
        return not self.reasons

    @property
    def statement(self) -> str:
        """Scope and limits of the certificate, in words."""
        if not self.granted:
            return f"certificate refused: {'; '.join(self.reasons)}"
        return (
            f"approximate, with certificate: by {self.n_held_out} exact evaluations that took no "
            f"part in the approximation, no posterior mean is off by more than "
            f"{self.mean_shift_bound:.2g} of its standard deviation; regions that hold less than "
            f"{self.unseen:.2g} of the proposal's probability, such as a separate mode, "
            f"may have been missed"
        )


@dataclass(frozen=True, eq=False)
class Posterior(Solution):
    """Posterior draws of the distortion and of the outlier mixture.

    Parameters
    ----------
    model : DistortionModel
    mixture : OutlierMixture
    theta : ndarray, shape (chains, draws, D)
        One chain for each independent ensemble; its draws are those of the first walker, then of
        the second, and so on.
    hyper : dict of str to ndarray, shape (chains, draws)
        Sampled ones of 'f', 'j' and 's_out', in natural form.
    log_prob : ndarray, shape (chains, draws)
        Log posterior density, up to a constant.
    n_stars, n_flagged : int
        Number of all stars, and of those that are more likely false matches than not.
    n_false : float
        Expected number of false matches: the sum of the probabilities.
    reference_sigma : float
        Median quoted error, in which the priors of the mixture are scaled.
    convergence : Convergence
    sampler : SamplerInfo
    certificate : Certificate, optional
        Of the surrogate, where one was made.
    own_places : bool
        True if the stars' positions are unknowns of the solution, as in a self-calibration: the
        matches then have the positions of the mean, which are those of no other draw.
    tangent_point : tuple of float, optional
        RA and Dec in degrees of the plane of u, v: `LinearFit.tangent_point` of the fit.
    matches_digest : str
        `Matches.digest` of the stars; empty if it is not known, as in a file.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> posterior = bd.sample(fit, matches, seed=1, target_ess=100)
    >>> posterior.draws(100, rng).shape
    (100, 12)
    >>> low, high = posterior.interval(0.683).T
    >>> bool((low < high).all())
    True
    """

    model: DistortionModel
    mixture: OutlierMixture = field()
    theta: Float
    hyper: dict[str, Float]
    log_prob: Float
    n_stars: int
    n_flagged: int
    n_false: float
    reference_sigma: float
    convergence: Convergence = field()
    sampler: SamplerInfo
    certificate: Certificate | None = None
    own_places: bool = False
    tangent_point: tuple[float, float] | None = field(default=None)
    matches_digest: str = ""

    def __repr__(self) -> str:
        c = self.convergence
        state = "converged" if c.converged else f"NOT CONVERGED ({'; '.join(c.reasons)})"
        return (
            f"Posterior({self.model.summary}, {self.n_stars} stars, {self.n_flagged} of them "
            f"flagged, {len(self.flat)} draws, {state}, R-hat {c.rhat_max:.4g}, "
            f"ESS {c.ess_bulk_min:.4g})"
        )

    @property
    def approximation(self) -> str:
        """Warning for every output that the draws are not exact; empty where they are."""
        if self.sampler.exact or self.certificate is None:
            return ""
        return self.certificate.statement

    @cached_property
    def flat(self) -> Float:
        """All draws of theta, shape (chains * draws, D)."""
        return self.theta.reshape(-1, self.theta.shape[-1])

    @cached_property
    def mean(self) -> Float:
        """Posterior mean of theta, shape (D,)."""
        return self.flat.mean(axis=0)

    @cached_property
    def cov(self) -> Float:
        """Posterior covariance of theta, shape (D, D); zero for parameters that a gauge fixes."""
        # from one of the draws: the mean of equal numbers is rounded, their difference is not
        return np.atleast_2d(np.cov(self.flat - self.flat[0], rowvar=False))

    @property
    def sigma(self) -> Float:
        """Posterior standard deviation of theta, shape (D,)."""
        return self.flat.std(axis=0, ddof=1)

    def interval(self, probability: float) -> Float:
        """Central interval of every entry of theta, shape (D, 2).

        Parameters
        ----------
        probability : float
            Between 0 and 1.
        """
        tail = (1 - probability) / 2
        return np.quantile(self.flat, [tail, 1 - tail], axis=0).T

    def draws(self, n: int, rng: Random) -> Float:
        """Random draws (n, D) of theta, without replacement as long as there are enough.

        Parameters
        ----------
        n : int
            How many.
        rng : int or numpy.random.Generator
            Seed, or source of the random numbers.
        """
        theta, rows = self.drawn_rows(n, rng)
        return theta[rows]

    def drawn_rows(self, n: int, rng: Random) -> tuple[Float, Int]:
        """All draws of theta (m, D), and the rows (n,) among them that `draws` gives."""
        total = len(self.flat)
        return self.flat, generator_of(rng).choice(total, size=n, replace=n > total)

    def groups(self, provenance: Mapping[str, object] | None = None) -> dict[str, Group]:
        """Groups of variables by name, as posterior.nc has them; the top group is ''.

        Parameters
        ----------
        provenance : mapping, optional
            JSON-able facts about the run.
        """
        c = self.convergence
        names, units = self.model.names, self.model.units
        return {
            "": Group(
                attrs={
                    "schema": SCHEMA,
                    "creator": "bayesdist",
                    "model": json.dumps(self.model.to_dict()),
                    "mixture": json.dumps(asdict(self.mixture)),
                    "provenance": json.dumps(dict(provenance or {}), default=str),
                    "certificate": json.dumps(self.certificate and asdict(self.certificate)),
                    "n_parameters": len(names),
                    "own_places": int(self.own_places),
                    "tangent_point": json.dumps(self.tangent_point),
                    **{name: getattr(self, name) for name in POSTERIOR_NUMBERS},
                }
            ),
            "posterior": Group(
                {
                    "theta": (("chain", "draw", "parameter"), self.theta),
                    **{k: (("chain", "draw"), v) for k, v in self.hyper.items()},
                    "parameter": (("parameter",), names),
                },
                # no coordinate: ArviZ 1.x cannot summarise variables that do not share it
                attrs={"units": json.dumps(units)},
            ),
            "sample_stats": Group(
                {"lp": (("chain", "draw"), self.log_prob)},
                attrs=asdict(self.sampler) | {"exact": int(self.sampler.exact)},
            ),
            "diagnostics": Group(
                {
                    **{name: (("sampled",), getattr(c, name)) for name in DIAGNOSTICS},
                    "sampled": (("sampled",), c.names),
                },
                attrs={
                    "pareto_k": c.pareto_k,
                    "importance_efficiency": c.importance_efficiency,
                    "converged": int(c.converged),
                    "reasons": json.dumps(c.reasons),
                    "limit_ess": c.limits.ess,
                    "limit_rhat": c.limits.rhat,
                },
            ),
        }

    def to_datatree(self) -> xarray.DataTree:
        """Data tree for ArviZ and xarray.

        Returns
        -------
        xarray.DataTree
            Groups posterior (`theta` by chain, draw and parameter, whose names are a coordinate
            and whose units are the attribute `units`; f, j, s_out), sample_stats (`lp`, the log
            density) and diagnostics.

        Raises
        ------
        InputError
            If xarray is not installed.

        Examples
        --------
        >>> matches, truth = bd.simulate_wise(500, rng=np.random.default_rng(1))
        >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
        >>> tree = bd.sample(fit, matches, seed=1, target_ess=100).to_datatree()
        >>> tree["posterior"]["theta"].dims
        ('chain', 'draw', 'parameter')
        """
        return datatree_of(self.groups())

    @property
    def sampled_points(self) -> tuple[Float, Float]:
        """All draws as theta (n, D) and hyperparameters (n, h) in sampled coordinates."""
        h = self.bound_mixture.point({k: self.hyper[k].ravel() for k in self.mixture.hyper})
        return self.flat, h.reshape(len(self.flat), len(self.mixture.hyper))

    @property
    def bound_mixture(self) -> Hyper:
        """Mixture with its priors in the unit of the data."""
        return self.mixture.bind(self.reference_sigma)

    @property
    def likelihood(self) -> MixtureAt:
        """Mixture at the mean of theta and of the sampled coordinates of the hyperparameters.

        Location and scale of a symmetric density are nearly independent.
        """
        _, h = self.sampled_points
        return MixtureAt(self.mean, self.bound_mixture.constants(h.mean(axis=0)[None]))

    def mapped(self, matrix: Float) -> Posterior:
        """Posterior whose deviations from the mean are mapped by a matrix (D, D).

        Parameters
        ----------
        matrix : ndarray, shape (D, D)
            Of all parameters, in the order of the model's names.
        """
        return replace(self, theta=self.mean + (self.theta - self.mean) @ matrix.T)
