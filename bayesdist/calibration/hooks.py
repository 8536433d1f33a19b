"""Functions behind methods of `Calibration` that lie in modules which import it.

A calibration is written by formats, which are built on it.  Methods load these functions by name
when they are called; this is the only place where a lower layer names an upper one.
"""

WRITE = "bayesdist.products.writing:write_calibration"
TO_SKY = "bayesdist.calibration.sky_table:table_on_sky"
WCS = "bayesdist.calibration.wcs:wcs_of_chip"
SIP = "bayesdist.products.formats.sip.build:sip_wcs"
