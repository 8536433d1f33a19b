"""To which fit and posterior a file belongs."""

from __future__ import annotations

import hashlib

import numpy as np

from bayesdist.infer import LinearFit, Posterior

__all__ = ["fingerprint_of"]


def fingerprint_of(fit: LinearFit, posterior: Posterior) -> str:
    """A hash of the numbers of a fit and of the posterior's draws."""
    digest = hashlib.sha256()
    for values in (fit.mean, fit.cov, posterior.theta):
        digest.update(np.ascontiguousarray(values))
    return digest.hexdigest()
