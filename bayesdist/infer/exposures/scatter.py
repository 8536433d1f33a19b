"""Likelihood and posterior of the scatter tau of exposure-to-exposure deviations.

The deviations b ~ N(0, T), T = diag(tau^2) with one tau per kind, are part of the parameters theta.
The log-likelihood of theta is the quadratic form -1/2 d^T H d + r^T d with d = theta - theta_0.
Let P be T^-1 for the deviations and 0 for other parameters.  Then

    log p(data | tau) = 1/2 [-log |H + P| - log |T| + q^T (H + P)^-1 q - b_0^T T^-1 b_0]
    q = r - P theta_0

is the restricted likelihood (REML: all other parameters are integrated out, not maximised).  Its
maximum is the fixed point tau_k^2 = mean over e of (b_ek^2 + var b_ek) of the EM algorithm.  H is
an arrow matrix, so that the cost grows linearly with the number of exposures.

Outlying exposures would increase tau and with it the errors of all others.  Their deviations can be
made *loose*: they get a wide prior and do not contribute to tau.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

from bayesdist.infer.density.proposal import PiecewiseExponential
from bayesdist.infer.equations.arrow import Arrow, ArrowFactor
from bayesdist.utils.arrays import Bool, Float, Int

DEGREES = 4.0  # degrees of freedom of the half-Student-t prior on tau
MESH = np.concatenate([np.arange(-10.0, -3.0), np.arange(-3.0, 4.25, 0.5), [5.0, 7.0]])  # in sigma
WIDENED = 0.9  # factor on the log density of the proposals, to widen them
LEAST_CURVATURE = 0.3  # lower limit of the curvature used for the width of a proposal
LEAST_EFFICIENCY = 0.05  # importance efficiency below which a Markov chain is used
AT_ONCE = 2**18  # number of edge elements of the matrices that are factored at a time
PROPOSALS = 4  # proposals per requested draw of tau
# sweeps of a chain over all kinds before the first draw, and between draws
BURN_IN, BETWEEN = 40, 3
SMALLEST, LARGEST = 1e-6, 1e3  # limits of the search for tau, relative to the scale of its prior
OUTLYING = 10.0  # scatter of the deviations of outlying exposures, in tau
OUTLYING_FRACTION = 0.02  # prior probability that an exposure is outlying


@dataclass(frozen=True, eq=False)
class Scatter:
    """Likelihood of m deviations of k kinds, and posterior of their scatter tau."""

    kinds: tuple[str, ...]  # k kinds of deviation
    kind: Int  # kind (m,) of each deviation
    index: Int  # indices (m,) in theta of the deviations
    matrix: Arrow  # H, without the prior on the deviations
    right: Float  # r (D,)
    about: Float  # theta_0 (D,)
    scale: Float  # scale (k,) of the half-Student-t prior on each tau
    loose: Bool  # mask (m,) of loose deviations, with the prior N(0, scale^2)
    # factor (k,) of at least 1 on tau in the prior of theta: a kind that may be correlated with
    # others should not constrain them by the assumed independence
    caution: Float

    def precision(self, tau: Float) -> Float:
        """Inverse variances (..., m) of the deviations for given tau (..., k)."""
        return np.asarray(np.where(self.loose, self.scale[self.kind], tau[..., self.kind]) ** -2)

    def prior(self, tau: Float) -> Float:
        """Inverse variances (m,) of the prior on the deviations, with `caution` applied to tau."""
        return self.precision(self.caution * tau)

    def _moments(self, precision: Float) -> tuple[Float, ArrowFactor]:
        """Mean of theta (D,) and the factor of H + P, for given precisions (m,)."""
        diagonal = np.zeros(len(self.about))
        diagonal[self.index] = precision
        border, local = self.matrix.split(diagonal)
        factor = Arrow(
            self.matrix.border + np.diag(border),
            self.matrix.edge,
            self.matrix.blocks + np.einsum("nq,qr->nqr", local, np.eye(local.shape[1])),
        ).factor()
        return self.about + factor.solve(self.right - diagonal * self.about), factor

    def posterior(self, tau: Float) -> tuple[Float, ArrowFactor]:
        """Mean (D,) of theta and factor of its precision, for tau (k,) multiplied by `caution`."""
        return self._moments(self.prior(tau))

    def log_density(self, tau: Float) -> float:
        """Log posterior density of log tau (k,), up to a constant."""
        return float(self.log_densities(tau[None])[0])

    def log_densities(self, tau: Float) -> Float:
        """Log posterior densities (n,) of log tau (n, k), up to a constant."""
        within = np.minimum(tau, LARGEST * self.scale)  # keeps all matrices positive definite
        precision, b = self.precision(within), self.about[self.index]
        step = max(1, AT_ONCE // max(self.matrix.edge.size, self.matrix.border.size))
        parts = [self._evidence(precision[a : a + step]) for a in range(0, len(tau), step)]
        value = np.concatenate(parts) + np.log(precision).sum(axis=1) - precision @ b**2
        prior = -0.5 * (DEGREES + 1) * np.log1p((tau / self.scale) ** 2 / DEGREES)
        out = 0.5 * value + (prior + np.log(tau)).sum(axis=1)
        return np.where((tau > LARGEST * self.scale).any(axis=1), -np.inf, out)

    def _evidence(self, precision: Float) -> Float:
        """q^T (H + P)^-1 q - log |H + P|, for precisions (n, m)."""
        diagonal = np.zeros((len(precision), len(self.about)))
        diagonal[:, self.index] = precision
        border, local = self.matrix.split(diagonal)
        right, right_local = self.matrix.split(self.right - diagonal * self.about)
        n, (of_blocks, q), b = len(precision), local.shape[1:], border.shape[1]
        blocks = np.linalg.cholesky(self.matrix.blocks + local[..., None] * np.eye(q))
        # L^-1 times the right-hand side and B^T of all blocks, stacked
        sides = np.empty((n, of_blocks, q, 1 + b))
        sides[..., 0], sides[..., 1:] = right_local, self.matrix.edge.mT
        rows = np.linalg.solve(blocks, sides).reshape(n, of_blocks * q, 1 + b)
        product = rows.mT @ rows
        top = self.matrix.border + border[..., None] * np.eye(b) - product[:, 1:, 1:]
        top = np.linalg.cholesky(top)
        whitened = np.linalg.solve(top, (right - product[:, 0, 1:])[..., None])
        logs = np.log(np.einsum("tnqq->tnq", blocks)).sum(axis=(1, 2))
        logs += np.log(np.einsum("tbb->tb", top)).sum(axis=1)
        return np.asarray(product[:, 0, 0] + (whitened**2).sum(axis=(1, 2)) - 2 * logs)

    def gradient(self, tau: Float) -> Float:
        """Gradient (k,) of `log_density` with respect to log tau."""
        mean, factor = self._moments(self.precision(tau))
        squares = (mean**2 + factor.variances())[self.index]
        tight, k = ~self.loose, len(self.kinds)
        second = np.bincount(self.kind[tight], squares[tight], k)
        ratio = (tau / self.scale) ** 2
        prior = 1.0 - (DEGREES + 1) * ratio / (DEGREES + ratio)
        return np.asarray(second / tau**2 - np.bincount(self.kind[tight], minlength=k) + prior)

    @cached_property
    def robust(self) -> Float:
        """Robust estimate of tau (k,), which is insensitive to a few outlying exposures."""
        mean, factor = self._moments(self.precision(self.scale))
        b, sigma = mean[self.index], np.sqrt(factor.variances()[self.index])
        out = np.empty(len(self.kinds))
        for k in range(len(out)):
            of_kind = b[self.kind == k]
            spread = 1.4826 * np.median(np.abs(of_kind - np.median(of_kind)))
            # differences between deviations are better determined than their common mean
            out[k] = max(spread, 0.1 * float(np.median(sigma[self.kind == k])))
        return np.minimum(out, self.scale)

    def odds(self, tau: Float, member: Int) -> Float:
        """Log odds (n,) that the deviations of an exposure are outlying.

        Outlying deviations have ten times the scatter of the others; the prior odds are 1 to 49.
        `member` (m,) is the exposure (starting from 0) of each deviation, and `tau` (k,) the
        scatter of all deviations that are not loose.  The scatter is re-estimated without the
        tested exposure, since an outlying exposure increases tau and would then look normal.
        """
        precision = self.precision(tau)
        mean, factor = self._moments(precision)
        squares = (mean**2 + factor.variances())[self.index]
        tight, k = ~self.loose, len(self.kinds)
        total = np.bincount(self.kind[tight], squares[tight], k)
        count = np.bincount(self.kind[tight], minlength=k)
        out = np.empty(int(member.max()) + 1)
        for group in range(len(out)):
            rows = np.flatnonzero(member == group)
            at, kind = self.index[rows], self.kind[rows]
            columns = np.zeros((len(at), len(self.about)))
            columns[np.arange(len(at)), at] = 1.0
            cov = factor.solve(columns)[:, at]
            inverse = np.linalg.inv((cov + cov.T) / 2)
            # information from the data about this exposure's deviations, without their prior
            information = inverse - np.diag(precision[rows])
            pull = inverse @ mean[at]
            mine = np.where(tight[rows], squares[rows], 0.0)
            n_others = np.maximum(count[kind] - tight[rows], 1)
            scatter = np.sqrt(np.maximum(total[kind] - mine, 0.0) / n_others)
            evidence = []
            for times in (1.0, OUTLYING):
                T = np.maximum(times * scatter, SMALLEST * self.scale[kind]) ** -2.0
                L = np.linalg.cholesky(information + np.diag(T))
                half = np.linalg.solve(L, pull)
                evidence.append(
                    0.5 * half @ half - np.log(np.diag(L)).sum() + 0.5 * np.log(T).sum()
                )
            prior = np.log(OUTLYING_FRACTION / (1 - OUTLYING_FRACTION))
            out[group] = evidence[1] - evidence[0] + prior
        return out

    def loosened(self, loose: Bool) -> Scatter:
        """Copy with another mask (m,) of loose deviations."""
        return replace(self, loose=loose)

    def mode(self) -> Float:
        """Most probable log tau (k,)."""
        low, high = np.log(SMALLEST * self.scale), np.log(LARGEST * self.scale)
        bounds = list(zip(low, high - 1e-6, strict=True))
        optimum = minimize(
            lambda x: -self.log_density(np.exp(x)),
            np.log(self.robust),
            jac=lambda x: -self.gradient(np.exp(x)),
            method="L-BFGS-B",
            bounds=bounds,
            options={"gtol": 1e-4, "ftol": 1e-12},
        )
        return np.asarray(optimum.x)

    def draws(
        self, n: int, rng: np.random.Generator, least_efficiency: float = LEAST_EFFICIENCY
    ) -> Float:
        """Draws (n, k) from the posterior of tau, with equal weights.

        They come from importance sampling of log tau with resampling.  The kinds are proposed
        independently, each from its conditional density at the mode of the others, slightly
        widened, since the scatter of different kinds is usually almost independent.  If the
        importance efficiency is below `least_efficiency`, a Markov chain is started from the best
        proposal instead.
        """
        proposals = self._proposals(self.mode())
        u = rng.uniform(size=(PROPOSALS * n, len(proposals)))
        x = np.stack(
            [proposal.quantile(p) for proposal, p in zip(proposals, u.T, strict=True)], axis=1
        )
        log_q = sum(proposal.log_density(t) for proposal, t in zip(proposals, x.T, strict=True))
        log_w = self.log_densities(np.exp(x)) - log_q
        w = np.exp(log_w - logsumexp(log_w))
        if 1 / (w**2).sum() < least_efficiency * len(w):
            return np.exp(self._chain(x[int(np.argmax(w))], proposals, n, rng))
        # systematic resampling
        at = (np.arange(n) + rng.uniform()) / n
        return np.exp(x[np.minimum(np.searchsorted(np.cumsum(w), at), len(w) - 1)])

    def _chain(
        self,
        start: Float,
        proposals: list[PiecewiseExponential],
        n: int,
        rng: np.random.Generator,
    ) -> Float:
        """Draws (n, k) of log tau from a Metropolis-within-Gibbs chain over the kinds.

        Each step is an independent draw from the proposal of the kind, or a random-walk step of
        about its width.  The former crosses a wide density, the latter follows a density that
        depends on the other kinds.
        """
        x = start.copy()
        value, out = self.log_density(np.exp(x)), np.empty((n, len(x)))
        ends = np.array([proposal.quantile(np.array([0.16, 0.84])) for proposal in proposals])
        width = np.diff(ends, axis=1)[:, 0] / 2
        for sweep in range(BURN_IN + BETWEEN * n):
            for k, proposal in enumerate(proposals):
                new = x.copy()
                gain = 0.0
                if rng.uniform() < 0.5:
                    new[k] = proposal.quantile(rng.uniform(size=1))[0]
                    gain = float(np.subtract(*proposal.log_density(np.array([x[k], new[k]]))))
                else:
                    new[k] += width[k] * rng.standard_normal()
                new_value = self.log_density(np.exp(new))
                if np.log(rng.uniform()) < new_value - value + gain:
                    x, value = new, new_value
            if sweep >= BURN_IN:
                out[(sweep - BURN_IN) // BETWEEN] = x
        return out

    def _proposals(self, mode: Float) -> list[PiecewiseExponential]:
        """Conditional density of log tau for each kind, with the others at the mode."""
        out, step = [], 1e-3
        for k, e in enumerate(np.eye(len(mode))):
            up, down = (self.gradient(np.exp(mode + s * step * e))[k] for s in (1, -1))
            # the density decreases as tau towards zero, so its width is a few units of log tau
            sigma = 1 / np.sqrt(max((down - up) / (2 * step), LEAST_CURVATURE))
            mesh = mode[k] + sigma * MESH
            mesh = mesh[mesh < np.log(LARGEST * self.scale[k])]
            points = mode + (mesh - mode[k])[:, None] * e
            values = WIDENED * self.log_densities(np.exp(points))
            slopes = np.diff(values) / np.diff(mesh)
            out.append(
                PiecewiseExponential(mesh, values, max(slopes[0], 0.5), min(slopes[-1], -0.5))
            )
        return out
