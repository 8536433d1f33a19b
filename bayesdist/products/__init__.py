"""Calibration files that pipelines read, each with its uncertainty: written, read, and checked."""

from bayesdist.products.application import (
    Application,
    OutputFrame,
    Positions,
    frame_that_holds,
)
from bayesdist.products.application_inverse import InversePolynomial, fitted_inverse
from bayesdist.products.chips_in_frame import chips_of_idctab, chips_of_solution
from bayesdist.products.d2im import read_d2im, write_d2im
from bayesdist.products.formats.common.document import Finding
from bayesdist.products.idctab import IdcTab, read_idctab, write_idctab
from bayesdist.products.idctab_build import idctab_from_solution
from bayesdist.products.idctab_lint import lint_idctab
from bayesdist.products.inspect import describe, describe_idctab, describe_lookup_file
from bayesdist.products.lookup_file import LookupFile, read_lookup_file, write_lookup_file
from bayesdist.products.lookup_lint import lint_lookup_file
from bayesdist.products.npol import read_npol, write_npol
from bayesdist.products.orientation import Orientation
from bayesdist.products.orientation_aperture import orientation_from_aperture
from bayesdist.products.orientation_idctab import orientation_from_idctab
from bayesdist.products.oriented import Oriented, oriented
from bayesdist.products.pam import PixelAreaMap, pixel_area_map, write_pam
from bayesdist.products.release import Period, Release, write_release
from bayesdist.products.siaf import Aperture, read_aperture
from bayesdist.products.sip import SipHeader
from bayesdist.products.sip_build import sip_from_solution
from bayesdist.products.sip_implied import Implied, implied_values
from bayesdist.products.sip_inverse import worst_closure
from bayesdist.products.sip_lint import lint_sip
from bayesdist.products.sip_read import read_sip
from bayesdist.products.sip_rotate import (
    coefficient_map,
    pixel_matrix,
    rotated_sip,
    rotated_solution,
)
from bayesdist.products.sip_text import describe_sip
from bayesdist.products.sip_write import sip_header, write_sip
from bayesdist.products.storable import Lost, Stored, storable
from bayesdist.products.subarray import Subarray
from bayesdist.products.wise_lint import lint_wise_band
from bayesdist.products.wise_meta import WiseBand, read_wise_meta
from bayesdist.products.wise_write import write_wise_meta

__all__ = [
    "Aperture",
    "Application",
    "Finding",
    "IdcTab",
    "Implied",
    "InversePolynomial",
    "LookupFile",
    "Lost",
    "Orientation",
    "Oriented",
    "OutputFrame",
    "Period",
    "PixelAreaMap",
    "Positions",
    "Release",
    "SipHeader",
    "Stored",
    "Subarray",
    "WiseBand",
    "chips_of_idctab",
    "chips_of_solution",
    "coefficient_map",
    "describe",
    "describe_idctab",
    "describe_lookup_file",
    "describe_sip",
    "fitted_inverse",
    "frame_that_holds",
    "idctab_from_solution",
    "implied_values",
    "lint_idctab",
    "lint_lookup_file",
    "lint_sip",
    "lint_wise_band",
    "orientation_from_aperture",
    "orientation_from_idctab",
    "oriented",
    "pixel_area_map",
    "pixel_matrix",
    "read_aperture",
    "read_d2im",
    "read_idctab",
    "read_lookup_file",
    "read_npol",
    "read_sip",
    "read_wise_meta",
    "rotated_sip",
    "rotated_solution",
    "sip_from_solution",
    "sip_header",
    "storable",
    "worst_closure",
    "write_d2im",
    "write_idctab",
    "write_lookup_file",
    "write_npol",
    "write_pam",
    "write_release",
    "write_sip",
    "write_wise_meta",
]
