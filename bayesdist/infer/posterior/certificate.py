"""How good draws are that cost no pass over the data: the certificate of a surrogate."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Certificate"]


@dataclass(frozen=True)
class Certificate:
    """Distance of the surrogate s from the posterior p, by pilots that were not used to make it.

    Each pilot is one pass over the data.
    """

    n_train: int
    n_held_out: int
    n_outside: int  # pilots where the posterior density is zero
    raw_sd: float  # standard deviation of log p - log q: without a surrogate
    remainder_sd: float  # standard deviation of log p - log s, over the pilots held out
    remainder_max: float  # the largest of these, with p and s normalised
    raw_efficiency: float  # effective fraction of draws of q, weighted by p / q; over all pilots
    # effective fraction of draws of s, weighted by p / s; over the pilots held out: 1 / (1 + chi2)
    efficiency: float
    pareto_k: float  # tail of p / q: where it is heavy, q misses a part of p that no pilot shows
    chi2: float  # estimate of chi2(p || s) (module docstring)
    chi2_upper: float  # upper limit of it
    # no posterior mean is off by more than this many standard deviations; from `chi2_upper`
    mean_shift_bound: float
    # bound of the total variation: no probability is off by more; from `chi2_upper`
    tv_bound: float
    unseen: float  # largest probability under q of a region that all held-out pilots missed (95 %)
    reasons: tuple[str, ...]  # of a refusal; empty when it is granted

    @property
    def granted(self) -> bool:
        """True if draws of the surrogate may represent the posterior."""
        return not self.reasons

    @property
    def statement(self) -> str:
        """Scope and limits of the certificate, in words."""
        if not self.granted:
            return f"certificate refused: {'; '.join(self.reasons)}"
        return (
            f"approximate, with certificate: by {self.n_held_out} exact evaluations that took no "
            f"part in the approximation, no posterior mean is off by more than "
            f"{self.mean_shift_bound:.2g} of its standard deviation; regions that hold less than "
            f"{self.unseen:.2g} of the proposal's probability, such as a separate mode, "
            f"may have been missed"
        )
