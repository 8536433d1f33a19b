"""Fields of errors on the sky with a known angular covariance, as seen on a detector."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import Image, Pool, Row
from bayesdist.assess.terms.functions import FunctionField, Functions
from bayesdist.assess.terms.given import SMOOTH_DRAWS
from bayesdist.model import DistortionModel
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float

NODES = 12  # along u and v of the field, between which the field of errors is interpolated
MODES = 40  # functions that represent the field beyond its constant and tilt
# bands of finer structure, each a wave of a sine and a cosine: at least 12, and as many as their
# fraction of the variance times 100; wider ones than `BAND` are divided
MIN_WAVES, MAX_WAVES = 12, 100
BAND = 1.15  # largest ratio of the wavenumbers at the edges of a band
FINEST = 2e-5  # separation in units of the diameter of the field to which differences are exact
# ratio to the smallest wavenumber of the waves, beyond which each has the variance of its band
EXACT = 3.0
# scales in units of the diameter of the field: those outside are an error common to the field, or
# errors that are independent at any two positions
SCALES = (1e-9, 1e6)
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # directions of waves that are spread evenly


@dataclass(frozen=True)
class AngularCovariance:
    """Covariance of errors at two directions as a function of their separation.

    It is a sum of exponentials, V(theta) = sum of v exp(-theta / s), for each of the axes u and v,
    which are independent.
    """

    # variance v in mas^2 (per year^2 for motions) and scale s in degrees of each exponential
    parts: tuple[tuple[float, float], ...] = ()

    def __call__(self, separation: ArrayLike) -> Float:
        """Covariance in mas^2 at separations in degrees, of any shape."""
        theta = np.asarray(separation, float)
        out = np.zeros(theta.shape)
        for variance, scale in self.parts:
            out += variance * np.exp(-theta / scale)
        return out

    def __add__(self, other: AngularCovariance) -> AngularCovariance:
        return AngularCovariance((*self.parts, *other.parts))

    def times(self, factor: float) -> AngularCovariance:
        """Covariance multiplied by a factor."""
        return AngularCovariance(tuple((factor * v, scale) for v, scale in self.parts))

    @property
    def sigma(self) -> float:
        """Standard deviation of one error on one axis, in mas."""
        return math.sqrt(sum(variance for variance, _ in self.parts))

    def of_field(self, diameter: float) -> tuple[float, AngularCovariance]:
        """Variance that is common to a field, and the covariance that varies over it.

        `diameter` of the field in degrees.
        """
        shortest, longest = (factor * diameter for factor in SCALES)
        common = sum(variance for variance, scale in self.parts if scale > longest)
        varying = tuple((v, max(s, shortest)) for v, s in self.parts if s <= longest)
        return common, AngularCovariance(varying)

    def beyond(self, wavenumber: ArrayLike) -> Float:
        """Variance in structure with larger wavenumbers, in radians per degree, of any shape.

        In the plane exp(-theta / s) has the spectrum s^2 / (1 + k^2 s^2)^(3/2).
        """
        k = np.asarray(wavenumber, float)
        out = np.zeros(k.shape)
        for variance, scale in self.parts:
            out += variance / np.hypot(1.0, k * scale)
        return out

    def bands(self, smallest: float, n: int, largest: float) -> tuple[Float, Float]:
        """Wavenumbers (b,) of bands beyond the smallest, and the variance (b,) of each.

        Bands have at most 1/n of the variance beyond the smallest wavenumber, and reach to the
        largest in steps of at most `BAND`, so that differences at all separations down to its
        inverse have their variance.  The last band has no upper edge.
        """
        quantiles = np.arange(1, n + 1)[::-1] / n * self.beyond(smallest)
        # `beyond` is at most the sum of v / (k s)
        reach = 4.0 * n * sum(v / s for v, s in self.parts) / float(self.beyond(smallest))
        k = np.geomspace(smallest, max(reach, largest, 2.0 * smallest), 4000)
        falling = np.log(self.beyond(k))  # numpy interpolates over rising values
        edges = np.exp(np.interp(np.log(quantiles), falling[::-1], np.log(k)[::-1]))
        edges = np.append(edges, max(largest, BAND * edges[-1]))
        steps = [
            np.geomspace(low, high, max(1, math.ceil(math.log(high / low) / math.log(BAND))), False)
            for low, high in pairwise(edges)
        ]
        edges = np.append(np.concatenate(steps), edges[-1])
        middle = np.sqrt(edges * np.append(edges[1:], BAND * edges[-1]))
        return middle, -np.diff(self.beyond(edges), append=0.0)


class SplitField:
    """Gaussian field of errors on one axis, split into a constant and tilt, and the rest.

    The constant and tilt are the generalised least-squares estimate from the errors at nodes that
    cover the field, so that they are independent of the rest.  The rest is represented by the
    functions with the largest variance, and by waves for structure finer than these.  The sum has
    the stated variance everywhere, and the waves beyond `EXACT` that of the covariance, so that
    differences of close positions follow it.
    """

    def __init__(
        self, covariance: AngularCovariance, model: DistortionModel, mean: Float, mas: float
    ) -> None:
        """Prepare the functions; `mas` is one mas in the unit of u and v."""
        self.covariance, self.model, self._mean, self._mas = covariance, model, mean, mas
        edges = [self._sky(c.number, *mesh(*grid_pixels(c.size, (5, 5)))) for c in model.chips]
        low, high = (f(np.concatenate(edges), axis=0) for f in (np.min, np.max))
        self._centre, self._half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-12)
        side = np.linspace(-1.0, 1.0, NODES)
        unit_nodes = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        self._nodes = self._centre + self._half * unit_nodes
        common, self._varying = covariance.of_field(2.0 * float(np.hypot(*self._half)))
        self._tilt = np.diag([mas * math.sqrt(common), 0.0, 0.0])
        if self._varying.parts:
            self._divide(common)

    def _divide(self, common: float) -> None:
        """Prepare the constant and tilt, the functions and the waves; `common` in mas^2."""
        K = self._mas**2 * self._varying(cdist(self._nodes, self._nodes))
        self._factor = cho_factor(K)
        B = self._plane(self._nodes)
        S = np.linalg.inv(B.T @ cho_solve(self._factor, B))
        S = (S + S.T) / 2.0
        root = B @ np.linalg.cholesky(S)
        S[0, 0] += self._mas**2 * common
        self._tilt = np.linalg.cholesky(S)
        values, vectors = np.linalg.eigh(K - root @ root.T)
        largest = np.argsort(values)[::-1][:MODES]
        self._modes = cho_solve(
            self._factor, vectors[:, largest] * np.sqrt(np.maximum(values[largest], 0.0))
        )
        smallest = np.pi * math.sqrt(MODES) / (2.0 * self._half.mean())
        share = float(self._varying.beyond(smallest)) / self._varying.sigma**2
        n = max(MIN_WAVES, math.ceil(MAX_WAVES * share))
        finest = 1.0 / (FINEST * 2.0 * float(np.hypot(*self._half)))
        k, variance = self._varying.bands(smallest, n, finest)
        angle = GOLDEN_ANGLE * np.arange(len(k))
        self._waves = k * np.stack([np.cos(angle), np.sin(angle)])
        self._of_waves = self._mas**2 * variance
        self._exact = k > EXACT * smallest

    @property
    def n_rest(self) -> int:
        """Number of functions of the rest, of value 0 if the errors are common to the field."""
        return MODES + 2 * self._waves.shape[1] if self._varying.parts else 1

    def _sky(self, chip: int, x: Float, y: Float) -> Float:
        """Positions (N, 2) on the sky in degrees, of pixels (N,) on a chip."""
        epoch = None if self.model.time is None else self.model.time.epoch0[0]
        place = place_of(self.model, epoch=epoch, chip=chip)
        uv = place.basis.evaluate(x, y) @ place.polynomial(self._mean).T
        return np.asarray(uv / (3.6e6 * self._mas))

    def _plane(self, sky: Float) -> Float:
        """Constant and tilts (N, 3) at positions (N, 2)."""
        return np.column_stack([np.ones(len(sky)), (sky - self._centre) / self._half])

    def tilt(self, chip: int, x: Float, y: Float) -> Float:
        """Values (N, 3) of functions whose coefficients have unit variance: constant and tilt."""
        return np.asarray(self._plane(self._sky(chip, x, y)) @ self._tilt)

    def rest(self, chip: int, x: Float, y: Float) -> Float:
        """Values (N, m) of functions whose coefficients have unit variance: the rest."""
        if not self._varying.parts:
            return np.zeros((len(x), 1))
        sky = self._sky(chip, x, y)
        phi = self._mas**2 * self._varying(cdist(sky, self._nodes)) @ self._modes
        common = np.square(self._plane(sky) @ self._tilt).sum(axis=1)
        variance = np.maximum((self._mas * self.covariance.sigma) ** 2 - common, 0.0)
        # variance (N, waves): that of the covariance for fine waves, and the rest for the others
        exact = float(self._of_waves[self._exact].sum())
        others = np.where(self._exact, 0.0, self._of_waves)
        fine = np.minimum(variance / exact, 1.0)[:, None] * np.where(
            self._exact, self._of_waves, 0.0
        )
        variance = np.maximum(variance - exact, 0.0)
        size = np.square(phi).sum(axis=1)
        # near nodes the functions may have more than there is
        phi *= np.sqrt(np.minimum(variance / np.where(size > 0, size, 1.0), 1.0))[:, None]
        fine += np.maximum(variance - size, 0.0)[:, None] * others / others.sum()
        amplitude, phase = np.sqrt(fine), sky @ self._waves
        return np.hstack([phi, amplitude * np.cos(phase), amplitude * np.sin(phase)])


@dataclass(frozen=True, eq=False)
class SkyTerm:
    """One part of a catalogue's field of errors."""

    row: Row
    split: SplitField
    is_tilt: bool  # True for the constant and tilt, False for the rest
    epoch: float | None = None  # epoch of the catalogue, for errors of motions; None for positions
    date: float | None = None  # of the exposures; None for the date of the evaluation

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the part."""
        return (self.row,)

    def draw(self, n: int, rng: np.random.Generator) -> Functions | GrowingFunctions:
        """Draws of independent coefficients for u and v."""
        functions = self.split.tilt if self.is_tilt else self.split.rest
        n_own, m = min(n, SMOOTH_DRAWS), 3 if self.is_tilt else self.split.n_rest
        out = Functions(
            self.row,
            {None: rng.standard_normal((n_own, 2, m))},
            functions,
            n,
            covariance={None: np.tile(np.eye(m), (2, 1, 1))},
            pools=(Pool(np.arange(n) % n_own, n_own, renewed=True),),
        )
        return out if self.epoch is None else GrowingFunctions(out, self.epoch, self.date)


@dataclass(frozen=True, eq=False)
class GrowingFunctions:
    """Errors proportional to the time since the epoch of a catalogue."""

    per_year: Functions
    epoch: float  # decimal years
    date: float | None  # see `SkyTerm`
    _cache: dict[float, Functions] = field(default_factory=dict, repr=False)

    @property
    def pools(self) -> tuple[Pool, ...]:
        """Finite sets from which the coefficients are taken."""
        return self.per_year.pools

    def on(self, domain: EvaluationDomain, image: Image) -> FunctionField:
        """Errors at the positions and the epoch of a domain."""
        date = domain.epoch if self.date is None else self.date
        years = 0.0 if date is None else date - self.epoch
        if years not in self._cache:
            self._cache.clear()  # as in `Functions.on`
            of = self.per_year
            self._cache[years] = replace(
                of,
                coefficients={k: years * c for k, c in of.coefficients.items()},
                covariance={k: years**2 * c for k, c in (of.covariance or {}).items()},
                _cache={},
                _absorbed={},
            )
        return self._cache[years].on(domain, image)
