"""Functions behind methods of `Calibration` that lie in modules which import it.

Methods load these functions by name when they are called; this is the only place where a lower
layer names an upper one.
"""

WCS = "bayesdist.calibration.wcs:wcs_of_chip"
SIP = "bayesdist.products.formats.sip.build:sip_wcs"
