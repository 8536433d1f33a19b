"""What this machine can do at best: arithmetic in the cache, and bytes from memory."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numba as nb
import numpy as np

from bayesdist.infer.kernel.blocks import BLOCK, scratch
from bayesdist.infer.kernel.numeric import whole_vectors
from tests.benchmarks.timing import best

__all__ = ["Roofline", "measure"]

CACHED = 1024  # doubles of one array: 8 KB, in any first-level cache
CHAIN = 16  # fused multiply-adds of one element
STREAM = 16_000_000  # doubles of one array: beyond any last-level cache

# one pass of the Gaussian mixture beside the two polynomials, for each star:
# residuals 2, variances 2, exponents 6, peak 3, exponential 14 (degree 11, scaled), sum of the two
# branches 4, product and total 2; quotients share one inverse root of two steps, 12
MIXTURE_OPS = 45
BYTES_PER_STAR = 6 * 8  # X, Y, u, v, var_u, var_v


@nb.njit(fastmath={"contract", "nsz", "arcp"})
def _multiply_adds(x, out, c, times):
    whole_vectors()  # as the passes do
    c0, c1, c2, c3 = c
    for _ in range(times):
        for s in range(len(x)):
            a = x[s]
            r = c0
            r = r * a + c1
            r = r * a + c2
            r = r * a + c3
            r = r * a + c0
            r = r * a + c1
            r = r * a + c2
            r = r * a + c3
            r = r * a + c0
            r = r * a + c1
            r = r * a + c2
            r = r * a + c3
            r = r * a + c0
            r = r * a + c1
            r = r * a + c2
            r = r * a + c3
            r = r * a + c0
            out[s] = r


@nb.njit(parallel=True)
def _triad(a, b, c, factor):
    whole_vectors()
    for i in nb.prange(len(a)):
        a[i] = b[i] + factor * c[i]


@dataclass(frozen=True)
class Roofline:
    """Ceilings of one core, and of the memory.

    Parameters
    ----------
    fma_per_ns : float
        Fused multiply-adds of double precision, in the cache.
    bytes_per_ns : float
        Stream triad over all threads: GB/s.
    """

    fma_per_ns: float
    bytes_per_ns: float

    def floor_ns(self, order: int, batch: int, threads: int) -> dict[str, float]:
        """Least nanoseconds for one star and evaluation, for each ceiling.

        Horner's rule in two variables takes as many multiply-adds as there are terms, for each
        axis.  The stars are read once for a batch of parameter vectors.
        """
        terms = (order + 1) * (order + 2) // 2
        return {
            "polynomials": 2 * terms / self.fma_per_ns / threads,
            "arithmetic": (2 * terms + MIXTURE_OPS) / self.fma_per_ns / threads,
            "memory": BYTES_PER_STAR / batch / self.bytes_per_ns,
        }

    def or_better(self, other: Roofline) -> Roofline:
        """The higher one of each ceiling, of two measurements."""
        return Roofline(
            max(self.fma_per_ns, other.fma_per_ns), max(self.bytes_per_ns, other.bytes_per_ns)
        )

    def to_dict(self) -> dict[str, float]:
        """For the report."""
        return asdict(self)


def measure(*, quick: bool = False) -> Roofline:
    """Run the three loops.

    Parameters
    ----------
    quick : bool
        Short loops, for tests.

    Returns
    -------
    Roofline
    """
    times = 200 if quick else 20_000
    # from lines of the cache on, as the passes' arrays: else up to a third slower
    x, out = (scratch(CACHED // BLOCK).reshape(-1) for _ in range(2))
    x[:] = np.random.default_rng(0).uniform(0.5, 1.0, CACHED)
    coefficients = (0.1, 0.2, 0.3, 0.4)
    _multiply_adds(x, out, coefficients, 1)
    fma = best(lambda: _multiply_adds(x, out, coefficients, times), 15)
    a, b, c = (np.zeros(STREAM // (50 if quick else 1)) for _ in range(3))
    _triad(a, b, c, 2.0)
    triad = best(lambda: _triad(a, b, c, 2.0), 5)
    return Roofline(
        fma_per_ns=CACHED * CHAIN * times / fma / 1e9,
        # two arrays read, one written; the read for ownership is not counted, as in STREAM
        bytes_per_ns=3 * a.nbytes / triad / 1e9,
    )
