"""Posterior of a self-calibration with the stars integrated out: density, proposal and draws.

The proposal consists of Laplace approximations at several values of the jitter, as for matched
stars (`GridProposal`).  Its nodes are found in few passes, because a pass with elimination of the
stars is expensive, and many detections determine the jitter well.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from bayesdist.errors import DegenerateError
from bayesdist.infer.convergence import Limits
from bayesdist.infer.density.laplace import Node, Split
from bayesdist.infer.density.proposal import GridProposal
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.sampler.chains import ChainSettings, ensemble_seeds, run_chains
from bayesdist.infer.stars.likelihood import Hyper, OutlierMixture
from bayesdist.infer.stars.shards import Compute, Pieces
from bayesdist.kinds.selfcal.infer.elimination import (
    Mixture,
    ModePiece,
    in_pieces,
    log_density,
    memberships,
    slope,
    to_sample,
)
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.utils.arrays import Float

DROP = 18.0  # the nodes extend to this log density below the maximum
N_NODES = 13  # 9 nodes lose 0.2 % of the draws if the jitter may be zero; 25 gain nothing
# if the squared errors change by less than LINEAR from the first node to the last, nodes are
# interpolated between N_EXACT modes
LINEAR, N_EXACT = 0.1, 4
MAX_DECREMENT = 1e-4  # decrement at which the mode of a node has converged
MAX_STEPS = 12  # maximum number of Newton steps per node
MAX_ITERATIONS = 10  # refinements of the mesh of log j, each by a factor of seven
MIN_EFFECT = 0.02  # change of the log density above which the jitter has an effect
MIN_JITTER = 1e-3  # jitter relative to the median error that is negligible
# cost of a detection relative to that of a matched star, because the star's mode must be found
RELATIVE_COST = 60


@dataclass(frozen=True, eq=False)
class SelfTarget:
    """Posterior density of psi = (free parameters, log j, logit f), with the jitter j in pixels."""

    solution: SelfCalibrationMode  # the mode; fixed parameters keep their values there
    pieces: Pieces[ModePiece]  # its detections
    outliers: OutlierMixture | None = None  # in pixels; default: see `mixture`

    @property
    def problem(self) -> Problem:
        """Detections, linearised about the mode."""
        return self.solution.problem

    @property
    def prior(self) -> Prior:
        """Prior from other sources than the detections."""
        return self.solution.prior

    @cached_property
    def mixture(self) -> OutlierMixture:
        """Outlier model in pixels; by default uniform false detections."""
        return self.outliers or OutlierMixture("uniform", self.problem.match_radius)

    @cached_property
    def hyper(self) -> Hyper:
        """Priors of the jitter and the fraction of false detections."""
        return self.mixture.bind(self.problem.sigma)

    @property
    def n_theta(self) -> int:
        """Number of free parameters."""
        return len(self.solution.free)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        all_names = self.problem.model.names
        return (*(all_names[k] for k in self.solution.free), *self.hyper.names)

    def theta(self, free: Float) -> Float:
        """All parameters (..., D) from the free parameters (..., F)."""
        out = np.tile(self.solution.theta, (*free.shape[:-1], 1))
        out[..., self.solution.free] = free
        return out

    def mixtures(self, hyper: Float) -> Float:
        """Convert sampled coordinates to jitter (pixels) and fraction of false detections.

        The result has shape (n, 2).
        """
        values = self.hyper.values(hyper)
        j = values.get("j", np.full(len(hyper), self.mixture.jitter or 0.0))
        return np.stack([j, values["f"]], axis=1)

    def log_density(self, psi: Float) -> Float:
        """Log posterior (n,) of points psi (n, F + h); minus infinity outside the support."""
        ok = np.isfinite(psi).all(axis=1)
        out = np.full(len(psi), -np.inf)
        if not ok.any():
            return out
        theta, h = self.theta(psi[ok, : self.n_theta]), psi[ok, self.n_theta :]
        value = self.prior.log_density(theta) + self.hyper.log_prior(h)
        value += self.pieces.sum(log_density, theta, self.mixtures(h))
        out[ok] = np.where(np.isnan(value), -np.inf, value)
        return out


@one_thread
def sample_selfcal(
    solution: SelfCalibrationMode,
    *,
    outliers: OutlierMixture | None = None,
    seed: int = 1,
    ensembles: int = 4,
    target_ess: float = 400.0,
    target_rhat: float = 1.01,
    max_steps: int = 20_000,
    checkpoint_every: int = 200,
    folder: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    compute: Compute | None = None,
) -> Posterior:
    """Sample the posterior of a self-calibration, with the stars integrated out.

    Parameters
    ----------
    solution : SelfCalibrationMode
    outliers : OutlierMixture, optional
        Outlier model in pixels; by default false detections are uniform within the match radius.
    seed, ensembles, target_ess, target_rhat, max_steps, checkpoint_every, folder, progress
        See `bayesdist.sample`.
    compute : Compute, optional
        Computing engine; this process by default.

    Returns
    -------
    Posterior
        Draws of distortion, frames, jitter and fraction of false detections, with the jitter in the
        unit of u, v. Parameters that the gauge fixes are constant and are not checked for
        convergence.

    Raises
    ------
    DegenerateError
        If the detections do not determine the free parameters.
    InputError
        If the checkpoints belong to other data or settings, or files cannot be written.
    """
    seeds = ensemble_seeds(seed, ensembles)
    started = time.monotonic()
    with in_pieces(solution.problem, solution.stars, compute) as pieces:
        at_mode = pieces.map(to_sample, solution.theta, solution.mixture)
        target = SelfTarget(solution, at_mode, outliers)
        settings = ChainSettings(
            seeds=seeds,
            n_stars=RELATIVE_COST * len(solution.problem),
            limits=Limits(target_ess, target_rhat),
            max_steps=max_steps,
            checkpoint_every=checkpoint_every,
            folder=None if folder is None else Path(folder),
            fingerprint=_fingerprint(solution, target.mixture, seed, ensembles, checkpoint_every),
            progress=progress,
        )
        chains = run_chains(target, propose(target), settings)
    problem, draws, n = solution.problem, chains.draws, target.n_theta
    member = memberships(problem, solution.theta, solution.mixture, solution.stars)
    posterior = Posterior(
        model=problem.model,
        mixture=target.mixture,
        theta=target.theta(draws[..., :n]),
        hyper=target.hyper.values(draws[..., n:]),
        log_prob=chains.log_densities,
        n_stars=len(problem),
        n_flagged=int((member < 0.5).sum()),
        n_false=len(problem) - solution.expansion.n_members,
        reference_sigma=target.hyper.scale,
        convergence=chains.verdict.among((*problem.model.names, *target.hyper.names)),
        sampler=chains.info(seed, started),
        own_places=True,
    )
    return _in_unit(posterior, problem.model.pixel_size(solution.theta))


def _in_unit(posterior: Posterior, pixel: float) -> Posterior:
    """Convert the errors of a posterior from pixels to the unit of u, v."""
    m, hyper = posterior.mixture, dict(posterior.hyper)
    if "j" in hyper:
        hyper["j"] = pixel * hyper["j"]

    def scaled(length: float | None) -> float | None:
        return None if length is None else pixel * length

    mixture = replace(
        m,
        match_radius=scaled(m.match_radius),
        jitter=scaled(m.jitter),
        jitter_scale=scaled(m.jitter_scale),
    )
    sigma = pixel * posterior.reference_sigma
    return replace(posterior, mixture=mixture, hyper=hyper, reference_sigma=sigma)


def _fingerprint(solution: SelfCalibrationMode, *settings: object) -> str:
    """Hash of the data, model and settings, which a resumed run must share."""
    p, digest = solution.problem, hashlib.sha256()
    shape = () if p.shape is None else (p.shape,)
    for column in (p.seen, p.var, *shape, p.starts, p.groups.index, solution.theta):
        digest.update(np.ascontiguousarray(column).data)
    digest.update(repr((p.model.to_dict(), settings)).encode())
    return digest.hexdigest()


def propose(target: SelfTarget) -> GridProposal:
    """Build the grid proposal; its nodes cover all but 1e-8 of the posterior of the jitter.

    Raises DegenerateError if no mode is found at a node.
    """
    split = Split(
        target.n_theta, target.mixture.hyper, tuple(k for k in target.mixture.hyper if k == "j")
    )
    if not split.held:
        z, bend = _fraction(target, split, np.zeros(0))
        jitter = target.mixture.jitter or 0.0
        return _grid(target, split, np.zeros((1, 0)), [_mode(target, jitter, z)], z, bend)
    at, top = _nodes_at(target)
    z, bend = _fraction(target, split, np.array([top]))
    modes = _modes(target, np.exp(2 * at), z)
    return _grid(target, split, at[:, None], modes, z, bend)


def _fraction(target: SelfTarget, split: Split, at: Float) -> tuple[float, float]:
    """Cube root of the most probable fraction of false detections, and the curvature there.

    It is computed with the stars integrated out.  At the stars' modes the fraction would be biased
    low, because a star is less well determined if one of its detections may be false.  The fraction
    hardly depends on the jitter.
    """
    solution = target.solution
    n = len(target.problem)
    z = float(np.cbrt(max(solution.mixture.fraction, 0.3 / n)))
    step = z / (3 * max(np.sqrt(n * z**3), 1.0))  # about a standard deviation
    for _ in range(4):
        mesh = np.clip(z + step * np.linspace(-2.0, 2.0, 5), z / 5, 0.98)
        y = np.column_stack([np.tile(solution.theta[solution.free], (5, 1)), mesh])
        psi = split.to_psi(y, np.tile(at, (5, 1)))
        value = target.log_density(psi) + split.log_jacobian(y)
        a, b, _ = np.polyfit(mesh - z, value - value[2], 2)
        if a >= 0:  # not yet near the maximum
            z = float(mesh[int(np.argmax(value))])
            continue
        move = float(np.clip(-b / (2 * a), -2 * step, 2 * step))
        z, step = float(np.clip(z + move, z / 5, 0.98)), float(1 / np.sqrt(-2 * a))
        if abs(move) < 0.2 * step:
            break
    return z, step**-2


def _nodes_at(target: SelfTarget) -> tuple[Float, float]:
    """Nodes in log j and its most probable value, with all other parameters fixed."""
    solution = target.solution
    free = solution.theta[solution.free]
    f = solution.mixture.fraction
    logit = np.log(f) - np.log1p(-f)

    def along(log_j: Float) -> Float:
        psi = np.column_stack([np.tile(free, (len(log_j), 1)), log_j, np.full(len(log_j), logit)])
        return target.log_density(psi)

    sigma = target.problem.sigma
    low, high = np.log(MIN_JITTER * sigma), np.log(30 * max(sigma, solution.mixture.jitter))
    mesh = np.linspace(low, high, 16)
    for turn in range(MAX_ITERATIONS):
        value = along(mesh)
        top = int(np.argmax(value))
        inside = np.flatnonzero(value > value[top] - DROP)
        begin, end = max(inside[0] - 1, 0), min(inside[-1] + 1, len(mesh) - 1)
        if inside[-1] - inside[0] > 6 or turn == MAX_ITERATIONS - 1:
            break
        mesh = np.linspace(mesh[begin], mesh[end], 16)
    fine = np.linspace(mesh[begin], mesh[end], 400)
    open_end = begin == 0 and mesh[0] <= low + 1e-9
    if open_end:
        # the left end is the tail of the prior, in which a single node is enough
        likelihood = value - value[0] - (mesh - mesh[0])
        felt = np.flatnonzero(np.abs(likelihood) > MIN_EFFECT)
        if len(felt):
            fine = fine[fine >= mesh[max(felt[0] - 2, 0)]]
    return np.linspace(fine[0], fine[-1], N_NODES), float(mesh[np.argmax(value)])


def _modes(target: SelfTarget, square: Float, z: float) -> list[_Mode]:
    """Modes for each squared jitter (n,), ascending, at a given fraction of false detections.

    If the jitter changes the errors only slightly, modes and curvatures are interpolated linearly
    in its square.
    """
    change = (square[-1] - square[0]) * float(np.mean(1 / (target.problem.var + square[0])))
    if change > LINEAR:
        return [_mode(target, np.sqrt(x), z) for x in square]
    exact = np.linspace(square[0], square[-1], N_EXACT)
    exact_modes = [_mode(target, np.sqrt(x), z) for x in exact]
    weights = np.stack([np.interp(square, exact, unit) for unit in np.eye(len(exact))], axis=1)
    return [_mixed(exact_modes, w) for w in weights]


@dataclass(frozen=True, eq=False)
class _Mode:
    """Free parameters (F,) at the mode for a given jitter, and the curvature (F, F) there."""

    theta: Float
    curvature: Float


def _mixed(found: Sequence[_Mode], weights: Float) -> _Mode:
    """Weighted mean of modes."""
    parts = [(w, mode) for w, mode in zip(weights, found, strict=True) if w > 0]
    return _Mode(
        sum(w * mode.theta for w, mode in parts), sum(w * mode.curvature for w, mode in parts)
    )


def _grid(
    target: SelfTarget, split: Split, at: Float, modes: Sequence[_Mode], z: float, bend: float
) -> GridProposal:
    """Proposal with nodes at the given grid coordinates (n, k), for a given fraction."""
    y = np.array([np.append(mode.theta, z) for mode in modes])
    # the density itself, since the expansion considers a single choice of members only
    values = target.log_density(split.to_psi(y, at)) + split.log_jacobian(y)
    nodes = []
    for x, y_mode, mode, value in zip(at, y, modes, values, strict=True):
        factor = _arrow(mode.curvature, bend).factor()
        nodes.append(Node(x, y_mode, factor, float(value) - 0.5 * factor.logdet))
    return GridProposal(split, tuple(nodes))


def _arrow(curvature: Float, bend: float) -> Arrow:
    """Arrow matrix of the curvature of the free parameters (F, F) and that of the fraction."""
    n = len(curvature)
    H = np.zeros((n + 1, n + 1))
    H[:-1, :-1], H[-1, -1] = curvature, bend
    return Arrow(H, np.zeros((0, n + 1, 0)), np.zeros((0, 0, 0)), n_tail=1)


def _mode(target: SelfTarget, jitter: float, z: float) -> _Mode:
    """Mode and curvature of the free parameters for a given jitter and fraction z^3."""
    solution, free = target.solution, target.solution.free
    theta = solution.theta.copy()
    observed = True
    for _ in range(MAX_STEPS):
        expansion = target.pieces.sum(slope, theta, Mixture(float(jitter), z**3), observed)
        gradient = (expansion.gradient + target.prior.pull(theta))[free]
        curvature = (expansion.curvature + target.prior.precision)[np.ix_(free, free)]
        try:
            factor = _arrow(curvature, 1.0).factor()
        except np.linalg.LinAlgError as error:
            if observed:  # a star is between two modes; EM weights give a positive curvature
                observed = False
                continue
            raise DegenerateError(
                "the detections do not determine the free parameters",
                where="self-calibration",
                do="check the gauge: dither more, add roll angles, or give priors",
            ) from error
        step = factor.solve(np.append(gradient, 0.0))[:-1]
        if gradient @ step < MAX_DECREMENT:
            break
        theta[free] += step
    return _Mode(theta[free], curvature)
