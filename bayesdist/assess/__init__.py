"""What a solution is worth: uncertainty maps, error budget, margins against requirements."""

from bayesdist.assess.area import AreaMap, area_map
from bayesdist.assess.budget.budget import BudgetTerm, ErrorBudget
from bayesdist.assess.budget.detector import detector_budget, error_budget
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.error_model import ErrorModel, error_model
from bayesdist.assess.maps import UncertaintyMap, uncertainty_map
from bayesdist.assess.mosaic import chip_places
from bayesdist.assess.requirements.margins import Margin, Requirement, check_requirements
from bayesdist.assess.solution import Solution
from bayesdist.assess.statistics import STATISTICS, field_statistic
from bayesdist.assess.terms.given import TERM_KINDS, UserTerm
from bayesdist.assess.terms.local import LocalErrors
from bayesdist.assess.units import UNITS, convert, pixel_scale_of
from bayesdist.assess.vectors import VectorMap, distortion_vectors
from bayesdist.diagnose.alignment import Alignment, alignment_residuals
from bayesdist.diagnose.residuals.binned import (
    BinnedResiduals,
    BinnedSums,
    binned_residuals,
    binned_sums,
    residual_statistics,
)
from bayesdist.diagnose.residuals.misfit import Misfit, misfit_of, partitions_for, worst_misfit
from bayesdist.diagnose.residuals.sample import SAMPLE, StarSample, star_sample
from bayesdist.diagnose.residuals.star_sums import (
    ExposureSums,
    StarSums,
    flagged_by_exposure,
    star_sums,
)
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels

__all__ = [
    "DEFAULT_GRID",
    "SAMPLE",
    "STATISTICS",
    "TERM_KINDS",
    "UNITS",
    "Alignment",
    "AreaMap",
    "BinnedResiduals",
    "BinnedSums",
    "BudgetTerm",
    "ErrorBudget",
    "ErrorModel",
    "EvaluationDomain",
    "ExposureSums",
    "LocalErrors",
    "Margin",
    "Misfit",
    "Requirement",
    "Solution",
    "StarSample",
    "StarSums",
    "UncertaintyMap",
    "UserTerm",
    "VectorMap",
    "alignment_residuals",
    "area_map",
    "binned_residuals",
    "binned_sums",
    "check_requirements",
    "chip_places",
    "convert",
    "detector_budget",
    "distortion_vectors",
    "error_budget",
    "error_model",
    "field_statistic",
    "flagged_by_exposure",
    "grid_pixels",
    "misfit_of",
    "partitions_for",
    "pixel_scale_of",
    "residual_statistics",
    "star_sample",
    "star_sums",
    "uncertainty_map",
    "worst_misfit",
]
