"""Building blocks of the ensembles: batches of proposals, whitened coordinates, checkpoints.

Independence proposals do not depend on the walkers, so that one pass over the data serves many
steps of all ensembles.  Each ensemble and batch has a separate stream of random numbers, so that
the draws do not depend on how they are evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density
from bayesdist.infer.equations.arrow import ArrowFactor
from bayesdist.utils.arrays import Bool, Float

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
