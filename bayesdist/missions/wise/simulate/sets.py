"""Sets of pairs of full size: their ingredients, and their rows chunk by chunk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from bayesdist.data.batches import even_edges
from bayesdist.errors import InputError
from bayesdist.missions.wise.published import (
    RESIDUAL_SIGMAS,
    SAMPLE_SIZES,
    WISE_ARRAYS,
    WISE_BANDS,
    WiseArray,
)
from bayesdist.missions.wise.simulate.pattern import BLOCKS, PartitionPattern, partition_pattern
from bayesdist.missions.wise.simulate.solution import wise_solution
from bayesdist.missions.wise.simulate.stars import POPULATIONS
from bayesdist.missions.wise.simulate.survey import FalseMatches, Survey, false_matches, survey
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int

CHUNK = 2**19  # pairs of a chunk at most
_STEP = 8192  # positions at a time: they stay in the cache


@dataclass(frozen=True, eq=False)
class PairChunk:
    """Consecutive pairs, in the order of their frames.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        Detector position, FITS 1-based pixels.
    u, v : ndarray, shape (N,)
        Reference position in distortion-free band-frame pixels.
    frame : ndarray of int, shape (N,)
        Number of the frame in the survey.
    mag, colour : ndarray, shape (N,)
    sigma : ndarray, shape (N,)
        Quoted error on each axis, WISE's and 2MASS's together, in pixels.
    false : ndarray of bool, shape (N,)
        True for false matches: the truth, which a calibration does not know.
    """

    x: Float
    y: Float
    u: Float
    v: Float
    frame: Int
    mag: Float
    colour: Float
    sigma: Float
    false: Bool

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True, eq=False)
class WiseSet:
    """Pairs of a band, by the ingredients that determine them.

    Parameters
    ----------
    band : str
    pairs : int
    seed : int
    false_fraction : float
        Expected fraction of false matches.
    model : DistortionModel
    theta : ndarray, shape (30,)
        The published distortion: the truth.
    survey : Survey
    false_matches : FalseMatches
    pattern : PartitionPattern or None
        Pattern in the residuals, where it is asked for.
    """

    band: str
    pairs: int
    seed: int
    false_fraction: float
    model: DistortionModel
    theta: Float
    survey: Survey
    false_matches: FalseMatches
    pattern: PartitionPattern | None

    @property
    def array(self) -> WiseArray:
        """The detector array."""
        return WISE_ARRAYS[self.band]

    @cached_property
    def edges(self) -> list[int]:
        """First row of each chunk, and the number of all rows."""
        return even_edges(self.pairs, CHUNK)

    def chunk(self, k: int) -> PairChunk:
        """Rows ``edges[k]`` to ``edges[k + 1]``.

        Each chunk has random numbers of its own: chunks can be made in any order, and at once.

        Parameters
        ----------
        k : int

        Returns
        -------
        PairChunk
        """
        rng = _generator(self.band, self.seed, _FIRST_CHUNK + k)
        start, stop = self.edges[k], self.edges[k + 1]
        n = stop - start
        before = np.clip(self._frame_edges, start, stop)
        frame = np.repeat(np.arange(len(self.survey.names)), np.diff(before))

        population = POPULATIONS[self.band]
        counts = rng.uniform(population.brightest, 1.0, size=n)
        sigma = population.sigma(counts)
        X, Y = rng.uniform(-1.0, 1.0, size=(2, n))
        r2 = (X**2 + Y**2) / 2.0
        error = sigma * rng.standard_normal((2, n))
        false = rng.uniform(size=n) < self.false_matches.probability(frame, r2)
        error[:, false] = self.false_matches.offsets(r2[false], rng).T
        colour = population.colours(false, rng)
        x, y = (
            centre + half * scaled
            for centre, half, scaled in zip(
                self.array.centre, self.model.basis().half_size, (X, Y), strict=True
            )
        )
        error += self._corrected(X, Y)
        if self.pattern is not None:
            # the template displaces WISE's measurement of its own source, whatever it is matched to
            error -= self.pattern.blocked(x, y).T
        mag = population.magnitudes(counts)
        return PairChunk(x, y, error[0], error[1], frame, mag, colour, sigma, false)

    @cached_property
    def _frame_edges(self) -> Int:
        """First row of each frame, and the number of all rows."""
        rng = _generator(self.band, self.seed, _FRAMES)
        counts = rng.multinomial(self.pairs, self.survey.share())
        return np.concatenate([[0], np.cumsum(counts)])

    @cached_property
    def _tables(self) -> list[Float]:
        """Legendre coefficients [i, j] of u and of v, with the subtracted part of the pattern."""
        i, j = np.array(self.model.basis().terms).T
        out = []
        for axis in (0, 1):
            values = self.theta[self.model.coefficient_slice(None, axis)]
            if self.pattern is not None:
                values = values + self.pattern.smooth[axis]
            table = np.zeros((self.model.order + 1,) * 2)
            table[i, j] = values
            out.append(table)
        return out

    def _corrected(self, X: Float, Y: Float) -> Float:
        """Polynomials (2, N) of both axes: as `model.predict`, at a tenth of its cost."""
        out = np.empty((2, X.size))
        for start in range(0, X.size, _STEP):
            rows = slice(start, start + _STEP)
            for axis, table in enumerate(self._tables):
                out[axis, rows] = legendre.legval2d(X[rows], Y[rows], table)
        return out


def wise_set(
    band: str,
    *,
    pairs: int | None = None,
    seed: int = 1,
    false_fraction: float = 0.03,
    partition: bool = False,
) -> WiseSet:
    """Set of pairs of WISE detections and 2MASS stars.

    Parameters
    ----------
    band : str
    pairs : int, optional
        By default as many as in section 4 of WSDC D-T033.
    seed : int, optional
        Bands do not depend on each other.
    false_fraction : float, optional
        Expected fraction of false matches among the pairs.
    partition : bool, optional
        True where the partition of the point-spread function shows in the residuals.

    Returns
    -------
    WiseSet

    Raises
    ------
    InputError
        For an unknown band, no pairs, and a fraction outside [0, 1).
    """
    model, theta = wise_solution(band)
    pairs = SAMPLE_SIZES[band] if pairs is None else pairs
    if pairs < 1:
        raise InputError(f"the number of pairs is {pairs}", where="pairs", do="give 1 or more")
    frames = survey()
    pattern = None
    if partition and band in BLOCKS:
        rng = _generator(band, seed, _PATTERN)
        pattern = partition_pattern(model.basis(), BLOCKS[band], RESIDUAL_SIGMAS[band], rng)
    return WiseSet(
        band=band,
        pairs=pairs,
        seed=seed,
        false_fraction=false_fraction,
        model=model,
        theta=theta,
        survey=frames,
        false_matches=false_matches(frames, WISE_ARRAYS[band].scale, false_fraction),
        pattern=pattern,
    )


_FRAMES, _PATTERN, _FIRST_CHUNK = range(3)


def _generator(band: str, seed: int, part: int) -> np.random.Generator:
    """Random numbers of one part of a band, independent of those of other parts."""
    key = (WISE_BANDS.index(band), part)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
