"""Public names and the modules that define them; each is imported on first use."""

from .maps.area import (
    AreaMap as AreaMap,
    area_map as area_map,
)
from .budget.budget import (
    BudgetTerm as BudgetTerm,
    ErrorBudget as ErrorBudget,
)
from .domain import EvaluationDomain as EvaluationDomain
from .model import (
    ErrorModel as ErrorModel,
    error_model as error_model,
)
from .assessment import (
    check_requirements as check_requirements,
    error_budget as error_budget,
)
from .evaluation import (
    Evaluation as Evaluation,
    EvaluationSettings as EvaluationSettings,
    evaluate as evaluate,
)
from .maps.uncertainty import (
    UncertaintyMap as UncertaintyMap,
    uncertainty_map as uncertainty_map,
)
from .requirements.margins import (
    Margin as Margin,
    Requirement as Requirement,
)
from .solution import chip_places as chip_places
from .statistics import (
    STATISTICS as STATISTICS,
    field_statistic as field_statistic,
)
from .terms.given import (
    TERM_KINDS as TERM_KINDS,
    Catalogue as Catalogue,
    UserTerm as UserTerm,
)
from .terms.local import LocalErrors as LocalErrors
from .units import (
    UNITS as UNITS,
    convert as convert,
    pixel_scale_of as pixel_scale_of,
)
from .vectors import (
    VectorMap as VectorMap,
    distortion_vectors as distortion_vectors,
)
