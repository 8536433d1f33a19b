"""Look-up tables from residuals: node values, their errors, and the polynomial that goes with them.

`field_table` models the nodes as a Gaussian random field, `binned_table` is the way of ACS ISR
2015-06; `fit_with_tables` runs either in turn with the polynomial fit.
"""

from bayesdist.infer.nodes.binned import binned_table, quadratic_smoother
from bayesdist.infer.nodes.field import field_table
from bayesdist.infer.nodes.fit import fit_with_tables
from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.nodes.hyperparameters import Matern
from bayesdist.infer.nodes.mixture import ResidualMixture, fit_mixture
from bayesdist.infer.nodes.pixels import (
    PixelShifts,
    corrected_matches,
    inside_chips,
    on_the_chips,
    pixel_shifts,
)
from bayesdist.infer.nodes.posterior import AxisField, TablePosterior
from bayesdist.infer.nodes.table_fit import Iteration, TableFit, held_sigma

__all__ = [
    "AxisField",
    "Iteration",
    "Matern",
    "NodeGrid",
    "PixelShifts",
    "ResidualMixture",
    "TableFit",
    "TablePosterior",
    "binned_table",
    "corrected_matches",
    "field_table",
    "fit_mixture",
    "fit_with_tables",
    "held_sigma",
    "inside_chips",
    "on_the_chips",
    "pixel_shifts",
    "quadratic_smoother",
]
