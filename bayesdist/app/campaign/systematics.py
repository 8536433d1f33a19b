"""What a campaign knows of its errors beside the posterior: the catalogue's, and the scatter."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.aberration import aberration_term
from bayesdist.app.fingerprint import fingerprint_of
from bayesdist.app.systematics import Systematics
from bayesdist.assess.terms.forms import GIVEN, ErrorTerm
from bayesdist.assess.terms.parameters import MOTIONS, CatalogueErrors, ExposureVariation
from bayesdist.assess.terms.solution import SolutionErrors
from bayesdist.data import MatchTable, ReferenceCatalog
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.catalogue.star_errors import StarCovariance, star_covariance
from bayesdist.infer.catalogue.star_influence import StarErrors
from bayesdist.infer.posterior.recoloured import with_spread
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays

if TYPE_CHECKING:
    from bayesdist.app.campaign.session import CampaignSession

__all__ = [
    "CATALOGUE_ERRORS",
    "catalogue_covariance",
    "catalogue_terms",
    "covariance_of",
    "errors_by_star",
    "kept_covariance",
    "shared_stars_of",
    "systematics_of",
    "with_kept_stars",
    "with_shared_stars",
]

Float = NDArray[np.float64]

CATALOGUE_ERRORS = "catalogue_errors.h5"

log = logging.getLogger("bayesdist")


def systematics_of(session: CampaignSession) -> Systematics:
    """The posterior with the errors of the catalogue, these as a term, and the exposures' scatter.

    A campaign is assessed for a new exposure, one that it has not seen: it deviates from the mean
    of the exposures as these scatter, and its shift and rotation are fitted by whoever uses it.
    """
    posterior = solution = session.posterior
    stars, found = shared_stars_of(session), session.discrepancy
    catalogue: tuple[CatalogueErrors, ...] = ()
    if stars is not None:
        solution = with_shared_stars(posterior, session.fit, stars)
        catalogue = catalogue_terms(posterior, stars, session.inputs.catalog.source)
    terms = list[ErrorTerm]()
    if found is not None:
        before = covariance_of(session.posterior, session.fit, stars)
        solution = found.with_noise(solution, before)
        terms += found.terms(left=session.structure_is_left)
    of_solution = SolutionErrors(solution, posterior if catalogue else None, catalogue)
    scatter = ExposureVariation(
        posterior.model,
        posterior.mean,
        *session.scatter,
        aberration=aberration_term(session, solution),
    )
    return Systematics(solution, (of_solution, *terms, scatter), aligned=True)


def shared_stars_of(session: CampaignSession) -> StarCovariance | None:
    """What the errors of the catalogue do to the parameters of a session's posterior."""
    return catalogue_covariance(
        session.run / CATALOGUE_ERRORS,
        session.fit,
        session.posterior,
        session.matches,
        session.inputs.catalog,
        session.largest_vafactor,
    )


def catalogue_terms(
    posterior: Posterior, stars: StarCovariance, catalogue: str
) -> tuple[CatalogueErrors, ...]:
    """What the errors of the catalogue do: of its positions, and of its motions where it has some.

    Parameters
    ----------
    posterior : Posterior
        That takes them for independent.
    stars : StarCovariance
    catalogue : str
        Name of the file that states the errors.
    """
    source = f"{GIVEN}: errors of {{}} in {Path(catalogue).name}"
    model, mean = posterior.model, posterior.mean
    moved = 0.0 if stars.motions is None else stars.motions
    of_positions = source.format("positions")
    positions = CatalogueErrors(model, mean, stars.total - moved, source=of_positions)
    if stars.motions is None:
        return (positions,)
    of_motions = source.format("proper motions")
    return positions, CatalogueErrors(model, mean, stars.motions, MOTIONS, of_motions)


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
    try:
        return _kept(path, fingerprint)
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
    motions = np.empty((0, 0)) if found.motions is None else found.motions
    kept = {"total": found.total, "counted": found.counted, "motions": motions}
    write_arrays(path, fingerprint, kept)
    return found


def with_kept_stars(session: CampaignSession) -> Posterior:
    """The posterior with the errors of the catalogue as `assess` has kept them.

    Neither catalogue nor pairs are needed; where nothing is kept it is the posterior alone.
    """
    stars = _kept_stars(session)
    if stars is None:
        return session.posterior
    return with_shared_stars(session.posterior, session.fit, stars)


def kept_covariance(session: CampaignSession) -> Float:
    """Covariance of that posterior, without the noise of its draws."""
    return covariance_of(session.posterior, session.fit, _kept_stars(session))


def _kept_stars(session: CampaignSession) -> StarCovariance | None:
    path = session.run / CATALOGUE_ERRORS
    if not path.exists():
        return None
    return _kept(path, fingerprint_of(session.fit, session.posterior))


def _kept(path: Path, fingerprint: str) -> StarCovariance:
    arrays = read_arrays(path, fingerprint, ("total", "counted", "motions"), do="")
    if not arrays["motions"].size:
        del arrays["motions"]
    return StarCovariance(**arrays)


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


def errors_by_star(catalog: ReferenceCatalog, largest_vafactor: float = 1.0) -> StarErrors | None:
    """Errors of the catalogue by code of the star; None where it has none."""
    found = _by_star(catalog)
    if not found:
        return None
    position, motion = (
        np.stack([found[f"{name}_{a}"] for a in "uv"], axis=1) / largest_vafactor
        if f"{name}_u" in found
        else None
        for name in ("sigma", "sigma_pm")
    )
    assert position is not None
    return StarErrors(position, motion, found.get("epoch"))


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
    before = covariance_of(posterior, fit)
    return with_spread(posterior, before, before + stars.extra)


def covariance_of(
    posterior: Posterior, fit: LinearFit, stars: StarCovariance | None = None
) -> Float:
    """Covariance of a posterior without the noise of its draws, and with a catalogue's errors."""
    formal = np.asarray(fit.cov, float)
    wider = float(np.trace(np.linalg.solve(formal, posterior.cov))) / len(formal)
    return wider * formal if stars is None else wider * formal + stars.extra
