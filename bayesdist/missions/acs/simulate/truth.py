"""A simulated campaign and its truth, with maps between pixels and the catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import ExposureLog
from bayesdist.missions.acs.simulate.pointings import AcsFrames
from bayesdist.missions.acs.simulate.stars import TrueStars
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

LINEAR_TERMS = ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")
MARGIN = 0.15  # beyond the edges of a chip, in halves of it: range of the inverse


@dataclass(frozen=True, eq=False)
class DetectionTruth:
    """Truth of the detections of one exposure, in the order of its list.

    Parameters
    ----------
    star : ndarray of int64, shape (N,)
        Row of the star in the catalogue; -1 for a false detection.
    blended : ndarray of bool, shape (N,)
        Stars whose position is drawn towards a close neighbour.
    """

    star: Int
    blended: Bool


@dataclass(frozen=True, eq=False)
class AcsTruth:
    """Truth of a simulated campaign.

    Parameters
    ----------
    model : DistortionModel
        In the reference gauge, without frames.
    theta : mapping of str to ndarray, shape (D,)
        True parameters for each filter.
    tables : tuple of LookupTable
        Of the detector and of the filters; empty without fine scale.
    stars : TrueStars
        In the order of the catalogue.
    log : ExposureLog
    frames : AcsFrames
    detections : tuple of DetectionTruth
        One for each exposure.
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
        """Positions in the catalogue of pixels of an exposure.

        Parameters
        ----------
        exposure : str
        x, y : array_like, shape (N,)
            Raw FITS 1-based pixels.
        chip : int or array_like, shape (N,)

        Returns
        -------
        ndarray, shape (N, 2)
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
        """Raw pixels of a chip at positions of the catalogue: the inverse of `to_catalog`.

        Parameters
        ----------
        exposure : str
        u, v : array_like, shape (N,)
        chip : int

        Returns
        -------
        x, y : ndarray, shape (N,)
            FITS 1-based pixels, to 1e-9; NaN where the position is far off the chip.
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
        """Linear terms of an exposure, with its deviations, as a perfect solution would have them.

        Parameters
        ----------
        exposure : str
        chip : int

        Returns
        -------
        ndarray, shape (6,)
            A_1, A_2, A_3, B_1, B_2, B_3 in the reference gauge: on WFC2 A_1 = B_1 = A_3 = 0 in this
            very exposure.  Free of velocity aberration.
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
        """Legendre coefficients (2, K) of w with the exposure's deviations."""
        one = self.log.exposures[e]
        codes = np.array([self.model.chip_code(chip)])
        theta = self.theta[one.filter]
        P = self.model.polynomials(theta, codes, np.array([one.epoch]))[0]
        if chip == 1:
            monomial = np.zeros((2, self.model.n_terms))
            monomial[:, 1:3] = self.frames.own[e]  # the terms x and y follow the constant
            P = P + self.model.basis(chip).from_monomials(monomial)
        return (np.eye(2) + self.frames.shared[e]) @ P

    def _map(self, e: int, chip: int) -> ChipMap:
        """Map of a chip in an exposure to (u, v) in the catalogue."""
        c, s = np.cos(self.frames.angle[e]), np.sin(self.frames.angle[e])
        P = self.frames.vafactor[e] * np.array([[c, -s], [s, c]]) @ self._in_gauge(e, chip)
        P[:, 0] += self.frames.centre[e]
        filters = ("", self.log.exposures[e].filter)  # the detector's table comes first
        tables = [t for name in filters for t in self.tables if (t.chip, t.filter) == (chip, name)]
        name = self.frames.names[e]
        return ChipMap(name, self.model.basis(chip), "pix", P, chip=chip, before=tuple(tables))


@dataclass(frozen=True, eq=False)
class AcsCampaign:
    """A simulated campaign.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Standard catalogue: epoch 2004.5, with proper motions.
    early, late : ReferenceCatalog
        Mean positions before and after SM4, of the same stars in the same order.
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
