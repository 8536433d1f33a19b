"""Classes, readers and writers of individual file formats for calibrations and star lists.

`bayesdist.read_calibration` and `bayesdist.Calibration.write` support all formats in the same way.
The names in this module give access to everything that a file of one format contains::

    from bayesdist.formats import read_idctab
    table = read_idctab("acs_wfc_idc.fits")

Each subpackage or module holds one format and imports none of the others.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
