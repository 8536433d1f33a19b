"""A simulated campaign and its truth, with maps between pixels and the catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from bayesdist.arrays import Bool, Float, Int
from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import ExposureLog
from bayesdist.missions.acs.simulate.pointings import AcsFrames
from bayesdist.missions.acs.simulate.stars import TrueStars
from bayesdist.model import DistortionModel, PolynomialBasis
from bayesdist.model.basis import polynomial_values
from bayesdist.model.lookup import LookupTable, corrected

LINEAR_TERMS = ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")
CLOSE = 1e-10  # pixels: largest error of an inverse
EXACT = 1e-13  # step in scaled pixels at which Newton's method has converged
STEPS = 30


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
        x, y = corrected(self.tables, x, y, chip=chips, filter=self.log.exposures[e].filter)
        out = np.empty((x.size, 2))
        for number in np.unique(chips):
            rows = chips == number
            field = Field(self.model.basis(int(number)), self._on_catalog(e, int(number)))
            out[rows] = field.at(x[rows], y[rows])
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
        e = self.frames.names.index(exposure)
        field = Field(self.model.basis(chip), self._on_catalog(e, chip))
        u, v = np.atleast_1d(np.asarray(u, float)), np.atleast_1d(np.asarray(v, float))
        x, y = np.full(u.shape, np.nan), np.full(u.shape, np.nan)
        near = field.near(u, v)
        straight_x, straight_y = field.inverse(u[near], v[near])
        filter = self.log.exposures[e].filter
        raw_x, raw_y = straight_x.copy(), straight_y.copy()
        for _ in range(STEPS):  # tables are flat: each step gains two digits
            seen_x, seen_y = corrected(self.tables, raw_x, raw_y, chip=chip, filter=filter)
            off_x, off_y = straight_x - seen_x, straight_y - seen_y
            raw_x += off_x
            raw_y += off_y
            if max(np.abs(off_x).max(initial=0.0), np.abs(off_y).max(initial=0.0)) < CLOSE:
                break
        x[near], y[near] = raw_x, raw_y
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

    def _on_catalog(self, e: int, chip: int) -> Float:
        """Legendre coefficients (2, K) of (u, v) in the catalogue."""
        c, s = np.cos(self.frames.angle[e]), np.sin(self.frames.angle[e])
        out: Float = self.frames.vafactor[e] * np.array([[c, -s], [s, c]]) @ self._in_gauge(e, chip)
        out[:, 0] += self.frames.centre[e]
        return out


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


class Field:
    """Polynomial map of one chip, with Legendre coefficients (2, K), and its inverse."""

    MARGIN = 0.15  # beyond the edges, in halves of the chip: range of the inverse

    def __init__(self, basis: PolynomialBasis, coef: Float) -> None:
        self.basis = basis
        n = basis.order + 1
        # powers[i, j, axis] of X^i Y^j
        self.powers = np.zeros((n, n, 2))
        i, j = np.array(basis.terms).T
        self.powers[i, j] = basis.to_scaled_powers(coef).T
        self.by_x = np.asarray(polynomial.polyder(self.powers, axis=0), float)
        self.by_y = np.asarray(polynomial.polyder(self.powers, axis=1), float)

    def at(self, x: Float, y: Float) -> Float:
        """Positions (N, 2) of pixels."""
        return self._values(*self.basis.scaled(x, y))

    def _values(self, X: Float, Y: Float) -> Float:
        return np.stack([polynomial_values(self.powers[..., a], X, Y) for a in (0, 1)], axis=-1)

    def _linear_inverse(self, u: Float, v: Float) -> Float:
        A = np.stack([self.powers[1, 0], self.powers[0, 1]], axis=-1)
        return np.linalg.solve(A, np.stack([u, v]) - self.powers[0, 0][:, None])

    def near(self, u: Float, v: Float) -> Bool:
        """Boolean mask of the positions (N,) that may lie on the chip."""
        X, Y = self._linear_inverse(u, v)
        out: Bool = np.maximum(np.abs(X), np.abs(Y)) < 1.0 + self.MARGIN
        return out

    def inverse(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Pixels of positions on or near the chip, by Newton's method."""
        X, Y = self._linear_inverse(u, v)
        for _ in range(STEPS):
            off = np.stack([u, v], axis=-1) - self._values(X, Y)
            a, c = (polynomial_values(self.by_x[..., k], X, Y) for k in (0, 1))
            b, d = (polynomial_values(self.by_y[..., k], X, Y) for k in (0, 1))
            det = a * d - b * c
            dX = (d * off[:, 0] - b * off[:, 1]) / det
            dY = (a * off[:, 1] - c * off[:, 0]) / det
            X, Y = X + dX, Y + dY
            if max(np.abs(dX).max(initial=0.0), np.abs(dY).max(initial=0.0)) < EXACT:
                break
        nx, ny = self.basis.size
        return (X * nx + nx + 1.0) / 2.0, (Y * ny + ny + 1.0) / 2.0
