"""Statistics of errors over places, for all draws: in blocks, which threads share."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.statistics import extent, field_statistic

__all__ = ["ErrorsOf", "drawn_statistics"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]
# the errors (rows, N, 2) of some draws, from standard normal ones of that shape for what is
# independent from place to place
ErrorsOf = Callable[[slice, Float], Float]

ROWS = 16  # draws whose noise comes from one generator: so that blocks do not change it


def drawn_statistics(
    errors: Sequence[ErrorsOf],
    names: Sequence[str],
    *,
    n_draws: int,
    n_places: int,
    block: int,
    seed: int,
    pairs: Int | None = None,
    over_all: bool = False,
) -> tuple[dict[str, Float], ...]:
    """Statistics of each draw's errors, of several errors with the same noise.

    `names`: of `STATISTICS`. `block`: places times draws that a thread holds at once. `seed`: of
    the noise. `pairs`: (2, P), pairs of places whose differences are judged; places themselves by
    default. `over_all`: True if largest differences are those of all places, not of `pairs`.
    Returns (n_draws,), one for each of the errors.
    """
    width = max(n_places, 0 if pairs is None else pairs.shape[1])
    step = ROWS * max(1, block // (ROWS * width))

    def one(name: str, error: Float, seen: Float) -> Float:
        if over_all and name.endswith("max"):
            return extent(name, error)
        return field_statistic(name, seen)

    def found(start: int) -> list[list[Float]]:
        rows = slice(start, min(start + step, n_draws))
        noise, out = _noise(seed, rows, n_places), []
        for error_of in errors:
            error = error_of(rows, noise)
            seen = error if pairs is None else error[:, pairs[0]] - error[:, pairs[1]]
            out.append([one(name, error, seen) for name in names])
        return out

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        blocks = list(pool.map(found, range(0, n_draws, step)))
    return tuple(
        {name: np.concatenate([b[e][k] for b in blocks]) for k, name in enumerate(names)}
        for e in range(len(errors))
    )


def _noise(seed: int, rows: slice, n_places: int) -> Float:
    """Standard normal numbers (rows, N, 2), those of a draw the same in any block."""
    shape = ROWS, n_places, 2
    starts = range(rows.start, rows.stop, ROWS)
    out = [np.random.default_rng((seed, k)).standard_normal(shape) for k in starts]
    return np.concatenate(out)[: rows.stop - rows.start]
