"""Inputs of a self-calibration: detections, additional constraints, and an initial model.

The initial parameters are those of the lists or of an earlier calibration.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from bayesdist.app.config.section import one_chip
from bayesdist.app.kind import Outline
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import ReferenceCatalog, read_catalog, read_exposures
from bayesdist.data.detections import Detections, detections_of
from bayesdist.data.matching.pairs import LinearMap, best_similarity
from bayesdist.data.matching.similarity import Similarity, find_similarity, pattern_index
from bayesdist.data.sky import parallax_factors
from bayesdist.errors import InputError
from bayesdist.infer import load_fit, load_posterior
from bayesdist.kinds.selfcal.config import SelfcalConfig
from bayesdist.kinds.selfcal.gauge import Commanded, GaugeConstraints, read_commanded
from bayesdist.kinds.selfcal.grouping import mutual_frames, refuse_duplicates
from bayesdist.kinds.selfcal.infer import ReferenceStars
from bayesdist.kinds.selfcal.infer.prior import (
    chips_side_by_side,
    fitted_polynomials,
    start_parameters,
    undistorted,
)
from bayesdist.kinds.selfcal.infer.problem import Problem, TangentPlane, contacts_of, prepare
from bayesdist.kinds.star_lists import (
    Start,
    known_calibration,
    lists_of,
    positions_by_chip,
    refuse_other_chips,
    start_of,
)
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float, Int

log = logging.getLogger("bayesdist")


@dataclass(frozen=True, eq=False)
class SelfcalInputs:
    """Detections, and additional information about exposures and stars."""

    config: SelfcalConfig
    base: Path  # folder that file names are relative to
    detections: Detections  # those that pass the cuts; without star codes
    n_read: int  # number of detections in the lists
    rejected: Mapping[str, int]  # number of detections that fail the cuts, by reason
    dilation: Float | None = None  # (E,), VAFACTOR, if the log states it
    catalog: ReferenceCatalog | None = None  # reference stars, if any
    commanded: Commanded | None = None  # commanded offsets and rolls, if any

    @property
    def unit_arcsec(self) -> float | None:
        """Size of the unit of u, v in arcsec; None if the pixel scale is unknown."""
        return _unit_arcsec(self.config)

    @property
    def jitter(self) -> float | None:
        """Fixed jitter in pixels; None if it is fitted."""
        jitter = self.config.outliers.jitter
        return None if jitter == "fit" else float(jitter)

    @property
    def references(self) -> ReferenceStars | None:
        """Reference stars to be identified among the detections; None if there are none."""
        reference = self.config.gauge.reference
        if self.catalog is None or reference is None:
            return None
        return ReferenceStars(self.catalog, reference.radius)

    @property
    def tangent_plane(self) -> TangentPlane | None:
        """Plane of the reference stars, or at the mean pointing; None without a pixel scale."""
        if self.unit_arcsec is None:
            return None
        point = None if self.config.gauge.reference is None else (0.0, 0.0)
        return TangentPlane(self.unit_arcsec, point)

    def contact(self, model: DistortionModel, theta: Float) -> tuple[float, float] | None:
        """Point (u, v) where the stars' plane touches the sky; None if the sky is taken as flat."""
        if self.tangent_plane is None:
            return None
        u, v = self.tangent_plane.contact(contacts_of(model, theta, self.detections.epoch))
        return float(u), float(v)

    @cached_property
    def parallax_factors(self) -> Float | None:
        """Parallax factors (E, 2) of exposures along u and v; None if parallaxes are not fitted."""
        if self.config.selfcal.motion != "parallax":
            return None
        epoch = self.detections.epoch
        if self.catalog is None or self.catalog.tangent_point is None:
            raise InputError(
                "asks for parallaxes, but the position of the field on the sky is unknown",
                where="selfcal.motion",
                do="give reference stars with ra and dec in gauge.reference",
            )
        if epoch is None:
            raise InputError(
                "asks for parallaxes, but the exposures have no dates",
                where="selfcal.motion",
                do="give an exposure log with epochs",
            )
        return parallax_factors(epoch, *self.catalog.tangent_point)

    @cached_property
    def start(self) -> tuple[DistortionModel, Float]:
        """Model, and initial parameters (D,) that align the detections of each star."""
        arguments = self.detections, self.unit_arcsec, self.catalog, self.commanded
        return started(self.config, self.base, *arguments)

    def known_for(self, model: DistortionModel) -> GaugeConstraints:
        """Constraints on the gauge in addition to the detections."""
        return GaugeConstraints.of(self.config, model, self.commanded, self.unit_arcsec)

    def problem(
        self, model: DistortionModel, detections: Detections, theta: Float, first: Float
    ) -> Problem:
        """Detections of stars, linearised at parameters `theta` (D,) near the solution.

        With the parameters `first` (D,) reference stars are identified among the detected stars.
        """
        block = self.config.selfcal
        problem = prepare(
            model,
            detections,
            theta,
            match_radius=block.match_radius,
            min_detections=block.min_detections,
            motion=block.motion,
            parallax_factors=self.parallax_factors,
            dilation=self.dilation,
        )
        references = self.references
        if references is None:
            return problem
        return replace(problem, priors=references(problem, first))


