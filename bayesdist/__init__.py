"""bayesdist: how well is the geometric distortion of a detector known?

Everything public is here and is loaded when it is first used::

    import bayesdist as bd
    matches = bd.read_matches("stars.ecsv")
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bayesdist.lazy import lazy_name
from bayesdist.version import __version__

_HOMES = {
    "bayesdist.errors": ("BayesdistError", "InputError"),
    "bayesdist.data": (
        "Matches",
        "ReferenceCatalog",
        "match_table",
        "open_matches",
        "read_catalog",
        "read_hst1pass",
        "read_matches",
        "read_matchup",
        "write_partitioned",
    ),
    "bayesdist.model": (
        "Chip",
        "DistortionModel",
        "LookupTable",
        "PolynomialBasis",
        "TimeDependence",
    ),
    "bayesdist.infer": (
        "Compute",
        "LinearFit",
        "OutlierMixture",
        "Posterior",
        "Rejection",
        "build_model",
        "fit_by_magnitude",
        "fit_linear",
        "load_posterior",
        "memberships",
        "residuals",
        "sample",
        "save_posterior",
    ),
    "bayesdist.simulate": ("simulate_matches", "simulate_partitioned"),
    "bayesdist.missions.wise.pairs.read": ("read_rvb",),
    "bayesdist.missions.wise.simulate": (
        "simulate_wise",
        "simulate_wise_partitioned",
        "wise_solution",
    ),
    "bayesdist.assess": (
        "ErrorBudget",
        "Margin",
        "Requirement",
        "UncertaintyMap",
        "UserTerm",
        "check_requirements",
        "error_budget",
        "uncertainty_map",
    ),
    "bayesdist.products": (
        "IdcTab",
        "SipHeader",
        "idctab_from_solution",
        "read_d2im",
        "read_idctab",
        "read_npol",
        "read_sip",
        "sip_from_solution",
        "write_d2im",
        "write_idctab",
        "write_npol",
        "write_sip",
    ),
    "bayesdist.app.commands.on_files.sky": ("apply_to_sky",),
    "bayesdist.app.run": ("run",),
}

__all__ = ["__version__", *sorted(name for names in _HOMES.values() for name in names)]


def __getattr__(name: str) -> Any:
    return lazy_name(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if TYPE_CHECKING:
    from bayesdist.app.commands.on_files.sky import apply_to_sky as apply_to_sky
    from bayesdist.app.run import run as run
    from bayesdist.assess import check_requirements as check_requirements
    from bayesdist.assess import error_budget as error_budget
    from bayesdist.assess import uncertainty_map as uncertainty_map
    from bayesdist.data import open_matches as open_matches
    from bayesdist.data import read_matches as read_matches
    from bayesdist.infer import fit_linear as fit_linear
    from bayesdist.infer import load_posterior as load_posterior
    from bayesdist.infer import sample as sample
    from bayesdist.products import read_idctab as read_idctab
    from bayesdist.products import read_sip as read_sip
    from bayesdist.products import write_idctab as write_idctab
    from bayesdist.products import write_sip as write_sip
    from bayesdist.simulate import simulate_matches as simulate_matches
