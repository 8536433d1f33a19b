"""MegaCam detections and all Gaia DR1 stars within 8 arcsec of them: one fit for each CCD.

The file has tangent-plane positions by the header's WCS and no CCD.  Four rows of nine CCDs are 394
arcsec wide with their gap; the wide gaps between the rows, and columns where the residuals of a
piecewise fit are least, tell where they begin.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

import bayesdist as bd

Float = NDArray[np.float64]

RADIUS = 8.0  # arcsec: the match circle about the header's position
SIGMA = 0.03  # arcsec: of a good centroid; the file has none
ORDER = 2
SIZE = (410, 940)  # "pixels" of one arcsec
GRID = [g.ravel() for g in np.meshgrid(np.linspace(15, 395, 9), np.linspace(15, 900, 9))]
MIXTURE = bd.OutlierMixture("uniform", match_radius=RADIUS, fraction_prior=(1.0, 1.0))
LIMITS = (3.0, 2.0, 1.5, 1.0, 0.7, 0.5, 0.5, 0.5)  # arcsec, of repeated clipping
LEFT, PITCH, BOTTOMS = -1823.0, 394.2, (-1850.0, -950.0, -40.0, 862.0)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Candidate pairs, arcsec: header position (x, y), Gaia position (u, v), magnitude, CCD."""

    x: Float
    y: Float
    u: Float
    v: Float
    mag: Float
    detection: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.x)

    @property
    def ccd(self) -> NDArray[np.int64]:
        column = np.clip(np.floor((self.x - LEFT) / PITCH), 0, 8).astype(int)
        return column + 9 * np.digitize(self.y, BOTTOMS[1:])

    @property
    def offset(self) -> Float:
        """Gaia minus header position (N, 2): the centre of the match circle is (0, 0)."""
        return np.stack([self.u - self.x, self.v - self.y], axis=1)

    def select(self, which) -> Pairs:
        return replace(self, **{k: v[which] for k, v in vars(self).items()})

    def of_ccds(self, numbers: Iterable[int]) -> Pairs:
        return self.select(np.isin(self.ccd, list(numbers)))

    def table(self) -> Table:
        """Of one CCD, as a file would hold it: CCD coordinates from (1, 1)."""
        row, column = divmod(int(self.ccd[0]), 9)
        x = self.x - (LEFT + PITCH * column) + 5
        y = self.y - BOTTOMS[row] + 1
        return Table({"x": x, "y": y, "u": x + self.offset[:, 0], "v": y + self.offset[:, 1]})

    def matches(self) -> bd.Matches:
        one, n = self.table(), len(self)
        columns = {name: np.array(one[name]) for name in one.colnames}
        sigma = np.full(n, SIGMA)
        return bd.Matches(**columns, sigma_u=sigma, sigma_v=sigma, unit="arcsec")


def of_file(path: Path) -> Pairs:
    """All pairs; bright stars that the catalogue holds three times are taken once."""
    table = Table.read(path)
    names = ("x_hdrwcs_arcsec", "y_hdrwcs_arcsec", "x_gaia_arcsec", "y_gaia_arcsec")
    values = np.array([table[name] for name in names], float)
    first = np.sort(np.unique(values, axis=1, return_index=True)[1])
    return Pairs(
        *values[:, first],
        np.array(table["G"], float)[first],
        np.array(table["det_id"], int)[first],
    )


@dataclass(frozen=True, eq=False)
class Fitted:
    """What the mixture and the clipped fit say of all pairs, CCD by CCD.

    Residuals (N, 2) are about the posterior mean, the first and the second pass of the clipped fit,
    and a clipped fit that is repeated.  Maps are (n, 2) on a grid over each CCD, the posterior's
    standard deviation among them.
    """

    outlier: Float
    residuals: dict[str, Float]
    used: NDArray[np.bool_]
    n_false: float
    false_sd: float
    converged: int
    maps: dict[str, Float]

    def radius(self, name: str) -> Float:
        """Distance (N,) of each pair from what a solution expects."""
        return np.hypot(*self.residuals[name].T)


