"""Exact sampling: four independent emcee ensembles in whitened coordinates.

Three moves, all built on `emcee.moves.MHMove` or taken from emcee:

- independence: the grid proposal, accepted by its importance weight;
- preconditioned Crank-Nicolson: q = sqrt(1 - b^2) x + b xi, corrected for its reference measure;
- differential evolution (`emcee.moves.DEMove`), which needs no good proposal.

`emcee.moves.DESnookerMove` is never used: in emcee 3.1.6 its acceptance factor is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import emcee
import h5py
import numpy as np
from emcee.moves import DEMove, MHMove
from numpy.typing import NDArray

from bayesdist.data.files import atomic_path
from bayesdist.errors import InputError
from bayesdist.infer.arrow import ArrowFactor
from bayesdist.infer.proposal import GridProposal
from bayesdist.infer.target import Target

__all__ = ["Block", "Ensembles", "Plan", "Whitening", "boundaries", "plan_moves"]

Float = NDArray[np.float64]

START_DRAWS = 4  # proposals for each walker's start: some fall outside the support
FIRST_CHECK = 50  # steps after which convergence is first judged


@dataclass(frozen=True)
class Plan:
    """How to sample, chosen from the quality of the proposal before the first step.

    Parameters
    ----------
    method : str
        What the report calls it.
    weights : tuple of float
        Shares of independence, Crank-Nicolson and differential evolution.
    walkers : int
        Walkers of one ensemble.
    warmup : int
        Steps that are dropped at least; of moves that go slowly, the first half is dropped.
    step : float
        b of the Crank-Nicolson move.
    thin : int
        Every so many steps are kept: moves that go slowly would only fill the memory.
    """

    method: str
    weights: tuple[float, float, float]
    walkers: int
    warmup: int
    step: float
    thin: int = 1


def plan_moves(efficiency: float, k: float, n_params: int, walkers: int | None = None) -> Plan:
    """Choose the moves from the importance efficiency and the Pareto k of the proposal.

    Acceptance plays no part: it looks fine on proposals that miss a tail.

    Parameters
    ----------
    efficiency, k : float
    n_params : int
    walkers : int, optional
        Overrides the number of walkers.

    Returns
    -------
    Plan
    """
    step = min(0.5, 2.0 / np.sqrt(n_params))
    if efficiency > 0.5 and k < 0.7:
        return Plan("independence", (0.95, 0.05, 0.0), walkers or 16, 10, step)
    if efficiency > 0.05 and k < 0.7:
        return Plan("independence + pCN", (0.6, 0.4, 0.0), walkers or 32, 100, step, 5)
    # emcee's red-blue moves want two walkers for each parameter
    least = 2 * (n_params + 1)
    return Plan("DE + pCN + independence", (0.2, 0.3, 0.5), max(walkers or 0, least), 500, step, 10)


@dataclass(frozen=True, eq=False)
class Whitening:
    """Coordinates in which the posterior is close to a standard Gaussian.

    Parameters
    ----------
    centre : ndarray, shape (D,)
    factor : ArrowFactor
        Of the curvature of the distortion parameters.
    scale : ndarray, shape (h,)
        Standard deviations of the hyperparameters.
    """

    centre: Float
    factor: ArrowFactor
    scale: Float

    @classmethod
    def of(cls, target: Target, proposal: GridProposal, draws: Float) -> Whitening:
        """From the proposal's best node and hyperparameters of some draws (n, D)."""
        n = target.n_theta
        factor = proposal.best.factor.matrix.without_tail().factor()
        hyper = draws[:, n:]
        centre = np.concatenate([proposal.best.mode[:n], np.nanmean(hyper, axis=0)])
        return cls(centre, factor, np.nanstd(hyper, axis=0))

    @property
    def n_theta(self) -> int:
        """Number of distortion parameters."""
        return self.factor.matrix.size

    def to_psi(self, w: Float) -> Float:
        """Sampled coordinates (n, D) from whitened ones."""
        n = self.n_theta
        parts = [self.factor.colour(w[:, :n]), w[:, n:] * self.scale]
        return self.centre + np.concatenate(parts, axis=1)

    def to_white(self, psi: Float) -> Float:
        """Whitened coordinates (n, D) from sampled ones."""
        n, shift = self.n_theta, psi - self.centre
        return np.concatenate([self.factor.whiten(shift[:, :n]), shift[:, n:] / self.scale], axis=1)


def _independence(proposal: GridProposal, whitening: Whitening) -> MHMove:
    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        psi = proposal.draw(len(coords), random)
        lost = ~np.all(np.isfinite(psi), axis=1)  # outside the support: target density zero
        white = np.where(np.asarray(lost)[:, None], coords, whitening.to_white(np.nan_to_num(psi)))
        # evaluated through the same coordinates on both sides, so that ratios are exact
        factor = proposal.log_density(whitening.to_psi(coords)) - proposal.log_density(
            whitening.to_psi(white)
        )
        return white, np.where(lost, -np.inf, factor)

    return MHMove(propose)


def _crank_nicolson(step: float) -> MHMove:
    keep = np.sqrt(1 - step**2)

    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        new = keep * coords + step * random.standard_normal(coords.shape)
        # reversible for the standard Gaussian, which the posterior is not
        return new, 0.5 * ((new**2).sum(axis=1) - (coords**2).sum(axis=1))

    return MHMove(propose)


