"""Coverage of total errors where the errors of stars are correlated between u and v.

`python -m tests.coverage.tilted RESULTS.jsonl --truths 200` makes the table of docs/validation.md.

Three kinds of stars, of which the map is a polynomial of the fitted order:

- ellipses: errors of the matches have a correlation of 0.9, as those of elongated images;
- motions: a catalogue like Gaia's, with covariances (5, 5) of position, parallax and motion that
  are alike over the field (as by a scanning law), ten years before the exposure;
- unmeasured: the same, but a third of the stars has no motion and no parallax.

Each truth is processed with its covariances, and again without the correlations.  Errors of
positions over the detector are compared with the stated ones along u and v, and along and across
the mean direction of the stars' errors.
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import bayesdist as bd
from bayesdist.data.sky import parallax_factors
from bayesdist.data.tangent import mean_direction, sky_of_plane
from bayesdist.model.grid import grid_pixels, mesh
from tests.adversarial.fields import MIDDLE, SIDE, distortion
from tests.coverage.places import LIMITS

ORDER, STARS = 3, 300
GRID, DRAWS = (9, 9), 1000  # of the assessment
RHO = 0.9
SIGMA = (0.02, 0.014)  # px, along u and v
PIXEL = 0.04  # arcsec
POINT = (150.0, 2.0)  # degrees, of the tangent plane
REFERENCE_EPOCH, EPOCH = 2016.0, 2026.0
CENTROID = 0.01  # px
PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")  # names of the Gaia archive
DIRECTIONS = ("u", "v", "along", "across")


@dataclass(frozen=True, eq=False)
class Truth:
    """Stars of one truth."""

    table: Mapping[str, Any]  # columns of the table of matches
    options: Mapping[str, Any]  # how it is read
    correlations: tuple[str, ...]  # columns with correlations
    true_map: Callable[[np.ndarray, np.ndarray], np.ndarray]  # pixels (N,) to u and v (N, 2)
    direction: np.ndarray  # (2,) unit vector along the mean long axis of the stars' errors
    catalogue: bd.Catalogue

    def matches(self, *, correlated: bool) -> bd.Matches:
        """The stars as read from their table, with or without the correlations of errors."""
        table = dict(self.table)
        if not correlated:
            table = {name: v for name, v in table.items() if name not in self.correlations}
        return bd.Matches.from_table(table, **self.options)


def ellipses(seed: int) -> Truth:
    """Errors with a correlation of 0.9."""
    rng = np.random.default_rng([46, 1, seed])
    bent = distortion(rng, ORDER)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, STARS))

    def true_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([x - MIDDLE, y - MIDDLE], axis=-1) + bent(x, y)

    size = rng.uniform(0.5, 2.0, STARS)[:, None, None]
    uv = np.multiply(*SIGMA) * RHO
    cov = size**2 * np.array([[SIGMA[0] ** 2, uv], [uv, SIGMA[1] ** 2]])
    u, v = (true_map(x, y) + normal(rng, cov)).T
    sigma_u, sigma_v = np.sqrt(np.einsum("nii->in", cov))
    table = {"x": x, "y": y, "u": u, "v": v, "sigma_u": sigma_u, "sigma_v": sigma_v}
    table["rho_uv"] = np.full(STARS, RHO)
    exact = bd.Catalogue("simulated", sigma=0.0, unit="pix", source="exact in the simulation")
    return Truth(table, {"unit": "pix"}, ("rho_uv",), true_map, long_axis(cov), exact)


def motions(seed: int) -> Truth:
    """A catalogue with correlated positions, parallaxes and motions, ten years old."""
    rng = np.random.default_rng([46, 2, seed])
    bent = distortion(rng, ORDER)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, STARS))

    def true_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return PIXEL * (np.stack([x - MIDDLE, y - MIDDLE], axis=-1) + bent(x, y))

    uv = true_map(x, y)
    ra, dec = sky_of_plane(*uv.T, POINT)
    C = _catalogue_covariances(rng)
    parallax = rng.exponential(0.5, STARS)  # mas
    motion = rng.normal(0.0, 8.0, (STARS, 2))  # mas/yr
    true = np.column_stack([np.zeros((STARS, 2)), parallax, motion])
    # parameters at the reference epoch, with positions relative to those of the exposure
    factors = parallax_factors([EPOCH], *mean_direction(ra, dec))[0]
    years = EPOCH - REFERENCE_EPOCH
    carry = np.column_stack([np.eye(2), factors, years * np.eye(2)])  # to the epoch
    true[:, :2] = -true @ carry.T
    measured = true + normal(rng, C)
    table: dict[str, Any] = {"x": x + normal(rng, np.full((STARS, 1, 1), CENTROID**2))[:, 0]}
    table["y"] = y + normal(rng, np.full((STARS, 1, 1), CENTROID**2))[:, 0]
    table["ra"] = ra + measured[:, 0] / 3.6e6 / np.cos(np.radians(dec))
    table["dec"] = dec + measured[:, 1] / 3.6e6
    table |= dict(zip(PARAMETERS[2:], measured[:, 2:].T, strict=True))
    sigma = np.sqrt(np.einsum("nii->ni", C))
    names = []
    for i, first in enumerate(PARAMETERS):
        table[f"{first}_error"] = sigma[:, i]
        for j, second in enumerate(PARAMETERS[:i]):
            names.append(f"{second}_{first}_corr")
            table[names[-1]] = C[:, i, j] / (sigma[:, i] * sigma[:, j])
    table["ref_epoch"] = np.full(STARS, REFERENCE_EPOCH)
    table["x_err"] = table["y_err"] = np.full(STARS, CENTROID)
    at_epoch = carry @ C @ carry.T
    exact = bd.Catalogue("simulated", sigma=0.0, unit="mas", source="exact in the simulation")
    options = {"epoch": EPOCH, "tangent_point": POINT}
    return Truth(table, options, tuple(names), true_map, long_axis(at_epoch), exact)


def unmeasured(seed: int) -> Truth:
    """As `motions`, but a third of the stars has no motion and no parallax."""
    truth = motions(seed)
    table, gone = dict(truth.table), np.arange(STARS) % 3 == 0
    for name in PARAMETERS[2:]:
        for column in (name, f"{name}_error"):
            table[column] = np.where(gone, np.nan, table[column])
    return replace(truth, table=table)


KINDS = {"ellipses": ellipses, "motions": motions, "unmeasured": unmeasured}


def _catalogue_covariances(rng: np.random.Generator) -> np.ndarray:
    """Covariances (N, 5, 5) in mas and mas/yr, with correlations that are alike for all stars."""
    root = np.eye(5) + 0.15 * rng.standard_normal((STARS, 5, 5))
    root[:, 1, 0] += 0.6
    root[:, 4, 3] += 1.4  # motions to the east and north: 0.8
    root[:, 3, 0] += 0.4
    root[:, 4, 1] += 0.4
    R = root @ np.swapaxes(root, 1, 2)
    d = 1 / np.sqrt(np.einsum("nii->ni", R))
    sigma = rng.uniform(0.1, 0.4, STARS)[:, None] * np.array([0.8, 0.7, 1.0, 1.0, 0.9])
    return R * (d * sigma)[:, :, None] * (d * sigma)[:, None]


def normal(rng: np.random.Generator, covariance: np.ndarray) -> np.ndarray:
    """Normal deviates (N, n) with covariances (N, n, n)."""
    z = rng.standard_normal(covariance.shape[:2])
    return np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), z)


def long_axis(covariance: np.ndarray) -> np.ndarray:
    """Unit vector along the long axis of the mean of covariances (N, 2, 2)."""
    return np.linalg.eigh(covariance.mean(axis=0))[1][:, 1]


@dataclass(frozen=True)
class Covered:
    """Fractions of positions within one and two stated sigmas, by direction."""

    kind: str
    seed: int
    correlated: bool  # whether the correlations were given
    within: Mapping[str, tuple[float, float]]
    squares: Mapping[str, float]  # mean squared error in units of the stated one
    verdict: str  # on a limit of 0.9 times the actual p95, which is not met


def covered(kind: str, seed: int, *, correlated: bool) -> Covered:
    """A truth carried through a run in memory."""
    truth = KINDS[kind](seed)
    run = bd.calibrate(
        truth.matches(correlated=correlated),
        order=ORDER,
        size=(SIDE, SIDE),
        catalogue=truth.catalogue,
        seed=seed + 1,
        settings={"sampler": {"target_ess": 400}, "assess": {"grid": GRID, "draws": DRAWS}},
    )
    x, y = mesh(*grid_pixels((float(SIDE), float(SIDE)), GRID))
    posterior = run.posterior
    error = posterior.model.predict(np.asarray(posterior.mean), x, y) - truth.true_map(x, y)
    drawn = run.drawn_errors
    domain = run.evaluation_settings.domain(run.error_model)
    normals = np.random.default_rng(seed).standard_normal((DRAWS, domain.size, 2))
    draws = drawn.errors(domain)(slice(0, DRAWS), normals)
    stated = np.einsum("dna,dnb->nab", draws, draws) / DRAWS
    along = truth.direction
    axes = dict(zip(DIRECTIONS, [*np.eye(2), along, np.array([-along[1], along[0]])], strict=True))
    within, squares = {}, {}
    for name, axis in axes.items():
        pull = error @ axis / np.sqrt(np.einsum("nab,a,b->n", stated, axis, axis))
        within[name] = tuple(float(np.mean(np.abs(pull) < z)) for z in LIMITS)
        squares[name] = float(np.mean(pull**2))
    limit = 0.9 * float(np.percentile(np.hypot(*error.T), 95))
    (margin,) = run.check(bd.Requirement("above", "p95", limit, unit=posterior.model.unit))
    return Covered(kind, seed, correlated, within, squares, margin.verdict)


HEAD = (
    "| stars | errors | truths | direction | within 68.3 % | 95.4 % | rms pull | false met |\n"
    "|---|---|---|---|---|---|---|---|"
)


def fractions(runs: Iterable[Covered], direction: str) -> np.ndarray:
    """Mean fractions (2,) of positions within the stated errors of both levels."""
    return np.mean([run.within[direction] for run in runs], axis=0)


def table_of(runs: Iterable[Covered]) -> str:
    """A Markdown table with a row for each kind, treatment and direction."""
    every, lines = list(runs), [HEAD]
    for kind in KINDS:
        for correlated in (True, False):
            some = [run for run in every if run.kind == kind and run.correlated == correlated]
            for direction in DIRECTIONS if some else ():
                one, two = fractions(some, direction)
                pull = np.sqrt(np.mean([run.squares[direction] for run in some]))
                met = np.mean([run.verdict == "met" for run in some])
                lines.append(
                    f"| {kind} | {'covariances' if correlated else 'diagonal'} | {len(some)} | "
                    f"{direction} | {one:.3f} | {two:.3f} | {pull:.2f} | {met:.2f} |"
                )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.coverage.tilted", description=__doc__)
    parser.add_argument("results", type=Path, help="file of JSON lines; what it holds is kept")
    parser.add_argument("--truths", type=int, default=200, help="of each kind (default 200)")
    a = parser.parse_args()
    logging.getLogger("bayesdist").setLevel(logging.ERROR)
    runs = dict[tuple[str, int, bool], Covered]()
    if a.results.exists():
        for line in a.results.read_text().splitlines():
            run = Covered(**json.loads(line))
            runs[run.kind, run.seed, run.correlated] = run
    with a.results.open("a") as file:
        for seed in range(a.truths):
            for kind in KINDS:
                for correlated in (True, False):
                    if (kind, seed, correlated) not in runs:
                        run = runs[kind, seed, correlated] = covered(
                            kind, seed, correlated=correlated
                        )
                        file.write(json.dumps(asdict(run)) + "\n")
                        file.flush()
    print(table_of(runs.values()))


if __name__ == "__main__":
    main()