def read_selfcal(config: SelfcalConfig, base: Path) -> SelfcalInputs:
    """Read all inputs of a self-calibration; paths are relative to `base`."""
    block, gauge = config.selfcal, config.gauge
    star_lists = lists_of(block, base, errors=block.sigma == "columns")
    names = star_lists.names
    for name, detections, good in zip(names, star_lists.lists, star_lists.passed, strict=True):
        if not good.any():
            raise InputError(
                f"no detection of exposure {name} passes the cuts",
                where=detections.source,
                do="widen them, or leave the exposure out",
            )
    used = [
        detections.select(good)
        for detections, good in zip(star_lists.lists, star_lists.passed, strict=True)
    ]
    if len(used) < 2:
        raise InputError(
            f"there is only one exposure, {names[0]}, but distortion is measured between exposures",
            where=used[0].source,
            do="give dithered exposures of one field",
        )
    refuse_other_chips(used, config.chips(), "selfcal.lists")
    refuse_duplicates(
        [np.column_stack([detections.x, detections.y, detections.chip]) for detections in used],
        names,
        source="selfcal.lists",
    )
    epoch, dilation = _of_log(config, base, names)
    if epoch is None and all(detections.epoch is not None for detections in used):
        epoch = np.concatenate(
            [detections.epoch for detections in used if detections.epoch is not None]
        )
    sigma = None if isinstance(block.sigma, str) else float(block.sigma)
    commanded, catalog = None, _read_references(config, base)
    if gauge.offsets is not None:
        commanded = read_commanded(
            base / gauge.offsets, names, block.unit, config.detector.scale_mas, gauge.offset_sigma
        )
    return SelfcalInputs(
        config,
        base,
        detections_of(used, epoch=epoch, sigma=sigma),
        len(star_lists),
        star_lists.cut,
        dilation,
        catalog,
        commanded,
    )


def refuse_selfcal(inputs: SelfcalInputs) -> None:
    """Refuse exposures that cannot be aligned, and an initial distortion that cannot be read."""
    model, _ = inputs.start
    inputs.known_for(model)


def outline_of_selfcal(inputs: SelfcalInputs) -> Outline:
    """Shape of the solution, from the initial model."""
    model, theta = inputs.start
    plain = DistortionModel(model.order, model.chips, model.unit, model.time)
    return Outline(plain, model.pixel_size(theta))


def _unit_arcsec(config: SelfcalConfig) -> float | None:
    """Size of the unit of u and v in arcsec; None for pixels of unknown size."""
    scale = config.detector.scale_mas
    return ARCSEC.get(config.selfcal.unit, None if scale is None else scale / 1000)


def _of_log(
    config: SelfcalConfig, base: Path, names: Sequence[str]
) -> tuple[Float | None, Float | None]:
    """Dates and VAFACTOR of the exposures; None for what the log does not state."""
    exposures = config.selfcal.exposures
    if exposures is None:
        return None, None
    log = read_exposures(base / exposures)
    entries = [log[name] for name in names]
    factors = np.array([np.nan if entry.vafactor is None else entry.vafactor for entry in entries])
    has_factor = np.isfinite(factors)
    if has_factor.any() and not has_factor.all():
        raise InputError(
            f"exposure {names[int(np.argmin(has_factor))]} has no vafactor, although others do",
            where=log.source,
            do="give it for all exposures, or for none",
        )
    return np.array([entry.epoch for entry in entries]), factors if has_factor.all() else None


