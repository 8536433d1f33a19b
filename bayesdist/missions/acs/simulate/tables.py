"""Fine-scale distortion: random look-up tables of the published size.

Sizes are the longest vectors of ACS ISR 2015-06: 0.17 px for the grid of pixels (Figure 7 and
Section 4.3.1), half of that on WFC2 (Section 4.3), and for the filters those of Figures 11-13.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import cholesky
from scipy.sparse import csr_array

from bayesdist.missions.acs.simulate.distortion import CHIPS, EPOCH0, HALF, acs_solution
from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import mesh
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float

STEP = 64.0
SHAPE = (32, 64)  # nodes along y and x
ORDER = 5  # the tables are orthogonal to polynomials of this order
FINE = 16.0  # pixels between the points of integrals over the chip

DETECTOR_LONGEST = {1: 0.17, 2: 0.085}
DETECTOR_LENGTH = 200.0
COLUMNS = 4096 / 60  # "every 68th column": 60 equal strips of the mask
COLUMN_AMPLITUDE = 0.1  # of the longest vector

# Figures 12, 13, 11; F814W is not shown, and has the largest value for filters in the text
FILTER_LONGEST = {"F435W": 0.062, "F475W": 0.08, "F606W": 0.032, "F814W": 0.05}
FILTER_LENGTH = 150.0  # "spatially coherent over ~150 pixels", Section 4.3.2


def _nodes() -> tuple[Float, Float]:
    """Pixels of all nodes, (ny nx,) each."""
    x = (STEP + 1) / 2 + STEP * np.arange(SHAPE[1], dtype=float)
    y = (STEP + 1) / 2 + STEP * np.arange(SHAPE[0], dtype=float)
    return mesh(x, y)


@lru_cache(maxsize=2)
def _factor(length: float) -> Float:
    """Cholesky factor of the Matern 3/2 correlation between nodes."""
    x, y = _nodes()
    d = np.sqrt(3.0) * np.hypot(x[:, None] - x, y[:, None] - y) / length
    return np.asarray(cholesky((1.0 + d) * np.exp(-d), lower=True, check_finite=False))


@lru_cache(maxsize=2)
def _followed(chip: int) -> Float:
    """Orthonormal basis (2 nodes, 84) of the parts of a chip's table that a polynomial can follow.

    Its values at the nodes along x and y; and the nodes' parts in the integral over the chip of the
    polynomial times the displacement of u and of v, for a fit of the polynomial alone would take
    that from the table.
    """
    model, theta = acs_solution()
    basis = PolynomialBasis(ORDER, CHIPS[0].size, HALF)
    at_nodes = basis.evaluate(*_nodes())
    n, K = at_nodes.shape
    x, y = mesh(*(np.arange(0.5 + FINE / 2, size, FINE) for size in CHIPS[0].size))
    by_pixel = [
        model.predict(theta, x + dx, y + dy, epoch=EPOCH0[0], chip=chip)
        - model.predict(theta, x - dx, y - dy, epoch=EPOCH0[0], chip=chip)
        for dx, dy in ((0.5, 0.0), (0.0, 0.5))
    ]
    index, weight = LookupTable(chip, np.zeros((2, *SHAPE))).weights(x, y)
    rows = np.repeat(np.arange(len(x)), 4)
    shares = csr_array((weight.ravel(), (index.ravel(), rows)), shape=(n, len(x)))
    values = basis.evaluate(x, y) * (FINE / STEP) ** 2
    out = np.zeros((4, K, 2, n))
    for along in (0, 1):
        out[along, :, along] = at_nodes.T
        for axis in (0, 1):
            out[2 + axis, :, along] = (shares @ (values * by_pixel[along][:, [axis]])).T
    q, _ = np.linalg.qr(out.reshape(4 * K, 2 * n).T)
    return q


def _without_polynomial(values: Float, chip: int) -> Float:
    """Values at the nodes (2, nodes) less those a polynomial could follow: the truth is unique."""
    q, flat = _followed(chip), values.ravel()
    for _ in range(2):  # once more for the last digits
        flat = flat - q @ (q.T @ flat)
    return flat.reshape(values.shape)


def _table(values: Float, longest: float, chip: int, filter: str = "") -> LookupTable:
    values = _without_polynomial(values, chip)
    values = values * (longest / np.hypot(*values).max())
    return LookupTable(chip, values.reshape(2, *SHAPE), filter)


def detector_tables(rng: np.random.Generator) -> tuple[LookupTable, ...]:
    """Tables of the grid of pixels, one for each chip.

    A smooth random field, and along x the saw-tooth of a mask that was stepped over the columns.
    Nodes 64 pixels apart see the saw-tooth of 68 pixels as a slow beat.  Free of polynomials up to
    order 5: the sum over the nodes of value times polynomial is 0, and a fit of polynomials to
    evenly spread stars finds nothing in u and v.
    """
    x, _ = _nodes()
    out = []
    for chip in CHIPS:
        values = (_factor(DETECTOR_LENGTH) @ rng.standard_normal((x.size, 2))).T
        saw = 2.0 * ((x / COLUMNS + rng.uniform()) % 1.0) - 1.0
        values[0] += COLUMN_AMPLITUDE * np.hypot(*values).max() * saw
        out.append(_table(values, DETECTOR_LONGEST[chip.number], chip.number))
    return tuple(out)


def filter_tables(filter: str, rng: np.random.Generator) -> tuple[LookupTable, ...]:
    """Tables of a filter, one for each chip, as smooth and as free of polynomials."""
    n = SHAPE[0] * SHAPE[1]
    fields = [(_factor(FILTER_LENGTH) @ rng.standard_normal((n, 2))).T for _ in CHIPS]
    longest = [
        np.hypot(*_without_polynomial(field, chip.number)).max()
        for chip, field in zip(CHIPS, fields, strict=True)
    ]
    return tuple(
        _table(field, FILTER_LONGEST[filter] * length / max(longest), chip.number, filter)
        for chip, field, length in zip(CHIPS, fields, longest, strict=True)
    )
