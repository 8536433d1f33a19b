"""Stars that err together: measured by `assess`, used in all that rests on the solution.

A pattern on the detector that the model leaves out, and whatever the stars of an exposure have in
common, make errors of coefficients that no posterior of independent stars shows.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.fingerprint import fingerprint_of
from bayesdist.assess.centroid import without
from bayesdist.assess.residual_correlation import residual_correlation
from bayesdist.assess.terms import LocalTerm
from bayesdist.assess.unmodelled import Unmodelled, unmodelled
from bayesdist.data import MagnitudeErrors
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import Posterior
from bayesdist.infer.checkpoints import read_arrays, write_arrays
from bayesdist.infer.recoloured import with_spread
from bayesdist.infer.robust import (
    RobustCovariance,
    by_fitting_cells,
    recommended_cells,
    robust_covariance,
)

if TYPE_CHECKING:
    from bayesdist.app.session import Session

__all__ = [
    "ENOUGH",
    "EXPOSURES",
    "UNMODELLED",
    "SharedErrors",
    "facts_of",
    "keep_shared_errors",
    "kept_shared_errors",
    "measure_shared_errors",
]

Float = NDArray[np.float64]

FILE = "shared_errors.h5"
UNMODELLED = "unmodelled structure"
ENOUGH = 2000  # stars, below which cells tell nothing
EXPOSURES = 12  # of which so many are independent clusters

log = logging.getLogger("bayesdist")


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What the residuals of a run say of errors that stars have in common.

    Parameters
    ----------
    cov : ndarray, shape (D, D)
        Covariance of the parameters to be used; the formal one where stars err independently.
    formal : ndarray, shape (D, D)
    facts : dict
        As in summary.json: ratio {value, error, p_value}, exceeds, statement, doubts, cells_pix,
        reach_pix, unmodelled [{chip, rms_u, rms_v, error_u, error_v, beside_u,
        beside_v, found}]: what comes beside the coefficients' errors is less than the structure, as
        the fit was drawn towards it.
    """

    cov: Float
    formal: Float
    facts: dict[str, Any]

    @property
    def exceeds(self) -> bool:
        """Whether the covariance is larger than the formal one."""
        return bool(self.facts["exceeds"])

    @property
    def found(self) -> bool:
        """Whether stars have errors in common, of either kind."""
        return self.exceeds or any(one["found"] for one in self.facts["unmodelled"])

    @property
    def trusted(self) -> bool:
        """Whether what was measured may stand for the errors that the model does not describe."""
        return self.found and not self.facts["doubts"]

    @property
    def sentence(self) -> str:
        """What a reader has to know; empty where stars err independently."""
        if not self.found:
            return ""
        parts = []
        if self.exceeds:
            parts.append(
                f"{self.facts['statement']}; maps, budget, margins and files have the larger errors"
            )
        rms = max(
            (max(one["rms_u"], one["rms_v"]) for one in self.facts["unmodelled"] if one["found"]),
            default=None,
        )
        if rms is not None:
            parts.append(
                f"what the model leaves out at a place, {rms:.2g} {self.facts['unit']} rms on an "
                "axis, is a term of the budget"
            )
        if not self.exceeds:
            parts += self.facts["doubts"]
        return "; ".join(parts)

    def widened(self, posterior: Posterior) -> Posterior:
        """The posterior with its draws spread to the larger covariance; they keep their shape."""
        if not self.exceeds:
            return posterior
        return with_spread(posterior, self.formal, self.cov)

    def of_centroids(self, errors: MagnitudeErrors | None) -> MagnitudeErrors | None:
        """Scatter by magnitude without what is left out at a place, which is a term of its own."""
        found = [one for one in self.facts["unmodelled"] if one["found"]]
        if errors is None or not found:
            return errors
        n = len(self.facts["unmodelled"])  # stars are on all chips
        u, v = (np.sqrt(sum(one[f"rms_{axis}"] ** 2 for one in found) / n) for axis in "uv")
        return without(errors, u, v)

    def local_term(self, grid: tuple[int, int]) -> tuple[LocalTerm, ...]:
        """What is left out at a place, as a term of the budget; nothing where none is found."""
        if not any(one["found"] for one in self.facts["unmodelled"]):
            return ()
        sigma, relative = {}, []
        for one in self.facts["unmodelled"]:
            rms = np.array([one.get(f"beside_{a}", one[f"rms_{a}"]) for a in "uv"]) * one["found"]
            sigma[one["chip"]] = np.tile(rms, (grid[1], grid[0], 1))
            if rms.any():
                relative.append(np.hypot(one["error_u"], one["error_v"]) / np.hypot(*rms))
        return (LocalTerm(UNMODELLED, sigma, float(max(relative, default=0.0))),)


