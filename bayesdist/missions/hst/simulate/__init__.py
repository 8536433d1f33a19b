"""Simulated calibration campaign of ACS/WFC on 47 Tucanae, with its truth.

The data are like those of ACS ISR 2015-06: star lists of exposures over twelve years, a standard
catalogue and an exposure log.  The truth consists of the distortion, look-up tables, frames and
stars.
"""

from bayesdist.missions.hst.simulate.distortion import ACS_FILTERS, acs_model, acs_solution
from bayesdist.missions.hst.simulate.files import read_acs, write_acs
from bayesdist.missions.hst.simulate.making import simulate_acs
from bayesdist.missions.hst.simulate.truth import (
    LINEAR_TERMS,
    AcsCampaign,
    AcsTruth,
    DetectionTruth,
)

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
