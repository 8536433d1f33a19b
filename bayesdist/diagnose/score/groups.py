"""Test for a group of stars that is displaced as a whole: do the residuals have two centres?

Residuals r of stars with covariances C are described by a mixture of the stars that the solution
describes, of a group that is displaced from these by a common vector on the sky, and of false
matches with a wide scatter:

    f1(r) = (1 - f) sum_k w_k [(1 - p) N(r; a, s_k^2 K) + p N(r; a + d, s_k^2 K)] + f N_wide(r)

K is C^(1/2) S C^(1/2) with one matrix S for all stars, which corrects errors that are wrong by a
factor or along an axis.  The factors s_k allow for tails and for errors that differ from star to
star.  If it is much more likely, S of the group differs from that of the others, as the motions of
single stars make it.

The share p of the group may also vary over the field, as it does if visits with different pointing
or fields of view have been merged:

    logit p = b_0 + b_1 X + b_2 Y

The solution then follows the mean displacement p d, so that the centres of both parts are those
above minus (p - p_0) d, where p_0 is p at X = Y = 0.

The alternative is noise about a single centre, with the same false matches: any elliptical
distribution in units of the errors (Student's t, errors that are wrong by various factors, matches
that were cut at a radius in units of their errors), two such distributions of different shapes,
with fractions that may vary over the field, normal errors that were cut at a radius in pixels, and
normal errors of positions that were rounded afterwards.  Wherever errors differ from star to star,
both descriptions may take equal ones, or the stated ones without a common part, since errors that
were estimated from the residuals and a fitted jitter include the displacement.

Twice the logarithm of the ratio of both likelihoods is compared with chi-square of `GROUP_DOF`
degrees of freedom, and two more if p varies.  The noise has more freedom than the mixture without
its group, so that the ratio is mostly below one where there is no group; the parameters of the
group do not have a chi-square distribution themselves, because p = 0 and d = 0 are the same.  Fits
of simulated noise show that the p-values are larger than chance (docs/validation.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit, ndtr

from bayesdist.diagnose.score.missing_orders import ChipResiduals, rotations
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.statistics import sums_over
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_sf

MAX_STARS = 6000  # that are examined
MIN_STARS = 100
# Stars that the search for a group uses, and passes over them. Unless it raises the log-likelihood
# by `LEAST_GAIN` there is no result, as for most residuals without a group.
SEARCH_STARS = 600
SEARCH_PASSES = 8
START_PASSES = 5  # over those with which it compares where it may begin
LEAST_GAIN = 3.0
LEAST_OF_OWN = 3.0  # gain in log-likelihood for which the group has a matrix S of its own
MORE_LIKELY = 1.5  # factor by which a varying share must raise the gain in log-likelihood
GROUP_DOF = 8  # of the chi-square distribution that bounds twice the gain; see above
START_SLOPE = 2.0  # of logit p, from which fits of a varying share begin
LARGEST_LOGIT = 6.0  # of p at the centre, and of its slopes
PASSES = 40
SCALES = np.array([0.45, 0.7, 1.0, 1.5, 2.4])  # s_k
WIDE = 4.0  # smallest scatter of false matches, in typical errors
MOST_WIDE = 0.6  # largest fraction of false matches
# of the elliptical distribution: bins of the radius, at most, and stars in each at least
RADIAL_BINS = 14
STARS_PER_BIN = 40
RADIAL_PASSES = 6
UNEQUAL = 1.3  # ratio of the errors of single stars beyond which other errors are tried as well
JITTERS = (0.1, 0.3, 1.0, 3.0, 10.0)  # squared, in typical variances; see `_with_jitter`
COMMON = 0.8  # fraction of the smallest variance that may be caused by the displacement itself
AXES = ((0, 0), (0, 1), (1, 1))
TINY = 1e-300


@dataclass(frozen=True)
class DisplacedGroup:
    """Stars that are displaced from the others as a whole, and the probability of chance."""

    p_value: float
    share: float  # at most 0.5
    share_sigma: float  # its standard error
    shift: tuple[float, float]  # from the larger group to the smaller one, along u and v
    shift_sigma: tuple[float, float]
    separation: float  # its length in units of the scatter of the larger group along it
    # shares that 5 % and 95 % of the stars have, if the share varies over the field
    between: tuple[float, float] | None = None

    def sentence(self, unit: str) -> str:
        """Clause on the share of the stars and their displacement in the unit of u and v."""
        along = [_with_error(*pair) for pair in zip(self.shift, self.shift_sigma, strict=True)]
        varies = ""
        if self.between is not None:
            low, high = (f"{100 * share:.0f}" for share in self.between)
            varies = f" (from {low} to {high} % over the field)"
        return (
            "a part of the stars is displaced from the others as a whole: "
            f"{_with_error(100 * self.share, 100 * self.share_sigma)} % of them{varies} by "
            f"{along[0]} {unit} along u and {along[1]} {unit} along v"
        )

    @property
    def distance(self) -> float:
        """Length of the displacement."""
        return float(np.hypot(*self.shift))


def _with_error(value: float, sigma: float) -> str:
    """Number and its standard error, with two significant digits of the latter."""
    digits = max(0, 1 - int(np.floor(np.log10(max(sigma, TINY)))))
    return f"{value:.{digits}f} +- {sigma:.{digits}f}"


def displaced_group(
    sample: ScoredSample, chips: Sequence[ChipResiduals], terms_up_to: int
) -> DisplacedGroup | None:
    """Search for a displaced group of stars.

    Parameters
    ----------
    sample : ScoredSample
    chips : sequence of ChipResiduals
        Residuals of the sample, per chip.
    terms_up_to : int
        Order above that of the model up to which polynomials are subtracted from the residuals, as
        far as there are enough stars.

    Returns
    -------
    DisplacedGroup or None
        None if there are too few stars, or nothing like a group.
    """
    residual, covariance, position = _by_star(sample, chips, terms_up_to)
    n = residual.shape[1]
    if n < MIN_STARS or not np.median((residual**2).sum(axis=0)) > TINY:
        return None
    order = np.random.default_rng(1).permutation(n)[:MAX_STARS]
    residual, covariance, position = residual[:, order], covariance[:, order], position[:, order]
    possible = [_Stars.of(residual, errors, position) for errors in _possible_errors(covariance)]
    # the last errors, between the stated and equal ones, are tried only where these show a group
    searched = [_searched(stars) for stars in possible[:2]]
    if not max(s.likelihood for s in searched) >= max(s.noise for s in searched) + LEAST_GAIN:
        return None
    searched += [_searched(stars) for stars in possible[2:]]
    found = [(stars, m) for stars, s in zip(possible, searched, strict=True) for m in s.mixtures]
    further = [] if len(possible) == 1 else _with_jitter(residual, covariance, position)
    return _tested(found, further)


def _by_star(
    sample: ScoredSample, chips: Sequence[ChipResiduals], terms_up_to: int
) -> tuple[Float, Float, Float]:
    """Mean residuals (2, n) of single stars along u and v, their covariances (3, n) and places.

    The elements of the covariances are uu, uv and vv. The places (2, n) are X and Y on the chip.
    """
    residuals, covariances, places = [np.zeros((2, 0))], [np.zeros((3, 0))], [np.zeros((2, 0))]
    for chip in chips:
        part, most = chip, MAX_STARS // len(chips)
        if chip.n_stars > most:
            kept = np.random.default_rng(1).permutation(chip.n_stars) < most
            part = chip.at(np.flatnonzero(kept[chip.star]))
        rows = part.rows
        turn = rotations(sample.turn[rows])
        along = np.einsum("nji,jn->in", turn, sample.residual[:, rows])
        part = replace(part, z=along / part.error, per_error=True)
        rest = part.without_terms(part.orders(part.order + terms_up_to)[-1])
        residual = np.einsum("nij,jn->in", turn, rest.z * part.error)
        uu, vv = sample.variance[:, rows]
        uv = np.zeros(len(rows)) if sample.covariance is None else sample.covariance[rows]
        covariance = np.stack([uu, uv, vv])
        place = np.stack([part.X, part.Y])
        if part.n_stars < len(rows):
            weight = 1.0 / (uu + vv)
            total = np.bincount(part.star, weight)
            residual = sums_over(part.star, (weight * residual).T).T / total
            # as if detections were independent: a common error is a factor s_k
            covariance = sums_over(part.star, (weight**2 * covariance).T).T / total**2
            place = sums_over(part.star, (weight * place).T).T / total
        residuals.append(residual)
        covariances.append(covariance)
        places.append(place)
    residual, covariance, place = (
        np.concatenate(several, axis=1) for several in (residuals, covariances, places)
    )
    return residual, covariance, place


def _possible_errors(covariance: Float) -> Iterator[Float]:
    """Covariances (3, n) that stars may have without the displacement of some of them.

    Errors that were estimated from the residuals, and a fitted jitter, include the displacement.
    """
    yield covariance
    uu, uv, vv = covariance
    low, high = np.sqrt(np.quantile(uu + vv, [0.05, 0.95]))
    if high < UNEQUAL * low:
        return
    yield np.broadcast_to(np.median(covariance, axis=1)[:, None], covariance.shape)
    least = (uu + vv - np.hypot(uu - vv, 2 * uv)) / 2  # smaller eigenvalue
    common = COMMON * np.minimum(least, np.quantile(least, 0.02))
    yield covariance - np.array([1.0, 0.0, 1.0])[:, None] * common


@dataclass(frozen=True, eq=False)
class _Stars:
    """Residuals of stars, and their whitening."""

    residual: Float  # (2, n)
    whitening: Float  # (3, n) elements uu, uv, vv of the inverse roots of the covariances
    z: Float  # (2, n) whitened residuals
    log_det: Float  # (n,) logarithm of the determinant of the whitening
    position: Float  # (2, n) X and Y on the chip
    typical: float  # median error per axis

    @classmethod
    def of(cls, residual: Float, covariance: Float, position: Float) -> _Stars:
        """Build from residuals (2, n), the elements (3, n) of their covariances, and X and Y."""
        uu, uv, vv = covariance
        # root of a symmetric 2 x 2 matrix C: (C + d) / t, with d^2 = |C| and t^2 = trace + 2 d
        d = np.sqrt(np.maximum(uu * vv - uv**2, TINY))
        t = np.sqrt(uu + vv + 2 * d)
        whitening = np.stack([vv + d, -uv, uu + d]) / (d * t)
        z = _product(whitening, residual)
        typical = float(np.sqrt(np.median(uu + vv) / 2))
        return cls(residual, whitening, z, -np.log(d), position, typical)

    def at(self, rows: slice) -> _Stars:
        """Subset of the stars."""
        columns = (self.residual, self.whitening, self.z, self.log_det, self.position)
        residual, whitening, z, log_det, position = (column[..., rows] for column in columns)
        return _Stars(residual, whitening, z, log_det, position, self.typical)


class _Mixture(NamedTuple):
    """Parameters of B mixtures."""

    share: Float  # (B,) p, at X = Y = 0 if it varies
    slope: Float  # (B, 2) of logit p along X and Y
    centre: Float  # (B, 2, 2) of the stars and of the displaced group, along u and v
    shape: Float  # (B, 2, 2, 2) S of both
    scales: Float  # (B, k) weights w_k
    false: Float  # (B,) f
    wide_centre: Float  # (B, 2)
    wide: Float  # (B,) variance per axis of false matches, in the unit of u and v

    def best(self, k: int) -> _Mixture:
        """The k-th mixture alone."""
        return _Mixture(*(parameter[k : k + 1] for parameter in self))

    def repeated(self, n: int) -> _Mixture:
        """A single mixture n times."""
        return _Mixture(*(np.repeat(parameter, n, axis=0) for parameter in self))

    @property
    def varies(self) -> bool:
        """True if the share of the groups varies over the field."""
        return bool(self.slope.any())

    @property
    def shift(self) -> Float:
        """Displacements (B, 2) of the groups along u and v."""
        return np.asarray(self.centre[:, 1] - self.centre[:, 0])

    def shares(self, position: Float) -> Float:
        """Shares (B, n) of the groups at X and Y (2, n), or (B, 1) if they do not vary."""
        if not self.varies:
            return self.share[:, None]
        return np.asarray(expit(logit(self.share)[:, None] + self.slope @ position))


def _single(stars: _Stars, n_scales: int) -> _Mixture:
    """Mixture with a single centre from which fits start."""
    z = stars.z
    square = (z**2).sum(axis=0)
    scatter = float(np.median(square)) / (2 * np.log(2))
    weight = np.exp(-square / (2 * 16 * scatter))
    shape = (weight * z) @ z.T / weight.sum()
    return _Mixture(
        np.zeros(1),
        np.zeros((1, 2)),
        np.zeros((1, 2, 2)),
        np.stack([shape, shape])[None],
        np.full((1, n_scales), 1.0 / n_scales),
        np.full(1, 0.05),
        np.zeros((1, 2)),
        np.full(1, (10 * stars.typical) ** 2 * max(scatter, 1.0)),
    )


class _Searched(NamedTuple):
    """Mixtures with which a search ends, whose errors are Gaussian, and log-likelihoods."""

    mixtures: tuple[_Mixture, _Mixture]  # with one share, and with one that varies
    likelihood: float  # of the better one
    noise: float  # of an elliptical distribution about a single centre


def _searched(stars: _Stars) -> _Searched:
    """Best of many mixtures whose share is the same everywhere, and of those whose share varies."""
    unit, every = np.ones(1), stars
    single = _fitted(every, _single(every, 1), unit, SEARCH_PASSES, one_centre=True)
    stars = every.at(slice(0, SEARCH_STARS))
    total = single.shape[0, 0]
    root = np.linalg.cholesky(total)
    angle = np.arange(8) * np.pi / 4
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # in units of the total scatter: share, distance, number of directions, slopes of the share
    one = [(0.0, 0.0)]
    rising = [(START_SLOPE, 0.0), (-START_SLOPE, 0.0), (0.0, START_SLOPE), (0.0, -START_SLOPE)]
    starts = [(0.5, 1.7, 4, one), (0.25, 2.5, 8, one), (0.12, 4.5, 8, one), (0.5, 2.0, 4, rising)]
    share = np.concatenate([np.full(n * len(slopes), p) for p, _, n, slopes in starts])
    shift = np.concatenate([np.tile(d * ways[:n], (len(slopes), 1)) for _, d, n, slopes in starts])
    slope = np.concatenate([np.repeat(slopes, n, axis=0) for _, _, n, slopes in starts])
    whitening = _matrices(*np.median(stars.whitening, axis=1))
    along = shift @ root.T  # whitened
    shift = along @ np.linalg.inv(whitening)
    before = share[:, None] * shift
    centre = single.centre + np.stack([-before, shift - before], axis=1)
    # the scatter of the stars without that of the displacement
    of_shift = (share * (1 - share))[:, None, None] * along[:, :, None] * along[:, None]
    values, vectors = np.linalg.eigh(total - of_shift)
    least = 0.1 * np.trace(total) / 2
    shape = (vectors * np.maximum(values, least)[:, None]) @ np.swapaxes(vectors, 1, 2)
    B = len(share)
    start = _Mixture(
        share,
        slope,
        centre,
        np.stack([shape, shape], axis=1),
        np.ones((B, 1)),
        np.repeat(single.false, B),
        np.repeat(single.wide_centre, B, axis=0),
        np.repeat(single.wide, B),
    )
    varies = slope.any(axis=1)
    best = []
    for these in (~varies, varies):
        several = _Mixture(*(parameter[these] for parameter in start))
        fits = _fitted(stars, several, unit, START_PASSES)
        density = _log_density(stars, fits, unit).sum(axis=1)
        likeliest = fits.best(int(np.argmax(np.nan_to_num(density, nan=-np.inf))))
        best.append(_fitted(every, likeliest, unit, SEARCH_PASSES))
    likelihood = max(float(_log_density(every, fit, unit).sum()) for fit in best)
    return _Searched((best[0], best[1]), likelihood, _elliptical(every, single, unit))


def _with_jitter(residual: Float, covariance: Float, position: Float) -> list[_Stars]:
    """Stars with an error that is common to all in addition to the stated ones, of several sizes.

    Two groups add to errors in the same way: more, in units of the stated ones, where these are
    small.
    """
    typical = float(np.median(covariance[0] + covariance[2])) / 2
    round_error = np.array([1.0, 0.0, 1.0])[:, None] * typical
    return [_Stars.of(residual, covariance + factor * round_error, position) for factor in JITTERS]


def _tested(found: list[tuple[_Stars, _Mixture]], further: list[_Stars]) -> DisplacedGroup:
    """Test of the mixtures, each for other errors of the same stars, and estimate of the group.

    The noise may have `further` errors as well.
    """
    n_scales = len(SCALES)
    weights = np.full((1, n_scales), 0.1 / (n_scales - 1))
    weights[0, int(np.argmin(np.abs(SCALES - 1.0)))] = 0.9
    single = max((next(_noise(stars)) for stars in further), default=-np.inf)
    fits: list[tuple[_Stars, _Mixture, float]] = []
    for stars, start in found:
        if not fits or fits[-1][0] is not stars:
            single = max(single, *_noise(stars))
        fit = _fitted(stars, start._replace(scales=weights), SCALES, PASSES)
        # the same mixture about one centre, so that the noise is not only further from its maximum
        middle = (1 - fit.share[0]) * fit.centre[:, :1] + fit.share[0] * fit.centre[:, 1:]
        merged = fit._replace(centre=np.repeat(middle, 2, axis=1))
        merged = _fitted(stars, merged, SCALES, PASSES, one_centre=True)
        single = max(single, _elliptical(stars, merged, SCALES))
        likelihood = float(_log_density(stars, fit, SCALES).sum())
        fits.append((stars, fit, likelihood))
    # The solution also follows the chance fluctuations of the share, as one that varies does.
    stars, fit, likelihood = max(
        fits, key=lambda found: (found[2] - single) / (MORE_LIKELY if found[1].varies else 1.0)
    )
    gain = max(likelihood - single, 0.0)
    p_value = len(fits) * float(chi2_sf(2 * gain, GROUP_DOF + 2 * fit.varies))
    own = _fitted(stars, fit, SCALES, PASSES // 2, shapes=True)
    if _log_density(stars, own, SCALES).sum() > likelihood + LEAST_OF_OWN:
        fit = own
    return _described(stars, fit, min(1.0, p_value))


def _noise(stars: _Stars) -> Iterator[float]:
    """Largest log-likelihoods of several kinds of noise about a single centre."""
    start = _single(stars, len(SCALES))
    alone = _fitted(stars, start, SCALES, PASSES, one_centre=True)
    yield _elliptical(stars, alone, SCALES)
    # errors that differ along both axes, from star to star
    shape = alone.shape[0, 0]
    u, v = np.linalg.eigh(shape)[1].T
    starts = [np.stack([2.0 * shape, 0.5 * shape])]
    for angle in (0.0, np.pi / 4):
        a = np.cos(angle) * u + np.sin(angle) * v
        along = np.outer(a, a)
        across = np.eye(2) - along
        size = np.trace(shape) / 2
        starts.append(size * np.stack([1.5 * along + 0.5 * across, 0.5 * along + 1.5 * across]))
    several = alone.repeated(len(starts))._replace(share=np.full(3, 0.5), shape=np.stack(starts))
    several = _fitted(stars, several, SCALES, PASSES, one_centre=True, shapes=True)
    yield float(np.nanmax(_log_density(stars, several, SCALES).sum(axis=1)))
    # errors that differ over the field
    slopes = START_SLOPE * np.concatenate([np.eye(2), -np.eye(2)])
    several = alone.repeated(len(slopes))._replace(
        share=np.full(len(slopes), 0.5),
        slope=slopes,
        shape=np.stack([[1.5 * shape, 0.4 * shape]] * len(slopes)),
    )
    several = _fitted(stars, several, SCALES, PASSES, one_centre=True, shapes=True)
    yield float(np.nanmax(_log_density(stars, several, SCALES).sum(axis=1)))
    yield _cut(stars)
    yield _rounded(stars)


def _cut(stars: _Stars) -> float:
    """Largest log-likelihood of Gaussians that end at the largest residual, in the unit of u, v."""
    square = (stars.residual**2).sum(axis=0)
    radius2 = float(square.max()) * (1 + 1e-9)
    variance = np.exp(-stars.log_det)
    chi2 = (stars.z**2).sum(axis=0)
    typical = float(np.median(chi2)) / (2 * np.log(2))
    factor = (typical * np.geomspace(0.5, 8.0, 25))[:, None]
    core = np.exp(-0.5 * chi2 / factor) / (2 * np.pi * factor * variance)
    core /= -np.expm1(-0.5 * radius2 / (factor * variance))
    even = 1.0 / (np.pi * radius2)
    false = np.full((len(factor), 1), 0.02)
    for _ in range(RADIAL_PASSES):
        of_false = false * even / ((1 - false) * core + false * even)
        false = np.clip(of_false.mean(axis=1), 1e-6, MOST_WIDE)[:, None]
    return float(np.log((1 - false) * core + false * even).sum(axis=1).max())


def _rounded(stars: _Stars) -> float:
    """Largest log-likelihood of normal errors of positions that were then rounded."""
    scatter2 = np.median(stars.residual**2, axis=1) / 0.4549  # median of chi-square
    total = scatter2.mean() * np.array([0.6, 0.8, 1.0, 1.2])[:, None]
    share = np.array([0.5, 0.7, 0.8, 0.9, 0.95, 0.99])
    half = np.sqrt(3 * total * share).reshape(-1, 1, 1)
    width = np.sqrt(total * (1 - share)).reshape(-1, 1, 1)
    r = np.abs(stars.residual)
    core = ndtr((half - r) / width) - ndtr((-half - r) / width)
    core = np.prod(core / (2 * half), axis=1)
    wide2 = 100 * scatter2.mean()
    wide = np.exp(-0.5 * (r**2).sum(axis=0) / wide2) / (2 * np.pi * wide2)
    false = np.full((len(core), 1), 0.02)
    for _ in range(RADIAL_PASSES):
        of_false = false * wide / ((1 - false) * core + false * wide + TINY)
        false = np.clip(of_false.mean(axis=1), 1e-6, MOST_WIDE)[:, None]
    return float(np.log((1 - false) * core + false * wide + TINY).sum(axis=1).max())


def _parts(stars: _Stars, m: _Mixture, scales: Float) -> tuple[Float, Float, Float, Float]:
    """Whitened residuals from both centres, squares, and densities of all parts of B mixtures.

    Returns residuals (2, B, 2, n) along both axes, their squares (B, 2, n) in units of the errors,
    and the densities of both groups (B, 2, k, n) and of false matches (B, n), in units of those of
    the errors of single stars.
    """
    share = m.shares(stars.position)
    centre = np.moveaxis(m.centre, 2, 0)[..., None]  # (2, B, 2, 1)
    # the solution follows the mean displacement where the share varies
    followed = (share - m.share[:, None]) * m.shift.T[..., None]  # (2, B, n) or (2, B, 1)
    e = stars.z[:, None, None] - _product(stars.whitening, centre - followed[:, :, None])
    inverse = np.linalg.inv(m.shape)
    i, j, k = (inverse[..., a, b, None] for a, b in AXES)
    square = e[0] * (i * e[0] + 2 * j * e[1]) + k * e[1] ** 2
    norm = np.sqrt(np.linalg.det(inverse)) / (2 * np.pi)  # (B, 2)
    weight = np.stack([1 - share, share], axis=1) * ((1 - m.false)[:, None] * norm)[..., None]
    weight = weight[:, :, None] * (m.scales / scales**2)[:, None, :, None]
    core = weight * np.exp(square[:, :, None] * (-0.5 / scales**2)[:, None])
    away = ((stars.residual[:, None] - m.wide_centre.T[..., None]) ** 2).sum(axis=0)
    exponent = -0.5 * away / m.wide[:, None] - stars.log_det
    return e, square, core, (m.false / (2 * np.pi * m.wide))[:, None] * np.exp(exponent)


def _log_density(stars: _Stars, m: _Mixture, scales: Float) -> Float:
    """Logarithms (B, n) of the densities of the residuals."""
    _, _, core, wide = _parts(stars, m, scales)
    return np.asarray(np.log(core.sum(axis=(1, 2)) + wide + TINY) + stars.log_det)


def _fitted(
    stars: _Stars,
    m: _Mixture,
    scales: Float,
    passes: int,
    *,
    one_centre: bool = False,
    shapes: bool = False,
) -> _Mixture:
    """B mixtures after so many passes of expectation and maximisation (Dempster et al. 1977).

    Both groups keep a common centre if `one_centre`, and have a matrix S of their own if `shapes`.
    """
    n = stars.z.shape[1]
    least = WIDE**2 * stars.typical**2
    # (n, 12) products of the elements of the whitening with each other and with residuals
    uu, uv, vv = stars.whitening
    z0, z1 = stars.z
    squares = [uu * uu, uu * uv, uv * uv, uu * vv, uv * vv, vv * vv]
    products = np.stack([*squares, uu * z0, uu * z1, uv * z0, uv * z1, vv * z0, vv * z1], axis=1)
    for _ in range(passes):
        e, _, core, wide = _parts(stars, m, scales)
        total = core.sum(axis=(1, 2)) + wide + TINY
        core /= total[:, None, None]
        of_group = core.sum(axis=3)  # (B, 2, k)
        weight = np.einsum("bckn,k->bcn", core, scales**-2.0)
        normal, right = _equations(weight @ products, m.shape)
        if m.varies:
            share = m.shares(stars.position)
            # the mean displacement that the solution follows is part of the residuals
            followed = weight * (share - m.share[:, None])[:, None]
            matrix = _equations(followed @ products, m.shape)[0]
            right = right + (matrix @ m.shift[:, None, :, None])[..., 0]
        if one_centre:
            normal, right = (np.repeat(x.sum(axis=1)[:, None], 2, axis=1) for x in (normal, right))
        centre = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], float)
        members = of_group.sum(axis=2) + TINY  # (B, 2)
        inside = members.sum(axis=1)
        second = np.stack([np.einsum("bcn,bcn->bc", weight * e[a], e[b]) for a, b in AXES])
        shape = second / members if shapes else (second.sum(axis=2) / inside)[..., None]
        shape = _matrices(*np.broadcast_to(shape, second.shape))
        floor = 1e-4 * np.trace(shape, axis1=2, axis2=3) + 1e-9
        false = wide / total
        n_false = false.sum(axis=1) + TINY
        wide_centre = false @ stars.residual.T / n_false[:, None]
        of_square = false @ (stars.residual**2).sum(axis=0) / n_false
        share_at_centre, slope = members[:, 1] / inside, m.slope
        if m.varies:
            share_at_centre, slope = _share_step(stars.position, m, core.sum(axis=2))
        m = _Mixture(
            share_at_centre,
            slope,
            centre,
            np.asarray(shape + floor[..., None, None] * np.eye(2), float),
            of_group.sum(axis=1) / inside[:, None],
            np.clip(n_false / n, 1e-6, MOST_WIDE),
            wide_centre,
            np.maximum((of_square - (wide_centre**2).sum(axis=1)) / 2, least),
        )
    return m


def _share_step(position: Float, m: _Mixture, members: Float) -> tuple[Float, Float]:
    """Share (B,) at the centre and slopes (B, 2) after a Newton step of the logistic regression.

    `members` (B, 2, n) are the probabilities of each star to belong to the two groups.
    """
    share, either = m.shares(position), members.sum(axis=1)
    design = np.stack([np.ones(position.shape[1]), *position])
    gradient = (members[:, 1] - share * either) @ design.T
    curvature = np.einsum("bn,in,jn->bij", either * share * (1 - share), design, design)
    curvature += 1e-6 * (1.0 + np.trace(curvature, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    step = np.linalg.solve(curvature, gradient[..., None])[..., 0]
    logits = np.column_stack([logit(m.share), m.slope]) + step
    logits = np.clip(logits, -LARGEST_LOGIT, LARGEST_LOGIT)
    return np.asarray(expit(logits[:, 0])), np.asarray(logits[:, 1:])


def _equations(sums: Float, shape: Float) -> tuple[Float, Float]:
    """Normal equations of the centres of both groups: matrices (B, 2, 2, 2), right sides (B, 2, 2).

    `sums` (B, 2, 12) are those of the weighted products.
    """
    inverse = np.linalg.inv(shape)
    i, j, k = (inverse[..., a, b] for a, b in AXES)
    s = np.moveaxis(sums, 2, 0)
    uu = s[0] * i + 2 * s[1] * j + s[2] * k
    uv = s[1] * i + (s[2] + s[3]) * j + s[4] * k
    vv = s[2] * i + 2 * s[4] * j + s[5] * k
    u = s[6] * i + s[7] * j + s[8] * j + s[9] * k
    v = s[8] * i + s[9] * j + s[10] * j + s[11] * k
    ridge = 1e-9 * (uu + vv) + TINY
    return _matrices(uu + ridge, uv, vv + ridge), np.stack([u, v], -1)


def _elliptical(stars: _Stars, m: _Mixture, scales: Float) -> float:
    """Largest log-likelihood of an elliptical distribution with the shape of a mixture.

    The density of the mixture is multiplied by a step function of the radius.
    """
    _, square, core, wide = _parts(stars, m, scales)
    square = square[0, 0]
    variance = scales**2
    n_bins = int(np.clip(len(square) // STARS_PER_BIN, 2, RADIAL_BINS))
    ends = np.quantile(square, np.arange(1, n_bins) / n_bins)
    edges = np.concatenate([[0.0], ends, [square.max() * (1 + 1e-9)]])
    beyond = np.exp(-0.5 * edges[:, None] / variance) @ m.scales[0]
    mass = np.maximum(-np.diff(beyond), TINY)
    of = np.minimum(np.searchsorted(edges, square, side="right") - 1, n_bins - 1)
    false = float(m.false[0])
    core, wide = core.sum(axis=(1, 2))[0] / (1 - false), wide[0] / false
    step = np.ones(n_bins)
    for _ in range(RADIAL_PASSES):
        inside = (1 - false) * core * step[of]
        responsible = inside / (inside + false * wide + TINY)
        count = np.bincount(of, responsible, n_bins)
        step = count / (mass * max(count.sum(), TINY))
        false = float(np.clip(1 - responsible.mean(), 1e-6, MOST_WIDE))
    radial = np.log((1 - false) * core * step[of] + false * wide + TINY)
    return float((radial + stars.log_det).sum())


def _described(stars: _Stars, m: _Mixture, p_value: float) -> DisplacedGroup:
    """Share and displacement with their errors, from the squares of the scores of single stars."""
    e, _, core, wide = _parts(stars, m, SCALES)
    total = core.sum(axis=(1, 2))[0] + wide[0] + TINY
    core = core[0] / total
    share = np.clip(m.shares(stars.position)[0], 1e-6, 1 - 1e-6)
    p = float(share.mean())
    precise = (core / (SCALES**2)[:, None]).sum(axis=1)  # (2, n)
    pull = np.einsum("cjk,kcn->jcn", np.linalg.inv(m.shape[0]), e[:, 0])
    one, other = np.moveaxis(precise * _product(stars.whitening, pull), 1, 0)  # (2, n): axis
    # a centre moves both groups where the share differs from that at X = Y = 0
    followed = share - m.share[0]
    of_centres = one * (1 + followed) + other * followed, other * (1 - followed) - one * followed
    members = core.sum(axis=1)
    of_logit = members[1] * (1 - share) - members[0] * share
    design = np.stack([np.ones(len(total)), *(stars.position if m.varies else ())])
    score = np.concatenate([*of_centres, of_logit * design])
    covariance = np.linalg.pinv(score @ score.T)
    shift = m.shift[0]
    difference = np.concatenate([-np.eye(2), np.eye(2), np.zeros((2, len(design)))], axis=1)
    of_shift = difference @ covariance @ difference.T
    by_logit = (share * (1 - share) * design).mean(axis=1)
    share_sigma = float(np.sqrt(by_logit @ covariance[4:, 4:] @ by_logit))
    larger = 0
    if p > 0.5:
        p, share, shift, larger = 1 - p, 1 - share, -shift, 1
    between = None
    if m.varies:
        low, high = np.quantile(share, [0.05, 0.95])
        between = float(low), float(high)
    # scatter of the typical star along the displacement
    way = shift / max(float(np.hypot(*shift)), TINY)
    along = _product(np.median(stars.whitening, axis=1), way)
    spread = float(np.average(SCALES**2, weights=m.scales[0]))
    inverse = along @ np.linalg.inv(m.shape[0, larger]) @ along / spread
    return DisplacedGroup(
        p_value,
        p,
        share_sigma,
        (float(shift[0]), float(shift[1])),
        (float(np.sqrt(of_shift[0, 0])), float(np.sqrt(of_shift[1, 1]))),
        float(np.hypot(*shift) * np.sqrt(inverse)),
        between,
    )


def _product(matrix: Float, vector: Float) -> Float:
    """Symmetric matrices, given by their elements uu, uv, vv, times vectors (2, ...)."""
    uu, uv, vv = matrix
    u, v = vector
    return np.stack([uu * u + uv * v, uv * u + vv * v])


def _matrices(uu: Float, uv: Float, vv: Float) -> Float:
    """Symmetric matrices (..., 2, 2) of their elements."""
    return np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
