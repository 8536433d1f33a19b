"""Exact sampling: independent emcee ensembles, in psi or in whitened coordinates.

Three moves, all built on `emcee.moves.MHMove` or taken from emcee:

- independence: the grid proposal, accepted by its importance weight;
- preconditioned Crank-Nicolson: q = sqrt(1 - b^2) x + b xi, corrected for its reference measure;
- differential evolution (`emcee.moves.DEMove`), which needs no good proposal.

Proposals of independence alone do not depend on the walkers.  Then all proposals of a block are
evaluated in one pass over the data and numbered; emcee walks over the numbers, and log density and
ratio of proposal densities of a number are looked up.

`emcee.moves.DESnookerMove` is never used: in emcee 3.1.6 its acceptance factor is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import emcee
import numpy as np
from emcee.moves import DEMove, MHMove

from bayesdist.errors import InputError
from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density
from bayesdist.infer.sampler.checkpoints import Block, Walkers, block_path
from bayesdist.infer.sampler.move_schedule import Plan, StepRange
from bayesdist.infer.sampler.proposal_batch import ProposalBatch, draw_batch
from bayesdist.infer.sampler.whitening import Whitening
from bayesdist.utils.arrays import Bool, Float, Int

START_BATCHES = 20  # further batches of proposals that are searched for starts of walkers


class _Replay:
    """Proposals by number: first the positions of the walkers, then those of each step in turn."""

    def __init__(self, start: Walkers, batch: ProposalBatch, ensemble: int) -> None:
        log_prob, log_q = batch.log_prob[ensemble], batch.log_q[ensemble]
        outside = np.isnan(log_prob)
        self.psi = np.concatenate([start.coords, batch.psi[ensemble]])
        self.log_prob = np.concatenate([start.log_prob, np.where(outside, -np.inf, log_prob)])
        self.log_q = np.concatenate([start.log_q, np.where(outside, 0.0, log_q)])
        self.used = len(start.coords)

    def propose(self, numbers: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        """Next proposals, and the log ratio of their proposal densities."""
        old = self._index(numbers)
        new = np.arange(self.used, self.used + len(old))
        self.used += len(old)
        return new[:, None].astype(float), self.log_q[old] - self.log_q[new]

    def log_density(self, numbers: Float) -> Float:
        """Log posterior density of proposals."""
        return self.log_prob[self._index(numbers)]

    @staticmethod
    def _index(numbers: Float) -> Int:
        return numbers[:, 0].astype(np.int64)


def replay(start: Walkers, batch: ProposalBatch, ensemble: int) -> Block:
    """Block of Metropolis-Hastings steps over proposals that have been evaluated.

    The batch has proposals (ensembles, steps * walkers, D), step after step.
    """
    known, W = _Replay(start, batch, ensemble), len(start.coords)
    sampler = emcee.EnsembleSampler(
        W, 1, known.log_density, moves=MHMove(known.propose), vectorize=True
    )
    state = emcee.State(np.arange(W, dtype=float)[:, None], log_prob=start.log_prob.copy())
    state.random_state = start.random
    steps = batch.psi.shape[1] // W
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    index = sampler.get_chain()[..., 0].astype(np.int64)
    log_q = known.log_q[index[-1]]
    log_prob = known.log_prob[index]
    end = Walkers(known.psi[index[-1]], log_prob[-1], log_q, sampler.random_state)
    accepted = sampler.backend.accepted.astype(float)
    return Block(known.psi[index], log_prob, accepted, batch.log_weights[ensemble].copy(), end)


def _independence(proposal: Proposal, whitening: Whitening) -> MHMove:
    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        psi = proposal.draw(len(coords), random)
        lost = ~np.all(np.isfinite(psi), axis=1)  # outside the support: target density zero
        white = np.where(np.asarray(lost)[:, None], coords, whitening.to_white(np.nan_to_num(psi)))
        # evaluated through the same coordinates on both sides, so that ratios are exact
        both = proposal.log_density(whitening.to_psi(np.concatenate([coords, white])))
        return white, np.where(lost, -np.inf, both[: len(coords)] - both[len(coords) :])

    return MHMove(propose)


def _crank_nicolson(step: float) -> MHMove:
    keep = np.sqrt(1 - step**2)

    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        new = keep * coords + step * random.standard_normal(coords.shape)
        # reversible for the standard Gaussian, which the posterior is not
        return new, 0.5 * ((new**2).sum(axis=1) - (coords**2).sum(axis=1))

    return MHMove(propose)


@dataclass(frozen=True, eq=False)
class Ensembles:
    """Independent ensembles that advance block by block and write a file for each block."""

    target: Density
    proposal: Proposal
    pilot: ProposalBatch  # first proposals of each ensemble
    whitening: Whitening  # coordinates of moves that depend on the state
    plan: Plan
    seeds: tuple[int, ...]  # one for each ensemble
    folder: Path | None = None  # for the blocks; None keeps them in memory
    fingerprint: str = ""  # of data and settings; stored in each block

    # -- where the walkers start ------------------------------------------------------------------

    def starts(self) -> tuple[list[Walkers], Bool, int]:
        """First states from the pilot, mask (ensembles, n) of used proposals, number of new ones.

        Where the pilot is too short for so many walkers, further proposals are evaluated.
        """
        batches, W = [self.pilot], self.plan.walkers
        while (fewest := min(len(_usable(batches, e)) for e in range(len(self.seeds)))) < W:
            if len(batches) > START_BATCHES:
                raise InputError("the proposal has no mass inside the support", where="sampler")
            key = (0, len(batches))
            batches.append(draw_batch(self.target, self.proposal, self.seeds, key, W - fewest))
        n = self.pilot.psi.shape[1]
        states, taken = [], np.zeros((len(self.seeds), n), bool)
        for e, seed in enumerate(self.seeds):
            rows = _usable(batches, e)[:W]
            psi, log_prob, log_q = (
                np.concatenate([getattr(p, name)[e] for p in batches])[rows]
                for name in ("psi", "log_prob", "log_q")
            )
            random = tuple(np.random.RandomState(seed).get_state(legacy=True))
            coords = psi if self.plan.independent else self.whitening.to_white(psi)
            taken[e, rows[rows < n]] = True
            states.append(Walkers(coords, log_prob, log_q, random))
        return states, taken, sum(batch.n_evaluated for batch in batches[1:])

    # -- steps ------------------------------------------------------------------------------------

    def advance(
        self, states: Sequence[Walkers], span: StepRange, rest: ProposalBatch
    ) -> list[Block]:
        """One block of every ensemble from its state at `span.begin`, read from a file or run.

        `rest` are pilot proposals that were not taken as starts, for the first steps.
        """
        paths: list[Path | None] = [None] * len(self.seeds)
        if self.folder is not None:
            paths = [block_path(self.folder, e, span.end) for e in range(len(self.seeds))]
        mark = f"{self.fingerprint} {self.plan.method} {span.begin}"
        known = [Block.read(p, mark) if p is not None and p.exists() else None for p in paths]
        # always for all ensembles, so that the numbers do not depend on how many are known already
        batch = None
        if self.plan.independent and any(block is None for block in known):
            batch = self._batch(span, rest)
        out = []
        for e, (block, path) in enumerate(zip(known, paths, strict=True)):
            if block is None:
                steps = span.end - span.begin
                block = (
                    self._walk(states[e], steps) if batch is None else replay(states[e], batch, e)
                )
                if path is not None:
                    block.write(path, mark)
            out.append(block)
        return out

    def psi(self, block: Block) -> Float:
        """Sampled coordinates (steps stored, walkers, D) of a block."""
        if self.plan.independent:
            return block.coords
        flat = block.coords.reshape(-1, block.coords.shape[-1])
        return self.whitening.to_psi(flat).reshape(block.coords.shape)

    def _batch(self, span: StepRange, rest: ProposalBatch) -> ProposalBatch:
        W = self.plan.walkers
        if span.begin * W < rest.psi.shape[1]:
            return rest[slice(span.begin * W, span.end * W)]
        drawn, used = (span.full - span.begin) * W, (span.end - span.begin) * W
        return draw_batch(self.target, self.proposal, self.seeds, (span.begin,), drawn, used)

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

    def _walk(self, start: Walkers, steps: int) -> Block:
        sampler = self._sampler
        sampler.reset()
        state = emcee.State(start.coords, log_prob=start.log_prob, copy=True)
        state.random_state = start.random
        thin = self.plan.thin
        sampler.run_mcmc(state, steps // thin, thin_by=thin, skip_initial_state_check=True)
        coords, log_prob = sampler.get_chain(), sampler.get_log_prob()
        nothing = np.full(self.plan.walkers, np.nan)
        end = Walkers(coords[-1], log_prob[-1], nothing, sampler.random_state)
        accepted = sampler.backend.accepted.astype(float)
        return Block(coords, log_prob, accepted, np.empty(0), end)


def _usable(batches: Sequence[ProposalBatch], ensemble: int) -> Int:
    """Numbers, through the batches, of an ensemble's proposals with a density above zero."""
    return np.flatnonzero(np.isfinite(np.concatenate([p.log_prob[ensemble] for p in batches])))
