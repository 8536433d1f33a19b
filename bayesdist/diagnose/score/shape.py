"""Tests of the shape of the residuals: are they as symmetric and round as the likelihood assumes?

Errors that are merely larger in some parts of the data increase the scatter of the solution, and
the sandwich covariance includes that. Residuals that are lopsided, correlated between u and v, or
double-peaked, in ways that vary over the field, displace the solution: some stars are not where the
others are. Visits that were merged without a label, blends, ghosts and charge-transfer tails cause
such residuals.

With residuals z in units of their errors along the detector axes, and bounded weights w_t =
exp(-|z|^2 / (2 t^2)), every sum below has zero expectation if the errors are mixtures of Gaussians
centred on the solution: normal errors, Student's t, errors with a wrong scale for single stars,
false matches with a wide scatter. No other property of the noise is assumed. Sums over the
detections of a star are independent, and their variance is estimated from their own squares.

Polynomial terms that the model may lack, up to two orders above its own, and low-order terms of
each exposure are subtracted from the residuals first. If these exceed the errors, or if still
higher orders are missing, the shape is not tested: it is the shape of the missing terms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.diagnose.score.groups import GROUP_DOF, MAX_STARS, DisplacedGroup, displaced_group
from bayesdist.diagnose.score.missing_orders import MIN_STARS, ChipResiduals, legendre_products
from bayesdist.diagnose.score.result import DISPLACED_GROUP, POWER, Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.statistics import chi_square_of, hotelling_p, sums_over
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import beta_sf, chi2_isf, chi2_sf, norm_isf, norm_sf

GROUP = "shape"
REMEDY = (
    "exposures or visits without a label, stars whose proper motions are missing, blends, ghosts, "
    "charge-transfer tails, or a match radius that cuts true matches make such residuals: give the "
    "exposure of each star and fit frames, give proper motions with their errors and both dates, "
    "leave out the stars that are displaced, or give u_nominal and v_nominal; a higher order or "
    "larger errors do not help"
)
SKEWNESS = Family(
    "skewness by position",
    REMEDY,
    "the residuals are lopsided: their core is displaced from the rest, and differently over the "
    "field",
    "the residuals are not lopsided in ways that differ over the field",
    group=GROUP,
)
APART = replace(
    SKEWNESS,
    name="displaced stars",
    absent="no part of the stars is displaced from the others",
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
BOTH = replace(
    SKEWNESS,
    name="shape by position",
    present="the residuals are lopsided and correlated along both axes, differently over the field",
    absent="skewness and correlation together do not differ over the field",
)
TWO_CORES = replace(
    SKEWNESS,
    name="two cores",
    absent="the residuals do not have two cores",
)
GROUP_OF_STARS = replace(
    SKEWNESS,
    name=DISPLACED_GROUP,
    remedy="stars without proper motions, a catalogue that was made from two or has two epochs, "
    "exposures and visits without a label, or blends, ghosts and charge-transfer tails make such "
    "residuals: give proper motions with their errors and both dates, give the exposure of each "
    "star and fit frames, or leave out the stars that are displaced; neither further terms of the "
    "model nor other errors help",
    absent="no group of stars is displaced from the others",
)

CUT_ELSEWHERE = (
    "; if a match radius has cut true matches about other positions, give these as u_nominal and "
    "v_nominal"
)

# (6,) powers of the Legendre polynomials with which the shape may vary: 1, X, Y, XY, X^2, Y^2
TERMS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
AREA = np.array([1 / ((2 * i + 1) * (2 * j + 1)) for i, j in TERMS])  # mean squares over the field
HIGHER = 2  # orders above the model's that are subtracted from the residuals
# largest ratio of the residuals' scatter before and after the subtraction
MOST_MISSING = 1.3
MIN_STARS_OF_EXPOSURE = 200  # of an exposure that is tested separately
CORE, REST = (
    1.3,
    4.0,
)  # widths t, in errors, of the weights that select the core and the remaining residuals
REACH = 2.5  # width of the weights in the correlation test
FREE = 3.0  # smallest distance of a star from the edge of its match circle, in errors
CELLS = 16  # along each side of a chip; patches consist of cells
PATCHES = (2, 3, 4, 5, 6, 8, 11, 16)  # cells along the side of a patch
MIN_STARS_OF_PATCH = 40
STARS_PER_CELL = 60  # in the test for two cores
MAX_CELLS = 8
WAVES = (
    2.4,
    2.8,
    3.2,
    3.6,
)  # angular frequencies, in units of the inverse scatter along the main axis
# Mean gain in log-likelihood per star of two equal groups, over the best elliptical distribution,
# in units of the fourth power of their distance in errors: 0.0004 and 0.0005 for distances of two
# and three errors.
GAIN_PER_STAR = 4.5e-4
WAVE_REACH = 2.0  # width of the weights of the test for two cores, in units of that scatter


def shape_tests(sample: ScoredSample, chips: Sequence[ChipResiduals]) -> list[Outcome]:
    """Outcomes of the tests for skewness, correlation, two cores, and a displaced group of stars.

    Parameters
    ----------
    sample : ScoredSample
    chips : sequence of ChipResiduals
        Residuals of the sample.  Chips that lack terms larger than the errors are not tested.

    Returns
    -------
    list of Outcome
    """
    parts = list(_symmetric_chips(sample, chips))
    unit = sample.model.unit
    group = displaced_group(sample, parts, HIGHER)
    skewness, correlation = _skewness(parts, unit), _correlation(parts, unit)
    tests = (
        _displaced_group(parts, group, unit, cut=_cut_elsewhere(sample)),
        skewness,
        _apart(parts, unit),
        _patch(parts, unit),
        correlation,
        _both(skewness, correlation),
        _two_cores(parts, unit),
    )
    return [test for test in tests if test is not None]


def _symmetric_chips(
    sample: ScoredSample, chips: Sequence[ChipResiduals]
) -> Iterator[ChipResiduals]:
    """Iterate over the residuals of the chips that can be tested, without their missing terms."""
    free = _free_radius(sample)
    for chip in chips:
        order = chip.orders(chip.order + HIGHER)[-1]
        if order == chip.order or _lacks_more_than(chip, order):
            continue
        part = chip.without_terms(order)
        # Displaced stars move the solution itself away from the core of the residuals: only terms
        # beyond its own are missing.
        if chip.without_polynomials(chip.order).scatter() > MOST_MISSING * part.scatter():
            continue
        part = part.in_units_of_scatter()
        if free is not None:
            # radius of the disc about the solution that is entirely inside the match circle
            reach = free[part.rows] / part.error
            part = part.at(np.flatnonzero((reach > FREE) & (np.hypot(*part.z) < reach)))
        if part.n_stars >= MIN_STARS:
            yield part


def _lacks_more_than(chip: ChipResiduals, order: int) -> bool:
    """True if the residuals contain terms of higher orders than `order`."""
    missing = chip.missing_orders
    return missing is not None and missing.order > order


def _free_radius(sample: ScoredSample) -> Float | None:
    """Distance (N,) of the model's position from the edge of the match circle.

    None if the sample has no match circle.
    """
    if sample.from_nominal is None or not sample.match_radius:
        return None
    return np.asarray(sample.match_radius - np.hypot(*(sample.from_nominal - sample.residual)))


def _terms_of(chip: ChipResiduals) -> Float:
    """Values (n, 6) of `TERMS`."""
    return legendre_products(chip.X, chip.Y, TERMS)


def _displacements(z: Float) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
    """Scores of the core and of the remaining residuals with respect to a displacement.

    Returns a pair of (score (2, n), derivative (n,)); the derivatives are averaged over both axes.
    """
    square = (z**2).sum(axis=0)
    out = []
    for reach in (CORE, REST):
        weight = np.exp(-square / (2 * reach**2))
        out.append((z * weight, weight * (1.0 - square / (2 * reach**2))))
    return out[0], out[1]


def _skewness(chips: list[ChipResiduals], unit: str) -> Outcome | None:
    """Test whether the core is displaced from the rest of the residuals, as a function of position.

    The displacement is expanded in `TERMS`. If several exposures have enough stars, each is also
    tested separately.
    """
    parts = [part for chip in chips if (part := _displaced(chip)) is not None]
    if not parts:
        return None
    T, dof, dof_residual, p_value = _together(parts)
    exposures = [
        part
        for chip in chips
        for exposure in (chip.by_exposure() if np.ptp(chip.exposure) else ())
        if exposure.n_stars >= MIN_STARS_OF_EXPOSURE and (part := _displaced(exposure)) is not None
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
    """Test statistic of one chip or exposure."""

    statistic: float
    dof: int
    n_stars: int
    squares: tuple[
        float, float
    ]  # mean square over the field, noise included, and that of the noise

    @classmethod
    def of(cls, change: Float, star: Int, area: Float) -> _Part | None:
        """Build from the changes (n, q) that the detections contribute.

        `area` (q,) weights the squares of their sums over the field. Returns None if the changes
        are linearly dependent.
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
        """Probability of a larger statistic (Hotelling's distribution)."""
        return hotelling_p(self.statistic, self.dof, self.n_stars)


