"""Initial model and parameters of a self-calibration, from its lists or an earlier calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesdist.app.config.section import one_chip
from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.matching.pairs import LinearMap, best_similarity
from bayesdist.data.matching.similarity import Similarity, find_similarity, pattern_index
from bayesdist.errors import InputError
from bayesdist.infer import load_fit, load_posterior
from bayesdist.kinds.selfcal.config import SelfcalConfig
from bayesdist.kinds.selfcal.grouping import mutual_frames
from bayesdist.kinds.selfcal.infer.prior import (
    chips_side_by_side,
    fitted_polynomials,
    start_parameters,
    undistorted,
)
from bayesdist.kinds.selfcal.known import Commanded
from bayesdist.kinds.star_lists import Start, known_calibration, positions_by_chip, start_of
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float, Int


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
