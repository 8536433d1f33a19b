"""Public names and the modules that define them; each is imported on first use."""

from .app.calibrations import read_calibration as read_calibration
from .app.run import Run as Run
from .app.runs import (
    open_run as open_run,
    run as run,
)
from .assess import (
    Catalogue as Catalogue,
    ErrorBudget as ErrorBudget,
    Margin as Margin,
    Requirement as Requirement,
    UncertaintyMap as UncertaintyMap,
    UserTerm as UserTerm,
    check_requirements as check_requirements,
    error_budget as error_budget,
    uncertainty_map as uncertainty_map,
)
from .calibration.calibration import Calibration as Calibration
from .data import (
    Matches as Matches,
    ReferenceCatalog as ReferenceCatalog,
    match as match,
    match_table as match_table,
    open_matches as open_matches,
    read_catalog as read_catalog,
    read_matches as read_matches,
)
from .diagnose.diagnostics import (
    Diagnostics as Diagnostics,
    diagnose as diagnose,
)
from .errors import (
    BayesdistError as BayesdistError,
    InputError as InputError,
)
from .infer import (
    Compute as Compute,
    LinearFit as LinearFit,
    OutlierMixture as OutlierMixture,
    Posterior as Posterior,
    Rejection as Rejection,
    build_model as build_model,
    fit_by_magnitude as fit_by_magnitude,
    fit_linear as fit_linear,
    load_posterior as load_posterior,
    memberships as memberships,
    residuals as residuals,
    sample as sample,
    save_posterior as save_posterior,
)
from .kinds.matches.calibrate import calibrate as calibrate
from .model import (
    Chip as Chip,
    DistortionModel as DistortionModel,
    LookupTable as LookupTable,
    TimeDependence as TimeDependence,
)
from .simulate import simulate_matches as simulate_matches
from .version import __version__ as __version__
