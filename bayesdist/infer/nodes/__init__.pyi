"""Public names and the modules that define them; each module is imported on first use."""

from .field import (
    binned_table as binned_table,
    field_table as field_table,
    quadratic_smoother as quadratic_smoother,
)
from .fit import (
    Iteration as Iteration,
    TableFit as TableFit,
    fit_with_tables as fit_with_tables,
    held_sigma as held_sigma,
)
from .grid import NodeGrid as NodeGrid
from .posterior import (
    AxisField as AxisField,
    Matern as Matern,
    TablePosterior as TablePosterior,
)
from .residuals import (
    PixelShifts as PixelShifts,
    ResidualMixture as ResidualMixture,
    corrected_matches as corrected_matches,
    fit_mixture as fit_mixture,
    inside_chips as inside_chips,
    on_the_chips as on_the_chips,
    pixel_shifts as pixel_shifts,
)
