"""Covariances of errors in u and v and of astrometric parameters, as matrices and as columns.

This module imports little, because sky positions of single files need it.
"""

from __future__ import annotations

import numpy as np

from bayesdist.utils.arrays import Float

LARGEST_RHO = 0.999999  # correlation of errors; beyond, weights lose their digits


def covariances_of(sigma_u: Float, sigma_v: Float, rho: Float | float) -> Float:
    """Covariances (N, 2, 2) of errors in u and v with their correlations."""
    mixed = rho * sigma_u * sigma_v
    rows = [np.stack([sigma_u**2, mixed], axis=-1), np.stack([mixed, sigma_v**2], axis=-1)]
    return np.stack(rows, axis=-2)


def errors_of(covariance: Float) -> dict[str, Float]:
    """Columns sigma_u, sigma_v and rho_uv of covariances (N, 2, 2)."""
    sigma_u, sigma_v = np.sqrt(np.einsum("nii->in", covariance))
    rho = np.clip(covariance[:, 0, 1] / (sigma_u * sigma_v), -LARGEST_RHO, LARGEST_RHO)
    return {"sigma_u": sigma_u, "sigma_v": sigma_v, "rho_uv": rho}


def with_correlations(sigma: Float, correlations: Float) -> Float:
    """Covariances (N, n, n) of errors (N, n) with correlation matrices (N, n, n)."""
    return np.asarray(correlations * sigma[:, :, None] * sigma[:, None])


def without_sizes(covariance: Float) -> tuple[Float, Float]:
    """Errors (N, n) and correlation matrices (N, n, n) of covariances (N, n, n).

    Errors of zero have no correlations.
    """
    sigma = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
    inverse = 1.0 / np.where(sigma > 0, sigma, np.inf)
    out = np.clip(with_correlations(inverse, covariance), -1.0, 1.0)
    np.einsum("nii->ni", out)[:] = 1.0
    return sigma, out