def fitted(pairs: Pairs, true: NDArray[np.bool_] | None = None) -> Fitted:
    """A mixture and clipped fits for each CCD, and least squares of the true pairs where known."""
    n = len(pairs)
    outlier, used = np.zeros(n), np.zeros(n, bool)
    residuals = {k: np.zeros((n, 2)) for k in ("mixture", "first pass", "clipped", "repeated")}
    maps: dict[str, list[Float]] = {}
    n_false, variance, converged = 0.0, 0.0, 0
    for number in np.unique(pairs.ccd):
        rows = np.flatnonzero(pairs.ccd == number)
        matches = pairs.select(rows).matches()
        model = bd.build_model(matches, order=ORDER, size=SIZE)
        fit = bd.fit_linear(matches, model)
        posterior = bd.sample(fit, matches, outliers=MIXTURE, target_ess=100, max_steps=1000)
        solutions = {
            "mixture": posterior,
            "first pass": replace(fit, mean=fit.clip.theta),
            "clipped": fit,
            "repeated": repeated(matches, model),
        }
        for name, one in solutions.items():
            residuals[name][rows] = bd.residuals(one, matches)
        outlier[rows] = bd.memberships(posterior, matches).outlier_probability
        used[rows] = fit.uses(matches)
        n_false += posterior.n_false
        variance += (posterior.hyper["f"].std() * len(rows)) ** 2
        converged += posterior.convergence.converged
        if true is not None:
            solutions["truth"] = plain(matches.select(true[rows]), model)
        for name, one in solutions.items():
            maps.setdefault(name, []).append(model.predict(one.mean, *GRID))
        drawn = model.predict(posterior.draws(300, np.random.default_rng(number)), *GRID)
        maps.setdefault("sd", []).append(drawn.std(axis=0))
    return Fitted(
        outlier,
        residuals,
        used,
        n_false,
        float(np.sqrt(variance)),
        converged,
        {name: np.concatenate(several) for name, several in maps.items()},
    )


def plain(matches: bd.Matches, model: bd.DistortionModel) -> bd.LinearFit:
    """Least squares that leaves nobody out."""
    return bd.fit_linear(matches, model, rejection=bd.Rejection(1e12, None))


def repeated(matches: bd.Matches, model: bd.DistortionModel) -> bd.LinearFit:
    """Clipping again and again within limits that someone has to choose."""
    fit = plain(matches, model)
    for limit in LIMITS:
        kept = np.hypot(*bd.residuals(fit, matches).T) < limit
        fit = plain(matches.select(kept), model)
    return fit


def twin(
    pairs: Pairs, certain: NDArray[np.bool_], turns: int, seed: int
) -> tuple[Pairs, NDArray[np.bool_]]:
    """A set of known truth with the densities of the real one.

    The pairs `certain` are kept.  False ones pair every detection with catalogue stars moved by
    30 to 120 arcsec, `turns` times over in other directions.

    Returns
    -------
    Pairs
    ndarray of bool
        Which of them are true.
    """
    rng = np.random.default_rng(seed)
    _, detections = np.unique(pairs.detection, return_index=True)
    star_u, stars = np.unique(pairs.u, return_index=True)
    x, y = pairs.x[detections], pairs.y[detections]
    parts = [pairs.select(certain)]
    for k in range(turns):
        angle, length = 2 * np.pi * (k + rng.uniform()) / turns, rng.uniform(30, 120)
        u = star_u + length * np.cos(angle)
        v = pairs.v[stars] + length * np.sin(angle)
        i, j = np.nonzero((x[:, None] - u) ** 2 + (y[:, None] - v) ** 2 < RADIUS**2)
        parts.append(
            Pairs(x[i], y[i], u[j], v[j], pairs.mag[stars][j], pairs.detection[detections][i])
        )
    both = {k: np.concatenate([vars(p)[k] for p in parts]) for k in vars(parts[0])}
    return Pairs(**both), np.arange(len(both["x"])) < certain.sum()
