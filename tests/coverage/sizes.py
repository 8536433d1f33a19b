"""Runs of many sizes whose truth is in the fitted family, against the exact posterior.

`python -m tests.coverage.sizes RESULTS.jsonl --seeds 10` makes the table of docs/validation.md.

The errors of the stars are normal, independent and as quoted, the map is a polynomial of the fitted
order, and exposures differ by the shift and rotation that are fitted to them.  The exact posterior
is then that of least squares: its covariance is computed here with numpy alone.
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander2d

import bayesdist as bd
from bayesdist.assess.domain import field_statistic
from bayesdist.model.grid import grid_pixels, mesh
from tests.adversarial.fields import MIDDLE, SIDE, distortion, scaled

SIGMA = 0.02  # px: error of a star on each axis
GRID, DRAWS = (17, 17), 2000  # of the assessment
FACTOR = 1.6  # of the limit, relative to the actual p95
EXACT = bd.Catalogue("simulated", sigma=0.0, unit="pix", source="exact in the simulation")


@dataclass(frozen=True)
class Size:
    """Size of a calibration; exposures have frames of shift and rotation, or none."""

    order: int
    stars: int
    chips: int = 1
    exposures: int = 1
    frames: bool = False

    def __str__(self) -> str:
        frames = ", with frames" if self.frames else ""
        return (
            f"order {self.order}, {self.stars} stars, chips {self.chips}, "
            f"exposures {self.exposures}{frames}"
        )

    @property
    def n_params(self) -> int:
        """Number of parameters."""
        polynomials = self.chips * (self.order + 1) * (self.order + 2)
        return polynomials + (3 * (self.exposures - 1) if self.frames else 0)

    @property
    def most(self) -> float:
        """Largest ratio of the stated error to the exact one that is aimed at."""
        return 1.25 if self.stars < max(100, 5 * self.n_params) else 1.15


SIZES = (
    Size(2, 40),
    Size(3, 100),
    Size(3, 300),
    Size(7, 400),
    Size(4, 1500),
    Size(3, 3000),
    Size(5, 10_000),
    Size(3, 100_000),
    Size(3, 4000, chips=4),
    Size(2, 600, exposures=2),
    Size(4, 6000, chips=2, exposures=4, frames=True),
    Size(6, 20_000, exposures=12, frames=True),
)


@dataclass(frozen=True, eq=False)
class Inside:
    """Stars of one truth, and the exact posterior of positions."""

    size: Size
    seed: int
    maps: tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], ...]  # of each chip
    rotation: np.ndarray  # (exposures,) radians
    shift: np.ndarray  # (exposures, 2) px
    x: np.ndarray  # (N,)
    y: np.ndarray
    chip: np.ndarray  # (N,) from 0
    exposure: np.ndarray  # (N,) from 0
    uv: np.ndarray = field(repr=False)  # (N, 2) measured

    @classmethod
    def drawn(cls, size: Size, seed: int) -> Inside:
        """A random truth."""
        rng = np.random.default_rng([17, size.order, size.stars, size.chips, size.exposures, seed])
        maps = tuple(_map_of(rng, size.order, chip) for chip in range(size.chips))
        moved = np.arange(size.exposures) > 0 if size.frames else np.zeros(size.exposures, bool)
        rotation = moved * 1e-3 * rng.standard_normal(size.exposures)
        shift = moved[:, None] * 5.0 * rng.standard_normal((size.exposures, 2))
        x, y = rng.uniform(0.5, SIDE + 0.5, (2, size.stars))
        exposure, chip = np.divmod(
            np.arange(size.stars) % (size.chips * size.exposures), size.chips
        )
        uv = np.empty((size.stars, 2))
        for k, true_map in enumerate(maps):
            uv[chip == k] = true_map(x[chip == k], y[chip == k])
        c, s = np.cos(rotation)[exposure], np.sin(rotation)[exposure]
        u, v = uv.T
        uv = np.stack([c * u - s * v, s * u + c * v], axis=1) + shift[exposure]
        uv += SIGMA * rng.standard_normal(uv.shape)
        return cls(size, seed, maps, rotation, shift, x, y, chip, exposure, uv)

    @property
    def matches(self) -> bd.Matches:
        """The stars as matches with errors."""
        quoted, size = np.full(self.size.stars, SIGMA), self.size
        columns: dict[str, Any] = {}
        if size.chips > 1:
            columns["chip"] = self.chip
            columns["chip_numbers"] = tuple(range(1, size.chips + 1))
        if size.exposures > 1:
            columns["exposure"] = self.exposure
            columns["exposure_names"] = tuple(f"e{k:02d}" for k in range(size.exposures))
        u, v = self.uv.T
        return bd.Matches(x=self.x, y=self.y, u=u, v=v, sigma_u=quoted, sigma_v=quoted, **columns)

    @cached_property
    def grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels x and y of the assessment's grid on all chips, and the chip (from 0) of each."""
        x, y = mesh(*grid_pixels((float(SIDE), float(SIDE)), GRID))
        n = self.size.chips
        return np.tile(x, n), np.tile(y, n), np.repeat(np.arange(n), len(x))

    @property
    def of_exposure(self) -> int:
        """Exposure in which positions are compared, one whose frame was fitted if there are any."""
        return 1 + self.seed % (self.size.exposures - 1) if self.size.frames else 0

    def _design(
        self, x: np.ndarray, y: np.ndarray, chip: np.ndarray, exposure: np.ndarray
    ) -> np.ndarray:
        """Derivatives (N, 2, D) of u and v along the axes of the polynomials."""
        order, size = self.size.order, self.size
        degrees = np.add.outer(np.arange(order + 1), np.arange(order + 1)).ravel()
        phi = legvander2d(scaled(x), scaled(y), [order, order])[:, degrees <= order]
        K = phi.shape[1]
        out = np.zeros((len(x), 2, 2 * K * size.chips + 3 * (size.exposures - 1) * size.frames))
        for k in range(size.chips):
            rows = np.flatnonzero(chip == k)
            for a in (0, 1):
                first = (2 * k + a) * K
                out[rows, a, first : first + K] = phi[rows]
        for e in range(1, size.exposures if size.frames else 1):
            rows = np.flatnonzero(exposure == e)
            first = 2 * K * size.chips + 3 * (e - 1)
            out[rows, 0, first] = out[rows, 1, first + 1] = 1.0
            for k, true_map in enumerate(self.maps):
                here = rows[chip[rows] == k]
                u, v = true_map(x[here], y[here]).T / SIDE
                out[here, 0, first + 2], out[here, 1, first + 2] = -v, u
        return out

    @cached_property
    def _exact(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (P, 2, D) at the grid, and a root (D, D) of the covariance of parameters."""
        design = self._design(self.x, self.y, self.chip, self.exposure)
        information = np.einsum("nad,nae->de", design, design, optimize=True) / SIGMA**2
        root = np.linalg.inv(np.linalg.cholesky(information)).T
        x, y, chip = self.grid
        return self._design(x, y, chip, np.full(len(x), self.of_exposure)), root

    @cached_property
    def exact_sigma(self) -> np.ndarray:
        """Exact posterior standard deviation (P, 2) of positions, by least squares."""
        at, root = self._exact
        return np.asarray(np.sqrt(np.sum((at @ root) ** 2, axis=2)))

    def exact_p95(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws (n,) of the p95 of position errors from the exact posterior."""
        at, root = self._exact
        drawn = rng.standard_normal((n, root.shape[1])) @ (at @ root).reshape(-1, len(root)).T
        return np.array([field_statistic("p95", d.reshape(-1, 2)) for d in drawn])

    def actual_error(self, model: bd.DistortionModel, mean: np.ndarray) -> np.ndarray:
        """Predicted less true positions (P, 2) on the grid, along the axes of the exposure."""
        x, y, chip = self.grid
        out = []
        for k, true_map in enumerate(self.maps):
            rows = chip == k
            which: dict[str, Any] = {"chip": k + 1}
            if self.size.frames:
                which["exposure"] = np.full(rows.sum(), self.of_exposure)
            predicted = model.predict(mean, x[rows], y[rows], **which)
            u, v = true_map(x[rows], y[rows]).T
            angle = self.rotation[self.of_exposure]
            c, s = np.cos(angle), np.sin(angle)
            true = np.stack([c * u - s * v, s * u + c * v], axis=1) + self.shift[self.of_exposure]
            out.append(np.asarray(predicted) - true)
        return np.concatenate(out)


def _map_of(
    rng: np.random.Generator, order: int, chip: int
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Map of a chip: chips lie side by side along u."""
    distorted = distortion(rng, order)

    def true_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = np.stack([x - MIDDLE + chip * (SIDE + 50.0), y - MIDDLE], axis=-1)
        return np.asarray(at + distorted(x, y))

    return true_map


@dataclass(frozen=True)
class Compared:
    """What a run states of one truth, and what is so."""

    size: Size
    stated: float  # rms over the grid and both axes, px
    exact: float
    within: tuple[float, float]  # fractions of positions within 1 and 1.96 stated sigmas
    verdict: str  # on a limit that the truth meets
    exactly_met: bool  # whether the exact posterior meets it with the probability that is asked


def compared(size: Size, seed: int) -> Compared:
    """A truth carried through a run in memory."""
    truth = Inside.drawn(size, seed)
    middle = (SIDE + 1) / 2
    chips = [bd.Chip(k + 1, f"c{k}", (SIDE, SIDE), (middle, middle)) for k in range(size.chips)]
    run = bd.calibrate(
        truth.matches,
        order=size.order,
        chips=chips,
        frames="shift_rotation" if size.frames else "none",
        catalogue=EXACT,
        seed=seed + 1,
        settings={"sampler": {"target_ess": 400}, "assess": {"grid": GRID, "draws": DRAWS}},
    )
    total = run.budget().total
    stated = np.column_stack([total.u, total.v])
    error = truth.actual_error(run.posterior.model, np.asarray(run.posterior.mean))
    pull = np.abs(error) / stated
    limit = FACTOR * float(field_statistic("p95", error))
    requirement = bd.Requirement("above", "p95", limit)
    (margin,) = run.check(requirement)
    drawn = truth.exact_p95(500, np.random.default_rng(seed))
    return Compared(
        size,
        float(np.sqrt(np.mean(stated**2))),
        float(np.sqrt(np.mean(truth.exact_sigma**2))),
        (float(np.mean(pull < 1)), float(np.mean(pull < 1.96))),
        margin.verdict,
        bool(np.mean(drawn <= limit) >= requirement.probability),
    )


HEAD = (
    "| size | runs | stated / exact | at most | cover 68/95 % | met, of exactly met | missed |\n"
    "|---|---|---|---|---|---|---|"
)


def ratio(runs: Iterable[Compared]) -> float:
    """Root mean square of stated over exact errors."""
    some = list(runs)
    return float(
        np.sqrt(np.mean([one.stated**2 for one in some]) / np.mean([one.exact**2 for one in some]))
    )


def table_of(runs: Iterable[Compared]) -> str:
    """A Markdown table with a row for each size."""
    every, lines = list(runs), [HEAD]
    for size in dict.fromkeys(run.size for run in every):
        some = [run for run in every if run.size == size]
        lines.append(f"| {size} | " + " | ".join([str(len(some)), *_cells(some, size.most)]) + " |")
    return "\n".join([*lines, f"| all | {len(every)} | " + " | ".join(_cells(every, None)) + " |"])


def _cells(runs: list[Compared], most: float | None) -> list[str]:
    inside = np.mean([run.within for run in runs], axis=0)
    met = sum(run.verdict == "met" for run in runs)
    return [
        "" if most is None else f"{ratio(runs):.2f}",
        "" if most is None else str(most),
        f"{inside[0]:.2f} / {inside[1]:.2f}",
        f"{met} of {sum(run.exactly_met for run in runs)}",
        str(sum(run.verdict == "missed" for run in runs)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.coverage.sizes", description=__doc__)
    parser.add_argument("results", type=Path, help="file of JSON lines; what it holds is kept")
    parser.add_argument("--seeds", type=int, default=10, help="truths of each size (default 10)")
    parser.add_argument("--most", type=int, default=10**9, help="largest number of stars")
    a = parser.parse_args()
    logging.getLogger("bayesdist").setLevel(logging.ERROR)
    runs = dict[tuple[Size, int], Compared]()
    if a.results.exists():
        for line in a.results.read_text().splitlines():
            row = json.loads(line)
            seed, size = row.pop("seed"), Size(**row.pop("size"))
            runs[size, seed] = Compared(size, **row | {"within": tuple(row["within"])})
    with a.results.open("a") as file:
        for seed in range(a.seeds):
            for size in SIZES:
                if (size, seed) not in runs and size.stars <= a.most:
                    runs[size, seed] = compared(size, seed)
                    row = asdict(runs[size, seed]) | {"seed": seed}
                    file.write(json.dumps(row) + "\n")
                    file.flush()
    print(table_of(run for size in SIZES for run in runs.values() if run.size == size))


if __name__ == "__main__":
    main()
