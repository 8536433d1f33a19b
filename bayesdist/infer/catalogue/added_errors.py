"""Errors to be added to the quoted ones: one for both axes, or one for each group of stars.

A star of group g has, along an axis, the variance s^2 + a_g.  The a_g are those of the restricted
likelihood (REML: Patterson and Thompson 1971), in which the part of the residuals that the fit
absorbs is added again star by star,

    E[e_i^2] = r_i^2 + x_i^T C x_i

with the covariance C of the fit and the derivatives x_i of the star's position; without it errors
would be too small by the parameters per star.  Good stars and false matches are separated by the
mixture of `by_magnitude`, so that a few false ones do not count, and parameters, memberships and
errors climb one bound in turn.

Groupings are compared by their evidence after Laplace with unit-information priors,

    ln E = ln L_R / c - sum_g ln(n_g) / 2

where n_g are the good stars of a group and c, one for normal errors, is the factor by which the
sums of squares scatter more than those of independent normal errors (from the squares themselves,
all detections of a star together): long tails and stars that are matched often make no groups.
With few stars in a group the penalty keeps it from being split off; where there are many groups,
their errors are shrunk to the common one as far as chance makes them differ (empirical Bayes), as
the errors that come out are used as if they were known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.magnitude_errors import AddedErrors
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.by_magnitude import (
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
STARS = 50_000  # from which the errors are estimated: they are then known to half a percent
PER_EXPOSURE = 100  # mean number of stars of each exposure among these, at least
DECISIVE = 3.0  # ln evidence, odds of 20 to 1, needed for errors that differ between stars
MATERIAL = 0.01  # of the errors of typical stars: groups that differ by less are not separated
SETTLED, TURNS = 1e-3, 50  # change of ln variance at which the maximisation ends; most iterations
HALVINGS = 45  # of the range in which an added variance lies
WIDER = 5.0  # false matches scatter at least this many times as wide as typical good ones
SHRUNK = 3  # fewest labels whose scatter can be estimated


@dataclass(frozen=True, eq=False)
class GroupedErrors:
    """Added errors by group, for the grouping of largest evidence."""

    # 'one' (both axes alike), 'axis', 'chip', 'exposure', 'filter' (both axes alike), or these 'and
    # axis'
    grouping: str
    by: str  # 'chip', 'exposure', 'filter' or empty
    labels: tuple[str, ...]  # of the G groups, as in `AddedErrors`
    n: Float  # good stars (G, 2) on which each error rests
    variance: Float  # added variances (G, 2) along u and v
    error: Float  # standard errors (G, 2) of the variances
    evidence: dict[str, float]  # gain of ln evidence over 'one', by grouping compared
    dispersion: float  # the factor c

    @property
    def by_axis(self) -> bool:
        """True if each axis has errors of its own."""
        return self.grouping.endswith(AXIS)

    @property
    def sigma(self) -> Float:
        """Added errors (G, 2)."""
        return np.sqrt(self.variance)

    @property
    def sigma_error(self) -> Float:
        """Standard errors (G, 2) of `sigma`; near zero they follow from that of the variance."""
        return self.error / (2.0 * np.sqrt(np.maximum(self.variance, self.error)))

    @property
    def excess(self) -> Float:
        """Errors (G, 2) to add to the quoted ones; the smallest of them is left to the jitter."""
        return np.sqrt(self.variance - self.variance.min())

    @property
    def added(self) -> AddedErrors | None:
        """The excess as errors to be added; None where one jitter is enough."""
        if self.grouping == ONE:
            return None
        excess = self.excess
        weight = np.maximum(self.n, 1e-300)
        other = np.sqrt(np.average(excess**2, axis=0, weights=weight))
        return AddedErrors(self.by, self.labels, excess, other)


@dataclass(eq=False)
class _State:
    """State of the maximisation: fit, mixture and added variances of one grouping."""

    fit: LinearFit
    square: Float
    f: float
    wide: float
    variance: Float
    good: Float
    log_likelihood: float = -np.inf


def grouped_errors(
    matches: Matches,
    fit: LinearFit,
    *,
    by: str = "",
    outliers: bool = True,
    priors: GaussianPriors | None = None,
) -> GroupedErrors:
    """Added errors of the best grouping: one error for both axes compared with one for each group.

    Of very many matches a sample is used.  The maximisation starts from `fit`, made of these
    matches or of those that they are a sample of, with `priors`.  `by` ('chip', 'exposure',
    'filter') names groups that are compared in addition to the axes; with `outliers` some matches
    may be false.

    Raises InputError where all matches are of one chip, exposure or filter by which they are to be
    grouped, and DegenerateError where the sample does not determine the model.
    """
    model = fit.model
    count = max(STARS, PER_EXPOSURE * len(model.exposures) * len(model.chips))
    table = matches.sample(count)
    names, label = table.grouped(by)
    present, label = np.unique(label, return_inverse=True)
    labels = tuple(names[k] for k in present)
    if by and len(labels) < 2:
        raise InputError(
            f"outliers.jitter_by is {by!r}, and all matches are of one {by}",
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
        name: one.log_likelihood / dispersion - 0.5 * np.log(np.maximum(counts[name], 1.0)).sum()
        for name, one in states.items()
    }
    evidence = {name: float(value[name] - value[ONE]) for name in codes if name != ONE}
    best = max(evidence, key=lambda name: evidence[name])
    typical = np.median(quoted + states[best].variance.min())
    spread = np.ptp(states[best].variance) / typical
    if evidence[best] < DECISIVE or np.sqrt(1.0 + spread) < 1.0 + MATERIAL:
        best = ONE
    return _result(best, by, labels, states[best], quoted, codes[best], evidence, dispersion)


def _quoted(table: Matches) -> Float:
    """Quoted variances (2, N)."""
    return np.stack([table.column("sigma_u"), table.column("sigma_v")]) ** 2


def _starting_state(table: Matches, fit: LinearFit, quoted: Float, outliers: bool) -> _State:
    """Starting state with one added variance for all, from the median residual."""
    square = residuals_of(fit, table) ** 2
    core = float(np.median(square)) / 0.4549  # of a squared normal variable
    variance = max(0.0, core - float(np.median(quoted)))
    wide = max(WIDER**2 * max(core, float(np.median(quoted))), float(square.sum(axis=0).max()) / 8)
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
    """State at the maximum of the restricted likelihood, for groups with codes (2, N)."""
    n_groups = int(code.max()) + 1
    variance = np.full(n_groups, float(np.average(start.variance)))
    f, wide, square, typical = start.f, start.wide, start.square, float(np.median(quoted))
    fit = start.fit
    for _ in range(TURNS):
        var = quoted + variance[code]
        good = good_probability(square, var, f, wide) if outliers else np.ones(len(table))
        if outliers:
            f, wide = false_matches(good, square, WIDER**2 * float(np.median(var)))
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
    # the determinant of the fit's normal matrix makes the likelihood the restricted one
    value = float(each.sum() + 0.5 * np.linalg.slogdet(fit.cov)[1])
    return _State(fit, square, f, wide, variance, good, value)


def _maxima(quoted: Float, square: Float, good: Float, code: Int, n_groups: int) -> Float:
    """Variance (G,), 0 or more, of each group at which its likelihood is largest.

    The derivative, sum w (e^2 - s^2 - a) / (s^2 + a)^2, changes its sign there: found by halving.
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
    for _ in range(HALVINGS):  # where small quoted errors come with large residuals
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
    """Number (G,) of good stars in each group; each axis of a star counts."""
    return np.asarray(np.bincount(code.ravel(), np.concatenate([good, good])), float)


