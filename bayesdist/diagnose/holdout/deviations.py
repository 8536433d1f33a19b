"""Deviations of exposures that were held out whole, against the scatter of the others.

Its scale and shears, and where its chips lie, are fitted to its own stars before these are judged:
what is wrong with them does not show in residuals.  With b and v the estimate of one deviation
and its variance by the stars alone, all others being as they scatter,

    b ~ N(0, tau^2 + v + w)

with draws of tau, and w what the errors of the solution do to b.  The probability of a larger one
is the mean over the draws.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from bayesdist.diagnose.holdout.frames import Frame
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.holdout.tests import HeldTest

__all__ = ["deviation_tests"]

Float = NDArray[np.float64]

MIN_INFORMATION = 0.5  # fraction of the prior variance that stars take off, to be tested


def deviation_tests(predictive: Predictive, frames: Mapping[str, Frame]) -> list[HeldTest]:
    """Tests of each deviation of each exposure that was held out whole.

    Their `limit` is the scatter.
    """
    known = predictive.deviations
    if known is None:
        return []
    n = predictive.model.n_distortion
    C, out = predictive.cov[:n, :n], []
    for name, frame in frames.items():
        taken = 1 - frame.precision * np.diag(frame.spent)
        by_solution = frame.spent @ frame.shared
        extra = np.einsum("qn,nm,qm->q", by_solution, C, by_solution)
        for kind, tau in zip(known.kinds, known.tau.T, strict=True):
            k = frame.names.index(kind)
            if taken[k] < MIN_INFORMATION:
                continue
            # without what its own prior has said
            b = frame.values[k] / taken[k]
            v = frame.spent[k, k] / taken[k] + extra[k] / taken[k] ** 2
            p = float(np.mean(2 * norm.sf(abs(b) / np.sqrt(tau**2 + v))))
            where = f"the {kind.replace('_', ' ')} of exposure {name}, held out whole"
            scatter = float(np.sqrt(np.mean(tau**2)))
            out.append(
                HeldTest(
                    "deviation", "exposure", where, k, frame.n, float(b), 0.0, p, limit=scatter
                )
            )
    return out