def _read_references(config: SelfcalConfig, base: Path) -> ReferenceCatalog | None:
    """Reference stars in the unit of u and v; None if there are none."""
    block, unit_arcsec = config.gauge.reference, _unit_arcsec(config)
    if block is None or unit_arcsec is None:  # with references the configuration requires a scale
        return None
    catalog = read_catalog(
        base / block.catalog,
        block.columns,
        unit=block.unit,
        epoch=block.epoch,
        tangent_point=block.tangent_point,
        motion_prior=block.motion_prior,
    )
    if catalog.sigma_u is None or catalog.sigma_v is None:
        raise InputError(
            "the reference stars have no errors",
            where=catalog.source,
            do="give the columns sigma_u and sigma_v, or ra_error and dec_error",
        )
    if not ((catalog.sigma_u > 0) & (catalog.sigma_v > 0)).all():
        raise InputError(
            "a reference star has the error zero", where=catalog.source, do="drop it, or correct it"
        )
    catalog = _with_motions(catalog)
    catalog_unit_arcsec = ARCSEC.get(catalog.unit, unit_arcsec)
    return catalog.rescaled(catalog_unit_arcsec / unit_arcsec, config.selfcal.unit)


def _with_motions(catalog: ReferenceCatalog) -> ReferenceCatalog:
    """Catalogue without stars that have a proper-motion error of zero.

    Some catalogues write unmeasured proper motions in this way.  The positions of such stars at
    other dates are unknown.
    """
    if catalog.sigma_pm_u is None or catalog.sigma_pm_v is None:
        return catalog
    measured = (catalog.sigma_pm_u > 0) & (catalog.sigma_pm_v > 0)
    if not measured.all():
        log.info(
            "match: %d of %d reference stars have no measured motion and are left out",
            len(catalog) - measured.sum(),
            len(catalog),
        )
    return catalog.select(measured)


def started(
    config: SelfcalConfig,
    base: Path,
    d: Detections,
    unit_arcsec: float | None,
    references: ReferenceCatalog | None,
    commanded: Commanded | None,
) -> tuple[DistortionModel, Float]:
    """Model, and initial parameters (D,) that align the detections of each star.

    The orientation on the sky is that of the reference stars, otherwise that of the commanded
    offsets, otherwise that of the first exposure.  Raises InputError, which names the exposures, if
    exposures have no stars in common.
    """
    block, number = config.selfcal, int(d.chip[0])  # chip number of a detector with one chip
    chips = config.chips()
    if not chips:
        pixel = config.model.reference_pixel
        chips = (one_chip(config.detector, pixel, number, f"chip {number}"),)
    start = _first(config, base, chips, unit_arcsec)
    # without an initial distortion the layout of the chips is unknown: each chip is a list
    several = len(chips) > 1 and block.initial_distortion is None
    exposure, chip, rows = _lists(d, apart=several)
    names = [d.exposure_names[e] for e in exposure]
    mags = None if d.mag is None else [d.mag[r] for r in rows]

    def planes(of: Start) -> list[Float]:
        return [positions_by_chip(of, d.x[r], d.y[r], d.chip[r]) for r in rows]

    if several:
        labels = [f"{name} chip {n}" for name, n in zip(names, chip, strict=True)]
        apart = mutual_frames(planes(start), mags, labels, source="selfcal.lists")
        start = chips_side_by_side(start, chips, apart, exposure, chip)
        exposure, chip, rows = _lists(d, apart=False)
        names, mags = list(d.exposure_names), None if d.mag is None else [d.mag[r] for r in rows]
    on = planes(start)
    onto = _onto_references(on[0], None if mags is None else mags[0], references)
    if onto is not None:
        on = [onto(plane) for plane in on]
    frames = mutual_frames(on, mags, names, source="selfcal.lists")
    if onto is None and commanded is not None and commanded.offsets is not None:
        middles = np.stack([plane.mean(axis=0) for plane in on])
        turned = _onto_offsets(frames.matrices, frames.shifts, middles[0], commanded.offsets)
        if turned is not None:
            onto, on = turned, [turned(plane) for plane in on]
            frames = mutual_frames(on, mags, names, source="selfcal.lists")
    middles = np.stack([plane.mean(axis=0) for plane in on])
    # frames rotate about the point where the planes of the exposures touch the sky
    (x, y), number = chips[0].reference_pixel, chips[0].number
    origin = start(np.array([x]), np.array([y]), number)
    u, v = (origin if onto is None else onto(origin))[0]
    model = DistortionModel(
        config.model.order,
        chips,
        unit=block.unit,
        time=config.time(),
        frames=block.frames,
        exposures=d.exposure_names,
        origin=(float(u), float(v)),
    )
    coefficients = fitted_polynomials(start, chips, model.order, onto)
    return model, start_parameters(model, coefficients, frames, middles)


