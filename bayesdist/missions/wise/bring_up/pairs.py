"""Matches for a bring-up, from bins of the detector with more matches than expected by chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import poisson

from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.data.matching.pairs import mutual_pairs
from bayesdist.errors import InputError
from bayesdist.missions.wise.pairs.radial_limit import RadialLimit
from bayesdist.model import DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Bool, Float, Int

RARE = 1e-3  # probability by chance, over all bins combined
DISPLACED = 10.0  # displacement for chance matches, in units of the radius in the corners
GRID = 17  # points per axis at which models are compared
OF_THE_BEST = 0.5  # minimum fraction of matched detections, relative to that of good bins
_DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


@dataclass(frozen=True, eq=False)
class Believed:
    """Accepted matches, which are those in covered bins, and statistics of the matching."""

    index: Int  # rows of the matches in the detections
    partner: Int  # rows of the matches in the reference
    n_pairs: int  # number of all matches, including those outside of covered bins
    n_false: float  # expected number of false matches in covered bins
    covered: Bool  # (n_bins,), True for covered bins
    coverage: float  # fraction of the bins with detections that are covered


class Field:
    """Detections, reference stars and the bins of the detector."""

    def __init__(
        self, detections: Detections, reference: Detections, model: DistortionModel, bins: int
    ) -> None:
        self.detections, self.reference, self.model, self.bins = detections, reference, model, bins
        self.sigma = _errors(detections), _errors(reference)
        size = model.chips[0].size
        out = np.zeros(len(detections), bool)
        for z, n in zip((detections.x, detections.y), size, strict=True):
            out |= (z < 0.5) | (z > n + 0.5)
        if out.any():
            k = int(np.argmax(out))
            raise InputError(
                f"detection {k + 1} is at pixel ({detections.x[k]:.2f}, {detections.y[k]:.2f}), "
                f"outside of the {size[0]:g} x {size[1]:g} detector",
                where="detections",
                do="correct the detector's size or remove the row",
            )
        ix, iy = (
            np.clip(((z - 0.5) / n * bins).astype(np.int64), 0, bins - 1)
            for z, n in zip((detections.x, detections.y), size, strict=True)
        )
        self.code = iy * bins + ix
        self.size = size
        self.grid = Detections(*mesh(*(np.linspace(1.0, n, GRID) for n in size)))

    def positions(self, theta: Float | None, stars: Detections) -> Float:
        """Undistorted positions (N, 2) of stars; the pixel positions if `theta` is None."""
        return stars.points if theta is None else self.model.predict(theta, stars.x, stars.y)

    def distance(self, before: Float | None, now: Float) -> float:
        """Largest difference between two models over the detector."""
        step = self.positions(now, self.grid) - self.positions(before, self.grid)
        return float(np.hypot(*step.T).max())

    def _paired(self, position: Float, radius: Float) -> tuple[Int, Int]:
        """Rows (n,) of detections and reference stars that are mutual nearest neighbours."""
        stars, reference = self.detections, self.reference
        index, partner, _ = mutual_pairs(
            position,
            reference.points,
            radius,
            frame=stars.exposure,
            reference_frame=reference.exposure,
        )
        return index, partner

    def match(self, theta: Float | None, rule: RadialLimit, number: int) -> Believed:
        """Matches of round `number` in bins with more matches than expected by chance."""
        stars, n_bins = self.detections, self.bins**2
        position = self.positions(theta, stars)
        radius = rule.at(stars.x, stars.y, self.size)
        index, partner = self._paired(position, radius)
        # detections that are displaced by more than the distortion have only false matches
        chance = np.zeros(n_bins)
        for direction in _DIRECTIONS:
            moved = position + DISPLACED * rule.corner * np.array(direction)
            strangers, _ = self._paired(moved, radius)
            chance += np.bincount(self.code[strangers], minlength=n_bins) / len(_DIRECTIONS)
        count = np.bincount(self.code[index], minlength=n_bins)
        n_detections = np.bincount(self.code, minlength=n_bins)
        covered = _covered(count, n_detections, chance)
        good = covered[self.code[index]]
        if not good.any():
            raise InputError(
                f"{len(index)} pairs are found in round {number} and {chance.sum():.0f} are "
                "expected by chance, but no part of the detector has a significant excess",
                where="bring-up",
                do="check orientation, offset and scale of the frames, or give another start or "
                "a larger radius",
            )
        n, n_chance = int(n_detections[covered].sum()), float(chance[covered].sum())
        return Believed(
            index=index[good],
            partner=partner[good],
            n_pairs=len(index),
            # false matches occur only for detections that have no true match
            n_false=n_chance * (n - int(good.sum())) / (n - n_chance),
            covered=covered,
            coverage=float(covered.sum() / (n_detections > 0).sum()),
        )

    def table(self, found: Believed) -> Matches:
        """Accepted matches as a table, with the frames as exposures."""
        stars, reference = self.detections, self.reference
        sigma = np.hypot(self.sigma[0][found.index], self.sigma[1][found.partner])
        frames, exposure = np.unique(stars.exposure[found.index], return_inverse=True)
        return Matches.of_distinct_rows(  # no detection has two reference stars
            x=stars.x[found.index],
            y=stars.y[found.index],
            u=reference.x[found.partner],
            v=reference.y[found.partner],
            sigma_u=sigma,
            sigma_v=sigma,
            unit=self.model.unit,
            exposure=exposure,
            exposure_names=tuple(stars.exposure_names[f] for f in frames),
            chip_numbers=(self.model.chips[0].number,),
            sources=("bring-up",),
        )


def _errors(stars: Detections) -> Float:
    """Errors (N,) of stars; raises InputError if there are none."""
    if stars.sigma is None:
        raise InputError("has no errors", where=stars.source, do="give sigma")
    return stars.sigma


def _covered(count: Int, there: Int, chance: Float) -> Bool:
    """Boolean mask (n_bins,) that is True for covered bins.

    Covered bins have more matches than expected by chance, and a fraction of matched detections
    not far below that of the best bins.  `count`, `there` and `chance` are the numbers of matches,
    of detections, and of matches of displaced detections in each bin.
    """
    has = there > 0
    expected = np.maximum(chance, there * (chance.sum() / there.sum()))
    # significant: for all bins combined the probability by chance is RARE
    clear = poisson.sf(count - 1, expected) < RARE / has.sum()
    excess = np.divide(count - expected, there, out=np.zeros(len(there)), where=has)
    if not clear.any():
        return np.zeros(len(there), bool)
    return np.asarray(clear & (excess > OF_THE_BEST * np.quantile(excess[clear], 0.9)))