def boundaries(every: int, max_steps: int, thin: int = 1) -> Iterator[int]:
    """Steps at which blocks end: 50, 100, 200, ... then every `every` steps up to `max_steps`.

    All are multiples of `thin`, so that every row that is kept stands for as many steps.
    """
    last, end = max_steps - max_steps % thin, 0
    while end < last:
        step = min(max(end, FIRST_CHECK), every)
        end = min(end + step + -step % thin, last)
        yield end


@dataclass(frozen=True, eq=False)
class Block:
    """Some steps of one ensemble.

    Parameters
    ----------
    psi : ndarray, shape (steps kept, walkers, D)
    log_prob : ndarray, shape (steps kept, walkers)
    accepted : ndarray, shape (walkers,)
        Number of accepted moves of each walker among the steps kept.
    state : emcee.State
        After the last step, with the state of the random numbers.
    """

    psi: Float
    log_prob: Float
    accepted: Float
    state: emcee.State


@dataclass(frozen=True, eq=False)
class Ensembles:
    """Independent ensembles that advance block by block and leave a file for each block.

    Parameters
    ----------
    target : Target
    proposal : GridProposal
    whitening : Whitening
    plan : Plan
    seeds : tuple of int
        One for each ensemble.
    folder : Path or None
        Where the blocks go; None keeps them in memory.
    fingerprint : str
        Of data and settings; kept in each block.
    """

    target: Target
    proposal: GridProposal
    whitening: Whitening
    plan: Plan
    seeds: tuple[int, ...]
    folder: Path | None = None
    fingerprint: str = ""

    @cached_property
    def _sampler(self) -> emcee.EnsembleSampler:
        plan = self.plan
        moves = [
            (_independence(self.proposal, self.whitening), plan.weights[0]),
            (_crank_nicolson(plan.step), plan.weights[1]),
            (DEMove(), plan.weights[2]),
        ]
        return emcee.EnsembleSampler(
            plan.walkers,
            len(self.whitening.centre),
            lambda w: self.target.log_density(self.whitening.to_psi(w)),
            moves=[move for move in moves if move[1] > 0],
            vectorize=True,
        )

    def start(self, ensemble: int) -> emcee.State:
        """First state of an ensemble: draws of the proposal."""
        random = np.random.RandomState(self.seeds[ensemble])
        psi = self.proposal.draw(START_DRAWS * self.plan.walkers, random)
        psi = psi[np.isfinite(psi).all(axis=1)]
        psi = psi[np.isfinite(self.target.log_density(psi))][: self.plan.walkers]
        if len(psi) < self.plan.walkers:
            raise InputError("the proposal has no mass inside the support", where="sampler")
        state = emcee.State(self.whitening.to_white(psi))
        state.random_state = random.get_state()
        return state

    def block(self, ensemble: int, state: emcee.State, begin: int, end: int) -> Block:
        """Steps `begin` to `end` of one ensemble, read from its file or run.

        Parameters
        ----------
        ensemble, begin, end : int
        state : emcee.State
            At step `begin`.

        Returns
        -------
        Block
        """
        path = None
        if self.folder is not None:
            path = self.folder / f"chain-{ensemble + 1}-{end:06d}.h5"
            if path.exists():
                return self._block(*_read_block(path, f"{self.fingerprint} {begin}"))
        sampler = self._sampler
        sampler.reset()
        thin = self.plan.thin
        sampler.run_mcmc(state, (end - begin) // thin, thin_by=thin, skip_initial_state_check=True)
        white, log_prob = sampler.get_chain(), sampler.get_log_prob()
        accepted = sampler.backend.accepted.astype(float)
        random = sampler.random_state
        if path is not None:
            mark = f"{self.fingerprint} {begin}"
            _write_block(path, mark, white, log_prob, accepted, random)
        return self._block(white, log_prob, accepted, random)

    def _block(self, white: Float, log_prob: Float, accepted: Float, random: tuple) -> Block:
        state = emcee.State(white[-1], log_prob=log_prob[-1])
        state.random_state = random
        psi = self.whitening.to_psi(white.reshape(-1, white.shape[-1])).reshape(white.shape)
        return Block(psi, log_prob, accepted, state)


def _write_block(
    path: Path, mark: str, white: Float, log_prob: Float, accepted: Float, random: tuple
) -> None:
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file["chain"], file["log_prob"], file["accepted"] = white, log_prob, accepted
        _, file["random_keys"], position, has_gauss, gauss = random
        file.attrs["belongs_to"] = mark
        file.attrs["random_position"] = position
        file.attrs["random_has_gauss"] = has_gauss
        file.attrs["random_gauss"] = gauss


def _read_block(path: Path, mark: str) -> tuple[Float, Float, Float, tuple]:
    try:
        with h5py.File(path, "r") as file:
            if file.attrs["belongs_to"] != mark:
                raise KeyError("belongs_to")
            random = (
                "MT19937",
                file["random_keys"][...],
                int(file.attrs["random_position"]),
                int(file.attrs["random_has_gauss"]),
                float(file.attrs["random_gauss"]),
            )
            return file["chain"][...], file["log_prob"][...], file["accepted"][...], random
    except (OSError, KeyError) as error:
        raise InputError(
            "the checkpoint cannot be read, or belongs to another run",
            where=str(path),
            do="delete it and resume: its steps are run again",
        ) from error
