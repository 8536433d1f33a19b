"""How good draws are that cost no pass over the data: the certificate of a surrogate."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Certificate"]


@dataclass(frozen=True)
class Certificate:
    """How far the surrogate s is from the posterior p, by pilots it was not made from.

    Parameters
    ----------
    n_train, n_held_out : int
        Pilots, each of them one pass over the data.
    n_outside : int
        Pilots where the posterior density is zero.
    raw_sd : float
        Standard deviation of log p - log q: without a surrogate.
    remainder_sd : float
        The same of log p - log s, over the pilots held out.
    remainder_max : float
        The largest of them, with p and s normalised.
    raw_efficiency : float
        Effective share of draws of q, weighted by p / q; over all pilots.
    efficiency : float
        The same of draws of s, weighted by p / s; over the pilots held out: 1 / (1 + chi2).
    pareto_k : float
        Tail of p / q: where it is heavy, q misses a part of p that no pilot shows.
    chi2, chi2_upper : float
        chi2(p || s): estimate and upper limit (derived in `bayesdist.infer.sampler.surrogate`).
    mean_shift_bound : float
        No posterior mean is off by more than this many standard deviations; from `chi2_upper`.
    tv_bound : float
        Bound of the total variation: no probability is off by more; from `chi2_upper`.
    unseen : float
        Largest probability under q of a region that all held-out pilots missed (95 %).
    reasons : tuple of str
        Why it is refused; empty when it is granted.
    """

    n_train: int
    n_held_out: int
    n_outside: int
    raw_sd: float
    remainder_sd: float
    remainder_max: float
    raw_efficiency: float
    efficiency: float
    pareto_k: float
    chi2: float
    chi2_upper: float
    mean_shift_bound: float
    tv_bound: float
    unseen: float
    reasons: tuple[str, ...]

    @property
    def granted(self) -> bool:
        """Whether draws of the surrogate may stand for the posterior."""
        return not self.reasons

    @property
    def statement(self) -> str:
        """What it says and what it does not, in words."""
        if not self.granted:
            return f"certificate refused: {'; '.join(self.reasons)}"
        return (
            f"approximate, with certificate: by {self.n_held_out} exact evaluations that took no "
            f"part in the approximation, no posterior mean is off by more than "
            f"{self.mean_shift_bound:.2g} of its standard deviation; regions that hold less than "
            f"{self.unseen:.2g} of the proposal's probability, such as a separate mode, "
            f"may have been missed"
        )
