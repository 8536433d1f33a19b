"""An honest covariance where stars err together, measured from cells of the detector."""

from bayesdist.infer.robust.cells import Cells, recommended_cells
from bayesdist.infer.robust.covariance import robust_covariance
from bayesdist.infer.robust.result import RobustCovariance
from bayesdist.infer.robust.size import by_fitting_cells

__all__ = [
    "Cells",
    "RobustCovariance",
    "by_fitting_cells",
    "recommended_cells",
    "robust_covariance",
]