def _together(parts: list[_Part]) -> tuple[float, float, float | None, float]:
    """Combined statistic, degrees of freedom, residual degrees of freedom and p-value."""
    if len(parts) == 1:
        (part,) = parts
        return part.statistic, part.dof, float(part.n_stars - part.dof), part.p_value
    T = sum(chi_square_of(part.p_value, part.dof) for part in parts)
    dof = sum(part.dof for part in parts)
    return T, dof, None, float(chi2_sf(T, dof))


def _displaced(chip: ChipResiduals, terms: Sequence[tuple[int, int]] = TERMS) -> _Part | None:
    """Displacement of the core from the rest of a chip's residuals, expanded in `terms`."""
    F, change = legendre_products(chip.X, chip.Y, terms), np.zeros((len(chip.X), 2 * len(terms)))
    for sign, (score, derivative) in zip((1, -1), _displacements(chip.z), strict=True):
        try:
            inverse = np.linalg.inv((F * derivative[:, None]).T @ F)
        except np.linalg.LinAlgError:
            return None
        step = F @ inverse
        change = change + sign * np.concatenate([step * axis[:, None] for axis in score], axis=1)
    return _Part.of(change * chip.sigma, chip.star, np.tile(AREA[: len(terms)], 2))


def _apart(chips: list[ChipResiduals], unit: str) -> Outcome | None:
    """Test whether the core is displaced from the rest of the residuals, equally over the field.

    It is the constant of `_skewness` alone, for stars that are displaced as a whole by the same
    amount, such as those without a proper motion.
    """
    parts = [part for chip in chips if (part := _displaced(chip, TERMS[:1])) is not None]
    if not parts:
        return None
    T, dof, dof_residual, p_value = _together(parts)
    square, noise = np.mean([part.squares for part in parts], axis=0)
    present = "a part of the stars is displaced from the others, everywhere in the same direction"
    family = replace(APART, present=present)
    return outcome(family, T, dof, dof_residual, p_value, square=square, noise=noise, unit=unit)


