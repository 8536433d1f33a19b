"""Simulated frames: epochs, densities of stars, and probabilities of false matches.

False matches are sources that are not in 2MASS, paired with another star that is close by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import brentq

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

FRAMES = 5000  # number of framesets, common to all bands
CADENCE_S = 11.0  # seconds between frames
PER_SCAN = 259  # frames per half orbit (of 95 minutes)
FIRST_SCAN = 350
START = 2010.02  # decimal year of the in-orbit checkout
YEAR_S = 365.25 * 86_400
POLE = 2500.0  # 2MASS sources per square degree at the galactic poles
THINNEST = 0.05  # lower limit of the sine of galactic latitude for the density
HIGHEST = 0.98  # sine of the highest galactic latitude on the orbit
ARCSEC2 = 3600.0**2
RADIUS = (1.5, 3.0)  # radius of the match circle at the centre and in the corners, pixels
NODES = 16  # quadrature nodes per half axis, for means over the array


@dataclass(frozen=True, eq=False)
class Survey:
    """Names, epochs and star densities of F frames."""

    names: tuple[str, ...]  # scan and frame, such as '00350a001'
    epoch: Float  # (F,), decimal years
    density: Float  # (F,), 2MASS sources per square arcsec

    def share(self) -> Float:
        """Fraction (F,) of the pairs in each frame, proportional to the density."""
        return self.density / self.density.sum()


def survey(n_frames: int = FRAMES) -> Survey:
    """Consecutive frames along a polar orbit.

    The stars are in a plane-parallel layer, so that their density is proportional to the cosecant
    of galactic latitude: 2500 per square degree at the poles, and at most 20 times as many.
    """
    number = np.arange(n_frames)
    scan, frame = np.divmod(number, PER_SCAN)
    # half orbits are from pole to pole; frames are at the centres of equal steps
    along = np.pi * (frame + 0.5) / PER_SCAN
    sine = np.maximum(np.abs(HIGHEST * np.cos(along)), THINNEST)
    names = tuple(
        f"{FIRST_SCAN + s:05d}a{f + 1:03d}"
        for s, f in zip(scan.tolist(), frame.tolist(), strict=True)
    )
    epoch = np.asarray(START + number * CADENCE_S / YEAR_S, np.float64)
    return Survey(names, epoch, POLE / sine / ARCSEC2)


def match_radius(r2: Float) -> Float:
    """Radius of the match circle in pixels, which increases towards the corners.

    `r2` is the squared distance from the centre of the array; it is 1 in the corners.
    """
    return RADIUS[0] + (RADIUS[1] - RADIUS[0]) * r2


@dataclass(frozen=True, eq=False)
class FalseMatches:
    """Probability and offsets of false pairs, by density of the frame and position on the array."""

    density: Float  # (F,), reference stars per square pixel of each frame
    unlisted: float  # fraction of sources that are not in the reference catalogue

    def probability(self, frame: Int, r2: Float) -> Float:
        """Probability (N,) that pairs are false.

        Sources in the reference catalogue are always matched correctly.  All others form a false
        pair if there is a reference star within the match circle.
        """
        caught = self.unlisted * _chance(self.density[frame], r2)
        return caught / (caught + (1.0 - self.unlisted))

    def offsets(self, r2: Float, rng: np.random.Generator) -> Float:
        """Random offsets (N, 2) of false matches in pixels, uniform on the match circle."""
        radius = match_radius(r2) * np.sqrt(rng.uniform(size=r2.size))
        angle = rng.uniform(0.0, 2.0 * np.pi, size=r2.size)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def false_matches(survey: Survey, scale: float, share: float) -> FalseMatches:
    """Distribution of false matches with an expected fraction `share` of all pairs.

    `scale` is in arcsec per pixel.  Raises InputError if the fraction is outside of [0, 1).
    """
    if not 0.0 <= share < 1.0:
        raise InputError(
            f"the fraction of false matches is {share:g}",
            where="false_fraction",
            do="give a number in [0, 1)",
        )
    density = survey.density * scale**2
    if share == 0.0:
        return FalseMatches(density, 0.0)
    nodes, weights = legendre.leggauss(NODES)
    half, weight = (nodes + 1.0) / 2.0, weights / 2.0
    r2 = ((half[:, None] ** 2 + half**2) / 2.0).ravel()
    each, index = np.unique(density, return_inverse=True)  # densities repeat in each half orbit
    chance = _chance(each[:, None], r2)
    of_density = np.bincount(index, survey.share())
    of_place = np.outer(weight, weight).ravel()

    def excess(logit: float) -> float:
        odds = np.exp(logit) * chance
        return float(of_density @ (odds / (odds + 1.0)) @ of_place) - share

    odds = np.exp(brentq(excess, -40.0, 40.0, xtol=1e-10))
    return FalseMatches(density, float(odds / (1.0 + odds)))


def _chance(density: Float, r2: Float) -> Float:
    """Probability that at least one star is within the match circle."""
    return -np.expm1(-np.pi * density * match_radius(r2) ** 2)
