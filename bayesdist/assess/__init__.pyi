"""Public names and the modules that define them; each is imported on first use."""

from .maps import (
    AreaMap as AreaMap,
    UncertaintyMap as UncertaintyMap,
    area_map as area_map,
    uncertainty_map as uncertainty_map,
)
from .budget import (
    BudgetTerm as BudgetTerm,
    ErrorBudget as ErrorBudget,
)
from .domain import (
    STATISTICS as STATISTICS,
    EvaluationDomain as EvaluationDomain,
    field_statistic as field_statistic,
)
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
from .requirements.margins import Margin as Margin
from .requirements.requirement import Requirement as Requirement
from .solution import chip_places as chip_places
from .terms.given import (
    TERM_KINDS as TERM_KINDS,
    UserTerm as UserTerm,
)
from .terms.catalogue import Catalogue as Catalogue
from .terms.correlated import LocalErrors as LocalErrors
from .units import (
    convert as convert,
    pixel_scale_of as pixel_scale_of,
)
from .vectors import (
    VectorMap as VectorMap,
    distortion_vectors as distortion_vectors,
)
