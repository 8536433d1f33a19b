"""Assessment of a solution: uncertainty maps, error budget, margins against requirements."""

from __future__ import annotations

from typing import Any

from bayesdist.lazy import lazy_name

_HOMES = {
    "bayesdist.assess.area": ("AreaMap", "area_map"),
    "bayesdist.assess.budget.budget": ("BudgetTerm", "ErrorBudget"),
    "bayesdist.assess.domain": ("EvaluationDomain",),
    "bayesdist.assess.error_model": ("ErrorModel", "error_budget", "error_model"),
    "bayesdist.assess.evaluation": ("Evaluation", "EvaluationSettings", "evaluate"),
    "bayesdist.assess.maps": ("UncertaintyMap", "uncertainty_map"),
    "bayesdist.assess.solution": ("chip_places",),
    "bayesdist.assess.requirements.margins": ("Margin", "Requirement", "check_requirements"),
    "bayesdist.assess.statistics": ("STATISTICS", "field_statistic"),
    "bayesdist.assess.terms.given": ("TERM_KINDS", "UserTerm"),
    "bayesdist.assess.terms.local": ("LocalErrors",),
    "bayesdist.assess.units": ("UNITS", "convert", "pixel_scale_of"),
    "bayesdist.assess.vectors": ("VectorMap", "distortion_vectors"),
}

__all__ = sorted(name for names in _HOMES.values() for name in names)


def __getattr__(name: str) -> Any:
    return lazy_name(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