def _cut_elsewhere(sample: ScoredSample) -> bool:
    """True if matches may have been cut at a radius about positions that are not given."""
    return bool(sample.match_radius) and sample.from_nominal is None


def _displaced_group(
    chips: list[ChipResiduals], group: DisplacedGroup | None, unit: str, *, cut: bool
) -> Outcome | None:
    """Outcome of the test for a group of stars that is displaced as a whole.

    The size is the rms displacement of all stars from their mean.  Where matches may have been cut
    at a radius about unknown positions (`cut`), one side of the residuals can be missing.
    """
    if not chips:
        return None
    typical = float(np.median([chip.sigma for chip in chips]))
    n_stars = min(sum(chip.n_stars for chip in chips), MAX_STARS)  # that are examined
    smallest = partial(_smallest_group, typical, n_stars)
    if group is None:
        return Outcome(GROUP_OF_STARS, 0.0, GROUP_DOF, None, 1.0, 0.0, smallest, unit)
    remedy = GROUP_OF_STARS.remedy + (CUT_ELSEWHERE if cut else "")
    family = replace(GROUP_OF_STARS, present=group.sentence(unit), remedy=remedy)
    size = np.sqrt(group.share * (1 - group.share)) * group.distance
    return Outcome(
        family,
        chi_square_of(group.p_value, GROUP_DOF),
        GROUP_DOF,
        None,
        group.p_value,
        float(size),
        smallest,
        unit,
    )


def _smallest_group(sigma: float, n: int, level: float) -> float:
    """Rms displacement of n stars, if half of them are displaced, that is found.

    `sigma` is the scatter of all stars per axis, the displacement included.
    """
    chance = float(chi2_isf(level, GROUP_DOF))
    needed = chance / 2 + float(norm_isf(1 - POWER)) * np.sqrt(chance)
    errors = (needed / (GAIN_PER_STAR * n)) ** 0.25
    return float(sigma * errors / 2 / np.sqrt(1 + errors**2 / 8))


