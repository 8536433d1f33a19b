"""Functions that implement methods of `Calibration` in modules of higher layers.

These modules import `Calibration`, so that it cannot import them.  Its methods import the functions
by name when they are called.  No other module of a lower layer refers to a higher one.
"""

WRITE = "bayesdist.products.writing:write_calibration"
TO_SKY = "bayesdist.calibration.sky_table:table_on_sky"
WCS = "bayesdist.calibration.wcs:wcs_of_chip"
FITS_WCS = "bayesdist.products.registry:fits_wcs"
