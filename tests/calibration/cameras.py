"""Calibrations of invented cameras, with all that a WCS has to cope with."""

from __future__ import annotations

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import FurtherError
from bayesdist.calibration.plane import Plane
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.model import Chip, DistortionModel, LookupTable, TimeDependence

POINT = (5.0, 0.3)  # degrees: near 0, where a double has 3e-12 arcsec
SIZE = (1200.0, 800.0)
PIXEL = 0.2  # arcsec
FURTHER = (
    FurtherError("catalogue zero point", "systematic", 0.003, 0.002),
    FurtherError("pattern", "local", 0.001, 0.004),
)


def camera(
    *,
    order: int = 4,
    chips: int = 1,
    unit: str = "arcsec",
    plane: Plane | None = None,
    drifts: bool = False,
    tables: bool = False,
    further: tuple[FurtherError, ...] = (),
    seed: int = 1,
) -> Calibration:
    """Camera with a parity as on the sky, distortion of a pixel and errors of 0.01 px."""
    rng = np.random.default_rng(seed)
    scale = {"arcsec": PIXEL, "pix": 1.0, "mas": 1e3 * PIXEL}[unit]
    detector = tuple(
        Chip(k + 1, f"C{k + 1}", SIZE, ((SIZE[0] + 1) / 2 + 3, (SIZE[1] + 1) / 2 - 5))
        for k in range(chips)
    )
    time = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2015.0,)) if drifts else None
    model = DistortionModel(order, detector, unit, time)
    theta = np.zeros(model.n_params)
    half = np.array(SIZE) / 2
    for k, chip in enumerate(detector):
        K = model.n_terms
        degree = np.array(model.bases[k].terms).sum(axis=1)
        legendre = rng.normal(0.0, 0.02 * half.min(), (2, K)) / np.maximum(degree, 1) ** 4
        legendre[:, :3] = [[2 + 5 * k, -half[0], 0.01 * half[1]], [850 * k, 0.02, half[1]]]
        for axis in (0, 1):
            theta[model.coefficient_slice(chip.number, axis)] = scale * legendre[axis]
        if drifts:
            theta[model.tdd_slice(chip.number)] = scale * rng.normal(0.0, 0.05, 2)
    root = rng.normal(size=(model.n_params, 2 * model.n_params))
    cov = (0.01 * scale) ** 2 * root @ root.T / (2 * model.n_params)
    made = tuple(_table(rng, k + 1, 0.1) for k in range(chips)) if tables else ()
    after = tuple(_table(rng, k + 1, 0.03 * scale) for k in range(chips)) if tables else ()
    return Calibration(
        "camera",
        GaussianSolution(model, theta, cov),
        Plane("sky", point=POINT) if plane is None else plane,
        before=made,
        after=after,
        further=further,
        reference_date=2015.0 if drifts else None,
    )


def _table(rng: np.random.Generator, chip: int, size: float) -> LookupTable:
    step = (100.0, 100.0)
    shape = (2, int(SIZE[1] // step[1]) + 1, int(SIZE[0] // step[0]) + 1)
    return LookupTable(chip, rng.uniform(-size, size, shape), first=(1.0, 1.0), step=step)


def pixels(n: int = 500, beyond: float = 0.05, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Random 0-based pixels on the chip, and on a margin of a part of its size."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(-beyond * s, (1 + beyond) * s, n) - 0.5 for s in SIZE)
    return x, y


def apart(first, second) -> float:
    """Largest distance in arcsec between positions (ra, dec) in degrees."""
    ra, dec = (np.asarray(a) - np.asarray(b) for a, b in zip(first, second, strict=True))
    ra = (ra + 180.0) % 360.0 - 180.0
    return float(3600 * np.hypot(ra * np.cos(np.radians(first[1])), dec).max())
