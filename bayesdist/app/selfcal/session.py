"""What the stages of a self-calibration share."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config.selfcal import SelfcalBlock
from bayesdist.app.discrepancy import RunDiscrepancy, kept_discrepancy
from bayesdist.app.selfcal.gauge import Known, fixed_by, gauge_words
from bayesdist.app.selfcal.inputs import (
    Commanded,
    Inputs,
    read_commanded,
    read_inputs,
    read_references,
)
from bayesdist.app.selfcal.matches import matches_of
from bayesdist.app.selfcal.matching import TURN_BACK, half_turned
from bayesdist.app.selfcal.start import started
from bayesdist.app.session import Session
from bayesdist.assess import StarSample, UncertaintyMap, uncertainty_map
from bayesdist.assess.maps import with_local
from bayesdist.assess.solution import Solution as Assessed
from bayesdist.data import MagnitudeErrors, MatchTable, ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.sky.earth import parallax_factors
from bayesdist.diagnose import ScoreTest
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.diagnose.selfcal.misfit import dithered_misfit
from bayesdist.diagnose.selfcal.score import selfcal_score_tests
from bayesdist.errors import DegenerateError, InputError, NotSettledError
from bayesdist.infer import GaussianPriors, Matches
from bayesdist.infer.discrepancy import Discrepancy
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.selfcal import Gauge, ReferenceStars, SelfCalibration, Solution, gauge_free
from bayesdist.infer.selfcal.calibrate import self_calibrate
from bayesdist.infer.selfcal.discrepancy import selfcal_discrepancy
from bayesdist.infer.selfcal.following import taken_by_stars
from bayesdist.infer.selfcal.gauge import Decision
from bayesdist.infer.selfcal.normal import Mixture, expand
from bayesdist.infer.selfcal.problem import Problem, prepared
from bayesdist.infer.selfcal.relative import gauge_free_matrix
from bayesdist.infer.selfcal.settled import gauge_of
from bayesdist.infer.selfcal.tangent import TangentPlane
from bayesdist.model import DistortionModel

__all__ = ["DETECTIONS", "SOLUTION", "SelfcalSession"]

Float = NDArray[np.float64]

DETECTIONS, SOLUTION = "detections.h5", "solution.h5"
_OF_DETECTIONS = ("x", "y", "star", "sigma", "theta", "stars", "mixture", "model")
_OF_SOLUTION = ("theta", "stars", "mixture", "held", "n_free", "reference")
RELINEARISED = 3  # times a problem is linearised anew about a solution that is read

_MATCH_AGAIN, _FIT_AGAIN = "run the stage 'match' again", "run the stage 'fit' again"


@dataclass
class SelfcalSession(Session):
    """What the stages share: detections, stars, the solution with its stars, its gauge."""

    things = "detections"

    @property
    def block(self) -> SelfcalBlock:
        """The self-calibration's part of the configuration."""
        assert self.config.selfcal is not None
        return self.config.selfcal

    @property
    def base(self) -> Path:
        """Folder that the configuration's files are relative to."""
        return Path(self.run.record["base"])

    @property
    def unit_arcsec(self) -> float | None:
        """Size of the unit of u, v; None where nobody says what a pixel is."""
        return {"arcsec": 1.0, "mas": 1e-3}.get(self.block.unit, self.scale_arcsec)

    # -- before the match -------------------------------------------------------------------------

    @cached_property
    def inputs(self) -> Inputs:
        """Detections that pass the cuts."""
        return read_inputs(self.config, self.base)

    @cached_property
    def commanded(self) -> Commanded | None:
        """Commanded offsets and rolls, where there are any."""
        gauge = self.config.gauge
        if gauge.offsets is None:
            return None
        return read_commanded(
            self.base / gauge.offsets,
            self.inputs.detections.exposure_names,
            self.block.unit,
            self.config.detector.scale_mas,
            gauge.offset_sigma,
        )

    @cached_property
    def reference_catalog(self) -> ReferenceCatalog | None:
        """Reference stars, where there are any."""
        return read_references(self.config, self.base, self.unit_arcsec)

    @cached_property
    def start(self) -> tuple[DistortionModel, Float]:
        """Model and first parameters."""
        return started(
            self.config,
            self.base,
            self.inputs,
            self.unit_arcsec,
            self.reference_catalog,
            self.commanded,
        )

    def calibrated(self, log: Callable[[str], None]) -> SelfCalibration:
        """Stars and solution, found now; nothing is written.

        Raises
        ------
        BayesdistError
            As `self_calibrate`; where that does not settle and one exposure lies half a turn from
            all the others, naming it.
        """
        model, theta = self.start
        block = self.block
        try:
            return self_calibrate(
                model,
                self.inputs.detections,
                theta,
                knowledge=self.known_for(model),
                match_radius=block.match_radius,
                start_radius=block.start_radius,
                least=block.min_detections,
                motion=block.motion,
                parallax_factors=self.parallax_factors,
                dilation=self.inputs.dilation,
                jitter=self.jitter,
                references=self.references,
                plane=self.tangent_plane,
                rounds=block.max_iterations,
                log=log,
            )
        except (NotSettledError, DegenerateError) as error:
            frames = [model.frame(theta, e)[0] for e in range(len(model.exposures))]
            turned = half_turned(np.array([np.arctan2(M[1, 0], M[0, 0]) for M in frames]))
            if not turned:
                raise
            name = model.exposures[turned[0]]
            raise InputError(
                f"{error.cause}, and exposure {name} lies half a turn from all the others",
                where="selfcal.lists",
                do=TURN_BACK,
            ) from error

    @property
    def jitter(self) -> float | None:
        """The jitter in pixels that is held; None where it is fitted."""
        jitter = self.config.outliers.jitter
        return None if jitter == "fit" else float(jitter)

    @property
    def references(self) -> ReferenceStars | None:
        """What the catalogue says of the stars."""
        catalog, block = self.reference_catalog, self.config.gauge.reference
        return None if catalog is None or block is None else ReferenceStars(catalog, block.radius)

    @property
    def tangent_plane(self) -> TangentPlane | None:
        """That of the reference stars, or of the first exposure; None for pixels of no size."""
        if self.unit_arcsec is None:
            return None
        point = None if self.config.gauge.reference is None else (0.0, 0.0)
        return TangentPlane(self.unit_arcsec, point)

    @cached_property
    def parallax_factors(self) -> NDArray[np.float64] | None:
        """Of each exposure (E, 2), along u and v; None where stars have no parallax.

        Raises
        ------
        InputError
            Where the field's place on the sky is not known, or the exposures have no dates.
        """
        if self.block.motion != "parallax":
            return None
        catalog, epoch = self.reference_catalog, self.inputs.detections.epoch
        if catalog is None or catalog.tangent_point is None:
            raise InputError(
                "asks for parallaxes, and nothing says where on the sky the field lies",
                where="selfcal.motion",
                do="give reference stars with ra and dec in gauge.reference",
            )
        if epoch is None:
            raise InputError(
                "asks for parallaxes, and the exposures have no dates",
                where="selfcal.motion",
                do="give an exposure log with epochs",
            )
        return parallax_factors(epoch, *catalog.tangent_point)

    def known_for(self, model: DistortionModel) -> Known:
        """What is known beside the detections."""
        return Known.of(self.config, model, self.commanded, self.unit_arcsec)

    # -- after the match --------------------------------------------------------------------------

    def keep_detections(self, found: SelfCalibration) -> None:
        """Write which detections are of which star, with their errors and the solution so far."""
        d, m = found.detections, found.solution.mixture
        assert d.sigma is not None
        s = found.solution
        arrays = {"x": d.x, "y": d.y, "star": d.star, "sigma": d.sigma}
        arrays |= {"theta": s.theta, "stars": s.stars}
        arrays["mixture"] = np.array([m.jitter, m.fraction])
        text = json.dumps(found.solution.problem.model.to_dict())
        arrays["model"] = np.frombuffer(text.encode(), np.uint8)
        if found.magnitude_errors is not None:
            arrays["magnitudes"] = np.stack(found.magnitude_errors)
        write_arrays(self.run / DETECTIONS, "", arrays)
        self.forget()

    @cached_property
    def _kept(self) -> dict[str, NDArray[np.float64]]:
        return read_arrays(self.run / DETECTIONS, "", _OF_DETECTIONS, do=_MATCH_AGAIN)

    @cached_property
    def detections(self) -> Detections:
        """Detections with their stars and errors, on one tangent plane, as the match left them."""
        kept = self._kept
        return replace(
            self.inputs.detections,
            x=kept["x"],
            y=kept["y"],
            star=kept["star"].astype(np.int64),
            sigma=kept["sigma"],
        )

    @property
    def matched(self) -> tuple[DistortionModel, Float, Float, Mixture]:
        """Model, parameters, stars and mixture of the match, from which the fit begins."""
        kept = self._kept
        model = DistortionModel.from_dict(json.loads(kept["model"].astype(np.uint8).tobytes()))
        mixture = Mixture(*(float(v) for v in kept["mixture"]))
        return model, kept["theta"], kept["stars"], mixture

    def problem_at(self, model: DistortionModel, theta: Float) -> Problem:
        """The detections, linearised at parameters near the solution."""
        problem = prepared(
            model,
            self.detections,
            theta,
            match_radius=self.block.match_radius,
            least=self.block.min_detections,
            motion=self.block.motion,
            parallax_factors=self.parallax_factors,
            dilation=self.inputs.dilation,
        )
        references = self.references
        if references is None:
            return problem
        return replace(problem, priors=references(problem, self._kept["theta"]))

    def keep_solution(self, solution: Solution, reference: Float) -> None:
        """Write a solution; `reference` is where what is known beside it was linearised."""
        m, decision = solution.mixture, solution.decision
        assert decision is not None
        arrays = {
            "theta": solution.theta,
            "stars": solution.stars,
            "mixture": np.array([m.jitter, m.fraction]),
            "held": decision.held,
            "n_free": np.array([decision.n_null, decision.n_open]),
            "reference": reference,
        }
        write_arrays(self.run / SOLUTION, "", arrays)
        self.fit_changed()

    @cached_property
    def solved(self) -> Solution:
        """The solution of an earlier stage, with its stars."""
        kept = read_arrays(self.run / SOLUTION, "", _OF_SOLUTION, do=_FIT_AGAIN)
        model, held = self.model, kept["held"].astype(np.int64)
        theta, stars = kept["theta"], kept["stars"]
        jitter, fraction = (float(v) for v in kept["mixture"])
        problem, mixture = self.problem_at(model, theta), Mixture(jitter, fraction)
        for _ in range(RELINEARISED):
            problem = problem.at(theta, stars)
        found = expand(problem, theta, mixture, stars)
        free = np.setdiff1d(np.arange(model.n_params), held)
        decision = Decision(*(int(n) for n in kept["n_free"]), held)
        information = self.known_for(model)(kept["reference"])
        stars = problem.found_again(theta, found.stars)
        return Solution(problem, theta, stars, mixture, free, found, information, decision)

    @cached_property
    def gauge(self) -> Gauge:
        """What the detections leave free, and what fixes it."""
        s = self.solved
        return gauge_of(s.problem, s.theta, self.known_for(self.model)(s.theta), s)

    @cached_property
    def fixed(self) -> dict[str, str]:
        """What fixes each property of the solution."""
        return fixed_by(self.gauge, self.solved, self.known_for(self.model))

    # -- what the usual stages ask for ------------------------------------------------------------

    @cached_property
    def model(self) -> DistortionModel:
        """The model that was fitted."""
        return self.fit.model

    @cached_property
    def priors(self) -> GaussianPriors:
        """None here: what is known is part of the solution."""
        return GaussianPriors.none(self.model)

    @cached_property
    def raw_matches(self) -> MatchTable:  # type: ignore[override]
        """Detections beside their stars."""
        return matches_of(self.solved, self.detections, self.inputs, self._unused)

    @property
    def matches(self) -> Matches:  # type: ignore[override]
        """The same: they have their errors."""
        return self.raw_matches

    @property
    def _unused(self) -> dict[str, int]:
        found = self.run.summary.get("selfcal", {}).get("detections", {})
        return dict(found.get("unused", {}))

    @cached_property
    def magnitude_errors(self) -> MagnitudeErrors | None:
        """Errors of the centroids, as their scatter about the stars shows them."""
        return self.kept_errors()

    @property
    def centroid(self) -> MagnitudeErrors | None:  # type: ignore[override]
        """The same, less the structure that residuals show."""
        errors, found = self.magnitude_errors, self.discrepancy
        return errors if found is None else found.of_centroids(errors)

    def _sampled(self) -> StarSample:
        sample, solution = super()._sampled(), self.solved
        taken = np.zeros(len(self.detections))
        taken[solution.problem.rows] = taken_by_stars(solution)
        return replace(sample, taken=taken[sample.table.row])

    @cached_property
    def misfits(self) -> tuple[Misfit, ...]:  # type: ignore[override]
        """Structure that the solution leaves, of all chips together: they share stars."""
        return (dithered_misfit(self.solved),)

    def estimate_discrepancy(self) -> Discrepancy:
        """What the model may leave out, from the residuals with the stars eliminated."""
        return selfcal_discrepancy(
            self.solved, rng=self.rng("assess"), priors=self.config.discrepancy.priors()
        )

    @cached_property
    def discrepancy(self) -> RunDiscrepancy | None:
        """What the model may leave out; exposures overlap in part, and their frames follow it."""
        found = kept_discrepancy(self)
        return found and replace(found, frames=True)

    def made_score_tests(self) -> tuple[ScoreTest, ...]:
        """Targeted tests of the residuals for what the model lacks, with the stars eliminated."""
        matches = self.raw_matches
        return selfcal_score_tests(self.solved, mag=matches.mag, epoch=matches.epoch)

    catalogue_stated = None
    motions_stated = None

    @property
    def relative(self) -> Assessed:
        """The solution of relative positions, whatever the gauge."""
        return gauge_free(self.solution, self.gauge.null)

    def relative_map(self, **where: Any) -> UncertaintyMap:
        """Uncertainty of relative positions over a chip, with what the model leaves out."""
        found, local = self.discrepancy, None
        if found is not None:
            S = gauge_free_matrix(self.model, self.solution.mean, self.gauge.null)
            relative = replace(found.moved(S), frames=False)  # of the detector alone
            local = relative.structure_sigma(self._domain(**where))
        return with_local(uncertainty_map(self.relative, **where), local)

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand."""
        return gauge_words(self.gauge, self.fixed, self.model)

    @property
    def doubts(self) -> list[str]:
        """What cannot be known, and what the match found odd."""
        warnings = self.run.summary.get("selfcal", {}).get("warnings", [])
        known = self.known_for(self.model).contradictions(self.solved.theta)
        hidden = [
            f"{100 * (1 - one.told):.0f} % of the structure that the model might leave is hidden: "
            "places of stars take it up where dithers are small"
            for one in self.misfits
            if one.hidden
        ]
        return [*self.gauge.sentences, *known, *warnings, *hidden, *super().doubts]

    def fit_changed(self) -> None:
        """Forget what rests on the solution."""
        self.errors_changed()
        names = ("fit", "model", "priors", "solved", "gauge", "fixed", "raw_matches")
        names += ("systematics", "solution", "discrepancy", "local_terms", "score_tests")
        for name in names:
            self.__dict__.pop(name, None)

    def forget(self) -> None:
        """Forget what rests on the match."""
        self.fit_changed()
        for name in ("_kept", "detections"):
            self.__dict__.pop(name, None)
