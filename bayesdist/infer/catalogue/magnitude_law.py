"""Errors as a smooth function of magnitude, by penalised likelihood.

ln sigma is linear between nodes in magnitude.  Its changes of slope have a normal prior (integrated
Wiener process).  The scale of the prior is estimated from the scatter in bins by restricted
likelihood and then fixed, so that all later steps maximise the same function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.utils.arrays import Float, Int

CELLS = 1000  # number of magnitude cells, small enough that the error is constant in each
LOG_VARIANCE = 1.36  # variance of ln(scatter) times n, for the median absolute deviation
BENDS = (1e-3, 1e2)  # limits of the prior scale of changes of slope over the range of magnitudes
ROOM = 2.0  # prior sigma of ln sigma about the scatter of the bins (a factor of 7)


@dataclass(frozen=True, eq=False)
class MagnitudeLaw:
    """Interpolation and prior of ln sigma at B nodes, for C cells of stars of similar magnitude."""

    cell: Int  # cell (N,) of each star
    design: Float  # linear interpolation (C, B) from the nodes to the cells
    # ln sigma (2, B) of u and v at the nodes from the scatter in bins; centre of a weak prior that
    # keeps sigma away from zero
    start: Float
    penalty: Float  # inverse covariance (B, B) of the smoothness prior

    @classmethod
    def of(cls, mag: Float, bins: MagnitudeErrors) -> MagnitudeLaw:
        """Law for stars with magnitudes (N,); the bins provide nodes and starting values."""
        count = min(len(mag), CELLS)
        rank = np.argsort(np.argsort(mag, kind="stable"), kind="stable")
        cell = rank * count // len(mag)
        size = np.bincount(cell, minlength=count)
        centre = np.bincount(cell, weights=mag, minlength=count) / size
        nodes = np.eye(len(bins.mag))
        design = np.stack([np.interp(centre, bins.mag, node) for node in nodes], axis=1)
        start = np.log(np.stack([bins.scatter_u, bins.scatter_v]))
        penalty = np.zeros_like(nodes)
        if len(bins.mag) > 2:
            bends = _bends(bins.mag)
            tau = _size_of_bends(start @ bends.T, bends, bins.n)
            penalty = bends.T @ bends / tau**2
        return cls(cell, design, start, penalty)

    def at_stars(self, nodes: Float) -> Float:
        """Squared errors (2, N) of the stars, from ln sigma (2, B) at the nodes."""
        return np.asarray(np.exp(2.0 * nodes @ self.design.T)[:, self.cell])

    def climbed(self, nodes: Float, weight: Float, square: Float) -> Float:
        """Maximise the penalised likelihood; return ln sigma (2, B) at the nodes.

        `nodes` (2, B) is the starting point, `weight` (N,) the probability that a star is a true
        match, and `square` (2, N) its expected squared error.  The likelihood is concave, so that
        Newton's method with step halving finds its only maximum.
        """
        n = self._of_cells(weight)
        prior = self.penalty + np.eye(len(self.penalty)) / ROOM**2
        out = nodes.copy()
        for axis in (0, 1):
            s = self._of_cells(weight * square[axis])
            eta, value = out[axis], self._value(out[axis], axis, n, s)
            for _ in range(100):
                of_cells = s * np.exp(-2.0 * self.design @ eta)
                pull = self.penalty @ eta + (eta - self.start[axis]) / ROOM**2
                gradient = self.design.T @ (of_cells - n) - pull
                hessian = 2.0 * (self.design.T * of_cells) @ self.design + prior
                # limit the steps: far below the maximum the curvature grows exponentially
                step = np.linalg.solve(hessian, gradient)
                step *= min(1.0, 1.0 / max(np.abs(step).max(), 1e-300))
                new_value = self._value(eta + step, axis, n, s)
                while new_value < value and np.abs(step).max() > 1e-8:
                    step /= 2.0
                    new_value = self._value(eta + step, axis, n, s)
                if new_value >= value:
                    eta, value = eta + step, new_value
                if np.abs(step).max() < 1e-6:
                    break
            out[axis] = eta
        return out

    def _of_cells(self, values: Float) -> Float:
        sums = np.bincount(self.cell, weights=values, minlength=len(self.design))
        return np.asarray(sums, float)

    def _value(self, eta: Float, axis: int, n: Float, s: Float) -> float:
        of_cells, off = self.design @ eta, eta - self.start[axis]
        likelihood = -(n @ of_cells) - 0.5 * (s @ np.exp(-2.0 * of_cells))
        return float(likelihood - 0.5 * (eta @ self.penalty @ eta + off @ off / ROOM**2))


def _bends(mag: Float) -> Float:
    """Matrix (B - 2, B) of changes of slope at the inner nodes, with unit prior variance."""
    at = (mag - mag[0]) / (mag[-1] - mag[0])
    gap = np.diff(at)
    slopes = np.diff(np.eye(len(mag)), axis=0) / gap[:, None]
    return np.asarray(np.diff(slopes, axis=0) / np.sqrt((gap[1:] + gap[:-1])[:, None] / 2.0))


def _size_of_bends(found: Float, bends: Float, n: Int) -> float:
    """Most likely prior scale of the changes of slope `found`, given the noise of the bins."""
    noise = (bends * (LOG_VARIANCE / n)) @ bends.T

    def misfit(log_tau: float) -> float:
        cov = noise + np.exp(2.0 * log_tau) * np.eye(len(noise))
        whitened = np.linalg.solve(np.linalg.cholesky(cov), found.T)
        return float((whitened**2).sum() + len(found) * np.linalg.slogdet(cov)[1])

    limits = np.log(BENDS)
    return float(np.exp(minimize_scalar(misfit, bounds=limits, method="bounded").x))
