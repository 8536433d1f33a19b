"""What a self-calibration is given: detections, and all that is known beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config import Config
from bayesdist.app.config.selfcal import SelfcalBlock
from bayesdist.app.selfcal.gauge import Known
from bayesdist.app.selfcal.inputs import (
    Commanded,
    Inputs,
    read_commanded,
    read_inputs,
    read_references,
    selfcal_block,
)
from bayesdist.app.selfcal.start import started
from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.sky.earth import parallax_factors
from bayesdist.errors import InputError
from bayesdist.infer.selfcal import ReferenceStars
from bayesdist.infer.selfcal.problem import Problem, prepare
from bayesdist.infer.selfcal.tangent import TangentPlane
from bayesdist.model import DistortionModel
from bayesdist.products import read_idctab

__all__ = ["Given", "read_given", "refuse_given"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Given:
    """Detections, and what is known of exposures and stars.

    Parameters
    ----------
    config : Config
    base : Path
        Folder that its files are relative to.
    inputs : Inputs
        Detections that pass the cuts.
    catalog : ReferenceCatalog or None
        Reference stars, where there are any.
    commanded : Commanded or None
        Commanded offsets and rolls, where there are any.
    """

    config: Config
    base: Path
    inputs: Inputs
    catalog: ReferenceCatalog | None = None
    commanded: Commanded | None = None

    @property
    def block(self) -> SelfcalBlock:
        """The self-calibration's part of the configuration."""
        return selfcal_block(self.config)

    @property
    def unit_arcsec(self) -> float | None:
        """Size of the unit of u, v; None where nobody says what a pixel is."""
        return unit_arcsec_of(self.config)

    @property
    def jitter(self) -> float | None:
        """The jitter in pixels that is held; None where it is fitted."""
        jitter = self.config.outliers.jitter
        return None if jitter == "fit" else float(jitter)

    @property
    def references(self) -> ReferenceStars | None:
        """What the catalogue says of the stars."""
        block = self.config.gauge.reference
        if self.catalog is None or block is None:
            return None
        return ReferenceStars(self.catalog, block.radius)

    @property
    def tangent_plane(self) -> TangentPlane | None:
        """That of the reference stars, or of the first exposure; None for pixels of no size."""
        if self.unit_arcsec is None:
            return None
        point = None if self.config.gauge.reference is None else (0.0, 0.0)
        return TangentPlane(self.unit_arcsec, point)

    @cached_property
    def parallax_factors(self) -> Float | None:
        """Of each exposure (E, 2), along u and v; None where stars have no parallax.

        Raises
        ------
        InputError
            Where the field's place on the sky is not known, or the exposures have no dates.
        """
        if self.block.motion != "parallax":
            return None
        epoch = self.inputs.detections.epoch
        if self.catalog is None or self.catalog.tangent_point is None:
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
        return parallax_factors(epoch, *self.catalog.tangent_point)

    @cached_property
    def start(self) -> tuple[DistortionModel, Float]:
        """Model, and parameters (D,) by which the detections of a star lie near each other.

        Raises
        ------
        InputError
            As `started`.
        """
        return started(
            self.config, self.base, self.inputs, self.unit_arcsec, self.catalog, self.commanded
        )

    def known_for(self, model: DistortionModel) -> Known:
        """What is known beside the detections.

        Raises
        ------
        InputError
            As `Known.of`.
        """
        return Known.of(self.config, model, self.commanded, self.unit_arcsec)

    def problem(
        self, model: DistortionModel, detections: Detections, theta: Float, first: Float
    ) -> Problem:
        """Detections of stars, linearised at parameters (D,) near the solution.

        Parameters
        ----------
        model : DistortionModel
        detections : Detections
            With codes of stars and errors.
        theta : ndarray, shape (D,)
        first : ndarray, shape (D,)
            By which reference stars are found among the detected ones.
        """
        problem = prepare(
            model,
            detections,
            theta,
            match_radius=self.block.match_radius,
            min_detections=self.block.min_detections,
            motion=self.block.motion,
            parallax_factors=self.parallax_factors,
            dilation=self.inputs.dilation,
        )
        references = self.references
        return (
            problem if references is None else replace(problem, priors=references(problem, first))
        )


def read_given(config: Config, base: Path) -> Given:
    """Read all that a self-calibration begins with.

    Parameters
    ----------
    config : Config
        With a section [selfcal].
    base : Path
        Folder that its files are relative to.

    Raises
    ------
    InputError
        As `read_inputs`, `read_references` and `read_commanded`.
    """
    inputs, gauge = read_inputs(config, base), config.gauge
    catalog, commanded = read_references(config, base, unit_arcsec_of(config)), None
    if gauge.offsets is not None:
        commanded = read_commanded(
            base / gauge.offsets,
            inputs.detections.exposure_names,
            selfcal_block(config).unit,
            config.detector.scale_mas,
            gauge.offset_sigma,
        )
    return Given(config, base, inputs, catalog, commanded)


def refuse_given(given: Given, config: Config, base: Path) -> None:
    """Refuse exposures that cannot be laid onto each other, and a start that cannot be read.

    Raises
    ------
    BayesdistError
    """
    model, _ = given.start
    given.known_for(model)
    path = base / (given.block.initial_distortion or "")
    if path.suffix == ".fits":
        read_idctab(path)


def unit_arcsec_of(config: Config) -> float | None:
    """Size of the unit of u, v; None for pixels of a size that nobody gives."""
    scale = config.detector.scale_mas
    pixel = None if scale is None else scale / 1000
    return {"arcsec": 1.0, "mas": 1e-3}.get(selfcal_block(config).unit, pixel)
