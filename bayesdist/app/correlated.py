"""Stars that err together: measured by `assess`, used in all that rests on the solution.

A pattern on the detector that the model leaves out, and whatever the stars of an exposure have in
common, make errors of coefficients that no posterior of independent stars shows.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.fingerprint import fingerprint_of
from bayesdist.assess.centroid import without
from bayesdist.assess.mean_square import MeanSquare
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
from bayesdist.model import DistortionModel

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
        reach_pix, patch_pix, unmodelled [{chip, rms_u, rms_v, error_u, error_v, beside {square_u,
        square_v, error_u, error_v}, found}]: the mean squares that come beside the coefficients'
        errors are less than the structure's, as the fit was drawn towards it.
    """

    cov: Float
    formal: Float
    facts: dict[str, Any]

    @property
    def exceeds(self) -> bool:
        """Whether the covariance is larger than the formal one."""
        return bool(self.facts["exceeds"])

    @property
    def at_place(self) -> bool:
        """Whether the model leaves something out at a place."""
        return any(one["found"] for one in self.facts["unmodelled"])

    @property
    def found(self) -> bool:
        """Whether stars have errors in common, of either kind."""
        return self.exceeds or self.at_place

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
        if errors is None or not self.at_place:
            return errors
        left = self.facts["unmodelled"]  # stars are on all chips
        u, v = (np.sqrt(np.mean([one[f"rms_{axis}"] ** 2 for one in left])) for axis in "uv")
        return without(errors, u, v)

    def local_term(self, grid: tuple[int, int]) -> tuple[LocalTerm, ...]:
        """What is left out at a place, as a term of the budget; nothing where none is found."""
        if not self.at_place:
            return ()
        squares = {}
        for one in self.facts["unmodelled"]:
            beside = one["beside"]
            square, error = (
                np.array([beside[f"{kind}_{a}"] for a in "uv"]) for kind in ("square", "error")
            )
            squares[one["chip"]] = MeanSquare(square, error)
        sigma = {c: np.tile(np.sqrt(s.mean), (grid[1], grid[0], 1)) for c, s in squares.items()}
        return (LocalTerm(UNMODELLED, sigma, squares=squares),)


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
        "patch_pix": _patch(model, left),
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


def _patch(model: DistortionModel, left: Sequence[Unmodelled]) -> float:
    """Side of patches that err as one and draw the fit as far as was measured; 0 where unknown.

    With P terms, independent patches of side a and mean square S draw positions on an area A by
    S P a^2 / A on the mean.
    """
    found = [0.0]
    for one in left:
        chip, structure = model.chips[model.chip_code(one.chip)], one.variance.sum()
        if structure > 0:
            area = np.prod(chip.size) / model.basis(chip.number).n_terms
            found.append(float(np.sqrt(one.drawn.sum() / structure * area)))
    return max(found)


def _row(one: Unmodelled, exceeds: bool) -> dict[str, Any]:
    u, v = (float(r) for r in one.rms)
    error_u, error_v = (float(e) for e in one.rms_error)
    return {
        "chip": one.chip,
        "rms_u": u,
        "rms_v": v,
        "error_u": error_u,
        "error_v": error_v,
        "beside": {
            f"{kind}_{axis}": float(value)
            for kind, values in (("square", one.beside.measured), ("error", one.beside.error))
            for axis, value in zip("uv", values, strict=True)
        },
        # where cells have shown that there is something, it is as large as it was measured
        "found": bool(one.found.any() or (exceeds and one.rms.any())),
    }
