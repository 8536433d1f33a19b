"""What a solution is worth: uncertainty maps, error budget, margins against requirements."""

from bayesdist.assess.area import AreaMap, area_map
from bayesdist.assess.budget import BudgetTerm, ErrorBudget, error_budget
from bayesdist.assess.fields import ErrorFields, error_fields
from bayesdist.assess.grid import DEFAULT_GRID, grid_pixels
from bayesdist.assess.maps import UncertaintyMap, uncertainty_map
from bayesdist.assess.misfit import Misfit, misfit_of
from bayesdist.assess.requirements import Margin, Requirement, check_requirements
from bayesdist.assess.residuals import BinnedResiduals, binned_residuals, residual_statistics
from bayesdist.assess.solution import Solution
from bayesdist.assess.statistics import STATISTICS, field_statistic
from bayesdist.assess.terms import TERM_KINDS, UserTerm
from bayesdist.assess.units import UNITS, convert, pixel_scale_of
from bayesdist.assess.vectors import VectorMap, distortion_vectors

__all__ = [
    "DEFAULT_GRID",
    "STATISTICS",
    "TERM_KINDS",
    "UNITS",
    "AreaMap",
    "BinnedResiduals",
    "BudgetTerm",
    "ErrorBudget",
    "ErrorFields",
    "Margin",
    "Misfit",
    "Requirement",
    "Solution",
    "UncertaintyMap",
    "UserTerm",
    "VectorMap",
    "area_map",
    "binned_residuals",
    "check_requirements",
    "convert",
    "distortion_vectors",
    "error_budget",
    "error_fields",
    "field_statistic",
    "grid_pixels",
    "misfit_of",
    "pixel_scale_of",
    "residual_statistics",
    "uncertainty_map",
]
