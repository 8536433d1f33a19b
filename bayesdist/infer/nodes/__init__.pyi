"""Public names and the modules that define them; each module is imported on first use."""

from .binned import (
    binned_table as binned_table,
    quadratic_smoother as quadratic_smoother,
)
from .field import field_table as field_table
from .fit import fit_with_tables as fit_with_tables
from .grid import NodeGrid as NodeGrid
from .hyperparameters import Matern as Matern
from .mixture import (
    ResidualMixture as ResidualMixture,
    fit_mixture as fit_mixture,
)
from .pixels import (
    PixelShifts as PixelShifts,
    corrected_matches as corrected_matches,
    inside_chips as inside_chips,
    on_the_chips as on_the_chips,
    pixel_shifts as pixel_shifts,
)
from .posterior import (
    AxisField as AxisField,
    TablePosterior as TablePosterior,
)
from .table_fit import (
    Iteration as Iteration,
    TableFit as TableFit,
    held_sigma as held_sigma,
)
