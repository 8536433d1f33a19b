"""Names of the package, each with the module where it is at home; loaded when first used."""

from .app.commands.on_files.sky import apply_to_sky as apply_to_sky
from .app.calibrate import calibrate as calibrate
from .app.run import (
    Run as Run,
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
from .data import (
    Matches as Matches,
    ReferenceCatalog as ReferenceCatalog,
    match as match,
    match_table as match_table,
    open_matches as open_matches,
    read_catalog as read_catalog,
    read_hst1pass as read_hst1pass,
    read_matches as read_matches,
    read_matchup as read_matchup,
    write_partitioned as write_partitioned,
)
from .diagnose.diagnostics import diagnose as diagnose
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
from .missions.wise.pairs.read import read_rvb as read_rvb
from .missions.wise.simulate import (
    simulate_wise as simulate_wise,
    simulate_wise_partitioned as simulate_wise_partitioned,
    wise_solution as wise_solution,
)
from .model import (
    Chip as Chip,
    DistortionModel as DistortionModel,
    LookupTable as LookupTable,
    PolynomialBasis as PolynomialBasis,
    TimeDependence as TimeDependence,
)
from .products import (
    IdcTab as IdcTab,
    SipHeader as SipHeader,
    idctab_from_solution as idctab_from_solution,
    read_d2im as read_d2im,
    read_idctab as read_idctab,
    read_npol as read_npol,
    read_sip as read_sip,
    sip_from_solution as sip_from_solution,
    write_d2im as write_d2im,
    write_idctab as write_idctab,
    write_npol as write_npol,
    write_sip as write_sip,
)
from .simulate import (
    simulate_matches as simulate_matches,
    simulate_partitioned as simulate_partitioned,
)
from .version import __version__ as __version__
