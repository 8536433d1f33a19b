"""What a campaign knows of its errors beside the posterior: the catalogue's, and the scatter."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.fingerprint import fingerprint_of
from bayesdist.app.systematics import Systematics
from bayesdist.assess.field_terms import CatalogueTerm, ExposureScatter, FieldTerm
from bayesdist.data import MatchTable, ReferenceCatalog
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.checkpoints import read_arrays, write_arrays
from bayesdist.infer.recoloured import with_spread
from bayesdist.infer.star_errors import StarCovariance, star_covariance

if TYPE_CHECKING:
    from bayesdist.app.campaign.session import CampaignSession

__all__ = ["CATALOGUE_ERRORS", "catalogue_covariance", "systematics_of", "with_shared_stars"]

Float = NDArray[np.float64]

CATALOGUE_ERRORS = "catalogue_errors.h5"

log = logging.getLogger("bayesdist")


def systematics_of(session: CampaignSession) -> Systematics:
    """The posterior with the errors of the catalogue, these as a term, and the exposures' scatter.

    A campaign is assessed for a new exposure, one that it has not seen: it deviates from the mean
    of the exposures as these scatter, and its shift and rotation are fitted by whoever uses it.
    """
    posterior, fields = session.posterior, list[FieldTerm]()
    solution = posterior
    stars = catalogue_covariance(
        session.run / CATALOGUE_ERRORS,
        session.fit,
        posterior,
        session.matches,
        session.inputs.catalog,
        float(session.inputs.log.values("vafactor").max()),
    )
    if stars is not None:
        solution = with_shared_stars(posterior, session.fit, stars)
        fields.append(CatalogueTerm(posterior, stars.total))
    scatter = ExposureScatter(posterior.model, posterior.mean, *session.scatter)
    return Systematics(solution, (*fields, scatter), aligned=True)


def catalogue_covariance(
    path: Path,
    fit: LinearFit,
    posterior: Posterior,
    matches: MatchTable,
    catalog: ReferenceCatalog,
    largest_vafactor: float = 1.0,
) -> StarCovariance | None:
    """What the errors of the catalogue do to the parameters, from a file where it has been found.

    It is computed for the linear fit, whose covariance has no noise of sampling: with hundreds of
    parameters a few thousand draws leave factors of several in the eigenvalues of theirs.
    Polynomials and drift are followed exactly, frames as far as they are correlated with these.

    Parameters
    ----------
    path : Path
        File that keeps it.  What belongs to another fit or posterior is replaced.
    fit : LinearFit
    posterior : Posterior
        Of the same matches.
    matches : MatchTable
        With errors that contain the catalogue's, and codes of the stars.
    catalog : ReferenceCatalog
    largest_vafactor : float
        By which catalogue positions were divided; a star in many exposures has one error, and the
        factors differ by less than a ten-thousandth.

    Returns
    -------
    StarCovariance or None
        None where the catalogue has no errors, or the matches no codes of stars.
    """
    errors = _by_star(catalog)
    if matches.star is None or not errors:
        return None
    fingerprint = fingerprint_of(fit, posterior)
    names = ("total", "counted")
    try:
        return StarCovariance(**read_arrays(path, fingerprint, names, do=""))
    except InputError:
        pass  # not there yet, or of another posterior
    log.info("assess: errors of the catalogue, one for each star in all of its exposures")
    found = star_covariance(
        fit,
        matches,
        errors["sigma_u"] / largest_vafactor,
        errors["sigma_v"] / largest_vafactor,
        motion_u=errors.get("sigma_pm_u", 0.0) / largest_vafactor,
        motion_v=errors.get("sigma_pm_v", 0.0) / largest_vafactor,
        epoch0=errors.get("epoch"),
        frames=False,
    )
    write_arrays(path, fingerprint, {name: getattr(found, name) for name in names})
    return found


def _by_star(catalog: ReferenceCatalog) -> dict[str, Float]:
    """Errors, and dates of the positions, by code of the star; empty where there are no errors."""
    if catalog.sigma_u is None or not (np.any(catalog.sigma_u) or np.any(catalog.sigma_v)):
        return {}
    out = {}
    for name in ("sigma_u", "sigma_v", "sigma_pm_u", "sigma_pm_v", "epoch"):
        values = getattr(catalog, name)
        if values is not None:
            out[name] = np.zeros(int(catalog.star.max()) + 1)
            out[name][catalog.star] = values
    return out


def with_shared_stars(posterior: Posterior, fit: LinearFit, stars: StarCovariance) -> Posterior:
    """A posterior whose draws are spread by what the errors of the catalogue add.

    The linear map that turns the covariance of the fit into the larger one is applied to the
    deviations of the draws, so that they keep their shape: no noise could be added, as errors that
    the fit takes for independent may cancel.  Where the posterior is as much wider than the fit as
    its jitter says, so is the covariance that the map begins with.

    Parameters
    ----------
    posterior : Posterior
    fit : LinearFit
        That `stars` was computed for.
    stars : StarCovariance

    Returns
    -------
    Posterior
        With other draws of theta and the same mean; all else is as it was.
    """
    formal = np.asarray(fit.cov, float)
    wider = float(np.trace(np.linalg.solve(formal, posterior.cov))) / len(formal)
    before = wider * formal
    return with_spread(posterior, before, before + stars.extra)
