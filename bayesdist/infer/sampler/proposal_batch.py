"""Independence proposals, drawn and evaluated in large batches.

They do not depend on the walkers, so that one pass over the data serves many steps of all
ensembles.  Each ensemble and batch has a separate stream of random numbers, so that the draws do
not depend on how they are evaluated.
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
PILOT_KEY = (0,)  # spawn key of the random numbers of the pilot


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
) -> ProposalBatch:
    """Draw and evaluate n proposals per ensemble.

    The random numbers are determined by the seed of the ensemble and the `key` of the batch.  If
    `n_used` is given, only the first `n_used` proposals are evaluated and returned; they are the
    same for any `n_used`.
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
) -> ProposalBatch:
    """Draw and evaluate the first batch, used to rate the proposal and to start the chains.

    If `folder` is given, the densities are stored in a file and read from it by a resumed run; the
    proposals themselves are drawn again.  Raises InputError if the file cannot be read or written,
    or belongs to other data or settings.
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
