"""Detections sorted by star, with all arrays that a pass over them needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from bayesdist.data.detections import Detections
from bayesdist.errors import InputError
from bayesdist.infer import kernel
from bayesdist.infer.kernel.blocks import threads_for
from bayesdist.model import DistortionModel
from bayesdist.model.grouping import Groups
from bayesdist.utils.arrays import Bool, Float, Int

MIN_DETECTIONS = 2  # of a star that gives information about the distortion
MOTIONS = {"none": 2, "proper_motion": 4, "parallax": 5}
# precision, in the unit of u, v, that makes a star's matrix positive and is no information
VAGUE = 1e-12


@dataclass(frozen=True, eq=False)
class StarPriors:
    """Gaussian priors of the stars: reference stars with their errors."""

    centre: Float
    precision: Float  # (S, q, q) zero for stars without a prior

    @classmethod
    def none(cls, n: int, q: int) -> StarPriors:
        """Priors without information on any star."""
        return cls(np.zeros((n, q)), np.tile(VAGUE * np.eye(q), (n, 1, 1)))

    @property
    def informed(self) -> Bool:
        """Boolean mask (S,) of stars with a prior."""
        return np.asarray(np.trace(self.precision, axis1=1, axis2=2) > 10 * VAGUE)


@dataclass(frozen=True, eq=False)
class Problem:
    """Detections sorted by star."""

    model: DistortionModel
    groups: Groups  # of equal effective coefficients; `index` is that of each detection here
    starts: Int  # first detection (S + 1,) of each star
    seen: Float  # scaled positions (2, N) of the detections
    # scaled position (N,) of the star by a current solution, at which the model is evaluated
    X: Float
    Y: Float
    offset: Float  # (N, 2) from there to the detection, on the sky
    # (N, 3) uu, uv, vv of the matrix that converts residuals on the sky into squared pixels
    W: Float
    var: Float  # square (N,) of the quoted errors, square pixels
    time: Float  # years (N,) since `epoch0`; empty where stars do not move
    factor: Float  # parallax factors (N, 2); empty without parallax
    priors: StarPriors
    rows: Int  # input row (N,) of each detection
    match_radius: float  # pixels: largest distance of detections of one star, and of false ones
    pixel: float  # median size of a pixel on the sky at the start, in the unit of u, v
    epoch0: float = 0.0  # date of the stars' positions
    # known scale (E,) of the sky in each exposure, about the frames' origin: VAFACTOR
    dilation: Float | None = None

    def __len__(self) -> int:
        return len(self.X)

    @property
    def columns(self) -> tuple[Int | Float, ...]:
        """Arrays of detections and stars for the compiled passes, in their order."""
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
        """Number of parameters of a star."""
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
        """Log density of a false detection per square pixel, without the fraction of such."""
        return -float(np.log(np.pi * self.match_radius**2))

    @property
    def least_root(self) -> float:
        """Root of the curvature of a star whose position is unknown within its match circle."""
        return float(np.sqrt(2.0) / (self.match_radius * self.pixel))

    @cached_property
    def sigma(self) -> float:
        """Median quoted error, pixels."""
        return float(np.sqrt(np.median(self.var)))

    @cached_property
    def _factors(self) -> Float:
        """Dilation of each group (G,)."""
        if self.dilation is None:
            return np.ones(len(self.groups))
        return np.asarray(self.dilation[self.groups.exposure], float)

    def effective(self, theta: Float) -> Float:
        """Effective Legendre coefficients (..., G, 2, K), the sky's dilation included."""
        out = self.model.effective(theta, self.groups)
        if self.dilation is None:
            return out
        o = np.asarray(self.model.origin)
        out = out * self._factors[:, None, None]
        out[..., 0] += o * (1.0 - self._factors[:, None])
        return out

    def effective_jacobian(self, theta: Float) -> list[tuple[Int, Float]]:
        """Derivatives of `effective`, as in `DistortionModel.effective_jacobian`."""
        found = self.model.effective_jacobian(theta, self.groups)
        return [(columns, k * d) for (columns, d), k in zip(found, self._factors, strict=True)]

    def powers(self, theta: Float) -> Float:
        """Effective coefficients (..., G, 2, K) of the scaled powers."""
        basis = self.model.basis(self.model.chips[0].number)
        return basis.to_scaled_powers(self.effective(theta))

    def places(self, theta: Float) -> Float:
        """Sky position (N, 2) of each detection by the model."""
        powers = self.powers(theta)
        with threads_for(len(self.X)):
            found = kernel.positions(self.groups.index, self.X, self.Y, powers, self.model.order)
        return np.asarray(found + self.offset)

    @cached_property
    def _half(self) -> Float:
        """Half the detector's sides in pixels, of each group (G, 2)."""
        chips = [self.model.chips[c].number for c in self.groups.chip]
        return np.array([self.model.basis(chip).half_size for chip in chips])

    def jacobians(self, theta: Float, rows: slice) -> Float:
        """Derivatives (n, 2, 2) of positions of some detections by their pixels."""
        g = self.groups.index[rows]
        with threads_for(len(g)):
            by = kernel.slopes(g, self.X[rows], self.Y[rows], self.powers(theta), self.model.order)
        return np.asarray(by / self._half[g, None])

    def star_places(self, stars: Float) -> Float:
        """Sky position (N, 2) of the star of each detection at its date."""
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
        """Mean position (S, 2) of each star's detections."""
        return self._means(self.places(theta))

    def shifts(self, before: Float, after: Float) -> Float:
        """Mean shift (S, 2) of each star's detections from parameters (D,) to others."""
        change = self.powers(after) - self.powers(before)
        with threads_for(len(self.X)):
            z = kernel.positions(self.groups.index, self.X, self.Y, change, self.model.order)
        return self._means(z)

    def _means(self, values: Float) -> Float:
        """Means (S, 2) of numbers (N, 2) over the detections of each star."""
        sums = [np.bincount(self.star, values[:, axis]) / self.counts for axis in (0, 1)]
        return np.stack(sums, axis=1)

    def mean_places(self, theta: Float) -> Float:
        """Stars (S, q) at the means of their detections, as start of a search."""
        out = np.zeros((self.n_stars, self.n_star))
        out[:, :2] = self.middles(theta)
        return out

    def median_places(self, theta: Float) -> Float:
        """Stars (S, q) at the medians of their detections, which a few false ones do not move."""
        out, z = np.zeros((self.n_stars, self.n_star)), self.places(theta)
        for axis in (0, 1):
            out[:, axis] = self.medians(z[:, axis])
        return out

    def medians(self, values: Float) -> Float:
        """Medians (S,) of numbers (N,) over the detections of each star."""
        return np.asarray(ndimage.median(values, self.star, np.arange(self.n_stars)))

    def found_again(self, theta: Float, stars: Float) -> Float:
        """Stars (S, q), those far from all their detections moved back to the mean of these."""
        middles = self.middles(theta)
        # of stars at rest their position
        own = stars if self.n_star == 2 else self._means(self.star_places(stars))
        # the match circle, for which a star's least curvature stands, limits its offset
        reach = np.sqrt(2.0) / self.least_root
        lost = np.hypot(*(own - middles).T) > reach
        if not lost.any():
            return stars
        out = stars.copy()
        out[lost] = 0.0
        out[lost, :2] = middles[lost]
        return out

    def at(self, theta: Float, stars: Float) -> Problem:
        """Problem linearised about a solution: theta (D,) and stars (S, q)."""
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
        return replace(self, X=X, Y=Y, offset=offset, W=W)

    def of_stars(self, which: Int) -> Problem:
        """Problem with some of the stars only, by their numbers in ascending order."""
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
    """Problem from detections, sorted for the passes.

    Detections without star codes, and stars with fewer than `min_detections`, are left out; the
    model's exposures are those of the detections.  `theta` is good enough for the size and shape of
    pixels on the sky; `match_radius` is in pixels; `motion`, one of `MOTIONS`, gives the parameters
    of a star, whose position is that at the mean date of the exposures; `parallax_factors` (E, 2),
    along u and v, are needed by 'parallax'; `dilation` (E,) is VAFACTOR.

    InputError when no star is left, for a motion without dates, or parallax without factors.
    """
    q = MOTIONS[motion]
    counts = np.bincount(detections.star[detections.star >= 0], minlength=1)
    used = (detections.star >= 0) & (counts[detections.star] >= max(min_detections, MIN_DETECTIONS))
    if not used.any():
        raise InputError(
            f"no star is seen {max(min_detections, MIN_DETECTIONS)} times",
            where=detections.source,
            do="give exposures that overlap, a better start (selfcal.initial_distortion) or a "
            "larger match radius",
        )
    if detections.sigma is None:
        raise InputError(
            "the detections carry no errors", where=detections.source, do="give sigma in pixels"
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
                "the exposures have no dates, and stars or detector move",
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
    for one in model.chips:
        of_chip = chip == one.number
        scaled = model.basis(one.number).scaled(
            detections.x[rows[of_chip]], detections.y[rows[of_chip]]
        )
        X[of_chip], Y[of_chip] = scaled
    problem = Problem(
        model=model,
        groups=groups,
        starts=starts,
        seen=np.stack([X, Y]),
        X=X,
        Y=Y,
        offset=np.zeros((len(rows), 2)),
        W=np.empty((0, 3)),
        var=detections.sigma[rows] ** 2,
        time=time,
        factor=factor,
        priors=StarPriors.none(len(starts) - 1, q),
        rows=rows,
        match_radius=match_radius,
        pixel=np.nan,
        epoch0=epoch0,
        dilation=None if dilation is None else np.asarray(dilation, float),
    )
    problem = problem.at(theta, problem.mean_places(theta))
    uu, uv, vv = problem.W.T
    return replace(problem, pixel=float(np.median(uu * vv - uv**2) ** -0.25))
