"""Linear deviations of exposures from their common mean, and the curvature of drifts.

Both appear only in differences between exposures, and few exposures determine little: two exposures
do not determine a curvature, and hardly a scatter if a drift is fitted to them.  In that case the
prior determines the result, as in any extrapolation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import product

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from bayesdist.diagnose.correlated.exposure_time import (
    CORRELATION_TIMES,
    SUSPECTED,
    UNCORRELATED,
    correlation_p,
    correlation_root,
)
from bayesdist.diagnose.correlated.information import Information
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors, log_half_t, log_widths
from bayesdist.diagnose.statistics import EfficientScore
from bayesdist.infer.equations.scaled import scaled_inverse
from bayesdist.infer.exposures.hierarchy import MOST_OUTLYING
from bayesdist.infer.exposures.scatter import OUTLYING, OUTLYING_FRACTION
from bayesdist.model import DistortionModel, Groups
from bayesdist.model.frames import LINEAR_MATRICES
from bayesdist.utils.arrays import Bool, Float, Int

# deviations of an exposure with a common scatter, and the frames that include them
KINDS = {
    "shift": ("shift", "shift_rotation", "shift_rotation_scale", "affine"),
    "rotation": ("shift_rotation", "shift_rotation_scale", "affine"),
    "scale": ("shift_rotation_scale", "affine"),
    "shear": ("affine",),
}
# deviations that are not linear; they are only tested
QUADRATIC = "second order"
# parameters of linear deviations, except for shifts
LINEAR = {
    "rotation": ("rotation",),
    "scale": ("scale",),
    "shear": ("shear_plus", "shear_cross"),
}
# number of coefficients of each kind
COEFFICIENTS = {"shift": 2, QUADRATIC: 6} | {kind: len(names) for kind, names in LINEAR.items()}
SCATTERS = {
    "shift": "shift",
    "rotation": "rotation",
    "scale": "shape",
    "shear": "shape",
    QUADRATIC: QUADRATIC,
}
CURVATURE = "curvature"
# largest number of estimated deviations of exposures (6 of each exposure without frames, 3 if shift
# and rotation are fitted); if there are more, those of a subset of the exposures represent all
MAX_DEVIATIONS = 240
# number of steps in each amplitude, by the number of scatters: first on a coarse grid over the
# whole range, then on a finer grid where the density is not negligible
COARSE, REFINED = (12, 8, 6, 5), (30, 18, 11, 6)
WIDE = 100.0  # multiple of the expected amplitudes that is practically a flat prior
MIN_OF_OTHERS = 5  # exposures; with fewer, outliers cannot be identified
# lower limit of amplitudes, as a fraction of the prior median or of the resolution of the data, the
# smaller of both
LEAST = 1 / 3
# upper limits, in units of the median, of the resolution of the data and of the size that the data
# suggest; the largest applies.  Few exposures of a larger scatter would otherwise be stated to
# scatter by exactly the limit.
MOST, MOST_RESOLVED, MOST_SUGGESTED = 100.0, 10.0, 10.0
MOST_CURVATURE = 10.0  # in units of the median: a few dates hardly constrain the curvature
NEGLIGIBLE = 1e-3  # density relative to the maximum
# smallest fraction of the information on a parameter that other exposures must have
LEAST_KEPT = 1e-6


@dataclass(frozen=True, eq=False)
class DeviationsInTime:
    """Posterior draws of the deviations of all exposures and of their correlation time."""

    epoch: Float  # (E,) dates of the exposures, decimal years
    coefficients: Float  # (n, E, q) deviations of the exposures, in the order of their kinds
    time: Float  # (n,) correlation times in years; 0 in draws with independent exposures

    def at(self, epoch: float) -> tuple[Float, Float]:
        """Normal distribution of the deviations of an exposure at another date, for each draw.

        Returns
        -------
        mean : ndarray, shape (n, q)
            Mean of the deviations, conditional on those of the other exposures.
        width : ndarray, shape (n,)
            Standard deviation, relative to the scatter of the exposures.
        """
        mean = np.zeros(self.coefficients[:, 0].shape)
        width = np.ones(len(self.time))
        everywhere = np.ones(len(self.epoch), bool)
        for time in np.unique(self.time[self.time > 0]):
            rows = np.flatnonzero(self.time == time)
            root = correlation_root(self.epoch, float(time), everywhere)
            correlation = np.exp(-np.abs(self.epoch - epoch) / time)
            white = scipy.linalg.solve_triangular(root, correlation, lower=True)
            weight = scipy.linalg.solve_triangular(root, white, trans=1, lower=True)
            mean[rows] = np.einsum("neq,e->nq", self.coefficients[rows], weight)
            width[rows] = np.sqrt(max(1.0 - white @ white, 0.0))
        return mean, width


@dataclass(frozen=True, eq=False)
class LinearDeviations:
    """Draws of the deviations of exposures, and of the curvature of the drift."""

    model: DistortionModel
    # (n, D) effect of the deviations on the parameters, with the sign of the parameters' error
    theta: Float
    # chip (by code), axis and index of each basis function with a curvature in time
    terms: tuple[tuple[int, int, int], ...]
    # (n, terms) second derivative with respect to time, in the unit of u and v per squared year
    curvature: Float
    epoch: float  # zero point of time, decimal years; NaN without curvature
    scatter: dict[str, Float]  # draws (n,) of each scatter
    n_exposures: int
    # kinds of deviations: 'shift', 'rotation', 'scale' and 'shear'
    kinds: tuple[str, ...] = ()
    # half the longer side of a chip, in the unit of u and v: the size of a shift by 1
    size: float = 1.0
    # codes of exposures with outlying deviations, which are excluded from the scatter
    outlying: tuple[int, ...] = ()
    # median correlation time of the deviations in years; 0 if they are independent
    correlation_time: float = 0.0
    # rms of the curvature over detector and dates, minus lines in time, both axes together
    bend: float = 0.0
    # None if the deviations are independent in all draws
    in_time: DeviationsInTime | None = None

    @property
    def facts(self) -> dict[str, object]:
        """Number of exposures and median scatters, for summaries."""
        scatter = {name: float(np.median(values)) for name, values in self.scatter.items()}
        out: dict[str, object] = {"exposures": self.n_exposures, "scatter": scatter}
        if self.correlation_time > 0:
            out["correlation_years"] = self.correlation_time
        return out

    def polynomials(self, epoch: float | None, chip: int) -> Float:
        """Coefficients (n, 2, K) on a chip of the curvature alone, at the date `epoch`."""
        out = np.zeros((len(self.curvature), 2, self.model.n_terms))
        code = self.model.chip_code(chip)
        for k, (c, axis, term) in enumerate(self.terms):
            if c == code and epoch is not None:
                out[:, axis, term] += 0.5 * self.curvature[:, k] * (epoch - self.epoch) ** 2
        return out

    def of_single_exposures(
        self, mean: Float, chip: int, rng: np.random.Generator, epoch: float | None = None
    ) -> Float:
        """Coefficients (n, 2, K) on a chip (by number) of the deviation of a future exposure.

        The deviations deform the polynomials of the parameters `mean` (D,).  If the deviations of
        exposures are correlated in time, those at the date `epoch` follow in part from the others.
        """
        code, n = self.model.chip_code(chip), len(self.theta)
        at = np.array([self.model.time.epoch0[0] if self.model.time else 0.0])
        P = self.model.polynomials(mean, np.array([code]), at)[0].copy()
        P[:, 0] = 0.0
        along = np.zeros((2, *P.shape))
        along[0, 0, 0] = along[1, 1, 0] = self.size
        fields = [
            (kind, field)
            for kind in self.kinds
            for field in (
                along if kind == "shift" else [LINEAR_MATRICES[k] @ P for k in LINEAR[kind]]
            )
        ]
        expected, width = np.zeros((n, len(fields))), np.ones(n)
        if self.in_time is not None and epoch is not None:
            expected, width = self.in_time.at(epoch)
        out = np.zeros((n, *P.shape))
        for k, (kind, field) in enumerate(fields):
            size = expected[:, k] + width * self.scatter[SCATTERS[kind]] * rng.standard_normal(n)
            out += size[:, None, None] * field
        return out


@dataclass(frozen=True, eq=False)
class DeviationColumns:
    """Displacements of the stars of some groups by functions with random coefficients."""

    model: DistortionModel
    theta: Float
    kinds: tuple[str, ...]  # kinds of deviations of each exposure
    # chip (by code), axis and index of each basis function with a curvature in time
    terms: tuple[tuple[int, int, int], ...]
    scatter: NDArray[np.str_]  # (n,) name of the scatter of each coefficient
    # (G,) exposure of each group of stars, from 0; -1 if its deviations are not estimated
    of_group: Int
    n_exposures: int  # number of exposures with estimated deviations
    n_all: int  # number of all exposures
    middle: float  # zero point of time; NaN without curvature terms
    size: float  # half the longer side of a chip, in the unit of u and v
    # code, epoch (n_exposures,): of each exposure, and its date in decimal years
    code: Int
    epoch: Float

    def __len__(self) -> int:
        return len(self.scatter)

    @property
    def n_of_exposures(self) -> int:
        """Number of coefficients that are deviations of exposures; they precede the curvatures."""
        return len(self) - len(self.terms)

    def positions(self, chip: int, epoch: float, phi: Float) -> Float:
        """Positions (C, 2) along the axes of the polynomials, for the basis (C, K)."""
        poly = self.model.polynomials(self.theta, np.array([chip]), np.array([epoch]))
        return np.asarray(phi @ poly[..., 0, :, :].T)

    def at(self, g: int, chip: int, epoch: float, phi: Float, centre: Float) -> tuple[Int, Float]:
        """Indices (q,) of the functions that displace stars of a group, and their values (C, 2, q).

        Exposures deviate about `centre` (2,); `phi` (C, K) is the model's basis at the stars.
        """
        displacements = _deviations(
            self.positions(chip, epoch, phi) - centre, self.kinds, self.size
        )
        if self.of_group[g] < 0:
            displacements = displacements[:, :, :0]
        columns = int(self.of_group[g]) * displacements.shape[2] + np.arange(displacements.shape[2])
        curved = [k for k, term in enumerate(self.terms) if term[0] == chip]
        out = np.zeros((len(phi), 2, len(curved)))
        for k, number in enumerate(curved):
            _, axis, term = self.terms[number]
            out[:, axis, k] = 0.5 * (epoch - self.middle) ** 2 * self.size * phi[:, term]
        columns = np.concatenate([columns, self.n_of_exposures + np.array(curved, np.int64)])
        return columns, np.concatenate([displacements, out], axis=2)


def deviation_columns(
    model: DistortionModel,
    theta: Float,
    groups: Groups,
    counts: Float,
    *,
    exposures: bool = True,
    second_order: bool = False,
    most: int | None = None,
) -> DeviationColumns | None:
    """Deviations that the frames of a model do not include, and curvatures of its drift.

    `counts` (G,) is the number of stars of each group.  Without `exposures`, single exposures do
    not deviate; this is the case if a hierarchy of them was fitted.  With `second_order` they
    deviate in terms of the second order as well.  Returns None if nothing can deviate, for example
    for a single exposure without a drift.

    The deviations of at most `most` exposures are estimated; by default as many as have
    `MAX_DEVIATIONS` deviations.  If there are more exposures, the selected ones represent all and
    are at most half of them: the polynomials follow the mean of all exposures, including the
    selected ones, and the deviations of the others cannot be separated from that mean.
    """
    keys = np.column_stack([groups.exposure, groups.epoch])
    distinct, of_group = np.unique(keys, axis=0, return_inverse=True)
    n_all = n_exposures = len(distinct)
    kinds = tuple(k for k, fitted in KINDS.items() if model.frames not in fitted)
    if second_order:
        kinds = (*kinds, QUADRATIC)
    if n_all < 2 or not exposures:
        kinds = ()
    chosen = np.arange(n_all)
    per_exposure = [SCATTERS[k] for k in kinds for _ in range(COEFFICIENTS[k])]
    if most is None:
        most = MAX_DEVIATIONS // max(len(per_exposure), 1)
    if kinds and n_all > most:
        n_exposures = min(most, n_all // 2)
        # one random exposure per interval of equal length, so that all dates are represented
        uniform = np.random.default_rng(n_all).uniform(size=n_exposures)
        chosen = ((np.arange(n_exposures) + uniform) * n_all / n_exposures).astype(int)
    number = np.full(n_all, -1)
    number[chosen] = np.arange(n_exposures)
    terms = _bending(model)
    scatter = np.array([*per_exposure * n_exposures, *[CURVATURE] * len(terms)])
    if not len(scatter):
        return None
    return DeviationColumns(
        model=model,
        theta=theta,
        kinds=kinds,
        terms=terms,
        scatter=scatter,
        of_group=number[of_group.ravel()],
        n_exposures=n_exposures,
        n_all=n_all,
        middle=float(np.average(groups.epoch, weights=counts)) if terms else np.nan,
        size=model.pixel_size(theta) * max(max(c.size) for c in model.chips) / 2,
        code=distinct[chosen, 0].astype(np.int64),
        epoch=distinct[chosen, 1],
    )


def linear_deviations(
    information: Information,
    working: Information,
    priors: DiscrepancyPriors,
    n: int,
    rng: np.random.Generator,
    *,
    exposures: bool,
) -> LinearDeviations | None:
    """Posterior draws of the deviations of exposures and of the curvature of drifts.

    `information` includes the excess variance of the scores, `working` is that of the likelihood of
    the solution.  Returns None if nothing can deviate.
    """
    model = working.model
    counts = np.array([c.count.sum() for c in working.groups()])
    groups = working.sums.groups
    columns = deviation_columns(model, working.theta, groups, counts, exposures=exposures)
    if columns is None:
        return None
    total = len(columns)
    centre = np.mean(
        [columns.positions(c.chip, c.epoch, c.phi).mean(axis=0) for c in working.groups()], axis=0
    )

    S, score = np.zeros((total, total)), np.zeros(total)
    crossed = [np.zeros((model.n_params, total)) for _ in range(2)]
    for source_index, source in enumerate((information, working)):
        for g, cells in enumerate(source.groups()):
            # the coefficients that displace these stars are few of all
            at, values = columns.at(g, cells.chip, cells.epoch, cells.phi, centre)
            moved = np.einsum("ab,cbq->caq", cells.frame, values)
            pulled = np.einsum("cab,cbq->caq", cells.curvature, moved, optimize=True)
            crossed[source_index][np.ix_(cells.columns, at)] += cells.onto_parameters(pulled)
            if source_index == 0:
                S[np.ix_(at, at)] += np.einsum("caq,car->qr", moved, pulled, optimize=True)
                score[at] += np.einsum("caq,ca->q", moved, cells.score, optimize=True)
    efficient = EfficientScore.of(information.covariance, information.score, crossed[0], S, score)
    response = working.covariance @ crossed[1]
    return deviation_draws(
        columns,
        efficient.information,
        efficient.score,
        response,
        priors,
        n,
        rng,
        change=partial(_change_without, working, columns),
    )


def _change_without(working: Information, columns: DeviationColumns, wrong: Bool) -> Float:
    """Change (D,) of the fit without the exposures that are True in the mask `wrong` (E,).

    The step of Newton's method is that of the likelihood of the other exposures.  The fit follows
    stars that deviate by several errors less than in proportion to their deviation, because it
    takes them for false matches.  The curvature at the solution does not show this, but their
    scores do.
    """
    D = len(working.theta)
    score, information = np.zeros(D), np.zeros((D, D))
    for g, cells in enumerate(working.groups()):
        exposure = columns.of_group[g]
        if exposure < 0 or not wrong[exposure]:
            continue
        score[cells.columns] += cells.onto_parameters(cells.score[..., None])[:, 0]
        jacobian = np.einsum("ck,akm->cam", cells.phi, cells.derivative)
        pulled = np.einsum("cab,cbm->cam", cells.curvature, jacobian)
        information[np.ix_(cells.columns, cells.columns)] += cells.onto_parameters(pulled)
    left = working.precision - information
    # the frames of these exposures are no longer determined
    kept = np.flatnonzero(np.diag(left) > LEAST_KEPT * np.diag(working.precision))
    change = np.zeros(D)
    change[kept] = -scaled_inverse(left[np.ix_(kept, kept)]) @ score[kept]
    return change


def deviation_draws(
    columns: DeviationColumns,
    S: Float,
    score: Float,
    taken: Float,
    priors: DiscrepancyPriors,
    n: int,
    rng: np.random.Generator,
    *,
    change: Callable[[Bool], Float] | None = None,
) -> LinearDeviations:
    """Posterior draws of deviations, with the sizes of their scatters marginalised.

    S (q, q) and `score` (q,) are information and score of the coefficients, with the part that the
    fit absorbs eliminated.  `taken` (D, q) is the change of the fit due to a unit of each
    coefficient.  `change` is a function of a mask (E,) of outlying exposures that returns the
    change (D,) of the fit without them; by default the fit follows them in proportion to their
    deviations.
    """
    total, scatter = len(columns), columns.scatter
    medians = {
        "shift": priors.exposure,
        "rotation": priors.exposure,
        "shape": priors.exposure,
        CURVATURE: priors.curvature,
    }
    names = list(dict.fromkeys(scatter.tolist()))
    index = np.array([names.index(s) for s in scatter])
    limits = []
    for k, name in enumerate(names):
        diagonal = np.diag(S)[index == k]
        diagonal = diagonal[diagonal > 1e-8 * max(float(diagonal.max()), 1e-300)]
        resolved = 1 / np.sqrt(np.median(diagonal)) if diagonal.size else medians[name]
        low = LEAST * min(medians[name], resolved)
        high = (MOST_CURVATURE if name == CURVATURE else MOST) * medians[name]
        limits.append((low, max(high, MOST_RESOLVED * resolved if resolved < 1e-2 else 0.0)))
    values, vectors = np.linalg.eigh(S)
    S = (vectors * np.maximum(values, 0.0)) @ vectors.T
    suggested, _ = _given(S, score, np.array([high for _, high in limits])[index])
    grids = []
    for k, (name, (low, high)) in enumerate(zip(names, limits, strict=True)):
        if name != CURVATURE:
            squares = suggested[index == k].reshape(columns.n_exposures, -1) ** 2
            # robust, because a few exposures may be outlying
            high = max(high, MOST_SUGGESTED * np.sqrt(np.median(squares.mean(axis=1))))
        grids.append(np.geomspace(low, high, COARSE[len(names) - 1]))
    first = np.array([grid[len(grid) // 2] for grid in grids])
    loose = _outlying(columns, S, score, index, first)
    roots = _roots(columns, S, score, index, loose, first)
    starts = [root.started(S, score) for root in roots]

    def conditional(k: int, amplitude: Float) -> tuple[Float, Float, Float]:
        """Scales of the coefficients, factor of their scaled precision, and the scaled score."""
        spread = np.where(loose > 0, 1.0, amplitude[index])
        information, pull = starts[k]
        scaled = information * np.outer(spread, spread) + np.eye(total)
        factor = scipy.linalg.cholesky(scaled, lower=True, check_finite=False)
        return spread, factor, scipy.linalg.solve_triangular(factor, spread * pull, lower=True)

    def weights(grids: Sequence[Float]) -> Float:
        """Posterior weights of all correlation times and combinations, the largest 1."""
        widths = np.ix_(*(np.exp(log_widths(g)) for g in grids))
        density = np.empty([len(roots), *(len(g) for g in grids)])
        for k, root in enumerate(roots):
            for at, amplitude in zip(np.ndindex(density.shape[1:]), product(*grids), strict=True):
                _, factor, z = conditional(k, np.array(amplitude))
                log = 0.5 * z @ z - np.log(np.diag(factor)).sum() + np.log(root.prior)
                density[(k, *at)] = log + sum(
                    log_half_t(a, medians[name]) for a, name in zip(amplitude, names, strict=True)
                )
        weight = np.exp(density - density.max()) * reduce(np.multiply, widths)
        return np.asarray(weight / weight.max())

    grids = _where_it_counts(grids, weights(grids).max(axis=0))
    weight = weights(grids)
    counts = rng.multinomial(n, (weight / weight.sum()).ravel())
    drawn, followed, sizes, times = [], [], [], []
    combinations = product(range(len(roots)), product(*grids))
    for (k, amplitude), m in zip(combinations, counts, strict=True):
        if m:
            spread, factor, z = conditional(k, np.array(amplitude))
            z = z[:, None] + rng.standard_normal((total, m))
            z = scipy.linalg.solve_triangular(factor, z, trans=1, lower=True)
            drawn.append((roots[k].matrix @ (spread[:, None] * z)).T)
            followed.append(
                drawn[-1] + _of_all_exposures(columns, roots[k], spread, loose, drawn[-1], rng)
            )
            sizes.append(np.tile(amplitude, (m, 1)))
            times.append(np.full(m, roots[k].time))
    order = rng.permutation(n)
    coefficients, amplitudes = np.concatenate(drawn)[order], np.concatenate(sizes)[order]
    of_fit = np.concatenate(followed)[order]
    per = columns.n_of_exposures // max(columns.n_exposures, 1)
    wrong: Bool = np.asarray(
        loose[: columns.n_of_exposures].reshape(columns.n_exposures, -1).any(axis=1)
    )
    correlation_time = np.concatenate(times)[order]
    shift = np.zeros(len(taken))
    if change is not None and wrong.any():
        shift = change(wrong)
        of_fit[:, : columns.n_of_exposures][:, np.repeat(wrong, per)] = 0.0
    in_time = None
    if correlation_time.any() and columns.n_exposures == columns.n_all:
        by_exposure = coefficients[:, : columns.n_of_exposures].reshape(n, columns.n_exposures, -1)
        typical = np.flatnonzero(np.logical_not(wrong))
        in_time = DeviationsInTime(
            columns.epoch[typical], by_exposure[:, typical], correlation_time
        )
    return LinearDeviations(
        model=columns.model,
        # the fit absorbs a deviation, so that its error has the opposite sign
        theta=shift - of_fit @ taken.T,
        terms=columns.terms,
        curvature=(curvature := coefficients[:, columns.n_of_exposures :] * columns.size),
        epoch=columns.middle,
        scatter={name: amplitudes[:, k] for k, name in enumerate(names)},
        n_exposures=columns.n_all,
        kinds=columns.kinds,
        size=columns.size,
        outlying=tuple(int(code) for code in columns.code[wrong]) if per else (),
        correlation_time=float(np.median(correlation_time)),
        bend=_bend(columns, curvature),
        in_time=in_time,
    )


def _of_all_exposures(
    columns: DeviationColumns,
    root: _CovarianceRoot,
    spread: Float,
    loose: Float,
    drawn: Float,
    rng: np.random.Generator,
) -> Float:
    """Difference between the coefficients that the parameters follow and the `drawn` ones (m, n).

    It is zero if the deviations of all exposures were estimated.  If a subset represents all
    exposures, it does not determine their mean.  The parameters then follow deviations that are
    drawn from the prior and multiplied by the ratio of the variation of the mean of all exposures
    to that of the sum over the subset.  Outlying exposures are not typical, and their draws are not
    changed.
    """
    out, n = np.zeros_like(drawn), columns.n_of_exposures
    if columns.n_all == columns.n_exposures or not n:
        return out
    times = columns.n_all / columns.n_exposures
    if root.time == 0:  # independent deviations add in quadrature
        times = np.sqrt(times)
    anew = root.matrix[:n, :n] @ (spread[:n, None] * rng.standard_normal((n, len(drawn))))
    out[:, :n] = np.where(loose[:n] > 0, 0.0, times * anew.T - drawn[:, :n])
    return out


def _bend(columns: DeviationColumns, curvature: Float) -> float:
    """Rms of curvatures (n, terms) over the detector and the dates, minus lines in time."""
    if not columns.terms:
        return 0.0
    years = columns.epoch - columns.middle
    square = years**2
    design = np.column_stack([np.ones(len(years)), years])
    square = square - design @ np.linalg.lstsq(design, square)[0]
    mean_square = columns.model.basis().mean_squares
    area = np.array([mean_square[term] for _, _, term in columns.terms])
    area = area / len({chip for chip, _, _ in columns.terms})
    return float(0.5 * np.sqrt(np.mean(square**2) * np.mean(curvature**2 @ area)))


@dataclass(frozen=True, eq=False)
class _CovarianceRoot:
    """Linear combinations of independent coefficients that have one correlation time."""

    time: float  # in years; 0 for independent exposures
    prior: float  # prior probability
    matrix: Float  # (n, n) without the scales of coefficients of typical exposures

    def started(self, S: Float, score: Float) -> tuple[Float, Float]:
        """Information and score of the independent coefficients."""
        return self.matrix.T @ S @ self.matrix, self.matrix.T @ score


def _roots(
    columns: DeviationColumns, S: Float, score: Float, index: Int, loose: Float, scale: Float
) -> list[_CovarianceRoot]:
    """Correlation times of the deviations, or independence alone.

    Correlation times are considered only if there is a drift and the data suggest a correlation.
    """
    n, E = columns.n_of_exposures, columns.n_exposures
    scales = np.where(loose > 0, loose, 1.0)
    independent = _CovarianceRoot(0.0, 1.0, np.diag(scales))
    if not n or columns.model.time is None:
        return [independent]
    mean, _ = _given(S, score, np.where(loose > 0, loose, WIDE * scale[index]))
    wrong: Bool = np.asarray(loose[:n].reshape(E, -1).any(axis=1))
    typical = mean[:n].reshape(E, -1)[~wrong]
    p, _ = correlation_p(typical, columns.epoch[~wrong], columns.model.time.breaks)
    if p > SUSPECTED:
        return [independent]
    out = [replace(independent, prior=UNCORRELATED)]
    for fraction in CORRELATION_TIMES:
        time = float(fraction * np.ptp(columns.epoch))
        matrix = np.diag(scales)
        root = correlation_root(columns.epoch, time, np.logical_not(wrong))
        matrix[:n, :n] = scales[:n, None] * np.kron(root, np.eye(n // E))
        out.append(_CovarianceRoot(time, (1 - UNCORRELATED) / len(CORRELATION_TIMES), matrix))
    return out


def _given(S: Float, score: Float, spread: Float) -> tuple[Float, Float]:
    """Mean (n,) and covariance (n, n) of coefficients with prior standard deviations `spread`."""
    scaled = S * np.outer(spread, spread) + np.eye(len(S))
    inverse = scipy.linalg.inv(scaled) * np.outer(spread, spread)
    return inverse @ score, inverse


def _outlying(columns: DeviationColumns, S: Float, score: Float, index: Int, scale: Float) -> Float:
    """Prior standard deviations (n,) of the coefficients of outlying exposures; 0 for all others.

    The most outlying exposures are removed one by one, according to the odds of a scatter that is
    ten times as large as that of the others (`infer.exposures.scatter`).  If more than a fifth
    would be removed, none are.
    """
    total, E = len(S), columns.n_exposures
    out = np.zeros(total)
    per = columns.n_of_exposures // max(E, 1)
    if E < MIN_OF_OTHERS or not per:
        return out
    kind, coefficient_index = index[:per], np.arange(E * per).reshape(E, per)
    while (out[coefficient_index].any(axis=1)).sum() <= MOST_OUTLYING * E:
        tight: Bool = np.logical_not(out[coefficient_index].any(axis=1))
        spread = np.where(out > 0, out, WIDE * scale[index])
        mean, _ = _given(S, score, spread)
        b = mean[coefficient_index] - np.median(mean[coefficient_index][tight], axis=0)
        # an outlier would increase a non-robust scatter and thereby go unnoticed
        robust = (1.4826 * np.median(np.abs(b[tight]), axis=0)) ** 2
        sizes = np.sqrt([np.mean(robust[kind == k]) for k in kind])
        spread[coefficient_index[tight]] = np.maximum(sizes, 1e-2 * scale[kind])
        mean, cov = _given(S, score, spread)
        squares = (mean**2 + np.diag(cov))[coefficient_index]
        odds = np.full(E, -np.inf)
        for e in np.flatnonzero(tight):
            rows = coefficient_index[e]
            inverse = np.linalg.inv(cov[np.ix_(rows, rows)])
            information = inverse - np.diag(spread[rows] ** -2.0)
            pull = inverse @ mean[rows]
            is_other = np.logical_and(tight, np.arange(E) != e)
            other_variance = np.array([np.mean(squares[is_other][:, kind == k]) for k in kind])
            evidence = []
            for times in (1.0, OUTLYING):
                precision = 1 / (times**2 * other_variance)
                values = np.linalg.eigvalsh(information / np.sqrt(np.outer(precision, precision)))
                fit = pull @ np.linalg.solve(information + np.diag(precision), pull)
                evidence.append(0.5 * (fit - np.log1p(np.maximum(values, 0.0)).sum()))
            odds[e] = evidence[1] - evidence[0]
        odds += np.log(OUTLYING_FRACTION / (1 - OUTLYING_FRACTION))
        worst = int(np.argmax(odds))
        if odds[worst] <= 0:
            return out
        size = np.array([np.sqrt(np.mean(b[worst, kind == k] ** 2)) for k in kind])
        out[coefficient_index[worst]] = np.maximum(
            size, OUTLYING * spread[coefficient_index[worst]]
        )
    return np.zeros(total)


def _where_it_counts(grids: Sequence[Float], weight: Float) -> list[Float]:
    """Finer grids over the range of amplitudes with a density that is not negligible."""
    out = []
    for k, grid in enumerate(grids):
        best = weight.max(axis=tuple(a for a in range(weight.ndim) if a != k))
        likely = np.flatnonzero(best > NEGLIGIBLE)
        low, high = max(likely[0] - 1, 0), min(likely[-1] + 1, len(grid) - 1)
        out.append(np.geomspace(grid[low], grid[high], REFINED[len(grids) - 1]))
    return out


def _bending(model: DistortionModel) -> tuple[tuple[int, int, int], ...]:
    """Basis functions that may be curved in time: those that drift in the model, on each chip."""
    if model.time is None:
        return ()
    out = []
    for chip in range(len(model.chips)):
        powers = model.basis(model.chips[chip].number).terms
        for axis, i, j in model.time.terms:
            out.append((chip, "uv".index(axis), powers.index((i, j))))
    return tuple(out)


def _deviations(position: Float, kinds: Sequence[str], size: float) -> Float:
    """Displacements (C, 2, q) due to unit deviations of each kind.

    Shifts, and the largest displacements of the second order, are in half sides of a chip.
    """
    chosen = [np.zeros((len(position), 0, 2))]
    for kind in kinds:
        if kind == "shift":
            chosen.append(np.broadcast_to(size * np.eye(2), (len(position), 2, 2)))
        elif kind == QUADRATIC:
            X, Y = position.T / size
            terms = size * np.stack([X**2, X * Y, Y**2], axis=1)
            chosen.append(np.einsum("ck,ab->cakb", terms, np.eye(2)).reshape(len(position), 6, 2))
        else:
            matrices = np.stack([LINEAR_MATRICES[name] for name in LINEAR[kind]])
            chosen.append(np.einsum("kab,cb->cka", matrices, position))
    return np.swapaxes(np.concatenate(chosen, axis=1), 1, 2)
