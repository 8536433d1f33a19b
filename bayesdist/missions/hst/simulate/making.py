"""Simulation of the 47 Tucanae campaign of ACS/WFC from a single seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.sparse import csr_array

from bayesdist.data.detections import Detections
from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.errors import InputError
from bayesdist.missions.hst.simulate.distortion import (
    ACS_FILTERS,
    CHIPS,
    EPOCH0,
    HALF,
    acs_solution,
)
from bayesdist.missions.hst.simulate.truth import (
    FAINT,
    AcsCampaign,
    AcsTruth,
    DetectionTruth,
    centroid_error,
    exposures_of,
    frames_of,
    measured_catalogs,
    true_stars,
)
from bayesdist.model import Chip, PolynomialBasis
from bayesdist.model.grid import mesh
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float

BASE = "F606W"
FEWEST = 100  # minimum number of stars
SCATTER = (
    7e-6  # exposure-to-exposure sd of linear terms: sigma(alpha) of Table 1 is 7e-6 / sqrt(60)
)


def simulate_acs(
    *,
    seed: int = 1,
    n_exposures: int = 110,
    n_stars: int = 53_900,
    filters: Sequence[str] = (BASE,),
    n_other: int = 15,
    fine_scale: bool = True,
    cte: bool = False,
    scatter: float = SCATTER,
    outlying: float = 0.0,
    centroid: float = 1.0,
    false: float = 0.05,
    blended: float = 0.01,
    pa_v3: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> AcsCampaign:
    """Simulate the campaign of ACS ISR 2015-06: star lists of 47 Tuc, and their truth.

    The parts of the simulation have independent random streams, so that an option that changes one
    part does not affect the others.

    Parameters
    ----------
    seed : int, optional
    n_exposures : int, optional
        Number of exposures in F606W.
    n_stars : int, optional
        Number of stars in the catalogue.
    filters : sequence of str, optional
        One or more of F435W, F475W, F606W, F814W.
    n_other : int, optional
        Number of exposures in each filter other than F606W.
    fine_scale : bool, optional
        True to include look-up tables of the detector and of the filters.
    cte : bool, optional
        True to displace the positions by charge-transfer inefficiency.
    scatter : float, optional
        Exposure-to-exposure standard deviation of A_2, B_2 and B_3, mostly common to both chips.
    outlying : float, optional
        Probability that the deviation of an exposure is ten times larger.
    centroid : float, optional
        Factor on the centroid errors; 0 gives exact positions.
    false : float, optional
        Fraction of false detections in each list.
    blended : float, optional
        Fraction of the stars that are displaced by a close neighbour, by up to half a pixel.
    pa_v3 : float, optional
        Common roll angle of all exposures in degrees; by default the roll angles follow the Sun.
    progress : callable, optional
        Function that is called with the number of finished exposures and their total number.

    Returns
    -------
    AcsCampaign

    Raises
    ------
    InputError
        If a filter is unknown or repeated, there are too few exposures or stars, a fraction is
        outside [0, 1), or another parameter is negative.
    """
    settings = {
        "seed": seed,
        "n_exposures": n_exposures,
        "n_stars": n_stars,
        "filters": list(filters),
        "n_other": n_other,
        "fine_scale": fine_scale,
        "cte": cte,
        "scatter": scatter,
        "outlying": outlying,
        "centroid": centroid,
        "false": false,
        "blended": blended,
        "pa_v3": pa_v3,
    }
    _check(filters, settings)
    if n_stars < FEWEST:
        raise InputError(
            f"n_stars is {n_stars}, so that exposures may be empty",
            where="n_stars",
            do=f"give at least {FEWEST}",
        )

    def rng(*key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))

    stars = true_stars(n_stars, rng(0))
    catalog, early, late = measured_catalogs(stars, rng(1))
    code = {name: k for k, name in enumerate(ACS_FILTERS)}
    keys: dict[Exposure, tuple[int, int]] = {}  # keys of the random stream of each exposure
    for name in filters:
        n = n_exposures if name == BASE else n_other
        new = exposures_of(name, n, rng(2, code[name]), pa_v3=pa_v3)
        keys |= {exposure: (code[name], k) for k, exposure in enumerate(new)}
    log = ExposureLog(tuple(sorted(keys, key=lambda exposure: exposure.epoch)), source="simulation")
    tables = detector_tables(rng(3)) if fine_scale else ()
    for name in filters if fine_scale else ():
        tables += filter_tables(name, rng(4, code[name]))
    model, _ = acs_solution()
    truth = AcsTruth(
        model=model,
        theta={name: acs_solution(name)[1] for name in filters},
        tables=tables,
        stars=stars,
        log=log,
        frames=frames_of(
            log, [rng(5, *keys[exposure]) for exposure in log], scatter=scatter, outlying=outlying
        ),
        detections=(),
        settings=settings,
    )
    detector = DetectionErrors(centroid, false, blended, cte)
    measured = []
    for k, exposure in enumerate(log):
        measured.append(star_list(truth, exposure.name, detector, rng(6, *keys[exposure])))
        if progress is not None:
            progress(k + 1, len(log))
    lists, detections = zip(*measured, strict=True)
    truth = replace(truth, detections=detections)
    return AcsCampaign(catalog, early, late, log, lists, truth)


# settings: lowest allowed value, exclusive upper bound, and description
_RANGES: dict[tuple[str, ...], tuple[float, float, str]] = {
    ("n_exposures", "n_other"): (1, np.inf, "1 or more"),
    ("outlying", "false", "blended"): (0.0, 1.0, "a fraction in [0, 1)"),
    ("scatter", "centroid", "seed"): (0.0, np.inf, "0 or more"),
}


def _check(filters: Sequence[str], settings: Mapping[str, Any]) -> None:
    for name in filters:
        acs_solution(name)
    if not filters or len(set(filters)) < len(filters):
        raise InputError(
            f"filters are {', '.join(filters) or 'none'}", where="filters", do="list each one once"
        )
    for names, (low, high, words) in _RANGES.items():
        for name in names:
            if not low <= settings[name] < high:
                raise InputError(f"{name} is {settings[name]:g}", where=name, do=f"give {words}")


# -- detections -----------------------------------------------------------------------------------


BORDER = 5.0  # pixels: stars closer to an edge are not measured
LIMIT, SOFT = -7.5, 0.3  # magnitude of 50 % completeness, and width of its decline
SATURATED = -14.0  # magnitude of saturation (Figure 5)
LAUNCH = 2002.2  # decimal year of the installation of ACS
CTE = 0.1  # pixels after 12 years and 2048 transfers at magnitude -9 (Section 3)
REACH = 2.0  # pixels: closer neighbours are blended


@dataclass(frozen=True)
class DetectionErrors:
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
    truth: AcsTruth, exposure: str, detector: DetectionErrors, rng: np.random.Generator
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
    detector: DetectionErrors,
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


# -- look-up tables -------------------------------------------------------------------------------


STEP = 64.0
SHAPE = (32, 64)  # nodes along y and x
ORDER = 5  # the tables are orthogonal to polynomials of this order
FINE = 16.0  # pixels between the points for integrals over the chip
DETECTOR_LONGEST = {1: 0.17, 2: 0.085}  # longest vector by chip, pixels
DETECTOR_LENGTH = 200.0  # correlation length, pixels
COLUMNS = 4096 / 60  # "every 68th column": 60 equal strips of the mask
COLUMN_AMPLITUDE = 0.1  # relative to the longest vector
# longest vector in pixels, from Figures 12, 13 and 11; for F814W, which is not shown, it is the
# largest value for filters in the text
FILTER_LONGEST = {"F435W": 0.062, "F475W": 0.08, "F606W": 0.032, "F814W": 0.05}
FILTER_LENGTH = 150.0  # "spatially coherent over ~150 pixels", Section 4.3.2


def _nodes() -> tuple[Float, Float]:
    """Pixels x and y (ny nx,) of all nodes."""
    x = (STEP + 1) / 2 + STEP * np.arange(SHAPE[1], dtype=float)
    y = (STEP + 1) / 2 + STEP * np.arange(SHAPE[0], dtype=float)
    return mesh(x, y)


@lru_cache(maxsize=2)
def _factor(length: float) -> Float:
    """Cholesky factor of the Matern 3/2 correlation between nodes."""
    x, y = _nodes()
    d = np.sqrt(3.0) * np.hypot(x[:, None] - x, y[:, None] - y) / length
    return np.asarray(cholesky((1.0 + d) * np.exp(-d), lower=True, check_finite=False))


@lru_cache(maxsize=2)
def _followed(chip: int) -> Float:
    """Orthonormal basis (2 nodes, 84) of the parts of a table that polynomials can absorb.

    It spans the values of polynomials at the nodes, for shifts along x and y, and the weights of
    the nodes in the integrals over the chip of polynomials times the displacement of u and of v.
    A fit of polynomials without tables would absorb these parts.
    """
    model, theta = acs_solution()
    basis = PolynomialBasis(ORDER, CHIPS[0].size, HALF)
    at_nodes = basis.evaluate(*_nodes())
    n, K = at_nodes.shape
    x, y = mesh(*(np.arange(0.5 + FINE / 2, size, FINE) for size in CHIPS[0].size))
    by_pixel = [
        model.predict(theta, x + dx, y + dy, epoch=EPOCH0[0], chip=chip)
        - model.predict(theta, x - dx, y - dy, epoch=EPOCH0[0], chip=chip)
        for dx, dy in ((0.5, 0.0), (0.0, 0.5))
    ]
    index, weight = LookupTable(chip, np.zeros((2, *SHAPE))).weights(x, y)
    rows = np.repeat(np.arange(len(x)), 4)
    node_weights = csr_array((weight.ravel(), (index.ravel(), rows)), shape=(n, len(x)))
    values = basis.evaluate(x, y) * (FINE / STEP) ** 2
    out = np.zeros((4, K, 2, n))
    for along in (0, 1):
        out[along, :, along] = at_nodes.T
        for axis in (0, 1):
            out[2 + axis, :, along] = (node_weights @ (values * by_pixel[along][:, [axis]])).T
    q, _ = np.linalg.qr(out.reshape(4 * K, 2 * n).T)
    return q


def _without_polynomial(values: Float, chip: int) -> Float:
    """Values (2, nodes) without the parts that polynomials can absorb, so that they are unique."""
    q, flat = _followed(chip), values.ravel()
    for _ in range(2):  # the second pass removes rounding errors
        flat = flat - q @ (q.T @ flat)
    return flat.reshape(values.shape)


def _table(values: Float, longest: float, chip: int, filter: str = "") -> LookupTable:
    values = _without_polynomial(values, chip)
    values = values * (longest / np.hypot(*values).max())
    return LookupTable(chip, values.reshape(2, *SHAPE), filter)


def detector_tables(rng: np.random.Generator) -> tuple[LookupTable, ...]:
    """Detector tables (irregularities of the pixel grid), one per chip.

    Each is the sum of a smooth random field and, along x, a saw-tooth due to a mask that was
    stepped over the columns.  The nodes are 64 pixels apart and sample the saw-tooth of 68 pixels
    as a slow beat.  The tables are orthogonal to polynomials up to order 5: the sum over the nodes
    of value times polynomial is 0, and so is a polynomial fitted to uniformly distributed stars.
    """
    x, _ = _nodes()
    out = []
    for chip in CHIPS:
        values = (_factor(DETECTOR_LENGTH) @ rng.standard_normal((x.size, 2))).T
        saw = 2.0 * ((x / COLUMNS + rng.uniform()) % 1.0) - 1.0
        values[0] += COLUMN_AMPLITUDE * np.hypot(*values).max() * saw
        out.append(_table(values, DETECTOR_LONGEST[chip.number], chip.number))
    return tuple(out)


def filter_tables(filter: str, rng: np.random.Generator) -> tuple[LookupTable, ...]:
    """Filter tables, one per chip: smooth random fields that are orthogonal to polynomials."""
    n = SHAPE[0] * SHAPE[1]
    fields = [(_factor(FILTER_LENGTH) @ rng.standard_normal((n, 2))).T for _ in CHIPS]
    longest = [
        np.hypot(*_without_polynomial(field, chip.number)).max()
        for chip, field in zip(CHIPS, fields, strict=True)
    ]
    return tuple(
        _table(field, FILTER_LONGEST[filter] * length / max(longest), chip.number, filter)
        for chip, field, length in zip(CHIPS, fields, longest, strict=True)
    )
