"""Simulated detections of one exposure: measured stars, blends, and false detections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.detections import Detections
from bayesdist.missions.hst.simulate.stars import FAINT, centroid_error
from bayesdist.missions.hst.simulate.truth import AcsTruth, DetectionTruth
from bayesdist.model import Chip
from bayesdist.utils.arrays import Bool, Float

BORDER = 5.0  # pixels: stars closer to an edge are not measured
LIMIT, SOFT = -7.5, 0.3  # magnitude of 50 % completeness, and width of its decline
SATURATED = -14.0  # magnitude of saturation (Figure 5)
LAUNCH = 2002.2  # decimal year of the installation of ACS
CTE = 0.1  # pixels after 12 years and 2048 transfers at magnitude -9 (Section 3)
REACH = 2.0  # pixels: closer neighbours are blended


@dataclass(frozen=True)
class Detector:
    """Errors of the detections of an exposure."""

    centroid: float = 1.0  # factor on the centroid errors; 0 gives exact positions
    false: float = 0.05  # fraction of false detections in a list (cosmic rays, artefacts)
    blended: float = 0.01  # fraction of the stars that are displaced by a close neighbour
    cte: bool = False  # True if charge-transfer inefficiency displaces the positions


def cte_shift(chip: int, y: Float, mag: Float, epoch: float) -> Float:
    """Shift (N,) along y in pixels due to charge-transfer inefficiency (CTE).

    According to ACS ISR 2015-06, Section 3, it is about 0.1 px and increases with time, with the
    number of transfers and towards faint stars.  WFC1 is read out at its upper edge and WFC2 at its
    lower edge; the trails point away from the edge.
    """
    transfers = (2048.5 - y if chip == 1 else y - 0.5) / 2048.0
    size = CTE * max(epoch - LAUNCH, 0.0) / 12.0 * transfers * 10 ** (0.15 * (mag + 9.0))
    return -size if chip == 1 else size


def star_list(
    truth: AcsTruth, exposure: str, detector: Detector, rng: np.random.Generator
) -> tuple[Detections, DetectionTruth]:
    """Simulated detections of an exposure in random order, and their truth."""
    e = truth.frames.names.index(exposure)
    epoch = truth.log[exposure].epoch
    u, v = truth.stars.at(epoch)
    parts = []
    for chip in truth.model.chips:
        x, y = truth.to_pixels(exposure, u, v, chip.number)
        on_chip = np.flatnonzero(_inside(x, y, chip))
        mag = truth.stars.mag[on_chip]
        detected = rng.uniform(size=len(on_chip)) < 1.0 / (1.0 + np.exp((mag - LIMIT) / SOFT))
        stars, mag = on_chip[detected], mag[detected]
        part = _measured(chip, x[stars], y[stars], mag, epoch, detector, rng)
        part["star"] = stars
        parts += [part, _junk(chip, len(stars), detector.false, rng)]
    columns: dict[str, Any] = {
        key: np.concatenate([part[key] for part in parts]) for key in parts[0]
    }
    columns["mag"] += truth.frames.zero_point[e]
    order = rng.permutation(len(columns["x"]))
    columns = {key: values[order] for key, values in columns.items()}
    star, blended = columns.pop("star"), columns.pop("blended")
    return Detections(exposure_names=(exposure,), **columns), DetectionTruth(star, blended)


def _inside(x: Float, y: Float, chip: Chip) -> Bool:
    nx, ny = chip.size
    out: Bool = (x >= BORDER) & (x <= nx + 1 - BORDER) & (y >= BORDER) & (y <= ny + 1 - BORDER)
    return out  # NaN is not inside


def _measured(
    chip: Chip,
    x: Float,
    y: Float,
    mag: Float,
    epoch: float,
    detector: Detector,
    rng: np.random.Generator,
) -> dict[str, NDArray[Any]]:
    """Columns of the measured stars of a chip, from their true pixels and magnitudes."""
    n = len(x)
    error = centroid_error(mag)
    if detector.cte:
        y = y + cte_shift(chip.number, y, mag, epoch)
    moved = detector.centroid * error * rng.standard_normal((2, n))

    # a neighbour shifts the centroid in proportion to its fraction of the flux
    blended = rng.uniform(size=n) < detector.blended
    distance = REACH * np.sqrt(rng.uniform(size=n))
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    ratio = 10 ** rng.uniform(-2.0, -0.3, n)
    pull = np.where(blended, distance * ratio / (1.0 + ratio), 0.0)

    quality = error * np.exp(0.25 * rng.standard_normal(n))
    saturated = mag < SATURATED
    quality = np.where(saturated, 0.3 * np.exp(0.5 * rng.standard_normal(n)), quality)
    quality = np.where(blended, quality + 0.3 * pull, quality)
    measured_mag = mag + np.hypot(0.02, error) * rng.standard_normal(n)
    measured_mag -= np.where(blended, 2.5 * np.log10(1.0 + ratio), 0.0)
    return {
        "x": x + moved[0] + pull * np.cos(angle),
        "y": y + moved[1] + pull * np.sin(angle),
        "chip": np.full(n, chip.number, np.int64),
        "mag": measured_mag,
        "q": quality,
        "blended": blended,
    }


def _junk(
    chip: Chip, stars: int, share: float, rng: np.random.Generator
) -> dict[str, NDArray[Any]]:
    """Columns of false detections, most of them faint and with a poor fit quality."""
    n = int(rng.poisson(stars * share / (1.0 - share)))
    nx, ny = chip.size
    return {
        "x": rng.uniform(BORDER, nx + 1 - BORDER, n),
        "y": rng.uniform(BORDER, ny + 1 - BORDER, n),
        "chip": np.full(n, chip.number, np.int64),
        "mag": FAINT - rng.exponential(1.5, n),
        "q": 0.25 * np.exp(0.8 * rng.standard_normal(n)),
        "blended": np.zeros(n, bool),
        "star": np.full(n, -1, np.int64),
    }
