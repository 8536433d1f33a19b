"""What a run's model may leave out: estimated by `assess`, kept in the run's folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.fingerprint import fingerprint_of
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.centroid import without
from bayesdist.assess.terms.correlated import Deviations, StructureErrors
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.data import MagnitudeErrors
from bayesdist.errors import InputError
from bayesdist.infer import Posterior
from bayesdist.infer.discrepancy import Discrepancy
from bayesdist.infer.discrepancy.storage import discrepancy_from_arrays, discrepancy_to_arrays
from bayesdist.infer.equations.scaled import scaled_cholesky
from bayesdist.infer.posterior.recoloured import with_spread
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays

if TYPE_CHECKING:
    from bayesdist.app.session import Session

__all__ = ["RunDiscrepancy", "keep_discrepancy", "kept_discrepancy"]

Float = NDArray[np.float64]

FILE = "discrepancy.h5"

log = logging.getLogger("bayesdist")


@dataclass(frozen=True, eq=False)
class RunDiscrepancy:
    """The discrepancy of a run's posterior, as the assessment takes it.

    Parameters
    ----------
    found : Discrepancy
    frames : bool
        Whether what is left out has made errors of the exposures' frames that count.
    """

    found: Discrepancy
    frames: bool = False

    def with_noise(self, posterior: Posterior, before: Float | None = None) -> Posterior:
        """The posterior with its draws spread by the errors of the stars as they scatter.

        Parameters
        ----------
        posterior : Posterior
        before : ndarray, shape (D, D), optional
            Its covariance where that is not the formal one, as in a hierarchy of exposures.
        """
        return self._widened(posterior, self.found.noise, before)

    def with_everything(self, posterior: Posterior, before: Float | None = None) -> Posterior:
        """The posterior with its draws spread by all that is known of errors of parameters."""
        return self._widened(posterior, self.found.covariance, before)

    def _widened(self, posterior: Posterior, cov: Float, before: Float | None) -> Posterior:
        formal = self.found.formal
        if before is None:
            return with_spread(posterior, formal, cov)
        # frames follow as they are correlated with polynomials and drift
        D = self.found.model.n_distortion
        follow = np.linalg.solve(before[:D, :D], before[:D]).T
        more = follow @ (cov - formal)[:D, :D] @ follow.T
        return with_spread(posterior, before, before + _least(before, (more + more.T) / 2))

    def terms(self, *, single: bool = False, left: bool = True) -> tuple[ErrorTerm, ...]:
        """Terms of the error model; with the deviation of single exposures, and what is left out.

        The latter at a position, where no tables stand for it.
        """
        out = list[ErrorTerm]()
        if self.found.structure:
            out.append(StructureErrors(self.found, self.frames, left))
        if self.found.linear is not None:
            out.append(Deviations(self.found, single, self.frames))
        return tuple(out)

    def structure_sigma(self, domain: EvaluationDomain) -> Float | None:
        """Standard deviations (N, 2) of what is left out; None where nothing is."""
        if not self.found.structure:
            return None
        return StructureErrors(self.found, self.frames).sigma(domain)

    @property
    def structure_rms(self) -> float | None:
        """Rms over the detector of the structure that the budget holds, both axes together."""
        rows = self.found.facts.get("structure")
        if not rows:
            return None
        by_axis = {a: np.mean([r["rms"] ** 2 for r in rows if r["axis"] == a]) for a in "uv"}
        return float(np.sqrt(by_axis["u"] + by_axis["v"]))

    def moved(self, matrix: Float) -> RunDiscrepancy:
        """The same in another gauge: errors of parameters times a matrix (D, D)."""
        return replace(self, found=self.found.moved(matrix))

    def of_centroids(self, errors: MagnitudeErrors | None) -> MagnitudeErrors | None:
        """Scatter by magnitude less the structure that is among the residuals, as it has a term.

        The median of its size: a prior's tail is in no residual.
        """
        rows = self.found.facts.get("structure")
        if errors is None or not rows:
            return errors
        u, v = (
            np.sqrt(np.mean([r["median"] ** 2 for r in rows if r["axis"] == axis])) for axis in "uv"
        )
        return without(errors, u, v)


def _least(before: Float, more: Float) -> Float:
    """What is added to a covariance, so that no direction loses more than half its variance."""
    root = scaled_cholesky(before)
    white = np.linalg.solve(root, np.linalg.solve(root, more).T)
    values, vectors = np.linalg.eigh((white + white.T) / 2)
    turned = root @ vectors
    return np.asarray((turned * np.maximum(values, -0.5)) @ turned.T)


def keep_discrepancy(session: Session, estimate: Callable[[], Discrepancy]) -> None:
    """Estimate the discrepancy and write it for the stages that follow.

    Raises
    ------
    InputError
        When it cannot be estimated: no verdict could rest on anything then.
    """
    found = estimate()
    arrays, facts = discrepancy_to_arrays(found)
    write_arrays(session.run / FILE, fingerprint_of(session.fit, session.posterior), arrays)
    session.run.summarise(discrepancy=facts)
    for row in facts.get("structure", []):
        log.info(
            "assess: structure beyond the model on chip %s, %s: %.2g %s rms, at most %.2g with "
            "95 %% probability",
            *(row["chip"], row["axis"], row["median"], facts["unit"], row["most"]),
        )


def kept_discrepancy(session: Session) -> RunDiscrepancy | None:
    """What `assess` has estimated; None before, and of another posterior."""
    facts: dict[str, Any] | None = session.run.summary.get("discrepancy")
    path = session.run / FILE
    if not facts or not path.exists():
        return None
    try:
        arrays = read_arrays(path, fingerprint_of(session.fit, session.posterior), do="")
    except InputError:
        return None
    found = discrepancy_from_arrays(session.posterior.model, arrays)
    return RunDiscrepancy(replace(found, facts=facts))
