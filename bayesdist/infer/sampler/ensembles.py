"""Exact sampling with independent emcee ensembles, in psi or in whitened coordinates.

There are three moves, built on `emcee.moves.MHMove` or taken from emcee:

- independence: draws of the grid proposal, accepted according to their importance weights;
- preconditioned Crank-Nicolson (pCN): q = sqrt(1 - b^2) x + b xi, with a correction because the
  posterior is not the standard Gaussian;
- differential evolution (`emcee.moves.DEMove`), which does not need a good proposal.

If only independence moves are used, proposals do not depend on the walkers.  All proposals of a
block are then evaluated in one pass over the data and numbered.  emcee walks over these numbers,
and log densities and proposal ratios are looked up.

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
from bayesdist.infer.sampler.proposals import (
    Block,
    ProposalBatch,
    Walkers,
    Whitening,
    block_path,
    draw_batch,
)
from bayesdist.infer.sampler.schedule import Plan, StepRange
from bayesdist.utils.arrays import Bool, Float, Int

START_BATCHES = 20  # maximum number of additional batches drawn to find starting points


class _Replay:
    """Evaluated proposals by number: the current walkers, then the proposals of each step."""

    def __init__(self, start: Walkers, batch: ProposalBatch, ensemble: int) -> None:
        log_prob, log_q = batch.log_prob[ensemble], batch.log_q[ensemble]
        outside = np.isnan(log_prob)
        self.psi = np.concatenate([start.coords, batch.psi[ensemble]])
        self.log_prob = np.concatenate([start.log_prob, np.where(outside, -np.inf, log_prob)])
        self.log_q = np.concatenate([start.log_q, np.where(outside, 0.0, log_q)])
        self.used = len(start.coords)

    def propose(self, numbers: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        """Numbers of the next proposals, and log ratios of old to new proposal densities."""
        old = self._index(numbers)
        new = np.arange(self.used, self.used + len(old))
        self.used += len(old)
        return new[:, None].astype(float), self.log_q[old] - self.log_q[new]

    def log_density(self, numbers: Float) -> Float:
        """Log posterior density of proposals given by number."""
        return self.log_prob[self._index(numbers)]

    @staticmethod
    def _index(numbers: Float) -> Int:
        return numbers[:, 0].astype(np.int64)


def replay(start: Walkers, batch: ProposalBatch, ensemble: int) -> Block:
    """Run the Metropolis-Hastings steps of an ensemble over proposals that are already evaluated.

    The batch has proposals (ensembles, steps * walkers, D), ordered by step.
    """
    proposals, W = _Replay(start, batch, ensemble), len(start.coords)
    sampler = emcee.EnsembleSampler(
        W, 1, proposals.log_density, moves=MHMove(proposals.propose), vectorize=True
    )
    state = emcee.State(np.arange(W, dtype=float)[:, None], log_prob=start.log_prob.copy())
    state.random_state = start.random
    steps = batch.psi.shape[1] // W
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    index = sampler.get_chain()[..., 0].astype(np.int64)
    log_q = proposals.log_q[index[-1]]
    log_prob = proposals.log_prob[index]
    end = Walkers(proposals.psi[index[-1]], log_prob[-1], log_q, sampler.random_state)
    accepted = sampler.backend.accepted.astype(float)
    return Block(proposals.psi[index], log_prob, accepted, batch.log_weights[ensemble].copy(), end)


def _independence(proposal: Proposal, whitening: Whitening) -> MHMove:
    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        psi = proposal.draw(len(coords), random)
        lost = ~np.all(np.isfinite(psi), axis=1)  # outside the support: target density zero
        white = np.where(np.asarray(lost)[:, None], coords, whitening.to_white(np.nan_to_num(psi)))
        # both densities are evaluated through the same coordinates, so that ratios are exact
        log_q = proposal.log_density(whitening.to_psi(np.concatenate([coords, white])))
        return white, np.where(lost, -np.inf, log_q[: len(coords)] - log_q[len(coords) :])

    return MHMove(propose)


def _crank_nicolson(step: float) -> MHMove:
    keep = np.sqrt(1 - step**2)

    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        new = keep * coords + step * random.standard_normal(coords.shape)
        # the move is reversible for the standard Gaussian; correct for the difference
        return new, 0.5 * ((new**2).sum(axis=1) - (coords**2).sum(axis=1))

    return MHMove(propose)


@dataclass(frozen=True, eq=False)
class Ensembles:
    """Independent ensembles that advance in blocks of steps, with a checkpoint per block."""

    target: Density
    proposal: Proposal
    pilot: ProposalBatch  # first proposals of each ensemble
    whitening: Whitening  # coordinates for moves that depend on the state
    plan: Plan
    seeds: tuple[int, ...]  # one per ensemble
    folder: Path | None = None  # folder of the checkpoints; None for no checkpoints
    fingerprint: str = ""  # hash of data and settings, stored in each checkpoint

    # -- starting points --------------------------------------------------------------------------

    def starts(self) -> tuple[list[Walkers], Bool, int]:
        """Initial states of the walkers, taken from the pilot.

        If the pilot has too few proposals for the walkers, additional ones are evaluated.  Returns
        the states, the mask (ensembles, n) of pilot proposals that were used, and the number of
        additional evaluations.  Raises InputError if hardly any proposal is inside the support.
        """
        batches, W = [self.pilot], self.plan.walkers
        while (fewest := min(len(_usable(batches, e)) for e in range(len(self.seeds)))) < W:
            if len(batches) > START_BATCHES:
                raise InputError(
                    "hardly any state that is proposed is inside the support of the priors",
                    where="sampler",
                    do="widen the priors, or check the least-squares fit on which proposals are "
                    "centred",
                )
            key = (0, len(batches))
            batches.append(draw_batch(self.target, self.proposal, self.seeds, key, W - fewest))
        n = self.pilot.psi.shape[1]
        states, used_as_start = [], np.zeros((len(self.seeds), n), bool)
        for e, seed in enumerate(self.seeds):
            rows = _usable(batches, e)[:W]
            psi, log_prob, log_q = (
                np.concatenate([getattr(p, name)[e] for p in batches])[rows]
                for name in ("psi", "log_prob", "log_q")
            )
            random = tuple(np.random.RandomState(seed).get_state(legacy=True))
            coords = psi if self.plan.independent else self.whitening.to_white(psi)
            used_as_start[e, rows[rows < n]] = True
            states.append(Walkers(coords, log_prob, log_q, random))
        return states, used_as_start, sum(batch.n_evaluated for batch in batches[1:])

    # -- steps ------------------------------------------------------------------------------------

    def advance(
        self, states: Sequence[Walkers], span: StepRange, rest: ProposalBatch
    ) -> list[Block]:
        """Advance every ensemble from its state at `span.begin`, or read the block from a file.

        `states` has the state of each ensemble.  `rest` are the pilot proposals that were not used
        as starting points; they are used for the first steps.
        """
        paths: list[Path | None] = [None] * len(self.seeds)
        if self.folder is not None:
            paths = [block_path(self.folder, e, span.end) for e in range(len(self.seeds))]
        mark = f"{self.fingerprint} {self.plan.method} {span.begin}"
        stored = [Block.read(p, mark) if p is not None and p.exists() else None for p in paths]
        # always drawn for all ensembles, so that results do not depend on which files exist
        batch = None
        if self.plan.independent and any(block is None for block in stored):
            batch = self._batch(span, rest)
        out = []
        for e, (block, path) in enumerate(zip(stored, paths, strict=True)):
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
    """Indices, counted through the batches, of an ensemble's proposals with non-zero density."""
    return np.flatnonzero(np.isfinite(np.concatenate([p.log_prob[ensemble] for p in batches])))
