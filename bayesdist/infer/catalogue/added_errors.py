"""Errors to be added to the quoted errors: one for both axes, or one per group of stars.

A star of group g has, along an axis, the variance s^2 + a_g.  The a_g maximise the restricted
likelihood (REML; Patterson and Thompson 1971), in which the part of the residuals that the fit
absorbs is added star by star,

    E[e_i^2] = r_i^2 + x_i^T C x_i

with the covariance C of the fit and the derivatives x_i of the star's position.  Without this term
the errors would be too small, depending on the number of parameters per star.  Good stars and false
matches are separated by the mixture of `by_magnitude`, so that false matches have little influence.
Parameters, memberships and errors are updated in turn, each step increasing the same bound.

Groupings are compared by their evidence (Laplace approximation, unit-information priors),

    ln E = ln L_R / c - sum_g ln(n_g) / 2

where n_g is the number of good stars in a group.  The dispersion c is the variance of the sums of
squares relative to that of independent normal errors.  It is estimated from the squares, with all
detections of a star taken together, so that neither long tails nor stars with many matches suggest
groups that do not exist.  The second term prevents small groups from being split off.  If there are
many groups, their errors are shrunk towards the common error, as far as their differences may be
noise (empirical Bayes), since the results are used as if they were exact.

Errors that are correlated between u and v enter by their variances alone, so that the estimates
remain consistent.  What the squares of both axes have in common is in the stated error of an error
for both axes, by its own dispersion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.data.magnitude_errors import AddedErrors
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.magnitude_errors import (
    FALSE,
    false_matches,
    refitted,
    residuals_of,
    variances_of,
)
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import good_probability, log_densities
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int

ONE, AXIS = "one", "axis"
STARS = 50_000  # sample size; it determines the errors to half a percent
PER_EXPOSURE = 100  # the sample has on average at least this many stars per exposure and chip
DECISIVE = 3.0  # ln evidence (odds of 20 to 1) required for a grouping
MATERIAL = 0.01  # relative difference in the errors of typical stars required for a grouping
SETTLED, TURNS = 1e-3, 50  # tolerance in ln variance, and maximum number of iterations
HALVINGS = 45  # number of bisections in the search for an added variance
WIDER = 5.0  # smallest ratio of the scatter of false matches to that of typical good ones
SHRUNK = 3  # smallest number of groups whose scatter can be estimated
MOST_LISTED = 4  # largest number of groups that a sentence lists individually


@dataclass(frozen=True, eq=False)
class GroupedErrors:
    """Added errors by group, for the grouping with the largest evidence."""

    # 'one' (a single error for both axes), 'axis', 'chip', 'exposure', 'filter' (each with the same
    # error for both axes), or 'chip and axis' and so on
    grouping: str
    by: str  # 'chip', 'exposure', 'filter' or empty
    labels: tuple[str, ...]  # labels of the G groups, as in `AddedErrors`
    n: Float  # number of good stars (G, 2) from which each error is estimated
    variance: Float  # added variances (G, 2) along u and v
    error: Float  # standard errors (G, 2) of the variances
    evidence: dict[str, float]  # ln evidence relative to 'one', by grouping
    dispersion: float  # the dispersion c

    @property
    def by_axis(self) -> bool:
        """True if the axes have different errors."""
        return self.grouping.endswith(AXIS)

    @property
    def sigma(self) -> Float:
        """Added errors (G, 2) along u and v, in the unit of u and v."""
        return np.sqrt(self.variance)

    @property
    def sigma_error(self) -> Float:
        """Standard errors (G, 2) of `sigma`, in the unit of u and v.

        They are limited near zero by the standard errors of the variance.
        """
        return self.error / (2.0 * np.sqrt(np.maximum(self.variance, self.error)))

    @property
    def excess(self) -> Float:
        """Errors (G, 2) to add in quadrature to the quoted ones, in the unit of u and v.

        The smallest added variance is subtracted, because the jitter describes it for all groups.
        """
        return np.sqrt(self.variance - self.variance.min())

    @property
    def added(self) -> AddedErrors | None:
        """Errors `excess` as `AddedErrors`; None if a single jitter is enough."""
        if self.grouping == ONE:
            return None
        excess = self.excess
        weight = np.maximum(self.n, 1e-300)
        average = np.sqrt(np.average(excess**2, axis=0, weights=weight))
        return AddedErrors(self.by, self.labels, excess, average)

    def sentence(self, unit: str) -> str:
        """Clause about errors in addition to the quoted ones; `unit` is that of u and v."""
        evidence = ", ".join(f"{name} {gain:.3g}" for name, gain in self.evidence.items())
        head = f"ln evidence gained by groups: {evidence}"
        if self.grouping == ONE:
            return f"one jitter for both axes ({head})"
        each, joint = list(self._each()), ", "
        if len(each) > MOST_LISTED:
            each, joint = [min(each), max(each)], " to "
        sizes = joint.join(
            f"{value:.3g} +- {error:.2g} {unit} {group_name}" for value, error, group_name in each
        )
        return (
            f"the errors beyond the quoted ones differ by {self.grouping}: {sizes} ({head}); what "
            "each has beyond the least was added to the quoted errors, and the jitter is the least"
        )

    def _each(self) -> Iterator[tuple[float, float, str]]:
        """Added error, its standard error, and the name of the group, for each group and axis."""
        for g, label in enumerate(self.labels):
            of = f"of {self.by} {label}" if self.by else ""
            for a in range(2 if self.by_axis else 1):
                along = f"along {'uv'[a]}" if self.by_axis else ""
                group_name = " ".join(part for part in (along, of) if part)
                yield float(self.sigma[g, a]), float(self.sigma_error[g, a]), group_name


@dataclass(eq=False)
class _State:
    """State of the maximisation: fit, mixture and added variances of one grouping."""

    fit: LinearFit
    square: Float  # expected squared errors (2, N)
    f: float  # fraction of false matches
    wide: float  # variance of false matches
    variance: Float  # added variances, one per group
    good: Float  # probability (N,) of being a true match
    log_likelihood: float = -np.inf  # restricted log-likelihood


def grouped_errors(
    matches: Matches,
    fit: LinearFit,
    *,
    by: str = "",
    outliers: bool = True,
    priors: GaussianPriors | None = None,
) -> GroupedErrors:
    """Estimate added errors for several groupings of the stars and select the best grouping.

    Parameters
    ----------
    matches : Matches
        Stars with quoted errors. A sample is used if there are very many.
    fit : LinearFit
        Fit to these matches, or to the matches from which they were sampled; starting point.
    by : str
        'chip', 'exposure' or 'filter' to compare groups by these in addition to a single error and
        an error per axis.
    outliers : bool
        True if some matches may be false.
    priors : GaussianPriors, optional
        Priors of the fit.

    Returns
    -------
    GroupedErrors

    Raises
    ------
    InputError
        If `by` is given and all matches have the same chip, exposure or filter.
    DegenerateError
        If the sample does not determine the model.
    """
    model = fit.model
    count = max(STARS, PER_EXPOSURE * len(model.exposures) * len(model.chips))
    table = matches.sample(count)
    names, label = table.grouped(by)
    present, label = np.unique(label, return_inverse=True)
    labels = tuple(names[k] for k in present)
    if by and len(labels) < 2:
        raise InputError(
            f"outliers.jitter_by is {by!r}, but all matches have the same {by}",
            where=", ".join(table.sources),
            do=f"leave it out, or name the column of the {by}s in data.columns",
        )
    axis = np.array([[0], [1]])
    codes = {ONE: np.zeros((2, len(table)), np.int64), AXIS: axis + 0 * label}
    if by:
        codes |= {by: np.stack([label, label]), f"{by} and {AXIS}": 2 * label + axis}
    quoted = _quoted(table)
    state = _starting_state(table, fit, quoted, outliers)
    states = {}
    for name, code in codes.items():
        states[name] = state = _maximised(table, model, quoted, code, state, outliers, priors)
    last = list(codes)[-1]
    dispersion = _dispersion(table, states[last], quoted, codes[last])
    counts = {name: _counts(states[name].good, code) for name, code in codes.items()}
    value = {
        name: state_of_grouping.log_likelihood / dispersion
        - 0.5 * np.log(np.maximum(counts[name], 1.0)).sum()
        for name, state_of_grouping in states.items()
    }
    evidence = {name: float(value[name] - value[ONE]) for name in codes if name != ONE}
    best = max(evidence, key=lambda name: evidence[name])
    typical = _typical(table, quoted + states[best].variance.min())
    spread = np.ptp(states[best].variance) / typical
    if evidence[best] < DECISIVE or np.sqrt(1.0 + spread) < 1.0 + MATERIAL:
        best = ONE
    if table.rho_uv is not None:
        dispersion = _dispersion(table, states[best], quoted, codes[best])
    return _result(best, by, labels, states[best], quoted, codes[best], evidence, dispersion)


def _quoted(table: Matches) -> Float:
    """Quoted variances (2, N)."""
    return np.stack([table.column("sigma_u"), table.column("sigma_v")]) ** 2


def _typical(table: Matches, squares: Float) -> float:
    """Median of squares (2, N) of stars whose motion is measured; of all stars if none is."""
    measured = ~table.motion_is_assumed
    return float(np.median(squares[:, measured] if measured.any() else squares))


def _starting_state(table: Matches, fit: LinearFit, quoted: Float, outliers: bool) -> _State:
    """Starting state with a common added variance, from the median residual."""
    square, typical = residuals_of(fit, table) ** 2, _typical(table, quoted)
    core = _typical(table, square) / 0.4549  # median of a squared standard normal variable
    variance = max(0.0, core - typical)
    wide = max(WIDER**2 * max(core, typical), float(square.sum(axis=0).max()) / 8)
    f = FALSE[0] if outliers else 0.0
    return _State(fit, square, f, wide, np.full(1, variance), np.ones(len(table)))


def _maximised(
    table: Matches,
    model: DistortionModel,
    quoted: Float,
    code: Int,
    start: _State,
    outliers: bool,
    priors: GaussianPriors | None,
) -> _State:
    """State at the maximum of the restricted likelihood; `code` (2, N) is the group per axis."""
    n_groups = int(code.max()) + 1
    variance = np.full(n_groups, float(np.average(start.variance)))
    f, wide, square, typical = start.f, start.wide, start.square, _typical(table, quoted)
    fit = start.fit
    for _ in range(TURNS):
        var = quoted + variance[code]
        good = good_probability(square, var, f, wide) if outliers else np.ones(len(table))
        if outliers:
            f, wide = false_matches(good, square, WIDER**2 * _typical(table, var))
        before, variance = variance, _maxima(quoted, square, good, code, n_groups)
        var = quoted + variance[code]
        fit, residual = refitted(table, model, var, good, priors)
        square = residual**2 + variances_of(fit, table)
        if (np.abs(variance - before) < SETTLED * (typical + variance)).all():
            break
    if outliers:
        each = np.logaddexp(*log_densities(residual**2, var, f, wide))
    else:
        each = -0.5 * (residual**2 / var + np.log(var)).sum(axis=0)
    # with the determinant of the normal matrix this is the restricted likelihood
    value = float(each.sum() + 0.5 * np.linalg.slogdet(fit.cov)[1])
    return _State(fit, square, f, wide, variance, good, value)


def _maxima(quoted: Float, square: Float, good: Float, code: Int, n_groups: int) -> Float:
    """Added variance a >= 0 (G,) of each group that maximises its likelihood.

    It is the zero of the derivative, sum w (e^2 - s^2 - a) / (s^2 + a)^2, found by bisection.
    """
    flat, weight = code.ravel(), np.concatenate([good, good])
    s2, e2 = quoted.ravel(), square.ravel()

    def rising(a: Float) -> Bool:
        var = s2 + a[flat]
        return np.bincount(flat, weight * (e2 - var) / var**2, n_groups) > 0

    low = np.zeros(n_groups)
    high = np.bincount(flat, weight * e2, n_groups) / np.maximum(
        np.bincount(flat, weight, n_groups), 1e-300
    )
    for _ in range(
        HALVINGS
    ):  # raise the upper limit if stars with small errors have large residuals
        if not (up := rising(high)).any():
            break
        high = np.where(up, 2.0 * high, high)
    inside = rising(low)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        up = rising(middle)
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    return np.where(inside, 0.5 * (low + high), 0.0)


def _counts(good: Float, code: Int) -> Float:
    """Expected number (G,) of good measurements in each group, counting both axes of a star."""
    return np.asarray(np.bincount(code.ravel(), np.concatenate([good, good])), float)


def _dispersion(table: Matches, state: _State, quoted: Float, code: Int) -> float:
    """Dispersion c: variance of sums of squares relative to independent normal errors."""
    var = quoted + state.variance[code]
    score = state.good * (state.square / var - 1.0)
    star = np.arange(len(table)) if table.star is None else table.star
    n_groups = int(code.max()) + 1
    _, of = np.unique((star * n_groups + code).ravel(), return_inverse=True)
    sums = np.bincount(of, score.ravel())
    return max(1.0, float((sums**2).sum() / (4.0 * state.good.sum())))


def _result(
    grouping: str,
    by: str,
    labels: tuple[str, ...],
    state: _State,
    quoted: Float,
    code: Int,
    evidence: dict[str, float],
    dispersion: float,
) -> GroupedErrors:
    """Arrange the results of the selected grouping by label and axis, shrunk if necessary."""
    columns = 2 if grouping.endswith(AXIS) else 1
    flat, weight = code.ravel(), np.concatenate([state.good, state.good])
    weight = weight / (quoted + state.variance[code]).ravel() ** 2
    total = np.maximum(np.bincount(flat, weight), 1e-300)
    error = np.sqrt(2.0 * dispersion / total)
    n = _counts(state.good, code) / (3 - columns)  # stars, not axes of stars
    variance = state.variance
    if len(variance) >= SHRUNK * columns:
        total_variance = np.bincount(flat, weight * state.square.ravel()) / total
        quoted_variance = np.bincount(flat, weight * quoted.ravel()) / total
        variance = variance.copy()
        for k in range(columns):
            rows = slice(k, None, columns)
            drawn = _shrunk(total_variance[rows], (error[rows] / total_variance[rows]) ** 2)
            variance[rows] = np.maximum(drawn - quoted_variance[rows], 0.0)
    several = grouping.startswith(by) if by else False
    n, variance, error = (
        np.broadcast_to(values.reshape(-1, columns), (len(values) // columns, 2))
        for values in (n, variance, error)
    )
    return GroupedErrors(
        grouping,
        by if several else "",
        labels if several else ("",),
        n,
        variance,
        error,
        evidence,
        dispersion,
    )


def _shrunk(variance: Float, noise: Float) -> Float:
    """Shrink the logarithms of variances (G,) towards their mean (DerSimonian and Laird 1986).

    `noise` (G,) is the sampling variance of each logarithm.  Half of it is added to the logarithm,
    to correct the bias of the logarithm of an estimate.
    """
    log = np.log(variance) + 0.5 * noise
    weight = 1.0 / noise
    q = float((weight * (log - np.average(log, weights=weight)) ** 2).sum())
    spare = float(weight.sum() - (weight**2).sum() / weight.sum())
    between = max(0.0, (q - (len(log) - 1)) / spare)
    mean = np.average(log, weights=1.0 / (between + noise))
    return np.asarray(np.exp(mean + between / (between + noise) * (log - mean)))
