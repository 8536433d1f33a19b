"""Date after which a solution no longer describes the data, from a scan over the new matches.

Each period b of the new matches gives a normal matrix N_b and a score r_b of the polynomials about
the released ones, with the frames eliminated.  Let e be the error of the release, with covariance C
and common to all periods, and let d be a change that starts at the date t.  Then

    r_b = N_b (e + d [b after t]) + noise of covariance N_b

and the gain in log-likelihood for each date t follows from sums over the periods.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from bayesdist.data.matches import Matches
from bayesdist.infer.compare.monitoring import NewFit, SolutionChange
from bayesdist.infer.equations.normal import NormalEquations, mixture
from bayesdist.infer.equations.scaled import FieldTest, determined
from bayesdist.infer.kernel import Constants
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import DistortionModel
from bayesdist.model.alignment import mean_squares, without
from bayesdist.model.frames import nearest_frame
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf

MOST_PERIODS = 24  # maximum number of periods
CREDIBLE = 0.95  # probability of the interval of the date


@dataclass(frozen=True, eq=False)
class PeriodScore:
    """Normal matrix and score of the polynomials for one period, with the frames eliminated."""

    first: float  # date of the first match, decimal years
    last: float  # date of the last match, decimal years
    n: int  # number of matches
    normal: Float  # normal matrix (n_polynomial, n_polynomial)
    score: Float  # score (n_polynomial,) about the released polynomials


@dataclass(frozen=True, eq=False)
class ChangeDate:
    """Most likely date of a change, with its significance.

    The change happened between the dates `after` and `before` (decimal years).  `after` and the
    start of `interval` are minus infinity if the change may precede the first new match.
    """

    after: float
    before: float
    # interval of dates with 95 % probability, with equal prior probability for all gaps between
    # periods
    interval: tuple[float, float]
    gain: Float  # decrease (P,) of chi-square for a change that starts with period k
    dof: int  # degrees of freedom of the best change
    p_value: float  # chance probability of the largest gain, times the number of dates tried
    change: SolutionChange  # change after the best date, instead of that of all matches
    # chi-square per degree of freedom of the periods about the best change; about 1 if errors are
    # correct and independent (slightly less, since the date was optimised)
    scatter: float
    scatter_dof: int  # degrees of freedom of `scatter`
    p_scatter: float  # probability of a larger scatter


def period_scores(new: NewFit, change: SolutionChange, matches: Matches) -> tuple[PeriodScore, ...]:
    """Scores of all periods in chronological order, from one pass over the data in chunks.

    `matches` are those of `new`, with epochs.  With at most `MOST_PERIODS` dates, each date is a
    period.
    """
    edges = _edges(matches)
    held: dict[int, tuple[NormalEquations, float, float, int]] = {}
    constants = new.likelihood.constants
    for table in matches.batches():
        of_period = np.searchsorted(edges, table.column("epoch"), side="right")
        for b in np.unique(of_period):
            part = table.select(of_period == b)
            chunk = _sums(new, part, constants)
            held[int(b)] = _joined(held[int(b)], chunk) if int(b) in held else chunk
    return tuple(
        PeriodScore(first, last, n, *_score(new, change, equations))
        for equations, first, last, n in (held[b] for b in sorted(held))
    )


def _edges(matches: Matches) -> Float:
    """Dates (decimal years) at which the second and later periods begin."""
    epoch = matches.sample(1_000_000).column("epoch")
    dates, counts = np.unique(epoch, return_counts=True)
    if len(dates) <= MOST_PERIODS:
        return dates[1:]
    period = (np.cumsum(counts) - counts) * MOST_PERIODS // counts.sum()
    return dates[np.flatnonzero(np.diff(period)) + 1]


def _sums(
    new: NewFit, table: Matches, constants: Constants
) -> tuple[NormalEquations, float, float, int]:
    stars, _ = prepare(new.model, table)
    epoch = table.column("epoch")
    equations = mixture(stars, new.theta, constants, True)
    return equations, float(epoch.min()), float(epoch.max()), len(table)


def _joined(
    a: tuple[NormalEquations, float, float, int], b: tuple[NormalEquations, float, float, int]
) -> tuple[NormalEquations, float, float, int]:
    return a[0] + b[0], min(a[1], b[1]), max(a[2], b[2]), a[3] + b[3]


def _score(new: NewFit, change: SolutionChange, equations: NormalEquations) -> tuple[Float, Float]:
    """Normal matrix and score of the polynomials about the release, with frames eliminated."""
    codes = np.unique(equations.groups.exposure)
    model = _of_exposures(new.model, codes)
    groups = replace(
        equations.groups, exposure=np.searchsorted(codes, equations.groups.exposure) + 1
    )
    theta = np.zeros(model.n_params)
    theta[: model.n_distortion] = new.released.mean
    M, d = change.frame
    if model.n_frame:
        for k, code in enumerate(codes):
            linear, shift = new.model.frame(new.theta, int(code))
            frame = nearest_frame(model.frames, linear @ M, linear @ d + shift)
            single = new.theta[new.model.frame_slice(int(code))][len(frame) - model.n_frame :]
            theta[model.frame_slice(k + 1)] = [*frame, *(single if model.chip_deviations else ())]
    n = model.n_polynomial
    # exposures deviate within their prior scatter
    scatter = new.scatter if len(new.scatter) else np.zeros(model.n_frame)
    equations = replace(equations, groups=groups, cross=equations.cross[:, :0])
    for last in (False, False, True):
        expanded = equations.moved(model.effective(theta, groups))
        matrix, right = expanded.assemble(model, theta)
        if not model.n_frame:
            return matrix.border[:n, :n], right[:n]
        blocks = matrix.blocks + np.diag(scatter)
        values = theta[model.n_global :].reshape(len(codes), -1)
        local = matrix.split(right)[1] - scatter * values
        if last:
            break
        # Newton step of the frames, with the polynomials fixed at the release
        step = np.linalg.solve(blocks, local[..., None])[..., 0]
        theta[model.n_global :] += step.ravel()
    gain = np.linalg.solve(blocks, np.swapaxes(matrix.edge[:, :n], 1, 2))
    normal = matrix.border[:n, :n] - np.einsum("ebq,eqc->bc", matrix.edge[:, :n], gain)
    score = right[:n] - np.einsum("eqb,eq->b", gain, local)
    return (normal + normal.T) / 2, score


def _of_exposures(model: DistortionModel, codes: Int) -> DistortionModel:
    """Model of selected exposures, preceded by one without matches in the frame of the release."""
    names = tuple(model.exposures[int(code)] for code in codes)
    return replace(model, exposures=("(release)", *names))


def scan_dates(scores: tuple[PeriodScore, ...], change: SolutionChange) -> ChangeDate:
    """Find the most likely date of a change, its interval, and the scatter of the periods.

    `scores` has the scores of the periods in chronological order.  `change` provides the covariance
    of the release and the fields that frames absorb.
    """
    # Exclude the fields that frames absorb: they are not changes. Because of the drift between the
    # periods, N_b retains a small part of them.
    free = null_space((change.absorbed / np.linalg.norm(change.absorbed, axis=0)).T)
    cov, normals = change.released_cov, np.array([s.normal for s in scores])
    rights = np.array([s.score for s in scores])
    after_n = np.cumsum(normals[::-1], axis=0)[::-1]
    after_r = np.cumsum(rights[::-1], axis=0)[::-1]
    all_n, all_r = after_n[0], after_r[0]
    # (C^-1 + N)^-1 without the inverse of C, which may be singular
    inner = np.linalg.solve(np.eye(len(cov)) + cov @ all_n, cov)
    ahead = [
        (normal - normal @ inner @ normal, right - normal @ inner @ all_r)
        for normal, right in zip(after_n, after_r, strict=True)
    ]
    gain, dofs = np.array([_gain(*item, free) for item in ahead]).T
    best = int(gain.argmax())
    starts = np.array([-np.inf, *(s.last for s in scores[:-1])])
    ends = np.array([s.first for s in scores])
    likely = np.exp((gain - gain[best]) / 2)
    order = np.argsort(-likely)
    reached = np.cumsum(likely[order]) / likely.sum()
    inside = order[: int(np.searchsorted(reached, CREDIBLE)) + 1]
    parts = [(normals[:best].sum(axis=0), rights[:best].sum(axis=0))] if best else []
    parts.append((after_n[best], after_r[best]))
    singly = [_gain(item.normal, item.score, free) for item in scores]
    jointly = [_gain(normal, right, free) for normal, right in parts]
    dof = sum(d for _, d in singly) - sum(d for _, d in jointly)
    chi2 = max(sum(v for v, _ in singly) - sum(v for v, _ in jointly), 0.0)
    return ChangeDate(
        after=float(starts[best]),
        before=float(ends[best]),
        interval=(float(starts[inside].min()), float(ends[inside].max())),
        gain=gain,
        dof=int(dofs[best]),
        p_value=min(1.0, len(gain) * float(chi2_sf(gain[best], dofs[best]))),
        change=_from_then_on(change, *ahead[best], free),
        scatter=chi2 / dof if dof > 0 else 1.0,
        scatter_dof=dof,
        p_scatter=float(chi2_sf(chi2, dof)) if dof > 0 else 1.0,
    )


def _gain(normal: Float, right: Float, free: Float) -> tuple[float, int]:
    """Decrease of chi-square for the best-fitting change, and its degrees of freedom."""
    white = right @ _root(normal, free)
    return float(white @ white), len(white)


def _root(normal: Float, free: Float) -> Float:
    """Matrix R (n, rank) such that R R^T is the covariance of a change in the free directions."""
    inside = free.T @ normal @ free
    return np.asarray(free @ determined((inside + inside.T) / 2))


def _from_then_on(
    change: SolutionChange, normal: Float, right: Float, free: Float
) -> SolutionChange:
    """Best-fitting change for a normal matrix and score, without the fields that frames absorb."""
    root = without(change.absorbed, mean_squares(change.model)) @ _root(normal, free)
    white = right @ _root(normal, free)
    return replace(
        change,
        difference=(root @ white).reshape(change.difference.shape),
        cov=root @ root.T,
        test=FieldTest.of(white),
    )