def _correlation(chips: list[ChipResiduals], unit: str) -> Outcome | None:
    """Test whether the product of the residuals along both axes varies with position.

    The product is expanded in `TERMS` without the constant: a correlation that is constant over the
    field displaces nothing. The size is half the correlation: the amount by which the standard
    deviations along both diagonals differ from their mean.
    """
    parts = [part for chip in chips if (part := _correlated(chip)) is not None]
    if not parts:
        return None
    T, dof, dof_residual, p_value = _together(parts)
    square, noise = np.mean([part.squares for part in parts], axis=0)
    return outcome(
        CORRELATION, T, dof, dof_residual, p_value, square=square, noise=noise, unit=unit
    )


def _correlated(chip: ChipResiduals) -> _Part | None:
    u, v = chip.z
    weight = np.exp(-(u**2 + v**2) / (2 * REACH**2))
    product = u * v * weight
    # by a small correlation c the density changes by the factor 1 + c u v
    unit = float(np.mean(u**2 * v**2 * weight))
    F = _terms_of(chip)[:, 1:]
    F = F - F.mean(axis=0)
    try:
        step = np.linalg.inv(F.T @ F) * chip.sigma / (2 * unit)
    except (np.linalg.LinAlgError, ZeroDivisionError):
        return None
    part = _Part.of(F * (product - product.mean())[:, None] @ step, chip.star, AREA[1:])
    if part is None:
        return None
    # The fit correlates the residuals, so that the variance of sums of their products is larger
    # than their squares show, by the inverse of the remaining degrees of freedom per residual.
    return replace(part, statistic=part.statistic * chip.free)


def _both(skewness: Outcome | None, correlation: Outcome | None) -> Outcome | None:
    """Combined test of skewness and correlation (Fisher 1925), more sensitive than each alone.

    Displaced stars cause both. Where the errors are symmetric the two are independent, since one is
    an odd function of the residuals and the other an even one. The size is that of the skewness.
    """
    if skewness is None or correlation is None:
        return None
    T = sum(chi_square_of(test.p_value, 2) for test in (skewness, correlation))
    return replace(
        skewness,
        family=BOTH,
        statistic=T,
        dof=4,
        dof_residual=None,
        p_value=float(chi2_sf(T, 4)),
    )


def _patch(chips: list[ChipResiduals], unit: str) -> Outcome | None:
    """Test for a patch of a chip with lopsided residuals, as caused by a ghost.

    Every square of `PATCHES` cells has its statistic; the p-value of the largest is multiplied by
    their number.
    """
    worst, n_patches = None, 0
    for chip in chips:
        patch = _worst_patch(chip)
        n_patches += patch.n_patches
        if worst is None or patch.p_value < worst.p_value:
            worst = patch
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
    p_value: float  # uncorrected
    n_stars: int
    n_patches: int  # number of patches examined
    # in pixels
    size: tuple[float, float]
    middle: tuple[float, float]
    squares: tuple[
        float, float
    ]  # mean square over the field, noise included, and that of the noise


def _worst_patch(chip: ChipResiduals) -> _Patch:
    core, outer = _displacements(chip.z)
    lopsided = core[0] / core[1].mean() - outer[0] / outer[1].mean()
    # each star counts once, at its mean position
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


def _two_cores(chips: list[ChipResiduals], unit: str) -> Outcome | None:
    """Test for residuals with two cores.

    For residuals t along the axis of their largest scatter, per cell of the detector, the mean of
    exp(-t^2 / (2 r^2)) cos(k t) is positive for every mixture of Gaussians centred on zero, and
    negative for two cores that are separated by 2 pi / k.
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
    # half the separation of the cores, in units of the scatter
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


def _along_main_axis(chip: ChipResiduals) -> tuple[Float, Int]:
    """Residuals along the axis of largest scatter in their cell, and their rows.

    The residuals are in units of the scatter along that axis.
    """
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
    """Half the separation of two equal cores that n stars can show.

    It is in units of the total scatter.
    """
    needed = float(norm_isf(level / len(WAVES)) + norm_isf(0.1)) / np.sqrt(n / 2)
    half = np.linspace(0.5, 1.0, 51)[:, None]
    waves = np.array(WAVES)
    dip = -np.cos(waves * half) * np.exp(-(waves**2) * (1 - half**2) / 2)
    enough = dip.max(axis=1) >= needed
    return float(half[np.argmax(enough), 0]) if enough.any() else np.inf
