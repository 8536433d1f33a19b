"""Independence proposals, drawn and evaluated many at a time.

They do not depend on where the walkers are, so that one sweep over the data serves many steps of
all ensembles.  Each ensemble has its own stream of random numbers for each page of proposals, which
makes what is drawn independent of how it is evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Target
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays

__all__ = ["Page", "draw_page", "pilot_page"]

Float = NDArray[np.float64]

ROWS = 8192  # proposals evaluated at a time


@dataclass(frozen=True, eq=False)
class Page:
    """Proposals of all ensembles and what is known of them.

    Parameters
    ----------
    psi : ndarray, shape (ensembles, n, D)
    log_prob : ndarray, shape (ensembles, n)
        Log posterior density; NaN outside the support, where it was not evaluated.
    log_q : ndarray, shape (ensembles, n)
        Log proposal density.
    """

    psi: Float
    log_prob: Float
    log_q: Float

    @property
    def log_weights(self) -> Float:
        """Log importance weights (ensembles, n); NaN outside the support."""
        return self.log_prob - self.log_q

    @property
    def n_evaluated(self) -> int:
        """Number of proposals that lie in the support."""
        return int((~np.isnan(self.log_prob)).sum())

    def __getitem__(self, rows: slice) -> Page:
        """Some of the proposals of each ensemble."""
        return Page(self.psi[:, rows], self.log_prob[:, rows], self.log_q[:, rows])

    def without(self, taken: NDArray[np.bool_], n: int) -> Page:
        """The first n proposals of each ensemble that are not among those taken."""
        rows = np.array([np.flatnonzero(~t)[:n] for t in taken])
        each = np.arange(len(rows))[:, None]
        return Page(self.psi[each, rows], self.log_prob[each, rows], self.log_q[each, rows])


def draw_page(
    target: Target,
    proposal: Proposal,
    seeds: Sequence[int],
    key: tuple[int, ...],
    n: int,
    n_used: int | None = None,
) -> Page:
    """Draw and evaluate a page of proposals.

    Parameters
    ----------
    target : Target
    proposal : Proposal
    seeds : sequence of int
        One for each ensemble.
    key : tuple of int
        Of the page; with the seed it fixes the random numbers.
    n : int
        Proposals of each ensemble.
    n_used : int, optional
        Those that are wanted: the first of them, the same whatever this number.
    """
    psi = _drawn(proposal, seeds, key, n)[:, :n_used]
    flat = psi.reshape(-1, psi.shape[-1])
    log_prob, log_q = np.full((2, len(flat)), np.nan)
    inside = np.flatnonzero(np.isfinite(flat).all(axis=1))
    for a in range(0, len(inside), ROWS):
        rows = inside[a : a + ROWS]
        log_prob[rows] = target.log_density(flat[rows])
        log_q[rows] = proposal.log_density(flat[rows])
    return Page(psi, log_prob.reshape(psi.shape[:2]), log_q.reshape(psi.shape[:2]))


def _drawn(proposal: Proposal, seeds: Sequence[int], key: tuple[int, ...], n: int) -> Float:
    streams = (np.random.default_rng(np.random.SeedSequence(s, spawn_key=key)) for s in seeds)
    return np.array([proposal.draw(n, rng) for rng in streams])


def pilot_page(
    target: Target,
    proposal: Proposal,
    seeds: Sequence[int],
    n: int,
    folder: Path | None = None,
    fingerprint: str = "",
    name: str = "pilot",
    key: tuple[int, ...] = (0,),
) -> Page:
    """The first page, which judges the proposal and then starts the chains.

    A file keeps what its evaluation gave; the proposals themselves are drawn again.

    Parameters
    ----------
    target : Target
    proposal : Proposal
    seeds : sequence of int
    n : int
        Proposals of each ensemble.
    folder : path, optional
    fingerprint : str
        Of data and settings.
    name : str
        Of its file.
    key : tuple of int
        As in `draw_page`.

    Raises
    ------
    InputError
        When the file cannot be read or written, or belongs to other data or settings.
    """
    path = None if folder is None else folder / f"chain-0-{name}.h5"
    if path is not None and path.exists():
        do = "delete it and resume: its proposals are evaluated again"
        known = read_arrays(path, fingerprint, ("log_prob", "log_q"), do=do)
        return Page(_drawn(proposal, seeds, key, n), **known)
    page = draw_page(target, proposal, seeds, key, n)
    if path is not None:
        write_arrays(path, fingerprint, {"log_prob": page.log_prob, "log_q": page.log_q})
    return page
