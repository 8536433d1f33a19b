"""Figures and the report that a person reads: the only home of matplotlib and corner."""

from bayesdist.report.area import pixel_area
from bayesdist.report.budget import budget_terms, dominating_term
from bayesdist.report.context import Check, Product, ReportInput
from bayesdist.report.corners import corner_coefficients, corner_outliers
from bayesdist.report.drawing import drawing_of, drawn, save_drawings, save_images
from bayesdist.report.figures import all_figures
from bayesdist.report.html import write_report
from bayesdist.report.margins import margins_against_limits
from bayesdist.report.residuals import residual_histogram, residuals_by_magnitude
from bayesdist.report.traces import traces
from bayesdist.report.two_hands import drawn_report, second_hand
from bayesdist.report.uncertainty import formal_uncertainty, uncertainty_radius
from bayesdist.report.vectors import residual_vectors, vector_flow

__all__ = [
    "Check",
    "Product",
    "ReportInput",
    "all_figures",
    "budget_terms",
    "corner_coefficients",
    "corner_outliers",
    "dominating_term",
    "drawing_of",
    "drawn",
    "drawn_report",
    "formal_uncertainty",
    "margins_against_limits",
    "pixel_area",
    "residual_histogram",
    "residual_vectors",
    "residuals_by_magnitude",
    "save_drawings",
    "save_images",
    "second_hand",
    "traces",
    "uncertainty_radius",
    "vector_flow",
    "write_report",
]
