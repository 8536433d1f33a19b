"""Tables and diagrams of several bands beside each other."""

from bayesdist.report.bands.context import BandResult, BandsInput, Printed
from bayesdist.report.bands.figures import band_figures
from bayesdist.report.bands.page import render_bands, write_bands

__all__ = [
    "BandResult",
    "BandsInput",
    "Printed",
    "band_figures",
    "render_bands",
    "write_bands",
]
