"""Detections sorted by star, with all arrays that the passes need, on a common tangent plane.

A camera images the tangent plane at its pointing, but exposure frames treat the sky as flat.  The
planes of two exposures are not related by a shift and a rotation; the difference grows with the
square of the position and with the offset.  Since the offsets are known from the current solution,
detections are moved to the pixels where they would be on the common plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import ndimage

from bayesdist.data.detections import Detections
from bayesdist.data.tangent import ARCSEC
from bayesdist.errors import InputError
from bayesdist.infer import kernel
from bayesdist.infer.kernel.blocks import threads_for
from bayesdist.model import DistortionModel
from bayesdist.model.effective import Groups
from bayesdist.utils.arrays import Bool, Float, Int

MIN_DETECTIONS = 2  # minimum number of detections for information about the distortion
MOTIONS = {"none": 2, "proper_motion": 4, "parallax": 5}  # number of parameters of a star
# negligible prior precision (unit of u, v) that keeps the matrix of a star positive definite
VAGUE = 1e-12

STEPS = 3  # Newton steps, each of which reduces the error by a factor of 100 or more


@dataclass(frozen=True, eq=False)
class StarPriors:
    """Gaussian priors on the parameters of the stars, such as those of reference stars."""

    centre: Float  # prior means (S, q)
    precision: Float  # inverse covariances (S, q, q); negligible for stars without a prior

    @classmethod
    def none(cls, n: int, q: int) -> StarPriors:
        """Priors without information, for n stars with q parameters."""
        return cls(np.zeros((n, q)), np.tile(VAGUE * np.eye(q), (n, 1, 1)))

    @property
    def informed(self) -> Bool:
        """Boolean mask (S,) that is True for stars with a prior."""
        return np.asarray(np.trace(self.precision, axis1=1, axis2=2) > 10 * VAGUE)


@dataclass(frozen=True, eq=False)
class Problem:
    """N detections of S stars, sorted by star, with the model linearised about a solution."""

    model: DistortionModel
    groups: Groups  # detections of equal effective coefficients; `index` (N,): group of each
    starts: Int  # index (S + 1,) of the first detection of each star, and the number N
    seen: Float  # scaled pixel coordinates (2, N) of the detections
    # scaled pixel coordinates (N,) at the current solution, where the model is evaluated
    X: Float
    Y: Float
    offset: Float  # displacement (N, 2) on the sky from there to the detection
    # elements uu, uv, vv (N, 3) of the matrix that converts sky residuals to squared pixels or,
    # with `shape`, to `var` times the chi-square of the quoted errors
    W: Float
    var: Float  # squared quoted errors (N,) in square pixels; with `shape` on the geometric mean
    time: Float  # years (N,) since `epoch0`; empty if stars have no proper motion
    factor: Float  # parallax factors (N, 2); empty without parallax
    priors: StarPriors
    rows: Int  # input row (N,) of each detection
    match_radius: float  # largest distance in pixels of a detection from its star
    pixel: float  # median size of a pixel on the sky at the start, in the unit of u, v
    epoch0: float = 0.0  # date of the stars' positions in decimal years
    dates: Float | None = None  # decimal years (N,) of the detections; None if they are unknown
    # known scale (E,) of the sky in each exposure about the origin of the frames
    dilation: Float | None = None
    # inverse covariances (N, 2, 2) of x and y times `var`, of determinant 1; None if errors are
    # equal on both axes.  The jitter has the same shape.
    shape: Float | None = None

    def __len__(self) -> int:
        return len(self.X)

    @property
    def columns(self) -> tuple[Int | Float, ...]:
        """Arrays of detections and stars in the order of the arguments of the compiled passes."""
        return (
            *(self.starts, self.groups.index, self.X, self.Y, self.offset, self.W, self.var),
            *(self.time, self.factor, self.priors.centre, self.priors.precision),
        )

    @property
    def n_stars(self) -> int:
        """Number of stars."""
        return len(self.starts) - 1

    @property
    def n_star(self) -> int:
        """Number of parameters of a star: 2, 4 or 5."""
        return self.priors.centre.shape[1]

    @property
    def counts(self) -> Int:
        """Number of detections of each star (S,)."""
        return np.asarray(np.diff(self.starts), np.int64)

    @cached_property
    def star(self) -> Int:
        """Star (N,) of each detection."""
        return np.repeat(np.arange(self.n_stars), self.counts)

    @property
    def log_outlier(self) -> float:
        """Log density of false detections per square pixel, without their fraction."""
        return -float(np.log(np.pi * self.match_radius**2))

    @property
    def least_root(self) -> float:
        """Square root of the smallest curvature allowed for a star, set by its match circle."""
        return float(np.sqrt(2.0) / (self.match_radius * self.pixel))

    @cached_property
    def sigma(self) -> float:
        """Median quoted error in pixels."""
        return float(np.sqrt(np.median(self.var)))

    @cached_property
    def _factors(self) -> Float:
        """Dilation of each group (G,)."""
        if self.dilation is None:
            return np.ones(len(self.groups))
        return np.asarray(self.dilation[self.groups.exposure], float)

    def effective(self, theta: Float) -> Float:
        """Effective Legendre coefficients (..., G, 2, K), including the dilation."""
        out = self.model.effective(theta, self.groups)
        if self.dilation is None:
            return out
        o = np.asarray(self.model.origin)
        out = out * self._factors[:, None, None]
        out[..., 0] += o * (1.0 - self._factors[:, None])
        return out

    def effective_jacobian(self, theta: Float) -> list[tuple[Int, Float]]:
        """Derivatives of `effective` in the form of `DistortionModel.effective_jacobian`."""
        jacobian = self.model.effective_jacobian(theta, self.groups)
        return [(columns, k * d) for (columns, d), k in zip(jacobian, self._factors, strict=True)]

    def powers(self, theta: Float) -> Float:
        """Effective coefficients (..., G, 2, K) of the powers of X and Y."""
        basis = self.model.basis(self.model.chips[0].number)
        return basis.to_scaled_powers(self.effective(theta))

    def places(self, theta: Float) -> Float:
        """Position u, v (N, 2) of each detection on the sky, according to the model."""
        powers = self.powers(theta)
        with threads_for(len(self.X)):
            positions = kernel.positions(
                self.groups.index, self.X, self.Y, powers, self.model.order
            )
        return np.asarray(positions + self.offset)

    @cached_property
    def _half(self) -> Float:
        """Half the sides of the chip of each group in pixels, shape (G, 2)."""
        chips = [self.model.chips[c].number for c in self.groups.chip]
        return np.array([self.model.basis(chip).half_size for chip in chips])

    def jacobians(self, theta: Float, rows: slice) -> Float:
        """Derivatives (n, 2, 2) of sky positions with respect to pixels, at parameters theta (D,).

        `rows` is a slice with the n detections.
        """
        g = self.groups.index[rows]
        with threads_for(len(g)):
            by = kernel.slopes(g, self.X[rows], self.Y[rows], self.powers(theta), self.model.order)
        return np.asarray(by / self._half[g, None])

    def star_places(self, stars: Float) -> Float:
        """Position u, v (N, 2) of the star of each detection, at the date of the detection."""
        out = stars[self.star, :2]
        if self.n_star >= 4:
            out = out + stars[self.star, 2:4] * self.time[:, None]
        if self.n_star == 5:
            out = out + stars[self.star, 4:] * self.factor
        return np.asarray(out)

    def squares(self, theta: Float, stars: Float) -> Float:
        """Squared distances (N,) of detections from their stars, in square pixels."""
        r, W = self.places(theta) - self.star_places(stars), self.W
        return np.asarray(
            W[:, 0] * r[:, 0] ** 2 + 2 * W[:, 1] * r[:, 0] * r[:, 1] + W[:, 2] * r[:, 1] ** 2
        )

    def middles(self, theta: Float) -> Float:
        """Mean position u, v (S, 2) of the detections of each star."""
        return self._means(self.places(theta))

    def shifts(self, before: Float, after: Float) -> Float:
        """Mean shift (S, 2) of the detections of each star, if parameters (D,) change.

        `before` and `after` are the parameters before and after the change.
        """
        change = self.powers(after) - self.powers(before)
        with threads_for(len(self.X)):
            z = kernel.positions(self.groups.index, self.X, self.Y, change, self.model.order)
        return self._means(z)

    def _means(self, values: Float) -> Float:
        """Means (S, 2) of values (N, 2) over the detections of each star."""
        sums = [np.bincount(self.star, values[:, axis]) / self.counts for axis in (0, 1)]
        return np.stack(sums, axis=1)

    def mean_places(self, theta: Float) -> Float:
        """Stars (S, q) at the means of their detections, as the start of a search."""
        out = np.zeros((self.n_stars, self.n_star))
        out[:, :2] = self.middles(theta)
        return out

    def median_places(self, theta: Float) -> Float:
        """Stars (S, q) at the medians of their detections, which are robust against false ones."""
        out, z = np.zeros((self.n_stars, self.n_star)), self.places(theta)
        for axis in (0, 1):
            out[:, axis] = self.medians(z[:, axis])
        return out

    def medians(self, values: Float) -> Float:
        """Medians (S,) of values (N,) over the detections of each star."""
        return np.asarray(ndimage.median(values, self.star, np.arange(self.n_stars)))

    def found_again(self, theta: Float, stars: Float) -> Float:
        """Stars (S, q); those outside their match circle are reset to the mean detection."""
        middles = self.middles(theta)
        # position of the star averaged over the dates of its detections
        position = stars if self.n_star == 2 else self._means(self.star_places(stars))
        # the radius of the match circle, from the smallest curvature of a star
        reach = np.sqrt(2.0) / self.least_root
        lost = np.hypot(*(position - middles).T) > reach
        if not lost.any():
            return stars
        out = stars.copy()
        out[lost] = 0.0
        out[lost, :2] = middles[lost]
        return out

    def at(self, theta: Float, stars: Float) -> Problem:
        """Linearise the problem about a solution theta (D,) and stars (S, q)."""
        groups, half = self.groups, self._half
        places, powers = self.star_places(stars), self.powers(theta)
        with threads_for(5 * len(self.X)):
            X, Y, offset, W = kernel.linearised(
                groups.index,
                self.seen,
                self.X,
                self.Y,
                places,
                powers,
                half,
                self.model.order,
            )
        out = replace(self, X=X, Y=Y, offset=offset, W=W)
        if self.shape is None:
            return out
        back = np.linalg.inv(out.jacobians(theta, slice(0, len(X))))
        matrix = np.swapaxes(back, 1, 2) @ self.shape @ back
        return replace(out, W=matrix.reshape(-1, 4)[:, [0, 1, 3]])

    def of_stars(self, which: Int) -> Problem:
        """Problem with a subset of the stars, given by ascending indices `which`."""
        counts = self.counts[which]
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        rows = np.repeat(self.starts[which] - starts[:-1], counts) + np.arange(starts[-1])
        return replace(
            self,
            groups=replace(self.groups, index=self.groups.index[rows]),
            starts=starts,
            seen=self.seen[:, rows],
            X=self.X[rows],
            Y=self.Y[rows],
            offset=self.offset[rows],
            W=self.W[rows],
            var=self.var[rows],
            time=self.time[rows] if len(self.time) else self.time,
            factor=self.factor[rows] if len(self.factor) else self.factor,
            priors=StarPriors(self.priors.centre[which], self.priors.precision[which]),
            rows=self.rows[rows],
            shape=None if self.shape is None else self.shape[rows],
        )


def prepare(
    model: DistortionModel,
    detections: Detections,
    theta: Float,
    *,
    match_radius: float,
    motion: str = "none",
    parallax_factors: Float | None = None,
    dilation: Float | None = None,
    min_detections: int = MIN_DETECTIONS,
) -> Problem:
    """Sort detections by star and prepare the arrays for the passes.

    Detections without star codes, and stars with fewer than `min_detections` detections, are left
    out.

    Parameters
    ----------
    model : DistortionModel
        Its exposures must be those of the detections.
    detections : Detections
        Detections with star codes and errors.
    theta : ndarray, shape (D,)
        Parameters that are accurate enough for the size and shape of the pixels on the sky.
    match_radius : float
        Largest distance of a detection from its star in pixels.
    motion : str
        Key of `MOTIONS`, which determines the parameters of a star. Positions refer to the mean
        date of the exposures.
    parallax_factors : ndarray, shape (E, 2), optional
        Parallax factors along u and v; required for 'parallax'.
    dilation : ndarray, shape (E,), optional
        Factor of velocity aberration of each exposure.
    min_detections : int
        Minimum number of detections of a star.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        If no star has enough detections, or errors, dates or parallax factors are missing.
    """
    q = MOTIONS[motion]
    counts = np.bincount(detections.star[detections.star >= 0], minlength=1)
    used = (detections.star >= 0) & (counts[detections.star] >= max(min_detections, MIN_DETECTIONS))
    if not used.any():
        raise InputError(
            f"no star is detected {max(min_detections, MIN_DETECTIONS)} times",
            where=detections.source,
            do="give exposures that overlap, a better start (selfcal.initial_distortion) or a "
            "larger match radius",
        )
    if detections.sigma is None:
        raise InputError(
            "the detections have no errors", where=detections.source, do="give sigma in pixels"
        )
    rows = np.flatnonzero(used)
    rows = rows[np.argsort(detections.star[rows], kind="stable")]
    star = np.unique(detections.star[rows], return_inverse=True)[1]
    starts = np.concatenate([[0], np.cumsum(np.bincount(star))]).astype(np.int64)
    exposure, chip = detections.exposure[rows], detections.chip[rows]
    time, factor, when, epoch0 = np.zeros(0), np.zeros((0, 2)), None, 0.0
    if q > 2 or model.time is not None:
        if detections.epoch is None:
            raise InputError(
                "the exposures have no dates, but stars or the distortion move with time",
                where=detections.source,
                do="give an exposure log with epochs",
            )
        when = detections.epoch[exposure]
        epoch0 = float(np.mean(detections.epoch))
        time = when - epoch0 if q > 2 else time
    if q == MOTIONS["parallax"]:
        if parallax_factors is None:
            raise InputError("parallax needs its factors for each exposure", do="give them")
        factor = np.asarray(parallax_factors, float)[exposure]
    groups = model.groups(len(rows), epoch=when, exposure=exposure, chip=chip)
    X, Y = np.empty(len(rows)), np.empty(len(rows))
    for chip_model in model.chips:
        of_chip = chip == chip_model.number
        scaled = model.basis(chip_model.number).scaled(
            detections.x[rows[of_chip]], detections.y[rows[of_chip]]
        )
        X[of_chip], Y[of_chip] = scaled
    var, shape = detections.sigma[rows] ** 2, None
    covariances = detections.covariances
    if covariances is not None:
        var = np.sqrt(np.linalg.det(covariances[rows]))
        shape = np.asarray(var[:, None, None] * np.linalg.inv(covariances[rows]), float)
    problem = Problem(
        model=model,
        groups=groups,
        starts=starts,
        seen=np.stack([X, Y]),
        X=X,
        Y=Y,
        offset=np.zeros((len(rows), 2)),
        W=np.empty((0, 3)),
        var=var,
        time=time,
        factor=factor,
        priors=StarPriors.none(len(starts) - 1, q),
        rows=rows,
        match_radius=match_radius,
        pixel=np.nan,
        epoch0=epoch0,
        dates=None if detections.epoch is None else np.asarray(detections.epoch, float)[exposure],
        dilation=None if dilation is None else np.asarray(dilation, float),
        shape=shape,
    )
    problem = problem.at(theta, problem.mean_places(theta))
    uu, uv, vv = problem.W.T
    return replace(problem, pixel=float(np.median(uu * vv - uv**2) ** -0.25))


# -- tangent planes of the exposures, and their mapping to a common plane --------------------------


@dataclass(frozen=True, eq=False)
class TangentPlane:
    """Tangent plane of u and v that is common to all exposures.

    The tangent point of an exposure is the position of the first chip's reference pixel, so that
    the distortion depends neither on the detections nor on the order of the exposures.

    Parameters
    ----------
    unit_arcsec : float
        Unit of u and v in arcseconds.
    point : tuple of float, optional
        Tangent point of the common plane in u and v; by default the mean of those of the exposures.
    """

    unit_arcsec: float
    point: tuple[float, float] | None = None

    def contact(self, contacts: Float) -> Float:
        """Tangent point (2,) of the common plane, from the tangent points (E, 2) of the exposures.

        Both are positions u, v.
        """
        return contacts.mean(axis=0) if self.point is None else np.asarray(self.point, float)

    def displacements(self, flat: Float, touches: Float, contact: Float) -> Float:
        """Displacements from the tangent plane of an exposure to the common plane.

        Parameters
        ----------
        flat : ndarray, shape (N, 2)
            Positions according to the frame of the exposure, which are exact at its tangent point.
        touches : ndarray, shape (2,)
            Tangent point of the exposure.
        contact : ndarray, shape (2,)
            Tangent point of the common plane.

        Returns
        -------
        ndarray, shape (N, 2)
            Displacements in the unit of u and v.
        """
        radian = ARCSEC / self.unit_arcsec
        p = (touches - contact) / radian
        q = (flat - touches) / radian
        c = 1.0 / np.sqrt(1.0 + p @ p)
        s = c * p
        # the rotation along the great circle from one tangent point to the other
        along = (q @ s)[:, None]
        exact = (q - s * along / (1.0 + c) + s) / (c - along)
        return np.asarray(radian * (exact - p - q))

    def onto_it(self, model: DistortionModel, detections: Detections, theta: Float) -> Detections:
        """Move detections to the pixels where they would be if all exposures had this plane.

        Parameters
        ----------
        model : DistortionModel
        detections : Detections
            Observed detections.
        theta : ndarray, shape (D,)
            Parameters of a solution, which provide offsets and distortion.

        Returns
        -------
        Detections
            Detections at pixels that the model maps to the positions on the common plane.
        """
        flat = places_of(model, detections, theta)
        contacts = contacts_of(model, theta, detections.epoch)
        contact = self.contact(contacts)
        moved = np.empty_like(flat)
        for e, touches in enumerate(contacts):
            rows = detections.exposure == e
            moved[rows] = self.displacements(flat[rows], touches, contact)
        aim, out = flat + moved, detections
        slopes = model.slopes(theta, detections.x, detections.y, **_where(model, detections))
        back = np.linalg.inv(slopes)
        for _ in range(STEPS):
            step = np.einsum("nab,nb->na", back, aim - places_of(model, out, theta))
            out = replace(out, x=out.x + step[:, 0], y=out.y + step[:, 1])
        return out


def contacts_of(model: DistortionModel, theta: Float, epoch: Float | None = None) -> Float:
    """Tangent points (E, 2) of the exposures: positions of the first chip's reference pixel.

    `epoch` (E,) are the dates of the exposures, required by a model with drift.
    """
    E, chip = len(model.exposures), model.chips[0]
    x, y = (np.full(E, z) for z in chip.reference_pixel)
    when = None if model.time is None else epoch
    return model.predict(theta, x, y, exposure=np.arange(E), chip=chip.number, epoch=when)


def places_of(
    model: DistortionModel, detections: Detections, theta: Float, dilation: Float | None = None
) -> Float:
    """Sky position (N, 2) of each detection according to the model, in the unit of u and v.

    `dilation` (E,) is the scale of the sky in each exposure, about the origin of the frames.
    """
    out = model.predict(theta, detections.x, detections.y, **_where(model, detections))
    if dilation is None:
        return out
    o = np.asarray(model.origin)
    return np.asarray(o + (out - o) * dilation[detections.exposure, None])


def _where(model: DistortionModel, detections: Detections) -> dict[str, Any]:
    """Exposure, chip and epoch of each detection, as keyword arguments of `predict`."""
    when = None
    if model.time is not None and detections.epoch is not None:
        when = detections.epoch[detections.exposure]
    return {"exposure": detections.exposure, "chip": detections.chip, "epoch": when}
