"""Date since when a solution no longer describes the data: a scan over the dates of new matches.

Each period of the new matches, once its frames are eliminated, gives a normal matrix N_b and a
score r_b of the polynomials about the released ones.  With the release's own error e, of covariance
C and common to all periods, and a change d from the date t on,

    r_b = N_b (e + d [b from t on]) + noise of covariance N_b

so that the gain in log-likelihood of each date follows from these sums.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from bayesdist.data.matches import Matches
from bayesdist.infer.compare.frame_fields import mean_squares, without
from bayesdist.infer.compare.monitoring import Change, NewFit
from bayesdist.infer.equations.normal import NormalEquations, mixture
from bayesdist.infer.equations.scaled import FieldTest, determined
from bayesdist.infer.kernel import Constants
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import DistortionModel
from bayesdist.model.frames import nearest_frame
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf

MOST_PERIODS = 24
CREDIBLE = 0.95


@dataclass(frozen=True, eq=False)
class PeriodScore:
    """Normal matrix and score of the polynomials by the matches of one period, without frames."""

    first: float  # date of the first match, decimal years
    last: float  # date of the last match
    n: int  # number of matches
    normal: Float  # normal matrix (n, n)
    score: Float  # score (n,) about the released polynomials


@dataclass(frozen=True, eq=False)
class ChangeDate:
    """Date from which on a change describes the data best.

    The change lies between `after` and `before`.  `after` and the start of `interval` are minus
    infinity where it may be there from the first new match on.
    """

    after: float
    before: float
    # dates that hold 95 % of the likelihood, for a prior that is equal for all gaps between periods
    interval: tuple[float, float]
    gain: Float  # decrease (P,) of chi-square by a change from period k on
    dof: int  # of the best change
    p_value: float  # probability of the largest gain by chance, times the number of gains
    change: Change  # from the best date on, in place of the change of all matches
    # chi-square per degree of freedom of the periods about the best change; 1 where errors are
    # right and independent, or slightly less, since the date was chosen
    scatter: float
    scatter_dof: int
    p_scatter: float  # probability of a larger scatter


def period_scores(new: NewFit, change: Change, matches: Matches) -> tuple[PeriodScore, ...]:
    """Scores of each period in the order of time, from one pass over the data in chunks.

    `matches` are those of `new`, with epochs; where they have no more than `MOST_PERIODS` dates,
    each date is a period.
    """
    edges = _edges(matches)
    held: dict[int, tuple[NormalEquations, float, float, int]] = {}
    constants = new.likelihood.constants
    for table in matches.batches():
        of_period = np.searchsorted(edges, table.column("epoch"), side="right")
        for b in np.unique(of_period):
            part = table.select(of_period == b)
            found = _sums(new, part, constants)
            held[int(b)] = _joined(held[int(b)], found) if int(b) in held else found
    return tuple(
        PeriodScore(first, last, n, *_score(new, change, equations))
        for equations, first, last, n in (held[b] for b in sorted(held))
    )


def _edges(matches: Matches) -> Float:
    """Dates at which a new period begins."""
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


def _score(new: NewFit, change: Change, equations: NormalEquations) -> tuple[Float, Float]:
    """Normal matrix and score of the polynomials about the release, frames eliminated."""
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
            own, shift = new.model.frame(new.theta, int(code))
            frame = nearest_frame(model.frames, own @ M, own @ d + shift)
            single = new.theta[new.model.frame_slice(int(code))][len(frame) - model.n_frame :]
            theta[model.frame_slice(k + 1)] = [*frame, *(single if model.chip_deviations else ())]
    n = model.n_polynomial
    # exposures deviate within their prior scatter
    scatter = new.scatter if len(new.scatter) else np.zeros(model.n_frame)
    equations = replace(equations, groups=groups, cross=equations.cross[:, :0])
    for last in (False, False, True):
        here = equations.moved(model.effective(theta, groups))
        matrix, right = here.assemble(model, theta)
        if not model.n_frame:
            return matrix.border[:n, :n], right[:n]
        blocks = matrix.blocks + np.diag(scatter)
        values = theta[model.n_global :].reshape(len(codes), -1)
        local = matrix.split(right)[1] - scatter * values
        if last:
            break
        # frames are at their mode for polynomials fixed at the release
        step = np.linalg.solve(blocks, local[..., None])[..., 0]
        theta[model.n_global :] += step.ravel()
    gain = np.linalg.solve(blocks, np.swapaxes(matrix.edge[:, :n], 1, 2))
    normal = matrix.border[:n, :n] - np.einsum("ebq,eqc->bc", matrix.edge[:, :n], gain)
    score = right[:n] - np.einsum("eqb,eq->b", gain, local)
    return (normal + normal.T) / 2, score


def _of_exposures(model: DistortionModel, codes: Int) -> DistortionModel:
    """Model of some exposures, after one without matches in the frame of the release."""
    names = tuple(model.exposures[int(code)] for code in codes)
    return replace(model, exposures=("(release)", *names))


def scan_dates(scores: tuple[PeriodScore, ...], change: Change) -> ChangeDate:
    """Most likely date of a change, its interval, and the scatter of the periods.

    `change` gives the covariance of the release and the fields that frames absorb.
    """
    # what frames absorb is no change; a drift between the periods leaves a trace of it in N_b
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
    gain, dofs = np.array([_gain(*one, free) for one in ahead]).T
    best = int(gain.argmax())
    starts = np.array([-np.inf, *(s.last for s in scores[:-1])])
    ends = np.array([s.first for s in scores])
    likely = np.exp((gain - gain[best]) / 2)
    order = np.argsort(-likely)
    reached = np.cumsum(likely[order]) / likely.sum()
    inside = order[: int(np.searchsorted(reached, CREDIBLE)) + 1]
    parts = [(normals[:best].sum(axis=0), rights[:best].sum(axis=0))] if best else []
    parts.append((after_n[best], after_r[best]))
    singly = [_gain(one.normal, one.score, free) for one in scores]
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
    """Twice the gain in log-likelihood of the best polynomials, and the number determined."""
    white = right @ _root(normal, free)
    return float(white @ white), len(white)


def _root(normal: Float, free: Float) -> Float:
    """Root (n, rank) of the covariance of the free directions."""
    inside = free.T @ normal @ free
    return np.asarray(free @ determined((inside + inside.T) / 2))


def _from_then_on(change: Change, normal: Float, right: Float, free: Float) -> Change:
    """Change for a normal matrix and its score, without what frames absorb."""
    root = without(change.absorbed, mean_squares(change.model)) @ _root(normal, free)
    white = right @ _root(normal, free)
    return replace(
        change,
        difference=(root @ white).reshape(change.difference.shape),
        cov=root @ root.T,
        test=FieldTest.of(white),
    )
