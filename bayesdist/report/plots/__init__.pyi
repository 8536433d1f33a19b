"""Public plot functions and the modules that define them; each is imported on first use."""

from .errors import (
    plot_budget as plot_budget,
    plot_margins as plot_margins,
    plot_validity as plot_validity,
)
from .maps import (
    plot_distortion as plot_distortion,
    plot_map as plot_map,
)
from .posterior import (
    plot_corner as plot_corner,
    plot_correlations as plot_correlations,
    plot_ranks as plot_ranks,
)
from .residuals import (
    plot_residual_density as plot_residual_density,
    plot_residual_histogram as plot_residual_histogram,
    plot_residual_vectors as plot_residual_vectors,
)
from .trends import (
    plot_exposures as plot_exposures,
    plot_residual_means as plot_residual_means,
)
