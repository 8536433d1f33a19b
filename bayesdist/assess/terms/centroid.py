"""Errors of centroids by magnitude: what the scatter of residuals is beside what else is in it.

The residual of a star holds the error of its centroid, that of the reference star, and whatever the
model leaves out.  A budget that lists the reference catalogue and the residual scatter beside each
other counts the catalogue twice: what is known to be in the residuals is taken off first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError


def centroid_errors(
    scatter: MagnitudeErrors, contained: Sequence[tuple[str, float, float]] = ()
) -> MagnitudeErrors:
    """Scatter of residuals by magnitude, less other errors that are in it.

    `contained`: errors that the residuals hold beside those of the centroids, in their unit.
    InputError where an error that is said to be in the residuals is larger than these.
    """
    squares = np.sum([(u**2, v**2) for _, u, v in contained] or [(0.0, 0.0)], axis=0)
    left = np.sqrt(squares)
    for sigma, known in zip((scatter.sigma_u, scatter.sigma_v), left, strict=True):
        # the median of n absolute residuals is known to 1.17 / sqrt(n)
        too_small = sigma * (1.0 + 3.0 * 1.17 / np.sqrt(scatter.n)) < known
        if too_small.any():
            k = int(np.argmax(too_small))
            raise InputError(
                f"errors of {known:.3g} are declared part of residuals that scatter by "
                f"{sigma[k]:.3g} at magnitude {scatter.mag[k]:.2f}",
                where=f"budget term {contained[0][0]!r}",
                do="correct them, or set included_in_scatter = false",
            )
    return scatter.less(*left)


def centroids_of(
    diagnostics: Diagnostics, contained: Sequence[tuple[str, float, float]] = ()
) -> MagnitudeErrors | None:
    """Errors of centroids by magnitude: the scatter of residuals less what has a term of its own.

    Of structure that is among the residuals the median of its size is taken off: a prior's tail is
    in no residual.

    `contained`: as `centroid_errors`. Returns None where the stars have no magnitudes. InputError
    as `centroid_errors`.
    """
    if diagnostics.centroid is None:
        return None
    errors = centroid_errors(diagnostics.centroid, contained) if contained else diagnostics.centroid
    correlated = diagnostics.correlated
    median = None if correlated is None else correlated.structure_median
    return errors if median is None else errors.less(*median)
