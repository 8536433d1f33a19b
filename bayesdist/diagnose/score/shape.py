"""Tests of the shape of the residuals: are they as symmetric and as round as the likelihood says?

Errors that are merely larger in some parts of the data scatter the solution, which the sandwich
covariance holds.  Residuals that are lopsided, correlated along u and v, or that have two cores, in
ways that differ over the field, displace it: some of the stars are not where the others are.  Two
visits that were merged without a label, blends, ghosts and charge-transfer tails look so.

With residuals z in units of their errors, along the axes of the detector, and bounded weights
w_t = exp(-|z|^2 / (2 t^2)), every sum below is zero on the mean for errors that are mixtures of
Gaussians about the solution: normal ones, Student's t, errors quoted wrong star by star, false
matches with a wide scatter of their own.  Nothing else is assumed of the noise; sums over the
detections of a star are independent, and vary by their own squares.

Terms of the polynomials that the model may lack, up to two orders above its own, and low terms of
each exposure are taken from the residuals before. Where these are larger than the errors, the shape
is not tested.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from bayesdist.diagnose.clusters import sums_over
from bayesdist.diagnose.score.result import Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.significance import chi_square_of, hotelling_p
from bayesdist.model.basis import polynomial_terms
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import beta_sf, chi2_sf, norm_isf, norm_sf

GROUP = "shape"
REMEDY = (
    "exposures or visits without a label, blends, ghosts, charge-transfer tails, or a match radius "
    "that cuts true matches make such residuals: give the exposure of each star and fit frames, "
    "cut the stars that are displaced, or give u_nominal and v_nominal; a higher order or larger "
    "errors do not help"
)
SKEWNESS = Family(
    "skewness by position",
    REMEDY,
    "the residuals are lopsided: their core is displaced from the rest, and differently over the "
    "field",
    "the residuals are not lopsided in ways that differ over the field",
    group=GROUP,
)
PATCH = replace(
    SKEWNESS,
    name="skewness of a patch",
    absent="no patch of the field has lopsided residuals",
)
CORRELATION = replace(
    SKEWNESS,
    name="correlation by position",
    present="the residuals along both axes are correlated, and differently over the field",
    absent="no correlation of the residuals along both axes differs over the field",
)
TWO_CORES = replace(
    SKEWNESS,
    name="two cores",
    absent="the residuals do not have two cores",
)

# (6,) powers of the Legendre polynomials that the shape may go with: 1, X, Y, XY, X^2, Y^2
TERMS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
AREA = np.array([1 / ((2 * i + 1) * (2 * j + 1)) for i, j in TERMS])  # mean squares
HIGHER = 2  # orders above the model's that are taken from the residuals
STARS_PER_TERM = 6  # of polynomials that are taken from the residuals
# How much smaller the residuals may be without these polynomials: where the model lacks more, their
# shape is that of what it lacks.
MOST_MISSING = 1.3
PASSES = 4  # of a robust fit
RIDGE = 1e-12  # of normal equations, relative
TINY = 1e-300
MIN_STARS = 100  # of a chip, for any test
MIN_STARS_OF_EXPOSURE = 200  # for a test of its own
LARGEST_LEVERAGE = 0.5
CORE, REST = 1.3, 4.0  # reach t of the weights of the core and of the rest, in errors
REACH = 2.5  # of the weights of correlations
FREE = 3.0  # errors between a star and the edge of its match circle, at least
CELLS = 16  # along each side of a chip, of which patches consist
PATCHES = (2, 3, 4, 5, 6, 8, 11, 16)  # cells along the side of a patch
MIN_STARS_OF_PATCH = 40
STARS_PER_CELL = 60  # of the test for two cores
MAX_CELLS = 8
WAVES = (2.4, 2.8, 3.2, 3.6)  # frequencies, in units of the inverse scatter along the main axis
WAVE_REACH = 2.0  # of the weights of the test for two cores, in the same unit


@dataclass(frozen=True, eq=False)
class _Chip:
    """Residuals of one chip in units of their errors, along the axes of the detector."""

    X: Float  # (n,)
    Y: Float
    z: Float  # (2, n)
    inlier: Float  # (n,)
    star: Int  # (n,) codes from 0
    exposure: Int  # (n,)
    sigma: float  # usual error along an axis, in the unit of u and v
    size: tuple[float, float]  # pixels
    free: float = 1.0  # degrees of freedom of the residuals, over their number

    @property
    def n_stars(self) -> int:
        """Number of stars."""
        return int(self.star.max(initial=-1)) + 1

    @property
    def terms(self) -> Float:
        """Values (n, 6) of `TERMS`."""
        return _legendre(self.X, self.Y, TERMS)

    def at(self, rows: Int) -> _Chip:
        """Some of the detections."""
        return replace(
            self,
            X=self.X[rows],
            Y=self.Y[rows],
            z=self.z[:, rows],
            inlier=self.inlier[rows],
            star=np.unique(self.star[rows], return_inverse=True)[1],
            exposure=self.exposure[rows],
        )

    def by_exposure(self) -> Iterator[_Chip]:
        """Detections of each exposure."""
        for code in np.unique(self.exposure):
            yield self.at(np.flatnonzero(self.exposure == code))


def shape_tests(sample: ScoredSample) -> list[Outcome]:
    """Outcomes of the tests of skewness, of correlation and for two cores.

    Chips with fewer than `MIN_STARS` stars are left out.
    """
    chips = list(_chips(sample))
    unit = sample.model.unit
    tests = (
        _skewness(chips, unit),
        _patch(chips, unit),
        _correlation(chips, unit),
        _two_cores(chips, unit),
    )
    return [test for test in tests if test is not None]


def _chips(sample: ScoredSample) -> Iterator[_Chip]:
    """Residuals of the chips that have stars enough."""
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    usable = sample.used & (leverage.max(axis=0) < LARGEST_LEVERAGE) & (sample.inlier > 0)
    free = _free_radius(sample)
    for code, chip in enumerate(sample.model.chips):
        rows = np.flatnonzero(usable & (sample.chip == code))
        if len(np.unique(sample.star[rows])) < MIN_STARS:
            continue
        variance = sample.variance[:, rows] * (1.0 - leverage[:, rows])
        # to the axes of the detector; the frames' scales are next to one
        z = sample.residual[:, rows] / np.sqrt(variance)
        z = np.einsum("nji,jn->in", _rotations(sample.turn[rows]), z)
        part = _Chip(
            sample.X[rows],
            sample.Y[rows],
            z,
            sample.inlier[rows],
            np.unique(sample.star[rows], return_inverse=True)[1],
            sample.exposure[rows],
            float(np.sqrt(np.median(variance))),
            chip.size,
        )
        order = _higher_order(sample.model.order, part.n_stars)
        if order == sample.model.order:
            continue
        z, before = _without_means(part, order), _scale(part.z)
        if before > MOST_MISSING * _scale(z):
            continue
        part = replace(part, z=z, free=1.0 - len(polynomial_terms(order)) / part.n_stars)
        scale = _scale(part.z, part.inlier)
        part = replace(part, z=part.z / scale, sigma=part.sigma * scale)
        if free is not None:  # of the disc about the solution that lies in the match circle
            reach = free[rows] / (scale * np.sqrt(variance.max(axis=0)))
            part = part.at(np.flatnonzero((reach > FREE) & (np.hypot(*part.z) < reach)))
        if part.n_stars >= MIN_STARS:
            yield part


def _free_radius(sample: ScoredSample) -> Float | None:
    """Distance (N,) of the model's position from the edge of the match circle, if there is any."""
    if sample.from_nominal is None or not sample.match_radius:
        return None
    return np.asarray(sample.match_radius - np.hypot(*(sample.from_nominal - sample.residual)))


