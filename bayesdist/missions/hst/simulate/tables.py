"""Simulated fine-scale distortion: random look-up tables of the published amplitudes.

The longest vectors are those of ACS ISR 2015-06: 0.17 px for the pixel grid of WFC1 (Figure 7 and
Section 4.3.1), half of this for WFC2 (Section 4.3), and the values of Figures 11-13 for the
filters.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import cholesky
from scipy.sparse import csr_array

from bayesdist.missions.hst.simulate.distortion import CHIPS, EPOCH0, HALF, acs_solution
from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import mesh
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Float

STEP = 64.0
SHAPE = (32, 64)  # nodes along y and x
ORDER = 5  # the tables are orthogonal to polynomials of this order
FINE = 16.0  # pixels between the points for integrals over the chip
DETECTOR_LONGEST = {1: 0.17, 2: 0.085}  # longest vector by chip, pixels
DETECTOR_LENGTH = 200.0  # correlation length, pixels
COLUMNS = 4096 / 60  # "every 68th column": 60 equal strips of the mask
COLUMN_AMPLITUDE = 0.1  # relative to the longest vector
# longest vector in pixels, from Figures 12, 13 and 11; for F814W, which is not shown, it is the
# largest value for filters in the text
FILTER_LONGEST = {"F435W": 0.062, "F475W": 0.08, "F606W": 0.032, "F814W": 0.05}
FILTER_LENGTH = 150.0  # "spatially coherent over ~150 pixels", Section 4.3.2


def _nodes() -> tuple[Float, Float]:
    """Pixels x and y (ny nx,) of all nodes."""
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
    """Orthonormal basis (2 nodes, 84) of the parts of a table that polynomials can absorb.

    It spans the values of polynomials at the nodes, for shifts along x and y, and the weights of
    the nodes in the integrals over the chip of polynomials times the displacement of u and of v.
    A fit of polynomials without tables would absorb these parts.
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
    node_weights = csr_array((weight.ravel(), (index.ravel(), rows)), shape=(n, len(x)))
    values = basis.evaluate(x, y) * (FINE / STEP) ** 2
    out = np.zeros((4, K, 2, n))
    for along in (0, 1):
        out[along, :, along] = at_nodes.T
        for axis in (0, 1):
            out[2 + axis, :, along] = (node_weights @ (values * by_pixel[along][:, [axis]])).T
    q, _ = np.linalg.qr(out.reshape(4 * K, 2 * n).T)
    return q


def _without_polynomial(values: Float, chip: int) -> Float:
    """Values (2, nodes) without the parts that polynomials can absorb, so that they are unique."""
    q, flat = _followed(chip), values.ravel()
    for _ in range(2):  # the second pass removes rounding errors
        flat = flat - q @ (q.T @ flat)
    return flat.reshape(values.shape)


def _table(values: Float, longest: float, chip: int, filter: str = "") -> LookupTable:
    values = _without_polynomial(values, chip)
    values = values * (longest / np.hypot(*values).max())
    return LookupTable(chip, values.reshape(2, *SHAPE), filter)


def detector_tables(rng: np.random.Generator) -> tuple[LookupTable, ...]:
    """Detector tables (irregularities of the pixel grid), one per chip.

    Each is the sum of a smooth random field and, along x, a saw-tooth due to a mask that was
    stepped over the columns.  The nodes are 64 pixels apart and sample the saw-tooth of 68 pixels
    as a slow beat.  The tables are orthogonal to polynomials up to order 5: the sum over the nodes
    of value times polynomial is 0, and so is a polynomial fitted to uniformly distributed stars.
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
    """Filter tables, one per chip: smooth random fields that are orthogonal to polynomials."""
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
