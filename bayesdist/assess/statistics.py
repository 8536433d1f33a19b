"""Statistics that turn an error field into one number, for all draws in blocks."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import numpy as np

from bayesdist.arrays import Float, Int
from bayesdist.errors import require_known
from bayesdist.infer.equations.scaled import one_thread

_PERCENTILES = {"p50": 50.0, "p68": 68.0, "p90": 90.0, "p95": 95.0, "p99": 99.0}
_DIRECTIONS = 64  # over half a turn
_BASE = ("max", "rms", "mean", *_PERCENTILES)

STATISTICS = (*_BASE, *(f"u_{s}" for s in _BASE), *(f"v_{s}" for s in _BASE))


ROWS = 16  # draws whose noise comes from one generator: so that blocks do not change it


class ErrorsOf(Protocol):
    """Errors of all draws at N positions."""

    @property
    def noisy(self) -> bool:
        """True if some are independent from position to position."""
        ...

    def __call__(self, rows: slice, normal: Float) -> Float:
        """Errors (d, N, 2) of some draws, given as many normal numbers for the noise."""
        ...


def field_statistic(name: str, error: Float) -> Float:
    """A statistic over the points of error fields.

    Parameters
    ----------
    name : str
        One of `STATISTICS`: of the radial error, or with the prefix ``u_`` or ``v_`` of the
        absolute error of one axis.
    error : ndarray, shape (..., N, 2)

    Returns
    -------
    ndarray, shape (...)

    Raises
    ------
    InputError
        For an unknown statistic.
    """
    require_known(name, STATISTICS, "statistic")
    axis, _, base = name.rpartition("_")
    return _of_sizes(base, _sizes(axis, error))


def _sizes(axis: str, error: Float) -> Float:
    """Absolute errors (..., N) of an axis, or radial ones where none is named."""
    if axis:
        return np.abs(error[..., "uv".index(axis)])
    return np.sqrt(error[..., 0] ** 2 + error[..., 1] ** 2)  # a fifth of the time of `hypot`


def _of_sizes(base: str, size: Float) -> Float:
    """A statistic of `_BASE` over the last axis."""
    if base == "max":
        return size.max(axis=-1)
    if base == "mean":
        return size.mean(axis=-1)
    if base == "rms":
        return np.sqrt(np.mean(size**2, axis=-1))
    return np.percentile(size, _PERCENTILES[base], axis=-1)


def extent(name: str, error: Float) -> Float:
    """Largest difference between the errors at any two points.

    `name`: one of 'max', 'u_max', 'v_max'. `error`: (..., N, 2). Returns (...), of both axes the
    largest extent along any of 64 directions, which falls short of the largest distance by 0.03 %
    at most.
    """
    axis = name.removesuffix("max").rstrip("_")
    if axis:
        return np.ptp(error[..., "uv".index(axis)], axis=-1)
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    along = (np.ptp(error @ [np.cos(a), np.sin(a)], axis=-1) for a in angles)
    return functools.reduce(np.maximum, along)


@one_thread  # of each thread that it starts
def drawn_statistics(
    errors: Sequence[ErrorsOf],
    names: Sequence[str],
    *,
    n_draws: int,
    n_positions: int,
    block: int,
    seed: int,
    pairs: Int | None = None,
    over_all: bool = False,
) -> tuple[dict[str, Float], ...]:
    """Statistics of each draw's errors, of several errors with the same noise.

    `names`: of `STATISTICS`. `block`: positions times draws that a thread holds at once. `seed`: of
    the noise. `pairs`: (2, P), pairs of positions whose differences are judged; the positions by
    default. `over_all`: True if largest differences are those of all positions, not of `pairs`.
    Returns (n_draws,), one for each of the errors.
    """
    width = max(n_positions, 0 if pairs is None else pairs.shape[1])
    step = ROWS * max(1, block // (ROWS * width))

    noisy = any(error_of.noisy for error_of in errors)
    by_axis = [tuple(name.rpartition("_")[::2]) for name in names]

    def found(start: int) -> list[list[Float]]:
        rows, out = slice(start, min(start + step, n_draws)), []
        noise = _noise(seed, rows, n_positions) if noisy else np.zeros(1)
        for error_of in errors:
            error = error_of(rows, noise)
            seen = error if pairs is None else error[:, pairs[0]] - error[:, pairs[1]]
            sizes = {axis: _sizes(axis, seen) for axis, _ in by_axis}
            out.append(
                [
                    extent(name, error)
                    if over_all and base == "max"
                    else _of_sizes(base, sizes[axis])
                    for name, (axis, base) in zip(names, by_axis, strict=True)
                ]
            )
        return out

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        blocks = list(pool.map(found, range(0, n_draws, step)))
    return tuple(
        {name: np.concatenate([b[e][k] for b in blocks]) for k, name in enumerate(names)}
        for e in range(len(errors))
    )


def _noise(seed: int, rows: slice, n_positions: int) -> Float:
    """Standard normal numbers (rows, N, 2), those of a draw the same in any block."""
    shape = ROWS, n_positions, 2
    starts = range(rows.start, rows.stop, ROWS)
    out = [np.random.default_rng((seed, k)).standard_normal(shape) for k in starts]
    return np.concatenate(out)[: rows.stop - rows.start]