def _rotations(turn: Float) -> Float:
    """Rotations (n, 2, 2) that are next to linear maps (n, 2, 2)."""
    angle = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def _legendre(X: Float, Y: Float, terms: tuple[tuple[int, int], ...]) -> Float:
    """Values (n, K) of Legendre products."""
    i, j = np.array(terms).T
    return np.asarray(legendre.legvander(X, i.max())[:, i] * legendre.legvander(Y, j.max())[:, j])


def _higher_order(order: int, n_stars: int) -> int:
    """Highest order above that of the model that so many stars determine; else the model's."""
    for total in range(order + HIGHER, order, -1):
        if STARS_PER_TERM * len(polynomial_terms(total)) <= n_stars:
            return total
    return order


def _without_means(chip: _Chip, order: int) -> Float:
    """Residuals (2, n) less polynomials up to an order, and low terms of each exposure."""
    z = _smoothed_away(_legendre(chip.X, chip.Y, polynomial_terms(order)), chip.z)
    codes, of = np.unique(chip.exposure, return_inverse=True)
    if len(codes) > 1:
        z = z.copy()
        for k in range(len(codes)):
            rows = np.flatnonzero(of == k)
            low = [n for n in (2, 1, 0) if STARS_PER_TERM * len(polynomial_terms(n)) <= len(rows)]
            if low:
                F = _legendre(chip.X[rows], chip.Y[rows], polynomial_terms(low[0]))
                z[:, rows] = _smoothed_away(F, z[:, rows])
    return z


