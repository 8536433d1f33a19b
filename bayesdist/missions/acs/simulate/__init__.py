"""The ACS/WFC calibration campaign on 47 Tucanae, of known truth.

What ACS ISR 2015-06 had before it, and what it could not know: star lists of exposures over twelve
years, a standard catalogue, a log; and the distortion, tables, frames and stars they came from.
"""

from bayesdist.missions.acs.simulate.campaign import AcsCampaign
from bayesdist.missions.acs.simulate.distortion import ACS_FILTERS, acs_model, acs_solution
from bayesdist.missions.acs.simulate.files import read_acs, write_acs
from bayesdist.missions.acs.simulate.making import simulate_acs
from bayesdist.missions.acs.simulate.truth import LINEAR_TERMS, AcsTruth, DetectionTruth

__all__ = [
    "ACS_FILTERS",
    "LINEAR_TERMS",
    "AcsCampaign",
    "AcsTruth",
    "DetectionTruth",
    "acs_model",
    "acs_solution",
    "read_acs",
    "simulate_acs",
    "write_acs",
]
