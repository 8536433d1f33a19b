"""Simulated calibration campaign of ACS/WFC on 47 Tucanae, with its truth.

Input as of ACS ISR 2015-06: star lists of exposures over twelve years, a standard catalogue, a log;
and, unknown to a calibration, the distortion, tables, frames and stars behind them.
"""

from bayesdist.missions.acs.simulate.distortion import ACS_FILTERS, acs_model, acs_solution
from bayesdist.missions.acs.simulate.files import read_acs, write_acs
from bayesdist.missions.acs.simulate.making import simulate_acs
from bayesdist.missions.acs.simulate.truth import (
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