def _smoothed_away(F: Float, z: Float) -> Float:
    """Residuals z (2, n) less their robust fit by functions F (n, K)."""
    left, ridge = z, RIDGE * np.eye(F.shape[1])
    for _ in range(PASSES):
        weight = np.exp(-(left**2).sum(axis=0) / (2 * (REST * _scale(left)) ** 2))
        WF = F * weight[:, None]
        normal = WF.T @ F
        left = z - (F @ np.linalg.solve(normal + np.trace(normal) * ridge, WF.T @ z.T)).T
    return np.asarray(left)


def _scale(z: Float, weight: Float | None = None) -> float:
    """Scatter along an axis of residuals (2, n), by the weighted median of their squares."""
    square = (z**2).sum(axis=0)
    if weight is None:
        return float(np.sqrt(max(np.median(square), TINY) / (2 * np.log(2))))
    order = np.argsort(square)
    total = np.cumsum(weight[order])
    median = square[order][np.searchsorted(total, total[-1] / 2)]
    return float(np.sqrt(max(median, TINY) / (2 * np.log(2))))


def _displacements(z: Float) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
    """Scores (2, n) of the core and of the rest by a displacement, and their derivatives (n,).

    Derivatives are averaged over both axes.
    """
    square = (z**2).sum(axis=0)
    out = []
    for reach in (CORE, REST):
        weight = np.exp(-square / (2 * reach**2))
        out.append((z * weight, weight * (1.0 - square / (2 * reach**2))))
    return out[0], out[1]


def _skewness(chips: list[_Chip], unit: str) -> Outcome | None:
    """Test whether the core is displaced from the rest of the residuals, as `TERMS` of position.

    Where several exposures have stars enough, each is tested by itself as well.
    """
    parts = [part for chip in chips if (part := _displaced(chip)) is not None]
    if not parts:
        return None
    T, dof, dof_residual, p_value = _together(parts)
    exposures = [
        part
        for chip in chips
        for one in (chip.by_exposure() if np.ptp(chip.exposure) else ())
        if one.n_stars >= MIN_STARS_OF_EXPOSURE and (part := _displaced(one)) is not None
    ]
    if len(exposures) > 1:
        alone = _together(exposures)
        if alone[3] < p_value:
            T, dof, dof_residual = alone[:3]
        p_value = min(1.0, 2 * min(p_value, alone[3]))
    square, noise = np.mean([part.squares for part in parts], axis=0)
    return outcome(SKEWNESS, T, dof, dof_residual, p_value, square=square, noise=noise, unit=unit)


@dataclass(frozen=True, eq=False)
class _Part:
    """Statistic of one chip or exposure."""

    statistic: float
    dof: int
    n_stars: int
    squares: tuple[float, float]  # mean square over the field, noise included, and of the noise

    @classmethod
    def of(cls, change: Float, star: Int, area: Float) -> _Part | None:
        """Of the sum of changes (n, q), whose squares over the field are weighted by area (q,).

        None where the changes are not independent of each other.
        """
        by_star = sums_over(star, change)
        total, covariance = by_star.sum(axis=0), by_star.T @ by_star
        try:
            statistic = float(total @ np.linalg.solve(covariance, total))
        except np.linalg.LinAlgError:
            return None
        squares = float(total**2 @ area), float(np.diag(covariance) @ area)
        return cls(statistic, len(total), len(by_star), squares)

    @property
    def p_value(self) -> float:
        """Probability of a larger statistic (Hotelling)."""
        return hotelling_p(self.statistic, self.dof, self.n_stars)


def _together(parts: list[_Part]) -> tuple[float, float, float | None, float]:
    """Statistic, degrees of freedom, those of the residuals, and probability of all parts."""
    if len(parts) == 1:
        (part,) = parts
        return part.statistic, part.dof, float(part.n_stars - part.dof), part.p_value
    T = sum(chi_square_of(part.p_value, part.dof) for part in parts)
    dof = sum(part.dof for part in parts)
    return T, dof, None, float(chi2_sf(T, dof))


def _displaced(chip: _Chip) -> _Part | None:
    """Displacement of the core from the rest of a chip's residuals, as `TERMS` of position."""
    F, change = chip.terms, np.zeros((len(chip.X), 2 * len(TERMS)))
    for sign, (score, derivative) in zip((1, -1), _displacements(chip.z), strict=True):
        try:
            inverse = np.linalg.inv((F * derivative[:, None]).T @ F)
        except np.linalg.LinAlgError:
            return None
        step = F @ inverse
        change = change + sign * np.concatenate([step * axis[:, None] for axis in score], axis=1)
    return _Part.of(change * chip.sigma, chip.star, np.tile(AREA, 2))


