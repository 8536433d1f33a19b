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

Each ensemble and batch has a separate stream of random numbers, so that the draws do not depend on
how they are evaluated.  Each block of steps can be stored as a checkpoint.

emcee takes a second to import, so that the functions that need it import it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.errors import InputError
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density
from bayesdist.infer.equations.arrow import ArrowFactor
from bayesdist.infer.sampler.schedule import Plan, StepRange
from bayesdist.utils.arrays import Bool, Float, Int

if TYPE_CHECKING:
    from emcee import EnsembleSampler

# proposals at walkers (n, D), and log ratios (n,) of old to new proposal densities
Move = Callable[[Float, np.random.RandomState], tuple[Float, Float]]

START_BATCHES = 20  # maximum number of additional batches drawn to find starting points


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
    def _sampler(self) -> EnsembleSampler:
        from emcee import EnsembleSampler
        from emcee.moves import DEMove, MHMove

        plan = self.plan
        moves = [
            (MHMove(_independence(self.proposal, self.whitening)), plan.weights[0]),
            (MHMove(_crank_nicolson(plan.step)), plan.weights[1]),
            (DEMove(), plan.weights[2]),
        ]
        return EnsembleSampler(
            plan.walkers,
            len(self.whitening.centre),
            lambda w: self.target.log_density(self.whitening.to_psi(w)),
            moves=[move for move in moves if move[1] > 0],
            vectorize=True,
        )

    def _walk(self, start: Walkers, steps: int) -> Block:
        from emcee import State

        sampler = self._sampler
        sampler.reset()
        state = State(start.coords, log_prob=start.log_prob, copy=True)
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
    from emcee import EnsembleSampler, State
    from emcee.moves import MHMove

    proposals, W = _Replay(start, batch, ensemble), len(start.coords)
    sampler = EnsembleSampler(
        W, 1, proposals.log_density, moves=MHMove(proposals.propose), vectorize=True
    )
    state = State(np.arange(W, dtype=float)[:, None], log_prob=start.log_prob.copy())
    state.random_state = start.random
    steps = batch.psi.shape[1] // W
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    index = sampler.get_chain()[..., 0].astype(np.int64)
    log_q = proposals.log_q[index[-1]]
    log_prob = proposals.log_prob[index]
    end = Walkers(proposals.psi[index[-1]], log_prob[-1], log_q, sampler.random_state)
    accepted = sampler.backend.accepted.astype(float)
    return Block(proposals.psi[index], log_prob, accepted, batch.log_weights[ensemble].copy(), end)


def _independence(proposal: Proposal, whitening: Whitening) -> Move:
    """Draws of the proposal, with the log ratios of old to new proposal densities."""

    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        psi = proposal.draw(len(coords), random)
        lost = ~np.all(np.isfinite(psi), axis=1)  # outside the support: target density zero
        white = np.where(np.asarray(lost)[:, None], coords, whitening.to_white(np.nan_to_num(psi)))
        # both densities are evaluated through the same coordinates, so that ratios are exact
        log_q = proposal.log_density(whitening.to_psi(np.concatenate([coords, white])))
        return white, np.where(lost, -np.inf, log_q[: len(coords)] - log_q[len(coords) :])

    return propose


def _crank_nicolson(step: float) -> Move:
    """Preconditioned Crank-Nicolson moves, with the log ratios that correct them."""
    keep = np.sqrt(1 - step**2)

    def propose(coords: Float, random: np.random.RandomState) -> tuple[Float, Float]:
        new = keep * coords + step * random.standard_normal(coords.shape)
        # the move is reversible for the standard Gaussian; correct for the difference
        return new, 0.5 * ((new**2).sum(axis=1) - (coords**2).sum(axis=1))

    return propose


ROWS = 8192  # proposals evaluated at a time
PILOT_KEY = (0,)  # spawn key of the random numbers of the pilot

CHECKPOINT = "a checkpoint"  # kind of file in error messages
BLOCK_ARRAYS = ("coords", "log_prob", "accepted", "log_weights")
END_ARRAYS = ("log_q", "random_keys", "random_state")


@dataclass(frozen=True, eq=False)
class ProposalBatch:
    """Proposals of all ensembles with their densities."""

    psi: Float  # (ensembles, n, D)
    # log posterior density (ensembles, n); NaN outside the support, where it was not evaluated
    log_prob: Float
    log_q: Float  # log proposal density (ensembles, n)

    @property
    def log_weights(self) -> Float:
        """Log importance weights (ensembles, n); NaN outside the support."""
        return self.log_prob - self.log_q

    @property
    def n_evaluated(self) -> int:
        """Number of proposals inside the support, for which the density was evaluated."""
        return int((~np.isnan(self.log_prob)).sum())

    def __getitem__(self, rows: slice) -> ProposalBatch:
        """Batch with a slice of the proposals of each ensemble."""
        return ProposalBatch(self.psi[:, rows], self.log_prob[:, rows], self.log_q[:, rows])

    def without(self, taken: Bool, n: int) -> ProposalBatch:
        """First n proposals of each ensemble that are False in the mask `taken` (ensembles, m)."""
        rows = np.array([np.flatnonzero(~t)[:n] for t in taken])
        each = np.arange(len(rows))[:, None]
        return ProposalBatch(
            self.psi[each, rows], self.log_prob[each, rows], self.log_q[each, rows]
        )


