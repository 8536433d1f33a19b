"""The posterior: draws, their moments, convergence diagnostics, and a record of the sampling."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.errors import InputError
from bayesdist.infer.convergence import DIAGNOSTICS, Convergence
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.likelihood import Hyper, MixtureAt, OutlierMixture
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Random, generator_of

if TYPE_CHECKING:
    import xarray

SCHEMA = 4  # version of the layout of posterior.nc
POSTERIOR_NUMBERS = ("n_stars", "n_flagged", "n_false", "reference_sigma")

SAMPLED = ("chain", "draw")  # dimensions that are numbered from 0


@dataclass(frozen=True)
class SamplerInfo:
    """Record of the sampling.

    Parameters
    ----------
    method : str
        Moves that were used.
    ensembles : int
        Number of independent ensembles.
    walkers : int
        Walkers per ensemble.
    steps : int
        Steps of each ensemble, including warm-up.
    warmup : int
        Steps dropped from each ensemble.
    passes : int
        Evaluations of the likelihood of all stars.
    acceptance : float
        Fraction of accepted proposals.
    wall_s : float
        Wall-clock time of this session in seconds.
    seed : int
        Seed of the random numbers.
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


@dataclass(frozen=True, eq=False)
class Posterior(Solution):
    """Posterior draws of the distortion and of the outlier mixture.

    Parameters
    ----------
    model : DistortionModel
    mixture : OutlierMixture
    theta : ndarray, shape (chains, draws, D)
        Draws of the distortion parameters, in the order of `model.names`. Each chain is one
        independent ensemble, with the draws of its walkers one after the other.
    hyper : dict of str to ndarray, shape (chains, draws)
        Draws of the hyperparameters that were sampled: outlier fraction 'f', jitter 'j' and
        outlier scale 's_out' (the last two in the model's unit), not their logarithms.
    log_prob : ndarray, shape (chains, draws)
        Log posterior density, up to a constant.
    n_stars : int
        Number of stars.
    n_flagged : int
        Number of stars with an outlier probability above 0.5.
    n_false : float
        Expected number of false matches: the sum of the outlier probabilities.
    reference_sigma : float
        Median quoted error; the priors of the mixture are scaled by it.
    convergence : Convergence
    sampler : SamplerInfo
    own_places : bool
        True if the stars' positions are unknowns of the solution, as in a self-calibration. The
        positions in the matches are then those of the posterior mean, not of the single draws.
    tangent_point : tuple of float, optional
        RA and Dec in degrees of the tangent point of u, v; see `LinearFit.tangent_point`.
    matches_digest : str
        `Matches.digest` of the stars; empty if it is unknown, as for a posterior from a file.

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
        """Posterior covariance of theta, shape (D, D); zero for parameters fixed by a gauge."""
        # relative to a draw: fixed parameters then give exactly zero, in spite of rounding
        return np.atleast_2d(np.cov(self.flat - self.flat[0], rowvar=False))

    @property
    def sigma(self) -> Float:
        """Posterior standard deviation of theta, shape (D,)."""
        return self.flat.std(axis=0, ddof=1)

    def interval(self, probability: float) -> Float:
        """Central credible interval of every parameter.

        Parameters
        ----------
        probability : float
            Posterior probability of the interval, between 0 and 1.

        Returns
        -------
        ndarray, shape (D, 2)
            Lower and upper end, in the order of theta.
        """
        tail = (1 - probability) / 2
        return np.quantile(self.flat, [tail, 1 - tail], axis=0).T

    def draws(self, n: int, rng: Random) -> Float:
        """Random subset of the posterior draws.

        Parameters
        ----------
        n : int
            Number of draws. They are taken without replacement if at least n exist.
        rng : int or numpy.random.Generator
            Seed or random generator.

        Returns
        -------
        ndarray, shape (n, D)
        """
        theta, rows = self.drawn_rows(n, rng)
        return theta[rows]

    def drawn_rows(self, n: int, rng: Random) -> tuple[Float, Int]:
        """All draws of theta (m, D), and indices (n,) of the rows that `draws` returns."""
        total = len(self.flat)
        return self.flat, generator_of(rng).choice(total, size=n, replace=n > total)

    def groups(self, provenance: Mapping[str, object] | None = None) -> dict[str, Group]:
        """Groups of variables by name, as stored in posterior.nc; '' is the root group.

        Parameters
        ----------
        provenance : mapping, optional
            Facts about the run that JSON can represent.

        Returns
        -------
        dict of str to Group
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
                attrs=asdict(self.sampler),
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
            Groups posterior (`theta` by chain, draw and parameter; f, j, s_out), sample_stats
            (`lp`, the log density) and diagnostics. The names of the parameters are the
            coordinate "parameter", their units the attribute `units` of the group.

        Raises
        ------
        InputError
            If xarray is not installed.

        Examples
        --------
        >>> from bayesdist.missions.wise import simulate_wise
        >>> matches, truth = simulate_wise(500, rng=np.random.default_rng(1))
        >>> fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1016, 1016)))
        >>> tree = bd.sample(fit, matches, seed=1, target_ess=100).to_datatree()
        >>> tree["posterior"]["theta"].dims
        ('chain', 'draw', 'parameter')
        """
        return datatree_of(self.groups())

    @property
    def sampled_points(self) -> tuple[Float, Float]:
        """All draws: theta (n, D), and the hyperparameters (n, h) in sampled coordinates."""
        h = self.bound_mixture.point({k: self.hyper[k].ravel() for k in self.mixture.hyper})
        return self.flat, h.reshape(len(self.flat), len(self.mixture.hyper))

    @property
    def bound_mixture(self) -> Hyper:
        """Mixture with its priors scaled to the unit of the data."""
        return self.mixture.bind(self.reference_sigma)

    @property
    def likelihood(self) -> MixtureAt:
        """Mixture at the posterior mean of theta and of the sampled hyperparameter coordinates.

        Both means may be taken separately, since location and scale of a symmetric density are
        nearly independent.
        """
        _, h = self.sampled_points
        return MixtureAt(self.mean, self.bound_mixture.constants(h.mean(axis=0)[None]))

    def mapped(self, matrix: Float) -> Posterior:
        """Posterior with the deviations of theta from its mean multiplied by a matrix.

        Parameters
        ----------
        matrix : ndarray, shape (D, D)
            Rows and columns in the order of `model.names`.

        Returns
        -------
        Posterior
        """
        return replace(self, theta=self.mean + (self.theta - self.mean) @ matrix.T)


# -- groups of variables, as in posterior.nc and in the data trees of ArviZ ------------------------


@dataclass(frozen=True, eq=False)
class Group:
    """Group of a netCDF file.

    `variables` maps each name to (names of its dimensions, values); `attrs` are the attributes.
    """

    variables: Mapping[str, tuple[tuple[str, ...], Any]] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)


def datatree_of(groups: Mapping[str, Group]) -> xarray.DataTree:
    """Convert groups to a data tree; '' is the root group, chains and draws are numbered from 0.

    Raises InputError if xarray is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise InputError(
            "xarray is not installed", where="to_datatree", do="pip install 'bayesdist[arviz]'"
        ) from None
    return xarray.DataTree.from_dict(
        {f"/{name}": _dataset(group, xarray.Dataset) for name, group in groups.items()}
    )


def _dataset(group: Group, dataset: type[xarray.Dataset]) -> xarray.Dataset:
    sizes: dict[str, int] = {}
    data: dict[str, tuple[tuple[str, ...], Any]] = {}
    coordinates: dict[str, tuple[tuple[str, ...], Any]] = {}
    for name, (along, content) in group.variables.items():
        values = np.asarray(content)
        sizes |= dict(zip(along, values.shape, strict=True))
        (coordinates if along == (name,) else data)[name] = (along, values)
    for name in SAMPLED:
        if name in sizes:
            coordinates[name] = ((name,), np.arange(sizes[name]))
    return dataset(data, coordinates, dict(group.attrs))
