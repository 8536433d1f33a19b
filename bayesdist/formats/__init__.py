"""Classes, readers and writers of individual file formats for calibrations and star lists.

`bayesdist.read_calibration` and `bayesdist.Calibration.write` support all formats in the same way.
The names in this module give access to everything that a file of one format contains::

    from bayesdist.formats import read_idctab
    table = read_idctab("acs_wfc_idc.fits")
"""

from bayesdist.data import read_hst1pass, read_matchup
from bayesdist.products import (
    IdcTab,
    SipHeader,
    describe,
    idctab_from_solution,
    lint,
    list_formats,
    read_d2im,
    read_idctab,
    read_npol,
    read_sip,
    sip_from_solution,
    write_d2im,
    write_idctab,
    write_npol,
    write_sip,
)

__all__ = [
    "IdcTab",
    "SipHeader",
    "describe",
    "idctab_from_solution",
    "lint",
    "list_formats",
    "read_d2im",
    "read_hst1pass",
    "read_idctab",
    "read_matchup",
    "read_npol",
    "read_sip",
    "sip_from_solution",
    "write_d2im",
    "write_idctab",
    "write_npol",
    "write_sip",
]