def _correlation(chips: list[_Chip], unit: str) -> Outcome | None:
    """Test whether the product of both residuals goes with `TERMS` of position but the constant.

    What is the same over the field displaces nothing.  The size is half the correlation, by which
    the standard deviations along both diagonals differ from their mean.
    """
    parts = [part for chip in chips if (part := _correlated(chip)) is not None]
    if not parts:
        return None
    T, dof, dof_residual, p_value = _together(parts)
    square, noise = np.mean([part.squares for part in parts], axis=0)
    return outcome(
        CORRELATION, T, dof, dof_residual, p_value, square=square, noise=noise, unit=unit
    )


def _correlated(chip: _Chip) -> _Part | None:
    u, v = chip.z
    weight = np.exp(-(u**2 + v**2) / (2 * REACH**2))
    product = u * v * weight
    # by a small correlation c the density changes by the factor 1 + c u v
    unit = float(np.mean(u**2 * v**2 * weight))
    F = chip.terms[:, 1:]
    F = F - F.mean(axis=0)
    try:
        step = np.linalg.inv(F.T @ F) * chip.sigma / (2 * unit)
    except (np.linalg.LinAlgError, ZeroDivisionError):
        return None
    part = _Part.of(F * (product - product.mean())[:, None] @ step, chip.star, AREA[1:])
    if part is None:
        return None
    # what the fit takes from all residuals together correlates them: the variance of sums of their
    # products is larger than the squares of these show, by the inverse of what is left
    return replace(part, statistic=part.statistic * chip.free)


def _patch(chips: list[_Chip], unit: str) -> Outcome | None:
    """Test for a patch of a chip whose residuals are lopsided, as a ghost makes them.

    Every square of `PATCHES` cells has a statistic of its own; the largest counts as one of all.
    """
    worst, n_patches = None, 0
    for chip in chips:
        found = _worst_patch(chip)
        n_patches += found.n_patches
        if worst is None or found.p_value < worst.p_value:
            worst = found
    if worst is None or not n_patches:
        return None
    present = (
        f"the residuals are lopsided in a patch of {worst.size[0]:.0f} x {worst.size[1]:.0f} "
        f"pixels about pixel ({worst.middle[0]:.0f}, {worst.middle[1]:.0f})"
    )
    return outcome(
        replace(PATCH, present=present),
        worst.statistic,
        2,
        float(worst.n_stars - 2),
        min(1.0, n_patches * worst.p_value),
        square=worst.squares[0],
        noise=worst.squares[1],
        unit=unit,
    )


@dataclass(frozen=True, eq=False)
class _Patch:
    """The patch of a chip with the most lopsided residuals."""

    statistic: float
    p_value: float  # by itself
    n_stars: int
    n_patches: int  # that were looked at
    # size, middle: pixels
    size: tuple[float, float]
    middle: tuple[float, float]
    squares: tuple[float, float]  # mean square over the field, noise included, and of the noise


def _worst_patch(chip: _Chip) -> _Patch:
    core, rest = _displacements(chip.z)
    lopsided = core[0] / core[1].mean() - rest[0] / rest[1].mean()
    # a star counts once, at its mean position
    count = np.bincount(chip.star)
    X, Y = (np.bincount(chip.star, at) / count for at in (chip.X, chip.Y))
    u, v = sums_over(chip.star, lopsided.T).T
    cell = cell_index(X, Y, (CELLS, CELLS))
    values = (np.ones(len(u)), u, v, u * u, u * v, v * v, count)
    sums = np.zeros((len(values), CELLS + 1, CELLS + 1))
    for k, value in enumerate(values):
        binned = np.bincount(cell, value, CELLS**2).reshape(CELLS, CELLS)
        sums[k, 1:, 1:] = binned.cumsum(axis=0).cumsum(axis=1)
    worst, n_patches = _Patch(0.0, 1.0, 3, 0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)), 0
    for side in PATCHES:
        within = sums[:, side:, side:] - sums[:, :-side, side:]
        within = within - sums[:, side:, :-side] + sums[:, :-side, :-side]
        n, a, b, aa, ab, bb, detections = within.reshape(len(values), -1)
        determinant = aa * bb - ab**2
        good = (n >= MIN_STARS_OF_PATCH) & (determinant > 1e-9 * (aa + bb) ** 2)
        n_patches += int(good.sum())
        if not good.any():
            continue
        safe = np.where(good, determinant, 1.0)
        T = np.where(good, (a * a * bb - 2 * a * b * ab + b * b * aa) / safe, 0.0)
        p = np.where(good, beta_sf(np.minimum(T / n.clip(1), 1.0), 1.0, (n.clip(3) - 2) / 2), 1.0)
        k = int(np.argmin(p))
        if p[k] < worst.p_value:
            iy, ix = np.divmod(k, CELLS - side + 1)
            size = chip.size[0] * side / CELLS, chip.size[1] * side / CELLS
            middle = (
                chip.size[0] * (ix + side / 2) / CELLS + 0.5,
                chip.size[1] * (iy + side / 2) / CELLS + 0.5,
            )
            factor = (chip.sigma / detections[k]) ** 2 * (side / CELLS) ** 2
            squares = factor * (a[k] ** 2 + b[k] ** 2), factor * (aa[k] + bb[k])
            worst = _Patch(float(T[k]), float(p[k]), int(n[k]), 0, size, middle, squares)
    return replace(worst, n_patches=n_patches)


