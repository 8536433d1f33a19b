"""Look-up tables from residuals: node values, their errors, and the polynomial that goes with them.

`field_table` models the nodes as a Gaussian random field, `binned_table` is the way of ACS ISR
2015-06; `fit_with_tables` runs either in turn with the polynomial fit.
"""

from bayesdist.infer.nodes.alternation import Alternated, Round
from bayesdist.infer.nodes.binning import binned_table
from bayesdist.infer.nodes.field import field_table
from bayesdist.infer.nodes.grid import NodeGrid
from bayesdist.infer.nodes.matern import Matern
from bayesdist.infer.nodes.pixels import PixelShifts, pixel_jacobian, pixel_shifts
from bayesdist.infer.nodes.posterior import AxisField, TablePosterior
from bayesdist.infer.nodes.smoothing import quadratic_smoother
from bayesdist.infer.nodes.tables import TableFit, fit_with_tables

__all__ = [
    "Alternated",
    "AxisField",
    "Matern",
    "NodeGrid",
    "PixelShifts",
    "Round",
    "TableFit",
    "TablePosterior",
    "binned_table",
    "field_table",
    "fit_with_tables",
    "pixel_jacobian",
    "pixel_shifts",
    "quadratic_smoother",
]
