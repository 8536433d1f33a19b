"""An honest covariance where stars err together, measured from cells of the detector."""

from bayesdist.infer.robust.cells import Cells, recommended_cells
from bayesdist.infer.robust.covariance import robust_covariance
from bayesdist.infer.robust.result import RobustCovariance

__all__ = ["Cells", "RobustCovariance", "recommended_cells", "robust_covariance"]
