"""The benchmark's posterior, and the only place that looks inside the library.

Everything else in this folder uses public names, so that a change inside `bayesdist.infer` is
answered here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numba
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

import bayesdist as bd
from bayesdist.data import open_matches
from bayesdist.infer import GaussianPriors, kernel, load
from bayesdist.infer.density.target import Target
from bayesdist.infer.stars.stars import prepare

__all__ = [
    "HYPER",
    "Problem",
    "Threads",
    "draws_of",
    "kernel_call",
    "open_stored",
    "simulated",
    "store",
]

Float = NDArray[np.float64]

SIZE = (1016.0, 1016.0)
SIGMA = 0.05  # pixels, median quoted error; log-normal scatter 0.3
JITTER = 0.03  # comparable to the errors: well measured already by few stars
FRACTION = 0.03
OUTLIER_SCALE = 1.0
HYPER = ("log j", "logit f", "log s_out")
PIECE = 1_000_000  # rows simulated and stored at a time


def _model(order: int) -> bd.DistortionModel:
    centre = ((SIZE[0] + 1) / 2, (SIZE[1] + 1) / 2)
    return bd.DistortionModel(order, (bd.Chip(1, "chip", SIZE, centre),))


def _truth(model: bd.DistortionModel) -> Float:
    """A distortion of a few pixels on top of a unit linear part."""
    theta = np.random.default_rng(7).standard_normal(model.n_params)
    for axis in (0, 1):
        theta[model.coefficient_slice(1, axis)][1 + axis] += SIZE[axis] / 2
    return theta


def _matches(n: int, order: int, rng: np.random.Generator) -> bd.Matches:
    model = _model(order)
    quoted = SIGMA * np.exp(0.3 * rng.standard_normal((2, n)))
    matches, _ = bd.simulate_matches(
        model,
        _truth(model),
        n,
        rng=rng,
        sigma=(quoted[0], quoted[1]),
        fraction=FRACTION,
        jitter=JITTER,
        outlier_scale=OUTLIER_SCALE,
    )
    return matches


@dataclass(frozen=True, eq=False)
class Problem:
    """One simulated data set and its posterior.

    Parameters
    ----------
    matches : Matches
    model : DistortionModel
    """

    matches: bd.Matches
    model: bd.DistortionModel

    def __len__(self) -> int:
        return len(self.matches)

    @property
    def with_correlations(self) -> Problem:
        """The same with errors that are correlated between u and v, of all shapes."""
        rho = np.random.default_rng(46).uniform(-0.9, 0.9, len(self))
        return replace(self, matches=self.matches.with_columns(rho_uv=rho))

    @property
    def dim(self) -> int:
        """Number of sampled parameters: coefficients, log j, logit f, log s_out."""
        return self.model.n_params + len(HYPER)

    @property
    def truth(self) -> Float:
        """Sampled parameters, shape (D,), that the data were made from."""
        hyper = [np.log(JITTER), np.log(FRACTION / (1 - FRACTION)), np.log(OUTLIER_SCALE)]
        return np.concatenate([_truth(self.model), hyper])

    @property
    def scale(self) -> float:
        """Median quoted error, which scales the priors."""
        m = self.matches
        return float(np.median(np.concatenate([m.sigma_u, m.sigma_v])))

    @cached_property
    def fit(self) -> bd.LinearFit:
        """The linear fit that every sampler starts from."""
        return bd.fit_linear(self.matches, self.model)

    @cached_property
    def target(self) -> Target:
        """The library's posterior density."""
        priors = GaussianPriors.none(self.model)
        return Target(load(self.model, self.matches), bd.OutlierMixture(), priors)

    def log_density(self, psi: Float) -> Float:
        """The library's log posterior (n,) of points (n, D), up to a constant."""
        return self.target.log_density(psi)


def simulated(n: int, order: int = 5, seed: int = 20150206) -> Problem:
    """Stars of one chip with 3 % false matches and a jitter that is well measured.

    Parameters
    ----------
    n : int
    order : int
    seed : int

    Returns
    -------
    Problem
    """
    return Problem(_matches(n, order, np.random.default_rng(seed)), _model(order))


def kernel_call(problem: Problem, psi: Float) -> Callable[[], Float]:
    """The bare kernel at points (n, D), with everything it takes made ready before."""
    target, model = problem.target, problem.model
    theta, h = psi[:, : model.n_params], psi[:, model.n_params :]
    stars, _ = prepare(model, problem.matches)
    coef, constants = stars.powers(theta), target.hyper.constants(h)
    return lambda: kernel.log_likelihood(stars.blocks, stars.columns, coef, model.order, constants)


class Threads:
    """Context in which the kernel has so many threads."""

    def __init__(self, n: int) -> None:
        self.n = min(n, numba.config.NUMBA_NUM_THREADS)

    def __enter__(self) -> int:
        self.before = kernel.get_threads()
        kernel.set_threads(self.n)
        return self.n

    def __exit__(self, *_: object) -> None:
        kernel.set_threads(self.before)


def draws_of(posterior: bd.Posterior) -> Float:
    """Draws (chains, n, D) in sampled coordinates."""
    hyper = posterior.mixture.bind(posterior.reference_sigma)
    return np.concatenate([posterior.theta, hyper.point(posterior.hyper)], axis=-1)


# -- on disk, for runs in a process of their own --------------------------------------------------


def store(folder: Path, n: int, order: int, seed: int = 20150206) -> None:
    """Write simulated matches as Parquet parts, in bounded memory.

    Parameters
    ----------
    folder : Path
        Made when missing.
    n, order, seed : int
    """
    folder.mkdir(parents=True, exist_ok=True)
    sequence = np.random.SeedSequence(seed).spawn(-(-n // PIECE))
    for k, child in enumerate(sequence):
        m = _matches(min(PIECE, n - k * PIECE), order, np.random.default_rng(child))
        names = ("x", "y", "u", "v", "sigma_u", "sigma_v")
        # random digits do not compress
        pq.write_table(
            pa.table({name: getattr(m, name) for name in names}),
            folder / f"part-{k:05d}.parquet",
            compression="none",
            use_dictionary=False,
        )


def open_stored(folder: Path, order: int) -> Problem:
    """The stored matches with their model, as a user would read them."""
    return Problem(open_matches(folder, unit="pix"), _model(order))