def measure_shared_errors(session: Session) -> None:
    """Two passes over the stars; what they show is kept in the run's folder."""
    keep_shared_errors(session, _measured(session))


def keep_shared_errors(session: Session, found: SharedErrors | None) -> None:
    """Write what was measured for the stages that follow; nothing where it was not."""
    path = session.run / FILE
    if found is None:
        path.unlink(missing_ok=True)
        session.run.summarise(shared_errors=None)
        return
    write_arrays(
        path,
        fingerprint_of(session.fit, session.posterior),
        {"cov": found.cov, "formal": found.formal},
    )
    session.run.summarise(shared_errors=found.facts)
    log.info("assess: %s", found.facts["statement"])


def kept_shared_errors(session: Session) -> SharedErrors | None:
    """What `assess` has measured; None before, for too few stars, and of another posterior."""
    facts = session.run.summary.get("shared_errors")
    path = session.run / FILE
    if not facts or not path.exists():
        return None
    fingerprint = fingerprint_of(session.fit, session.posterior)
    try:
        return SharedErrors(**read_arrays(path, fingerprint, ("cov", "formal"), do=""), facts=facts)
    except InputError:
        return None


def _measured(session: Session) -> SharedErrors | None:
    if len(session.shards) < ENOUGH:
        return None
    model, posterior = session.posterior.model, session.posterior
    try:
        robust = robust_covariance(
            session.shards,
            posterior,
            recommended_cells(model),
            exposures=bool(model.n_frame) and len(model.exposures) >= EXPOSURES,
            priors=session.priors,
        )
    except (InputError, DegenerateError) as error:
        log.info("assess: correlation of errors was not measured: %s", error)
        return None
    robust = by_fitting_cells(robust)
    return SharedErrors(robust.cov, robust.formal, facts_of(session, robust))


def facts_of(
    session: Session, robust: RobustCovariance, *, at_place: bool = True
) -> dict[str, Any]:
    """What summary.json says of shared errors.

    Parameters
    ----------
    session : Session
    robust : RobustCovariance
    at_place : bool
        Whether what is left out at a place is measured too.
    """
    model, doubts, left = robust.model, list(robust.doubts), tuple[Unmodelled, ...]()
    try:
        if at_place:
            cells = recommended_cells(model)
            left = unmodelled(session.shards, session.posterior, cells, robust=robust)
    except DegenerateError:
        if robust.exceeds:
            doubts.append("stars are too far apart to show what the model leaves out at a place")
    return {
        "unit": model.unit,
        "ratio": {
            "value": robust.ratio.value,
            "error": robust.ratio.error,
            "p_value": robust.ratio.p_value,
        },
        "exceeds": robust.exceeds,
        "statement": robust.statement,
        "doubts": doubts,
        "cells_pix": list(robust.cells.sides(model)),
        "reach_pix": _reach(session),
        "unmodelled": [_row(one, robust.exceeds) for one in left],
    }


def _reach(session: Session) -> float:
    """Distance in pixels over which residuals are correlated: the longest of all chips."""
    out = [0.0]
    for k, sums in enumerate(session.shown_sums):
        rng = np.random.default_rng([session.config.sampler.seed, k])
        try:
            found = residual_correlation(
                sums.residuals(), order=session.posterior.model.order, rng=rng
            )
        except DegenerateError:  # too few bins with stars
            continue
        out.append(found.reach)
    return max(out)


def _row(one: Unmodelled, exceeds: bool) -> dict[str, Any]:
    u, v = (float(r) for r in one.rms)
    error_u, error_v = (float(e) for e in one.rms_error)
    beside_u, beside_v = (float(r) for r in one.rms_beside)
    return {
        "chip": one.chip,
        "rms_u": u,
        "rms_v": v,
        "error_u": error_u,
        "error_v": error_v,
        "beside_u": beside_u,
        "beside_v": beside_v,
        # where cells have shown that there is something, it is as large as it was measured
        "found": bool(one.found.any() or (exceeds and one.rms.any())),
    }