def _dispersion(table: Matches, state: _State, quoted: Float, code: Int) -> float:
    """Factor by which sums of squares scatter more than those of independent normal errors."""
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
    """Table of labels and axes for the chosen groups."""
    columns = 2 if grouping.endswith(AXIS) else 1
    flat, weight = code.ravel(), np.concatenate([state.good, state.good])
    weight = weight / (quoted + state.variance[code]).ravel() ** 2
    total = np.maximum(np.bincount(flat, weight), 1e-300)
    error = np.sqrt(2.0 * dispersion / total)
    n = _counts(state.good, code) / (3 - columns)  # stars, not axes of stars
    variance = state.variance
    if len(variance) >= SHRUNK * columns:
        whole = np.bincount(flat, weight * state.square.ravel()) / total
        own = np.bincount(flat, weight * quoted.ravel()) / total
        variance = variance.copy()
        for k in range(columns):
            rows = slice(k, None, columns)
            drawn = _shrunk(whole[rows], (error[rows] / whole[rows]) ** 2)
            variance[rows] = np.maximum(drawn - own[rows], 0.0)
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
    """Variances (G,) whose logarithms are shrunk to their mean by how much chance explains.

    After DerSimonian and Laird 1986; `noise` (G,) is the variance of each logarithm by chance, half
    of which a logarithm's mean lies below that of the variance.
    """
    log = np.log(variance) + 0.5 * noise
    weight = 1.0 / noise
    q = float((weight * (log - np.average(log, weights=weight)) ** 2).sum())
    spare = float(weight.sum() - (weight**2).sum() / weight.sum())
    between = max(0.0, (q - (len(log) - 1)) / spare)
    mean = np.average(log, weights=1.0 / (between + noise))
    return np.asarray(np.exp(mean + between / (between + noise) * (log - mean)))