def draw_batch(
    target: Density,
    proposal: Proposal,
    seeds: Sequence[int],
    key: tuple[int, ...],
    n: int,
    n_used: int | None = None,
    rows_at_once: int = ROWS,
) -> ProposalBatch:
    """Draw and evaluate n proposals per ensemble.

    The random numbers are determined by the seed of the ensemble and the `key` of the batch.  If
    `n_used` is given, only the first `n_used` proposals are evaluated and returned; they are the
    same for any `n_used`.  `rows_at_once` proposals are evaluated in one pass over the data.
    """
    psi = _drawn(proposal, seeds, key, n)[:, :n_used]
    flat = psi.reshape(-1, psi.shape[-1])
    log_prob, log_q = np.full((2, len(flat)), np.nan)
    inside = np.flatnonzero(np.isfinite(flat).all(axis=1))
    for a in range(0, len(inside), rows_at_once):
        rows = inside[a : a + rows_at_once]
        log_prob[rows] = target.log_density(flat[rows])
        log_q[rows] = proposal.log_density(flat[rows])
    return ProposalBatch(psi, log_prob.reshape(psi.shape[:2]), log_q.reshape(psi.shape[:2]))


def _drawn(proposal: Proposal, seeds: Sequence[int], key: tuple[int, ...], n: int) -> Float:
    streams = (np.random.default_rng(np.random.SeedSequence(s, spawn_key=key)) for s in seeds)
    return np.array([proposal.draw(n, rng) for rng in streams])


def pilot_batch(
    target: Density,
    proposal: Proposal,
    seeds: Sequence[int],
    n: int,
    folder: Path | None = None,
    fingerprint: str = "",
) -> ProposalBatch:
    """Draw and evaluate the first batch of n proposals per ensemble.

    The batch is used to assess the proposal and to start the chains.

    If `folder` is given, the densities are stored in a file and read from it by a resumed run; the
    proposals themselves are drawn again.  Raises InputError if the file cannot be read or written,
    or belongs to other data or settings, that is, has another `fingerprint`.
    """
    path = None if folder is None else folder / "chain-0-pilot.h5"
    if path is not None and path.exists():
        do = "delete it and resume: its proposals are evaluated again"
        stored = read_arrays(path, fingerprint, CHECKPOINT, ("log_prob", "log_q"), do=do)
        return ProposalBatch(_drawn(proposal, seeds, PILOT_KEY, n), **stored)
    batch = draw_batch(target, proposal, seeds, PILOT_KEY, n)
    if path is not None:
        write_arrays(path, fingerprint, {"log_prob": batch.log_prob, "log_q": batch.log_q})
    return batch


# -- whitened coordinates of state-dependent moves -------------------------------------------------
@dataclass(frozen=True, eq=False)
class Whitening:
    """Transformation to coordinates in which the posterior is close to a standard Gaussian."""

    centre: Float  # psi (D,) at the origin of the whitened coordinates
    factor: ArrowFactor  # factor of the precision of the distortion parameters
    scale: Float  # standard deviations (h,) of the hyperparameters

    @classmethod
    def of(cls, target: Density, proposal: Proposal, draws: Float) -> Whitening:
        """Whitening from the best node of a proposal and the hyperparameters of `draws` (n, D).

        The parameters theta of the `target` are whitened by the covariance at that node.
        """
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
        """Convert whitened coordinates `w` (n, D) to sampled coordinates psi (n, D)."""
        n = self.n_theta
        parts = [self.factor.colour(w[:, :n]), w[:, n:] * self.scale]
        return self.centre + np.concatenate(parts, axis=1)

    def to_white(self, psi: Float) -> Float:
        """Convert sampled coordinates psi (n, D) to whitened coordinates (n, D)."""
        n, shift = self.n_theta, psi - self.centre
        return np.concatenate([self.factor.whiten(shift[:, :n]), shift[:, n:] / self.scale], axis=1)


# -- checkpoints, in blocks of steps ---------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Walkers:
    """State of the walkers of an ensemble."""

    coords: Float  # (walkers, D): psi for independence moves only, otherwise whitened coordinates
    log_prob: Float  # log posterior density (walkers,)
    log_q: Float  # log proposal density (walkers,); NaN if no move needs it
    random: tuple[
        object, ...
    ]  # state of emcee's random generator, from `numpy.random.RandomState.get_state`


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive steps of one ensemble."""

    coords: Float  # (steps stored, walkers, D) in the coordinates of `Walkers`
    log_prob: Float  # (steps stored, walkers)
    accepted: Float  # number (walkers,) of accepted moves
    # log importance weights (proposals,) for independence moves; NaN outside the support
    log_weights: Float
    end: Walkers  # state after the last step

    def write(self, path: Path, mark: str) -> None:
        """Write the block to a file; `mark` identifies the run."""
        arrays = {name: getattr(self, name) for name in BLOCK_ARRAYS}
        _, keys, *state = self.end.random
        end = (self.end.log_q, keys, np.array(state))
        write_arrays(path, mark, arrays | dict(zip(END_ARRAYS, end, strict=True)))

    @classmethod
    def read(cls, path: Path, mark: str) -> Block:
        """Read a block; raises InputError if the file cannot be read or has another mark."""
        do = "delete it and resume: its steps are run again"
        stored = read_arrays(path, mark, CHECKPOINT, (*BLOCK_ARRAYS, *END_ARRAYS), do=do)
        with restoring(path, CHECKPOINT, do=do):
            log_q, keys, (position, has_gauss, gauss) = (stored.pop(name) for name in END_ARRAYS)
            random = ("MT19937", keys, int(position), int(has_gauss), float(gauss))
            np.random.RandomState().set_state(random)  # raises if the state is invalid
            end = Walkers(stored["coords"][-1], stored["log_prob"][-1], log_q, random)
            return cls(**stored, end=end)


def block_path(folder: Path, ensemble: int, end: int) -> Path:
    """Path of the block of an ensemble (numbered from 0) that ends at step `end`."""
    return folder / f"chain-{ensemble + 1}-{end:06d}.h5"
