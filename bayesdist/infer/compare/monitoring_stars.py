"""A catalogue's errors in the comparison of new exposures with a release.

A star has one error in all of its new exposures, and where the release was made with the same
catalogue, it has moved both sides: what it moved alike is no change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.data.matches import MatchTable
from bayesdist.infer.catalogue.star_errors import star_covariance
from bayesdist.infer.catalogue.star_influence import StarErrors, star_influence
from bayesdist.infer.compare.monitoring import NewFit
from bayesdist.infer.linear import LinearFit

__all__ = ["with_star_errors_of"]


def with_star_errors_of(
    errors: StarErrors,
    new: NewFit,
    matches: MatchTable,
    released: tuple[LinearFit, MatchTable] | None = None,
) -> NewFit:
    """A fit of new matches that knows that a star has one error.

    Parameters
    ----------
    errors : StarErrors
        Of the catalogue, by code of the star; the quoted errors contain them.
    new : NewFit
    matches : MatchTable
        Those of `new`, with codes of the stars.
    released : tuple of LinearFit and MatchTable, optional
        The release and its matches, where they have the same catalogue and codes.

    Returns
    -------
    NewFit
    """
    n = new.model.n_polynomial
    motion_u, motion_v = (0.0, 0.0) if errors.motion is None else errors.motion.T
    shared = star_covariance(
        new.fit,
        matches,
        *errors.position.T,
        motion_u=motion_u,
        motion_v=motion_v,
        epoch0=errors.epoch,
        frames=False,
    )
    out = replace(new, extra=shared.extra[:n, :n])
    if released is None or released[1].star is None or matches.star is None:
        return out
    codes = np.intersect1d(released[1].star, matches.star)
    old, now = (
        star_influence(fit, table, errors, codes).by
        for fit, table in (released, (new.fit, matches))
    )
    variances = errors.variances[: len(old), codes]
    return replace(out, common=np.einsum("lasd,lsa,lasn->dn", old, variances, now[..., :n]))
