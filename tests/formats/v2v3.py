"""Calibrations for distortion reference files, and V2, V3 by trigonometry alone."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import asdf
import numpy as np
from numpy.typing import NDArray

from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.model import LookupTable
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import BuildOptions, Built

from .support import random_pixels, some_solution

Float = NDArray[np.float64]

V2REF, V3REF, ANGLE = -289.97, -697.72, 0.57


def imager(
    size: tuple[float, float], pixel: float, *, order: int = 5, unit: str = "arcsec", **what: Any
) -> Calibration:
    """A detector whose distortion is about as large as those of real imagers."""
    reference = ((size[0] + 1) / 2, (size[1] + 1) / 2 - 3.25)
    solution = some_solution(
        order, unit=unit, size=size, reference_pixel=reference, pixel=pixel, strength=1.0,
        angle=0.01, offset=(0.3 * pixel, -2.0 * pixel), seed=order,
    )  # fmt: skip
    return calibration_of(solution, "made up", **what)


def tables(size: tuple[float, float], *filters: str) -> tuple[LookupTable, ...]:
    """Tables of 0.05 pixels with errors, one for each filter; of few nodes, as asdf is slow."""
    rng = np.random.default_rng(8)
    step = 256
    first, n = (step + 1) / 2, [int(side) // step for side in size]
    return tuple(
        LookupTable(
            1, 0.05 * rng.normal(size=(2, n[1], n[0])), name, (first, first), (step, step),
            sigma=rng.uniform(0.001, 0.01, (2, n[1], n[0])),
        )
        for name in filters
    )  # fmt: skip


def files(key: str, calibration: Calibration, settings: dict[str, Any], **options: Any) -> Any:
    """Files of a format."""
    wanted = registry.product_settings()[key](**settings)
    return registry.build(key, calibration, wanted, BuildOptions(**options))


def read(built: Built) -> Any:
    """The document of a file in memory."""
    return registry.recognized(Content(built.file_name, built.content))


def tree_of(built: Built) -> dict[str, Any]:
    """Tree of an ASDF file, by asdf alone."""
    options = {"lazy_load": False, "memmap": False, "ignore_unrecognized_tag": True}
    with asdf.open(io.BytesIO(built.content), **options) as file:
        return dict(file.tree)


def with_tree(tree: dict[str, Any], name: str = "changed.asdf") -> Any:
    """The document of an ASDF file with another tree."""
    stream = io.BytesIO()
    asdf.AsdfFile(tree).write_to(stream)
    return registry.recognized(Content(name, stream.getvalue()))


def v2v3_of(calibration: Calibration, x: Float, y: Float, *, parity: int = -1) -> Float:
    """V2 and V3 (2, N) of FITS pixels, as Cox & Lallo (JWST-STScI-001550) turn Ideal ones."""
    u, v = calibration.forward(x, y, chip=calibration.numbers[0]).T
    angle = np.radians(ANGLE)
    return np.stack([
        V2REF + parity * u * np.cos(angle) + v * np.sin(angle),
        V3REF - parity * u * np.sin(angle) + v * np.cos(angle),
    ])  # fmt: skip


def largest_distance(ours: Float, theirs: Any, pixel: float) -> float:
    """Largest distance between positions (2, N), in pixels."""
    far = np.hypot(*(ours - np.stack([np.asarray(one, float) for one in theirs])))
    return float(far.max() / pixel)


def some_pixels(calibration: Calibration, n: int = 2000) -> tuple[Float, Float]:
    """Pixels anywhere on the detector."""
    return random_pixels(calibration.model.chips[0].size, n)


def same_calibration(ours: Calibration, theirs: Calibration) -> None:
    """Parameters, covariance, chip and tables are the same bytes."""
    assert theirs.model == ours.model and theirs.errors == ours.errors
    assert np.array_equal(theirs.solution.mean, ours.solution.mean)
    assert np.array_equal(theirs.solution.cov, ours.solution.cov)
    assert len(theirs.before) == len(ours.before)
    for a, b in zip(theirs.before, ours.before, strict=True):
        assert np.array_equal(a.values, b.values) and np.array_equal(a.sigma, b.sigma)
        assert (a.filter, a.first, a.step) == (b.filter, b.first, b.step)


def with_tables(calibration: Calibration, *filters: str) -> Calibration:
    """A calibration with tables of the detector ('') and of its filter."""
    size = calibration.model.chips[0].size
    return replace(calibration, before=tables(size, *filters))
