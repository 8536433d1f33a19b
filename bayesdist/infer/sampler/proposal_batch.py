"""Independence proposals, drawn and evaluated many at a time.

They do not depend on the walkers, so that one pass over the data serves many steps of all
ensembles.  Each ensemble has its own stream of random numbers for each batch of proposals, which
makes the draws independent of how they are evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density
from bayesdist.infer.sampler.checkpoints import CHECKPOINT
from bayesdist.utils.arrays import Bool, Float

ROWS = 8192  # proposals evaluated at a time


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
        """Number of proposals that lie in the support."""
        return int((~np.isnan(self.log_prob)).sum())

    def __getitem__(self, rows: slice) -> ProposalBatch:
        """Batch with some of the proposals of each ensemble."""
        return ProposalBatch(self.psi[:, rows], self.log_prob[:, rows], self.log_q[:, rows])

    def without(self, taken: Bool, n: int) -> ProposalBatch:
        """Batch of the first n proposals of each ensemble that are not among those taken."""
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
) -> ProposalBatch:
    """Batch of n proposals of each ensemble, drawn and evaluated.

    `key` of the batch and the ensemble's seed fix the random numbers.  Only the first `n_used` are
    returned; they do not depend on this number.
    """
    psi = _drawn(proposal, seeds, key, n)[:, :n_used]
    flat = psi.reshape(-1, psi.shape[-1])
    log_prob, log_q = np.full((2, len(flat)), np.nan)
    inside = np.flatnonzero(np.isfinite(flat).all(axis=1))
    for a in range(0, len(inside), ROWS):
        rows = inside[a : a + ROWS]
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
    name: str = "pilot",
    key: tuple[int, ...] = (0,),
) -> ProposalBatch:
    """First batch, which judges the proposal and then starts the chains.

    A file stores the result of its evaluation; the proposals themselves are drawn again.
    InputError when the file cannot be read or written, or belongs to other data or settings.
    """
    path = None if folder is None else folder / f"chain-0-{name}.h5"
    if path is not None and path.exists():
        do = "delete it and resume: its proposals are evaluated again"
        known = read_arrays(path, fingerprint, CHECKPOINT, ("log_prob", "log_q"), do=do)
        return ProposalBatch(_drawn(proposal, seeds, key, n), **known)
    batch = draw_batch(target, proposal, seeds, key, n)
    if path is not None:
        write_arrays(path, fingerprint, {"log_prob": batch.log_prob, "log_q": batch.log_q})
    return batch
