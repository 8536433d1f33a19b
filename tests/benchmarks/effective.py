"""Effective sample sizes, one way for independent chains and one for coupled walkers."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LONG_ENOUGH", "Tau", "autocorrelation", "smallest_ess"]

Float = NDArray[np.float64]

LONG_ENOUGH = 50  # autocorrelation times below which emcee calls a chain too short
TAIL = 0.05


def smallest_ess(chains: Float) -> tuple[float, float]:
    """Smallest bulk and tail effective sample size over parameters (ArviZ).

    Parameters
    ----------
    chains : ndarray, shape (chains, draws, D)
        Chains that do not influence each other.

    Returns
    -------
    bulk, tail : float
    """
    import arviz as az

    data = az.convert_to_dataset({"x": np.ascontiguousarray(chains)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bulk, tail = (az.ess(data, method=m)["x"].values for m in ("bulk", "tail"))
    return float(np.nanmin(bulk)), float(np.nanmin(tail))


@dataclass(frozen=True)
class Tau:
    """Integrated autocorrelation times of an ensemble of coupled walkers, in steps.

    Parameters
    ----------
    bulk, tail : float
        Largest over parameters; the tail is that of being beyond the 5 % or 95 % quantile.
    steps : int
        Length of the chain that they come from.
    n_stars : int
        Of the data set that they come from.
    """

    bulk: float
    tail: float
    steps: int
    n_stars: int

    @property
    def worst(self) -> float:
        """The larger of the two."""
        return max(self.bulk, self.tail)

    @property
    def lengths(self) -> float:
        """How many autocorrelation times the chain is long."""
        return self.steps / self.worst

    @property
    def long_enough(self) -> bool:
        """Whether emcee would trust it."""
        return self.lengths >= LONG_ENOUGH


def autocorrelation(chain: Float, thin: int, n_stars: int) -> Tau:
    """emcee's estimate; of short chains it is too small, which flatters the sampler.

    Parameters
    ----------
    chain : ndarray, shape (rows, walkers, D)
    thin : int
        Steps between two rows.
    n_stars : int

    Returns
    -------
    Tau
    """
    from emcee.autocorr import integrated_time

    low, high = np.quantile(chain, [TAIL, 1 - TAIL], axis=(0, 1))
    times = []
    for values in (chain, chain <= low, chain >= high):
        # a walker that was never in the tail leaves that undefined: then the bulk decides alone
        with np.errstate(invalid="ignore", divide="ignore"):
            tau = integrated_time(values.astype(float), tol=0, quiet=True)
        # a row stands for `thin` steps: no estimate is finer than that
        times.append(max(float(np.nan_to_num(tau).max()) * thin, float(thin)))
    return Tau(times[0], max(times[1:]), len(chain) * thin, n_stars)