def _two_cores(chips: list[_Chip], unit: str) -> Outcome | None:
    """Test for residuals that have two cores.

    Of residuals t along the axis of their largest scatter, in cells of the detector, the mean of
    exp(-t^2 / (2 r^2)) cos(k t) is positive for every mixture of Gaussians about zero, and negative
    for two cores that are 2 pi / k apart.
    """
    t, star, sigma, offset = [], [], [], 0
    for chip in chips:
        along, rows = _along_main_axis(chip)
        t.append(along)
        star.append(chip.star[rows] + offset)
        sigma.append(np.full(len(rows), chip.sigma))
        offset += chip.n_stars
    if not t or len(np.unique(np.concatenate(star))) < MIN_STARS:
        return None
    all_t, all_stars = np.concatenate(t), np.concatenate(star)
    typical = float(np.median(np.concatenate(sigma)))
    taper = np.exp(-(all_t**2) / (2 * WAVE_REACH**2))
    statistics = []
    for wave in WAVES:
        by_star = np.bincount(all_stars, taper * np.cos(wave * all_t))
        statistics.append(-by_star.sum() / np.sqrt((by_star**2).sum()))
    k = int(np.argmax(statistics))
    p_value = min(1.0, len(WAVES) * float(norm_sf(statistics[k])))
    # half the distance of the cores, in units of the scatter
    half = np.pi / WAVES[k] * typical
    n = len(np.unique(all_stars))
    present = f"the residuals have two cores, some {2 * half:.2g} {unit} apart"
    return Outcome(
        replace(TWO_CORES, present=present),
        chi_square_of(p_value, 1),
        1,
        None,
        p_value,
        float(half) if statistics[k] > 0 else 0.0,
        lambda level: typical * _smallest_half(n, level),
        unit,
    )


def _along_main_axis(chip: _Chip) -> tuple[Float, Int]:
    """Residuals along the axis of the largest scatter of their cell, in units of it, and rows."""
    side = int(np.clip(np.sqrt(chip.n_stars / STARS_PER_CELL), 1, MAX_CELLS))
    cell = cell_index(chip.X, chip.Y, (side, side))
    along, rows = [np.zeros(0)], [np.zeros(0, np.int64)]
    for code in np.unique(cell):
        at = np.flatnonzero(cell == code)
        weight = chip.inlier[at]
        if len(np.unique(chip.star[at])) < STARS_PER_CELL / 2 or weight.sum() < 2:
            continue
        z = chip.z[:, at] - (chip.z[:, at] @ weight / weight.sum())[:, None]
        values, vectors = np.linalg.eigh((z * weight) @ z.T / weight.sum())
        if values[1] > 0:
            along.append(vectors[:, 1] @ z / np.sqrt(values[1]))
            rows.append(at)
    return np.concatenate(along), np.concatenate(rows)


def _smallest_half(n: int, level: float) -> float:
    """Half the distance of two equal cores that n stars show, in units of the whole scatter."""
    needed = float(norm_isf(level / len(WAVES)) + norm_isf(0.1)) / np.sqrt(n / 2)
    half = np.linspace(0.5, 1.0, 51)[:, None]
    waves = np.array(WAVES)
    dip = -np.cos(waves * half) * np.exp(-(waves**2) * (1 - half**2) / 2)
    enough = dip.max(axis=1) >= needed
    return float(half[np.argmax(enough), 0]) if enough.any() else np.inf
