"""Simulated campaign and its truth, with transformations between pixels and the catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import ExposureLog
from bayesdist.missions.hst.simulate.pointings import AcsFrames
from bayesdist.missions.hst.simulate.stars import TrueStars
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

LINEAR_TERMS = ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")
MARGIN = 0.15  # margin around a chip in which the inverse is computed, in units of its half size


@dataclass(frozen=True, eq=False)
class DetectionTruth:
    """Truth of the detections of one exposure, in the order of its list.

    Parameters
    ----------
    star : ndarray of int64, shape (N,)
        Row of the star in the catalogue; -1 for a false detection.
    blended : ndarray of bool, shape (N,)
        True for stars that are displaced towards a close neighbour.
    """

    star: Int
    blended: Bool


@dataclass(frozen=True, eq=False)
class AcsTruth:
    """Truth of a simulated campaign.

    Parameters
    ----------
    model : DistortionModel
        Model in the gauge of the report, without frames.
    theta : mapping of str to ndarray, shape (D,)
        True parameters for each filter.
    tables : tuple of LookupTable
        Detector and filter tables; empty without fine-scale distortion.
    stars : TrueStars
        True stars in the order of the catalogue.
    log : ExposureLog
    frames : AcsFrames
        True frames of the exposures.
    detections : tuple of DetectionTruth
        Truth of the detections of each exposure.
    settings : mapping of str to object
        Arguments of the simulation.
    """

    model: DistortionModel
    theta: Mapping[str, Float]
    tables: tuple[LookupTable, ...]
    stars: TrueStars
    log: ExposureLog
    frames: AcsFrames
    detections: tuple[DetectionTruth, ...]
    settings: Mapping[str, object]

    def to_catalog(self, exposure: str, x: ArrayLike, y: ArrayLike, chip: ArrayLike) -> Float:
        """Transform pixels of an exposure to catalogue positions.

        Parameters
        ----------
        exposure : str
            Name of the exposure.
        x, y : array_like, shape (N,)
            Raw FITS 1-based pixels.
        chip : int or array_like, shape (N,)
            Chip numbers.

        Returns
        -------
        ndarray, shape (N, 2)
            Positions (u, v) at the epoch of the exposure, pixels of the catalogue.
        """
        e = self.frames.names.index(exposure)
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
        chips = np.broadcast_to(np.asarray(chip), x.shape)
        out = np.empty((x.size, 2))
        for number in np.unique(chips):
            rows = chips == number
            out[rows] = self._map(e, int(number)).at(x[rows], y[rows]).T
        return out

    def to_pixels(
        self, exposure: str, u: ArrayLike, v: ArrayLike, chip: int
    ) -> tuple[Float, Float]:
        """Transform catalogue positions to raw pixels of a chip: the inverse of `to_catalog`.

        Parameters
        ----------
        exposure : str
            Name of the exposure.
        u, v : array_like, shape (N,)
            Positions, pixels of the catalogue.
        chip : int
            Chip number.

        Returns
        -------
        x, y : ndarray, shape (N,)
            FITS 1-based pixels, accurate to 1e-9; NaN if the position is far outside of the chip.
        """
        chip_map = self._map(self.frames.names.index(exposure), chip)
        sky = np.stack([np.atleast_1d(np.asarray(w, float)) for w in (u, v)])
        centre = (np.array(chip_map.basis.size)[:, None] + 1.0) / 2.0
        off = np.linalg.solve(chip_map.linear, sky - chip_map.at(*centre))
        reach = (1.0 + MARGIN) * np.array(chip_map.basis.half_size)[:, None]
        near = (np.abs(off) < reach).all(axis=0)
        x, y = np.full(sky.shape, np.nan)
        (x[near], y[near]), _ = chip_map.pixels(sky[:, near])
        return x, y

    def linear_terms(self, exposure: str, chip: int) -> Float:
        """True linear terms of an exposure, including its deviations.

        Parameters
        ----------
        exposure : str
            Name of the exposure.
        chip : int
            Chip number.

        Returns
        -------
        ndarray, shape (6,)
            A_1, A_2, A_3, B_1, B_2, B_3 without velocity aberration, in the gauge of the report for
            this exposure: A_1 = B_1 = A_3 = 0 on WFC2.
        """
        e = self.frames.names.index(exposure)
        terms = self._linear(e, chip)
        skew = self._linear(e, 2)[:, 2]
        length = np.hypot(*skew)
        turn = np.array([[skew[1], -skew[0]], [skew[0], skew[1]]]) / length
        out: Float = (turn @ terms).ravel()
        return out

    def _linear(self, e: int, chip: int) -> Float:
        basis = self.model.basis(chip)
        return np.asarray(basis.to_monomials(self._in_gauge(e, chip)))[:, :3]

    def _in_gauge(self, e: int, chip: int) -> Float:
        """Legendre coefficients (2, K) of w, including the deviations of the exposure."""
        exposure = self.log.exposures[e]
        codes = np.array([self.model.chip_code(chip)])
        theta = self.theta[exposure.filter]
        P = self.model.polynomials(theta, codes, np.array([exposure.epoch]))[0]
        if chip == 1:
            monomial = np.zeros((2, self.model.n_terms))
            monomial[:, 1:3] = self.frames.own[e]  # the terms x and y follow the constant
            P = P + self.model.basis(chip).from_monomials(monomial)
        return (np.eye(2) + self.frames.shared[e]) @ P

    def _map(self, e: int, chip: int) -> ChipMap:
        """Map of a chip in an exposure to catalogue positions (u, v)."""
        c, s = np.cos(self.frames.angle[e]), np.sin(self.frames.angle[e])
        P = self.frames.vafactor[e] * np.array([[c, -s], [s, c]]) @ self._in_gauge(e, chip)
        P[:, 0] += self.frames.centre[e]
        filters = ("", self.log.exposures[e].filter)  # detector table first
        tables = [t for name in filters for t in self.tables if (t.chip, t.filter) == (chip, name)]
        name = self.frames.names[e]
        return ChipMap(name, self.model.basis(chip), "pix", P, chip=chip, before=tuple(tables))


@dataclass(frozen=True, eq=False)
class AcsCampaign:
    """Simulated campaign.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Standard catalogue at epoch 2004.5, with proper motions.
    early, late : ReferenceCatalog
        Mean positions of the same stars, in the same order, before and after SM4.
    log : ExposureLog
    lists : tuple of Detections
        Raw detections of each exposure, in the order of the log.
    truth : AcsTruth
    """

    catalog: ReferenceCatalog
    early: ReferenceCatalog
    late: ReferenceCatalog
    log: ExposureLog
    lists: tuple[Detections, ...]
    truth: AcsTruth