def _lists(d: Detections, *, apart: bool) -> tuple[Int, Int, list[Int]]:
    """Exposure and chip of each list, and the rows of its detections."""
    lists = []
    for e in range(len(d.exposure_names)):
        in_exposure = np.flatnonzero(d.exposure == e)
        if not apart:
            lists.append((e, 0, in_exposure))
            continue
        lists += [
            (e, int(n), in_exposure[d.chip[in_exposure] == n])
            for n in np.unique(d.chip[in_exposure])
        ]
    exposure, number, rows = zip(*lists, strict=True)
    return np.array(exposure), np.array(number), list(rows)


def _first(
    config: SelfcalConfig, base: Path, chips: tuple[Chip, ...], unit_arcsec: float | None
) -> Start:
    """Initial distortion: of an earlier run, of a calibration file, or none."""
    block, scale = config.selfcal, config.detector.scale_mas
    pixel = 1.0
    if block.unit != "pix" and scale is not None and unit_arcsec is not None:
        pixel = scale / 1000 / unit_arcsec
    if block.initial_distortion is None:
        return undistorted(chips, pixel)
    path = base / block.initial_distortion
    if path.is_dir() or path.suffix == ".nc":
        solution = load_fit(path) if path.name == "fit.nc" else load_posterior(path)
        if solution.model.unit != block.unit:
            raise InputError(
                f"is in {solution.model.unit}, but selfcal.unit is {block.unit!r}",
                where=str(path),
                do="calibrate in the same unit",
            )

        def earlier(x: Float, y: Float, chip: int) -> Float:
            when = None if solution.model.time is None else solution.model.time.epoch0[0]
            return np.asarray(solution.model.predict(solution.mean, x, y, chip=chip, epoch=when))

        return earlier
    if unit_arcsec is None:
        raise InputError(
            "a calibration file is in arcsec, but the pixel scale is unknown",
            where=str(path),
            do="set detector.scale_mas",
        )
    size = chips[0].size if len(chips) == 1 else None
    return start_of(known_calibration(open_document(path), None, size), unit_arcsec)


def _onto_references(
    plane: Float, mag: Float | None, references: ReferenceCatalog | None
) -> LinearMap | None:
    """Similarity from the first exposure to the reference stars, mirrored if necessary."""
    if references is None:
        return None
    index = pattern_index(np.column_stack([references.u, references.v]), references.mag)
    name = references.source
    use = mag if references.mag is not None else None

    def found(mirrored: bool) -> Similarity:
        return find_similarity(
            plane,
            index,
            mag=use,
            mirrored=mirrored,
            source="the first exposure",
            reference_name=name,
        )

    try:
        return found(False).map
    except InputError:
        return found(True).map


def _onto_offsets(
    matrices: Float, shifts: Float, middle: Float, offsets: Float
) -> LinearMap | None:
    """Rotation and scale that align the exposures with commanded offsets; None if all coincide."""
    commanded = np.isfinite(offsets).all(axis=1)
    if commanded.sum() < 2:
        return None
    places, asked = (matrices @ middle + shifts)[commanded], offsets[commanded]
    if not np.ptp(places, axis=0).max() > 0:
        return None
    return LinearMap(best_similarity(places, asked).matrix, np.zeros(2), middle)
